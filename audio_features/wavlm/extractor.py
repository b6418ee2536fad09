"""WavLM: hidden states of a speech network as features."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np

from audio_features.errors import FeatureError
from audio_features.speech_encoders import (
    HiddenStateExtractor,
    LayerChoice,
    Options,
    checked_device,
)
from audio_features.wavlm.weights import HOP, WINDOW
from audio_features.weight_files import check_fingerprint

if TYPE_CHECKING:
    from audio_features.speech_encoders import Layer

_GPU_BATCH = 8


class WavLM(HiddenStateExtractor):
    """Hidden states of WavLM (Chen et al. 2022), 50 frames per second.

    Frame t covers samples [320t, 320t + 400) at 16 kHz and is centred at 0.0125 + 0.02t seconds;
    a sound of N samples has floor((N - 400)/320) + 1 frames. Values agree with transformers'
    own forward pass to a relative 1e-5.

    Sounds of up to `full_context` seconds are processed whole. In longer sounds the convolutions
    are still exact, with Base's normalisation over the whole sound. The transformer processes
    overlapping chunks of equal length; the frames within `context` seconds of a chunk's edges
    are taken from its neighbours. This bounds the memory; values differ slightly from those of
    the whole sound.

    The level of the sound is unchanged, except for the normalisation that the weights expect,
    which is applied over the whole sound.

    Args:
        weights: Hugging Face's folder, Microsoft's WavLM-*.pt or a torchaudio state dict.
        layer: index into transformers' `hidden_states` (0 is the input of the first layer, k the
            output of the k-th); layers above it are not computed. "last" is the network's
            output. Several indices are concatenated; "mean" averages all states, {6: 1, 9: 3}
            takes a weighted mean (weights are scaled to sum to 1).
        dtype: "fp32", or "bf16" for matrix products in bfloat16: faster if the processor
            supports it, with a small error.
        fingerprint: fingerprint of the weights, as in a spec; other weights are refused.
        device: "cpu" or "cuda"; not part of the spec.
        final_norm: true applies Large's final normalisation to the topmost state (Base has
            none). By default it applies to "last", as in the output of all three code bases,
            and not to a number, as in transformers 5 and torchaudio's `extract_features`.
        options: any of
            normalize: None normalises the waveform as the weights expect; False leaves it
                unchanged; a number scales it to mean 0 and variance 1, with that number added to
                the variance (Hugging Face adds 1e-7, Microsoft 1e-5).
            full_context: longest sound that is processed whole, in seconds (300).
            chunk: longest chunk of longer sounds, in seconds (30). A sound is cut into as few
                chunks as possible, all of one length.
            context: part of a chunk that is context on either side, in seconds (5).

    Raises WeightsError if the weights cannot be used, FeatureError for an invalid setting.

    Examples:
        A spec does not hold the place of the weights:

        >>> af.extractor_from_spec({"kind": "wavlm", "layer": 6})
        Traceback (most recent call last):
        audio_features.errors.WeightsError: weights of WavLM are needed: name their place
        (features.weights=PATH to train, else --weights wavlm=PATH)
    """

    stem = "wavlm"
    first, hop = WINDOW / 2, HOP

    def __init__(
        self,
        weights: str | os.PathLike[str],
        layer: Layer = "last",
        *,
        dtype: str = "fp32",
        fingerprint: str | None = None,
        device: str = "cpu",
        final_norm: bool | None = None,
        **options: Any,
    ) -> None:
        import torch

        from audio_features.wavlm.network import Encoder, FrontEnd
        from audio_features.wavlm.weights import read_weights

        kinds = {"fp32": torch.float32, "bf16": torch.bfloat16}
        if dtype not in kinds:
            raise FeatureError(f"dtype={dtype!r}: 'fp32' or 'bf16'")
        self._options = Options(**options)
        self._device = checked_device(device)
        self.weights, shape, tensors = read_weights(weights)
        check_fingerprint(weights, self.fingerprint, fingerprint)
        self.dtype = dtype
        self._choice = LayerChoice(layer, final_norm, shape.layers)
        self.normalize = self._options.eps(self.weights.normalize)
        tensors = {name: tensor.to(self._device) for name, tensor in tensors.items()}
        self._front = FrontEnd(shape, tensors, kinds[dtype])
        self._encoder = Encoder(shape, tensors, max(self._choice.indices), kinds[dtype])

    @property
    def spec(self) -> dict[str, Any]:
        """Kind, every setting that affects the values, and the weights' fingerprint."""
        return {
            "kind": "wavlm",
            "layer": self.layer,
            "final_norm": self._choice.final_norm,
            "normalize": False if self.normalize is None else self.normalize,
            **self._options.seconds,
            "dtype": self.dtype,
            "fingerprint": self.fingerprint,
        }

    def hidden_states(self, samples: np.ndarray) -> np.ndarray:
        """Compute (T, D) float32 from (N,) samples at 16 kHz, without normalising them."""
        import torch

        from audio_features.wavlm.network import SoundFrames

        n_frames = (len(samples) - WINDOW) // HOP + 1
        values = np.empty((n_frames, self.dim), dtype=np.float32)
        chunks = self._options.chunks(n_frames, HOP)
        size = 1 if self._device.type == "cpu" else _GPU_BATCH
        before, after = self._encoder.reach
        # By default a GPU would round convolutions to TF32.
        with torch.inference_mode(), torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
            sound = torch.from_numpy(np.ascontiguousarray(samples)).to(self._device)
            window = SoundFrames(self._front, sound).window
            for at in range(0, len(chunks), size):
                batch = chunks[at : at + size]
                inputs = [window(c.start - before, c.stop + after) for c, _ in batch]
                states = self._encoder.states(torch.stack(inputs))
                for (chunk, keep), picked in zip(batch, self._choice.pick(self._encoder, states)):
                    part = picked[keep.start - chunk.start : keep.stop - chunk.start]
                    values[keep] = part.cpu().numpy()
        return values
