"""WavLM: hidden states of a speech network as features."""

from __future__ import annotations

import os
from collections.abc import Iterator
from functools import cached_property
from typing import Any

import numpy as np

from audio_features.errors import FeatureError
from audio_features.track import FeatureTrack
from audio_features.wave import Wave

SAMPLE_RATE = 16_000
HOP = 320
WINDOW = 400
FULL_CONTEXT_FRAMES = 3_000
"""Up to this length (60 s) the network sees the whole sound at once."""
CONTEXT_FRAMES = 100
"""What a chunk of a longer sound sees on either side of the frames it keeps (2 s)."""

_CHUNK_FRAMES = 1_200
_NORMALIZE_EPS = 1e-7  # Hugging Face's feature extractor; Microsoft's code has 1e-5


class WavLM:
    """Hidden states of WavLM (Chen et al. 2022), 50 frames per second.

    Frame t sees samples [320t, 320t + 400) at 16 kHz and is centred at 0.0125 + 0.02t seconds;
    a sound of N samples has floor((N - 400)/320) + 1 frames.

    Sounds of up to 60 s are seen whole, with the values of Hugging Face's own forward. Longer
    ones are seen in chunks of 24 s that overlap by 4 s, so that memory stays bounded (attention
    over the whole grows with the square of the length); their values differ a little from those
    of the whole, since context is cut and Base normalises its first layer over each chunk.

    The sound's level is left as it is: what the weights expect (`do_normalize`) is applied, over
    the whole sound, and nothing else.

    Args:
        weights: a local folder in Hugging Face's layout: config.json, model.safetensors (or
            pytorch_model.bin, read without unpickling objects), preprocessor_config.json.
        layer: "last" is the network's output; a number counts as transformers' `hidden_states`
            (0 is what enters the first layer, k what leaves the k-th, before the final
            normalisation that Large has). Layers above it are not computed.

    Raises WeightsError where the folder cannot be used, FeatureError for a layer it has not.
    """

    def __init__(self, weights: str | os.PathLike[str], layer: int | str = "last") -> None:
        from audio_features.wavlm.weights import normalizes_waveform, read_model

        self.weights = os.fspath(weights)
        self._model, self.fingerprint = read_model(weights)
        self._normalize = normalizes_waveform(weights)
        self.layer = layer
        self._keep_layers(layer)

    @property
    def centred(self) -> tuple[bool, ...]:
        """All columns: a clip's mean tells of voice and room."""
        return (True,) * self.dim

    @property
    def spec(self) -> dict[str, Any]:
        """{"kind": "wavlm", "layer": …, "fingerprint": …}."""
        return {"kind": "wavlm", "layer": self.layer, "fingerprint": self.fingerprint}

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the columns."""
        return tuple(f"wavlm_{i}" for i in range(self.dim))

    @property
    def dim(self) -> int:
        """Number of columns D: 768 for Base and Base+, 1024 for Large."""
        return self._model.config.hidden_size

    def extract(self, wave: Wave) -> FeatureTrack:
        """The hidden states of a sound of any rate: values (T, D)."""
        samples = wave.resample(SAMPLE_RATE).samples
        if self._normalize:
            # In float32, as Hugging Face's feature extractor: frames of near silence, which Large
            # normalises one by one, would show the rounding of anything else.
            samples = (samples - samples.mean()) / np.sqrt(samples.var() + _NORMALIZE_EPS)
        n_frames = (len(samples) - WINDOW) // HOP + 1
        if n_frames <= FULL_CONTEXT_FRAMES:
            values = self._forward(samples)
        else:
            values = np.empty((n_frames, self.dim), dtype=np.float32)
            for keep, chunk in _chunks(n_frames):
                part = self._forward(samples[chunk.start * HOP : (chunk.stop - 1) * HOP + WINDOW])
                values[keep] = part[keep.start - chunk.start : keep.stop - chunk.start]
        times = (np.arange(n_frames) * HOP + WINDOW / 2) / SAMPLE_RATE
        return FeatureTrack(values, times, self.spec, self.names)

    def _forward(self, samples: np.ndarray) -> np.ndarray:
        import torch

        with torch.inference_mode():
            return self._model(torch.from_numpy(samples)[None]).last_hidden_state[0].numpy()

    def _keep_layers(self, layer: int | str) -> None:
        """Cut the network so that its output is the hidden state asked for."""
        import torch

        if layer == "last":
            return
        encoder = self._model.encoder
        highest = len(encoder.layers)
        if isinstance(layer, bool) or not isinstance(layer, int) or not 0 <= layer <= highest:
            raise FeatureError(f"layer={layer!r}: 'last' or a whole number from 0 to {highest}")
        encoder.layers = encoder.layers[:layer]
        if self._model.config.do_stable_layer_norm:
            encoder.layer_norm = torch.nn.Identity()

    def __repr__(self) -> str:
        return f"WavLM({self.weights!r}, layer={self.layer!r})"


def _chunks(n_frames: int) -> Iterator[tuple[slice, slice]]:
    """Yield (frames kept, frames seen): chunks of one length, with context where there is any."""
    core = _CHUNK_FRAMES - 2 * CONTEXT_FRAMES
    for first in range(0, n_frames, core):
        start = min(max(0, first - CONTEXT_FRAMES), n_frames - _CHUNK_FRAMES)
        yield slice(first, min(first + core, n_frames)), slice(start, start + _CHUNK_FRAMES)
