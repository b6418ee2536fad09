"""Network inputs and hidden states of speech encoders, for windows of a long sound.

A front end gives the projected frames of a window that enter the encoder's layers. Everything
that depends on the whole sound (normalisation over time) is computed over the whole sound, so that
a window's frames do not depend on where the window begins.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch

from audio_features.huggingface.families import FAMILIES, front_norm
from audio_features.speech_encoders import SAMPLE_RATE

if TYPE_CHECKING:
    from audio_features.huggingface.weights import EncoderWeights

_MEL_HOP = 160
_MEL_WINDOW = 400
# Whisper's scale: (log10 + 4) / 4, at least 1e-10 and at most 8 decades below the maximum.
_SILENCE, _RANGE = -1.5, 2.0
_BLOCK_FRAMES = 500  # at once, which bounds the memory of the first convolution


class FramedSound(Protocol):
    """Frames of one sound."""

    n_frames: int
    """Frames of the whole sound."""

    def window(self, start: int, stop: int) -> torch.Tensor:
        """Return the inputs of frames [start, stop), on the network's device."""


class FrontEnd(Protocol):
    """Time base of an encoder, and the inputs of its layers.

    Frame t is centred at sample `first + t · hop` of the sound at 16 kHz.
    """

    first: float
    hop: int

    @property
    def longest(self) -> int | None:
        """Most frames that the encoder takes at once; None without a limit."""

    def sound(self, samples: torch.Tensor) -> FramedSound:
        """Prepare a sound: (N,) float32 at 16 kHz, normalised as the encoder expects.

        The samples are on the network's device.
        """


def front_end(weights: EncoderWeights, network: torch.nn.Module) -> FrontEnd:
    """Return the front end that fits the encoder."""
    inputs = FAMILIES[weights.model_type].inputs
    if inputs == "waveform":
        return Convolutions(weights.config, network)
    return (FilterBank if inputs == "filter bank" else LogMelFrames)(weights, network)


class Convolutions:
    """Convolutions over the waveform: HuBERT, wav2vec 2.0, data2vec-audio and WavLM.

    They have no padding: frame t covers the samples [t · hop, t · hop + window). Where the first
    one is normalised over time (`feat_extract_norm: group`), its mean and variance are those of
    the whole sound.

    Args:
        config: transformers' configuration.
        network: the model that has the convolutions.
    """

    longest = None

    def __init__(self, config: Any, network: torch.nn.Module) -> None:
        self._network: Any = network
        self._grouped = front_norm(config) == "group"
        self.window, self.hop = 1, 1
        for kernel, stride in zip(config.conv_kernel, config.conv_stride):
            self.window += (kernel - 1) * self.hop
            self.hop *= stride
        self.first = self.window / 2
        self._kernel, self._stride = config.conv_kernel[0], config.conv_stride[0]

    def sound(self, samples: torch.Tensor) -> _Waveform:
        """Prepare a sound; see `FrontEnd`."""
        return _Waveform(self, samples)

    def moments(self, samples: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor] | None:
        """Return mean and 1/sd (C, 1) of the first convolution over the sound (N,), if needed."""
        if not self._grouped:
            return None
        layer = self._network.feature_extractor.conv_layers[0]
        count = (len(samples) - self._kernel) // self._stride + 1
        block = _BLOCK_FRAMES * self.hop // self._stride
        total, squares = 0.0, 0.0
        for at in range(0, count, block):
            end = min(count, at + block)
            part = samples[at * self._stride : (end - 1) * self._stride + self._kernel]
            values = layer.conv(part[None, None])[0].double()
            total = total + values.sum(-1)
            squares = squares + values.square().sum(-1)
        mean = total / count
        variance = (squares / count - mean.square()).clamp_min(0.0)
        scale = torch.rsqrt(variance + layer.layer_norm.eps)
        return mean.float()[:, None], scale.float()[:, None]

    def frames(
        self,
        samples: torch.Tensor,
        start: int,
        stop: int,
        moments: tuple[torch.Tensor, torch.Tensor] | None,
    ) -> torch.Tensor:
        """Compute the projected frames [start, stop) of a sound (N,): (stop - start, width)."""
        first, *others = self._network.feature_extractor.conv_layers
        parts = []
        for at in range(start, stop, _BLOCK_FRAMES):
            end = min(stop, at + _BLOCK_FRAMES)
            x = samples[None, None, at * self.hop : (end - 1) * self.hop + self.window]
            if moments is None:
                x = first(x)
            else:
                norm = first.layer_norm
                x = (first.conv(x) - moments[0]) * moments[1]
                x = first.activation(x * norm.weight[:, None] + norm.bias[:, None])
            for layer in others:
                x = layer(x)
            # HuBERT gives the projection alone, the others give its input as well.
            projected = self._network.feature_projection(x.transpose(1, 2))
            parts.append(projected[0] if isinstance(projected, tuple) else projected)
        return torch.cat(parts, dim=1)[0]


