"""WavLM: hidden states of a speech network as features."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from audio_features.errors import FeatureError
from audio_features.speech_encoders import (
    SAMPLE_RATE,
    HiddenStateExtractor,
    LayerChoice,
    Options,
    checked_device,
    normalized,
)
from audio_features.track import FeatureTrack
from audio_features.wave import Wave
from audio_features.wavlm.weights import HOP, MICROSOFT_EPS, WINDOW
from audio_features.weight_files import check_fingerprint

if TYPE_CHECKING:
    import torch

    from audio_features.huggingface.extractor import Convolutions, Layers
    from audio_features.speech_encoders import Layer
    from audio_features.wavlm.weights import Architecture

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
        implementation: "fast", or "transformers" for transformers' own network (fp32 only), which
            the fast one is tested against.
        preset: "dsg" or "dsg+", see `PRESETS`; fixes layer and options.
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

    Attributes:
        weights: description of the weights; `weights.describe()` summarises it in one line.
        normalize: number added to the waveform's variance; None if it is not normalised.

    Raises WeightsError if the weights cannot be used, FeatureError for an invalid setting.

    Examples:
        A spec does not hold the place of the weights:

        >>> af.extractor_from_spec({"kind": "wavlm", "layer": 6})
        Traceback (most recent call last):
        audio_features.errors.WeightsError: weights of WavLM are needed: name their place
        (features.weights=PATH to train, else --weights wavlm=PATH)
    """

    stem = "wavlm"

    def __init__(
        self,
        weights: str | os.PathLike[str],
        layer: Layer = "last",
        *,
        dtype: str = "fp32",
        implementation: str = "fast",
        preset: str | None = None,
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
        if implementation not in ("fast", "transformers"):
            raise FeatureError(f"implementation={implementation!r}: 'fast' or 'transformers'")
        if implementation == "transformers" and dtype != "fp32":
            raise FeatureError(f"dtype={dtype!r}: the implementation of transformers uses fp32")
        self._options = Options(**options)
        self._device = checked_device(device)
        self.weights, shape, tensors = read_weights(weights)
        check_fingerprint(weights, self.fingerprint, fingerprint)
        self.dtype, self.preset, self.implementation = dtype, preset, implementation
        self._choice = LayerChoice(layer, final_norm, shape.layers)
        self.normalize = self._options.eps(self.weights.normalize)
        if preset is not None:
            if preset not in PRESETS:
                raise FeatureError(f"preset={preset!r}: one of {', '.join(PRESETS)}")
            if layer != "last" or final_norm is not None or self._options != Options():
                raise FeatureError(
                    f"preset={preset!r} fixes layer, normalisation and chunks: leave them out"
                )
            is_normalized = preset == "dsg+" and self.weights.normalize is not None
            self.normalize = MICROSOFT_EPS if is_normalized else None
        tensors = {name: tensor.to(self._device) for name, tensor in tensors.items()}
        top = max(self._choice.indices)
        if implementation == "transformers":
            self._front: FrontEnd | Convolutions
            self._encoder: Encoder | Layers
            self._front, self._encoder = _reference(shape, tensors, top)
        else:
            self._front = FrontEnd(shape, tensors, kinds[dtype])
            self._encoder = Encoder(shape, tensors, top, kinds[dtype])

    @property
    def spec(self) -> dict[str, Any]:
        """Kind, every setting that affects the values, and the weights' fingerprint."""
        made_by: dict[str, Any] = {"kind": "wavlm"}
        if self.implementation != "fast":
            made_by["implementation"] = self.implementation
        if self.preset is not None:
            made_by["preset"] = self.preset
        else:
            made_by |= {
                "layer": self.layer,
                "final_norm": self._choice.final_norm,
                "normalize": False if self.normalize is None else self.normalize,
                **self._options.seconds,
            }
        return {**made_by, "dtype": self.dtype, "fingerprint": self.fingerprint}

    def extract(self, wave: Wave) -> FeatureTrack:
        """Extract the hidden states of a sound at any sample rate: values (T, D).

        With a preset, the frame rate is that of its motion (20 or 30 per second).
        """
        samples = normalized(wave.resample(SAMPLE_RATE).samples, self.normalize)
        if self.preset is not None:
            values, times = PRESETS[self.preset](self.hidden_states, samples)
        else:
            values = self.hidden_states(samples)
            times = (np.arange(len(values)) * HOP + WINDOW / 2) / SAMPLE_RATE
        return FeatureTrack(values, times, self.spec, self.names)

    def hidden_states(self, samples: np.ndarray) -> np.ndarray:
        """Compute (T, D) float32 from (N,) samples at 16 kHz, without normalising them."""
        import torch

        n_frames = (len(samples) - WINDOW) // HOP + 1
        values = np.empty((n_frames, self.dim), dtype=np.float32)
        chunks = self._options.chunks(n_frames, HOP)
        size = 1 if self._device.type == "cpu" else _GPU_BATCH
        before, after = self._encoder.reach
        # By default a GPU would round convolutions to TF32.
        with torch.inference_mode(), torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
            sound = torch.from_numpy(np.ascontiguousarray(samples)).to(self._device)
            window = self._front.windows(sound)[1]
            for at in range(0, len(chunks), size):
                batch = chunks[at : at + size]
                inputs = [window(c.start - before, c.stop + after) for c, _ in batch]
                states = self._encoder.states(torch.stack(inputs))
                for (chunk, keep), picked in zip(batch, self._choice.pick(self._encoder, states)):
                    part = picked[keep.start - chunk.start : keep.stop - chunk.start]
                    values[keep] = part.cpu().numpy()
        return values


HiddenStates = Callable[[np.ndarray], np.ndarray]
"""Function from samples (N,) at 16 kHz to hidden states (T, D)."""


def _dsg(hidden_states: HiddenStates, samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    fps, clip, seed = 20, 88, 8
    hop = SAMPLE_RATE // fps
    n_frames = max(1, len(samples) // hop)
    stride = clip - seed
    pieces = -(-n_frames // stride)
    padded = np.zeros((pieces * stride + seed) * hop, dtype=np.float32)
    used = samples[: pieces * stride * hop]
    padded[seed * hop : seed * hop + len(used)] = used
    values = [
        _stretched(hidden_states(padded[at * hop : (at + clip) * hop]), clip)[seed:]
        for at in range(0, pieces * stride, stride)
    ]
    return np.concatenate(values)[:n_frames], np.arange(n_frames) / fps


def _dsg_plus(hidden_states: HiddenStates, samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    fps, piece = 30, 5 * SAMPLE_RATE
    n_frames = max(1, math.floor(len(samples) * fps / SAMPLE_RATE + 0.5))
    pieces = len(samples) // piece + 1
    padded = np.zeros(pieces * piece, dtype=np.float32)
    padded[: len(samples)] = samples
    frames = [hidden_states(part) for part in padded.reshape(pieces, piece)]
    return _stretched(np.concatenate(frames), n_frames), np.arange(n_frames) / fps


def _stretched(values: np.ndarray, n_frames: int) -> np.ndarray:
    import torch

    stretched = torch.nn.functional.interpolate(
        torch.from_numpy(values.T)[None], size=n_frames, mode="linear", align_corners=True
    )
    return stretched[0].T.numpy()


PRESETS = {"dsg": _dsg, "dsg+": _dsg_plus}
"""Functions from `HiddenStates` and normalised samples (N,) to values (T, D) and times (T,).

Features as computed by DiffuseStyleGesture (Yang et al. 2023), quirks included.

Its released checkpoints need exactly these features. For anything else use `WavLM` without a
preset and `FeatureTrack.to_rate`, which aligns frames by time.

Both presets stretch the WavLM frames of a segment to its motion frames by the ratio of lengths
(`interpolate` with align_corners=True) instead of by time, and use Large's last layer.

"dsg" (ZEGGS, 20 motion frames per second)
    The sound is cut every 80 motion frames. Each clip is processed with the 8 motion frames
    before it (zeros before the first), 4.4 s in all, and its 219 WavLM frames are stretched to
    88. The waveform is not normalised, although Large was trained on normalised sound
    (YoungSeng/DiffuseStyleGesture issue 23). One difference: they drop the remainder after the
    last whole clip; here it is padded with zeros to a whole clip.

"dsg+" (BEAT and TWH, 30 motion frames per second)
    The whole sound is normalised as the checkpoint says, padded with zeros to (N // 5 s + 1)
    times 5 s, and processed in pieces of 5 s without context. All frames, including those of the
    padding, are stretched to the motion frames of the sound without padding, so the features run
    ahead by up to 5 s at the end. Their number of motion frames is the minimum over MFCC, mel
    and prosody; here it is the sound's own, which differs by a few frames.
"""


def _reference(
    shape: Architecture, tensors: dict[str, torch.Tensor], top: int
) -> tuple[Convolutions, Layers]:
    """Return transformers' own network, the reference for the fast implementation.

    These are the convolutions and the layers up to `top` of its WavLMModel.

    Args:
        shape: architecture of the network.
        tensors: its tensors by transformers' names; the network is on their device.
        top: highest hidden state that is needed.
    """
    import torch

    from audio_features.huggingface.extractor import Convolutions, Layers
    from audio_features.huggingface.weights import transformers_needed

    with transformers_needed():
        from transformers import WavLMConfig, WavLMModel
    config = WavLMConfig(
        hidden_size=shape.width,
        num_hidden_layers=shape.layers,
        num_attention_heads=shape.heads,
        intermediate_size=shape.inner,
        feat_extract_norm=shape.front_norm,
        do_stable_layer_norm=shape.pre_norm,
        conv_dim=shape.channels,
        conv_bias=shape.conv_bias,
        num_conv_pos_embeddings=shape.position_kernel,
        num_conv_pos_embedding_groups=shape.position_groups,
        num_buckets=shape.buckets,
        max_bucket_distance=shape.max_distance,
        layer_norm_eps=shape.eps,
        mask_time_prob=0.0,
        mask_feature_prob=0.0,
    )
    with torch.random.fork_rng(devices=[]), torch.device("meta"):
        network = WavLMModel(config)
    network.load_state_dict(tensors, assign=True)
    network.eval().requires_grad_(False)
    return Convolutions(config, network), Layers(network, top)
