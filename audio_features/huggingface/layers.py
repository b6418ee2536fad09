"""Hidden states of a transformers network, in the order of its `hidden_states`."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import torch

_ONE_AT_A_TIME = threading.Lock()  # hooks would see the layers of another thread's sound


class Layers:
    """Layers of an encoder; those above `top` are removed from the network.

    Args:
        network: a network of `read_encoder`.
        top: highest hidden state that is needed.
    """

    reach = (0, 0)
    """Frames beside a window that must be given with it."""

    def __init__(self, network: torch.nn.Module, top: int) -> None:
        self._whisper = hasattr(network, "conv1")
        self._encoder = network if self._whisper else network.encoder
        layers = self._encoder.layers
        self._depth = len(layers)
        # State 0 is the input of the first layer, so that one layer always remains.
        self._encoder.layers = layers[: max(1, top)]
        self._norm = getattr(self._encoder, "layer_norm", None)

    @property
    def ends_in_norm(self) -> bool:
        """True if the topmost state is normalised to give the network's output."""
        return not self._whisper and "Stable" in type(self._encoder).__name__

    def final_norm(self, x: torch.Tensor) -> torch.Tensor:
        """Apply the final normalisation to the topmost state (B, T, width)."""
        return self._norm(x)

    def states(self, x: torch.Tensor) -> Iterator[torch.Tensor]:
        """Yield the hidden states 0 to `top`, each (B, T, width), of a batch of windows.

        Whisper's topmost state is its normalised output, as in transformers.
        """
        states: list[torch.Tensor] = []

        def before(module: Any, inputs: tuple, keywords: dict) -> None:
            states.append(inputs[0] if inputs else keywords["hidden_states"])

        def after(module: Any, inputs: tuple, outputs: Any) -> None:
            states.append(outputs[0] if isinstance(outputs, tuple) else outputs)

        layers = list(self._encoder.layers)
        with _ONE_AT_A_TIME:
            hooks = [layers[0].register_forward_pre_hook(before, with_kwargs=True)]
            hooks += [layer.register_forward_hook(after) for layer in layers]
            try:
                self._encoder(x)
            finally:
                for hook in hooks:
                    hook.remove()
        if self._whisper and len(layers) == self._depth:
            states[-1] = self._norm(states[-1])
        yield from states
