"""Layer selection: the hidden states of WavLM that become features."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from audio_features.errors import FeatureError
from audio_features.wavlm.encoder import Encoder

Layer = int | str | Sequence[int] | Mapping[int | str, float]
"""Argument of `WavLM`: a number, "last", "mean", several numbers, or {number: weight}."""


@dataclass(frozen=True)
class LayerChoice:
    """Selection from hidden states 0 to `top`, concatenated or averaged.

    Args:
        layer: see `WavLM`.
        final_norm: true applies the encoder's final normalisation to the topmost state; None
            means only for "last".
        top: number of layers of the network.

    Raises FeatureError for a layer that does not exist, or contradictory settings.
    """

    layer: Layer
    final_norm: bool | None
    top: int

    def __post_init__(self) -> None:
        layer, norm = self.layer, self.final_norm
        if norm is not None and not isinstance(norm, bool):
            raise FeatureError(f"final_norm={norm!r}: true or false")
        object.__setattr__(self, "final_norm", layer == "last" if norm is None else norm)
        for index in self.indices:
            if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index <= self.top:
                raise FeatureError(
                    f"layer={layer!r}: 'last', 'mean', or whole numbers from 0 to {self.top}"
                )
        if not self.indices or len(set(self.indices)) < len(self.indices):
            raise FeatureError(f"layer={layer!r}: name each layer once, and at least one")
        if norm and self.top not in self.indices:
            raise FeatureError(
                f"layer={layer!r} with final_norm: the final normalisation belongs to layer "
                f"{self.top} alone: leave final_norm out"
            )
        if self.weights is not None and not (
            np.isfinite(self.weights).all() and abs(sum(self.weights)) > 0
        ):
            raise FeatureError(f"layer={layer!r}: the weights must be finite and not sum to 0")

    @property
    def indices(self) -> tuple[int, ...]:
        """Selected indices into transformers' `hidden_states`."""
        if self.layer == "last":
            return (self.top,)
        if self.layer == "mean":
            return tuple(range(self.top + 1))
        if isinstance(self.layer, Mapping):
            # JSON turns the keys of a spec into strings.
            return tuple(
                int(key) if isinstance(key, str) and key.isdecimal() else key for key in self.layer
            )
        if isinstance(self.layer, list | tuple):
            return tuple(self.layer)
        return (self.layer,)

    @property
    def weights(self) -> tuple[float, ...] | None:
        """One weight per state if they are averaged, else None."""
        if self.layer == "mean":
            return (1.0,) * (self.top + 1)
        if not isinstance(self.layer, Mapping):
            return None
        try:
            return tuple(float(weight) for weight in self.layer.values())
        except (TypeError, ValueError) as error:
            raise FeatureError(f"layer={self.layer!r}: a weight is not a number") from error

    @property
    def spec(self) -> int | str | list[int] | dict[str, float]:
        """Selection as a JSON-serialisable value."""
        if isinstance(self.layer, Mapping):
            return {str(i): weight for i, weight in zip(self.indices, self.weights)}
        return list(self.layer) if isinstance(self.layer, tuple) else self.layer

    @property
    def is_list(self) -> bool:
        """True if several states are concatenated; the column names then include the layer."""
        return isinstance(self.layer, list | tuple)

    def pick(self, encoder: Encoder, states: Iterable[torch.Tensor]) -> torch.Tensor:
        """Compute the features (B, T, D) from the states 0, 1, … that `encoder` yields."""
        share = dict.fromkeys(self.indices, 1.0)
        if self.weights is not None:
            share = {i: w / sum(self.weights) for i, w in zip(self.indices, self.weights)}
        picked: dict[int, torch.Tensor] = {}
        for index, state in enumerate(states):
            if index not in share:
                continue
            if index == self.top and self.final_norm and encoder.ends_in_norm:
                state = encoder.final_norm(state)
            if self.weights is None:
                picked[index] = state
            else:
                picked[0] = picked.get(0, 0.0) + share[index] * state
        if self.weights is not None or len(share) == 1:
            return next(iter(picked.values()))
        return torch.cat([picked[index] for index in self.indices], dim=-1)