class _Waveform:
    def __init__(self, front: Convolutions, samples: torch.Tensor) -> None:
        self._front, self._samples = front, samples
        self.n_frames = max(0, (len(samples) - front.window) // front.hop + 1)
        self._moments = front.moments(samples) if self.n_frames else None

    def window(self, start: int, stop: int) -> torch.Tensor:
        return self._front.frames(self._samples, start, stop, self._moments)


class FilterBank:
    """Stacked frames of an 80-bin mel filter bank: w2v-BERT 2.0.

    Mel frame k covers the samples [160k, 160k + 400); `stride` of them are one frame. Each bin is
    normalised over the whole sound.
    """

    longest = None

    def __init__(self, weights: EncoderWeights, network: torch.nn.Module) -> None:
        from transformers import SeamlessM4TFeatureExtractor

        bins = weights.config.feature_projection_input_dim // weights.stride
        self._extract = SeamlessM4TFeatureExtractor(
            feature_size=bins, num_mel_bins=bins, stride=weights.stride
        )
        self._network, self._stacked = network, weights.stride
        self.hop = _MEL_HOP * weights.stride
        self.first = (_MEL_HOP * (weights.stride - 1) + _MEL_WINDOW) / 2

    def sound(self, samples: torch.Tensor) -> _Mel:
        """Prepare a sound; see `FrontEnd`."""
        n_mel = max(0, (len(samples) - _MEL_WINDOW) // _MEL_HOP + 1)
        n_frames = n_mel // self._stacked
        mel = np.empty((0, 1), np.float32)
        if n_frames:
            mel = self._extract(
                samples.cpu().numpy(), sampling_rate=SAMPLE_RATE, pad_to_multiple_of=self._stacked
            ).input_features[0][:n_frames]
        return _Mel(self._network, torch.from_numpy(np.asarray(mel, np.float32)).to(samples.device))


class _Mel:
    def __init__(self, network: torch.nn.Module, mel: torch.Tensor) -> None:
        self._network: Any = network
        self._mel, self.n_frames = mel, len(mel)

    def window(self, start: int, stop: int) -> torch.Tensor:
        return self._network.feature_projection(self._mel[None, start:stop])[0][0]


class LogMelFrames:
    """Log-mel spectrogram of Whisper, as its convolutions take it.

    Mel frame k is centred at sample 160k and every second one is the centre of a frame. The
    encoder takes windows of one length (30 s); a window holds the sound that follows its last
    frame too, and silence beyond the end. The dynamic range is limited over the whole sound.
    """

    first = 0.0
    hop = 2 * _MEL_HOP

    def __init__(self, weights: EncoderWeights, network: torch.nn.Module) -> None:
        from transformers import WhisperFeatureExtractor

        self.longest = int(weights.config.max_source_positions)
        self._extract = WhisperFeatureExtractor(feature_size=weights.config.num_mel_bins)

    def sound(self, samples: torch.Tensor) -> _LogMel:
        """Prepare a sound; see `FrontEnd`."""
        n_frames = math.ceil(len(samples) / self.hop)
        # transformers pads to the length of the window; a longer sound ends in a frame of silence,
        # as the spectrogram mirrors the sound at its end.
        n_padded = self.longest if n_frames <= self.longest else n_frames + 1
        padded = np.zeros(n_padded * self.hop, np.float32)
        padded[: len(samples)] = samples.cpu().numpy()
        mel = self._extract(
            padded, sampling_rate=SAMPLE_RATE, truncation=False, padding=False
        ).input_features[0]
        tensor = torch.from_numpy(np.asarray(mel, np.float32)).to(samples.device)
        return _LogMel(tensor, n_frames, self.longest)


class _LogMel:
    def __init__(self, mel: torch.Tensor, n_frames: int, longest: int) -> None:
        self._mel, self.n_frames, self._longest = mel, n_frames, longest
        self._silence = max(_SILENCE, float(mel.max()) - _RANGE)

    def window(self, start: int, stop: int) -> torch.Tensor:
        found = self._mel[:, 2 * start : 2 * (start + self._longest)]
        missing = 2 * self._longest - found.shape[1]
        return torch.nn.functional.pad(found, (0, missing), value=self._silence)


_ONE_AT_A_TIME = threading.Lock()  # hooks would see the layers of another thread's sound


class Layers:
    """Layers of an encoder; those above `top` are removed from the network.

    Args:
        network: a network of `read_encoder`.
        top: highest hidden state that is needed.
    """

    reach = (0, 0)
    """Frames beside a window that must be given with it."""

    def __init__(self, network: Any, top: int) -> None:
        self._whisper = hasattr(network, "conv1")
        self._encoder = network if self._whisper else network.encoder
        layers = self._encoder.layers
        self._depth = len(layers)
        # State 0 is the input of the first layer, so that one layer always remains.
        self._encoder.layers = layers[: max(1, top)]
        self._norm: Any = getattr(self._encoder, "layer_norm", None)

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
