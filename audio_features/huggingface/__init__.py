"""Hidden states of any supported Hugging Face speech encoder as features.

A front end gives the projected frames of a window that enter the encoder's layers. Everything
that depends on the whole sound (normalisation over time) is computed over the whole sound, so that
a window's frames do not depend on where the window begins.
"""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch

from audio_features.errors import FeatureError
from audio_features.huggingface.weights import front_norm, read_encoder
from audio_features.speech_encoders import (
    SAMPLE_RATE,
    HiddenStateExtractor,
    Options,
    checked_device,
)

if TYPE_CHECKING:
    from audio_features.speech_encoders import Layer

_MEL_HOP = 160
_MEL_WINDOW = 400
_STACKED = 2  # mel frames that are one frame of w2v-BERT 2.0
# Whisper's scale: (log10 + 4) / 4, at least 1e-10 and at most 8 decades below the maximum.
_SILENCE, _RANGE = -1.5, 2.0
_BLOCK_FRAMES = 500  # at once, which bounds the memory of the first convolution


class HuggingFace(HiddenStateExtractor):
    """Hidden states of a speech encoder in a local folder, computed by transformers in float32.

    HuBERT, wav2vec 2.0, data2vec-audio, WavLM, w2v-BERT 2.0 and the encoder of Whisper are
    supported; all published ones give 50 frames per second. Frame t is centred at
    `first + hop · t`: 0.0125 + 0.02t s for encoders of waveforms, 0.0175 + 0.02t s for w2v-BERT
    2.0, 0.02t s for Whisper. Nothing is downloaded and no code in the folder is run.

    Sounds of up to `full_context` seconds are processed whole and have transformers' values. In
    longer sounds, what depends on the whole sound (normalisation of waveform, first convolution
    and mel bins, Whisper's dynamic range) is computed over the whole sound; the layers process
    overlapping chunks, and the frames within `context` seconds of a chunk's edges are taken from
    its neighbours. Whisper takes 30 s at most.

    Args:
        weights: folder with config.json, the weights and, if the model has one,
            preprocessor_config.json. Without that file a waveform is normalised only where
            `feat_extract_norm` is `layer`. Tokenisers are not needed.
        layer: see `WavLM`: a number counts transformers' `hidden_states`, "last" is the encoder's
            output (before any adapter), and there are "mean", [6, 9] and {6: 1, 9: 3}.
        fingerprint: fingerprint of the weights, as in a spec; other weights are refused.
        device: "cpu" or "cuda"; not part of the spec.
        options: any of
            normalize: None normalises the waveform as the folder says; False leaves it unchanged;
                a number is added to the variance. Only for encoders of waveforms.
            full_context: longest sound that is processed whole, in seconds (30).
            chunk: longest chunk of longer sounds, in seconds (30).
            context: part of a chunk that is context on either side, in seconds (5). Where the
                encoder takes less than a chunk, at most a quarter of what it takes.

    Raises WeightsError if the folder cannot be used, FeatureError for an invalid setting.

    Examples:
        The folder of an encoder must be there; its spec names it, or only what it must hold:

        >>> af.HuggingFace("hubert-base/")
        Traceback (most recent call last):
        audio_features.errors.WeightsError: hubert-base: no such folder: give a local
        Hugging Face folder with config.json and model.safetensors
    """

    def __init__(
        self,
        weights: str | os.PathLike[str],
        layer: Layer = "last",
        *,
        fingerprint: str | None = None,
        device: str = "cpu",
        **options: Any,
    ) -> None:
        settings = Options(**{"full_context": 30.0, **options})
        self._device = checked_device(device)
        self.weights, config, network = read_encoder(weights)
        front_end = _FRONT_ENDS.get(self.weights.model, convolutions)
        takes_waveform = front_end is convolutions
        if not takes_waveform and settings.normalize is not None:
            raise FeatureError(f"normalize: {self.weights.model} takes no waveform: leave it out")
        self._choose(layer, None, settings, fingerprint)
        self._front = front_end(config, network.to(self._device))
        self.first, self.hop = self._front.first, self._front.hop
        self._layers = Layers(network, max(self._choice.indices))
        self.spec = {"kind": "hf", "model": self.weights.model, "layer": self._choice.spec}
        if takes_waveform:
            self.spec["normalize"] = False if self.normalize is None else self.normalize
        self.spec |= {**settings.seconds, "fingerprint": self.fingerprint}

    def hidden_states(self, samples: np.ndarray) -> np.ndarray:
        """Compute (T, D) float32 from (N,) samples at 16 kHz, without normalising them."""
        with torch.inference_mode(), torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
            tensor = torch.from_numpy(np.ascontiguousarray(samples)).to(self._device)
            n_frames, window = self._front.windows(tensor)
            values = np.empty((n_frames, self.dim), dtype=np.float32)
            if n_frames == 0:
                return values
            front = self._front
            for chunk, keep in self._options.chunks(n_frames, front.hop, front.longest):
                states = self._layers.states(window(chunk.start, chunk.stop)[None])
                picked = self._choice.pick(self._layers, states)[0]
                values[keep] = picked[keep.start - chunk.start : keep.stop - chunk.start].cpu()
        return values


Windows = tuple[int, Callable[[int, int], torch.Tensor]]
"""Number of frames of a sound, and the inputs (stop - start, …) of its frames [start, stop)."""


class FrontEnd(NamedTuple):
    """Inputs of an encoder's layers, made of a sound.

    Attributes:
        windows: makes them of samples (N,) float32 at 16 kHz, normalised as the encoder expects,
            on the network's device.
        hop: frame t is centred at sample `first + t · hop`.
        first: centre of the first frame.
        longest: most frames that the encoder takes at once, None without a limit.
    """

    windows: Callable[[torch.Tensor], Windows]
    hop: int
    first: float
    longest: int | None = None


def convolutions(config: Any, network: Any) -> FrontEnd:
    """Return the front end of HuBERT, wav2vec 2.0, data2vec-audio and WavLM.

    Their convolutions over the waveform have no padding: frame t covers the samples
    [t · hop, t · hop + size). Where the first one is normalised over time (`feat_extract_norm:
    group`), its mean and variance are those of the whole sound.

    Args:
        config: transformers' configuration.
        network: the model that has the convolutions.
    """
    size, hop = 1, 1
    for kernel, stride in zip(config.conv_kernel, config.conv_stride):
        size += (kernel - 1) * hop
        hop *= stride
    first, *others = network.feature_extractor.conv_layers
    kernel, stride = config.conv_kernel[0], config.conv_stride[0]

    def moments(samples: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return mean and 1/sd (C, 1) of the first convolution over the sound (N,)."""
        count, block = (len(samples) - kernel) // stride + 1, _BLOCK_FRAMES * hop // stride
        total, squares = 0.0, 0.0
        for at in range(0, count, block):
            end = min(count, at + block)
            part = samples[at * stride : (end - 1) * stride + kernel]
            values = first.conv(part[None, None])[0].double()
            total = total + values.sum(-1)
            squares = squares + values.square().sum(-1)
        mean = total / count
        variance = (squares / count - mean.square()).clamp_min(0.0)
        scale = torch.rsqrt(variance + first.layer_norm.eps)
        return mean.float()[:, None], scale.float()[:, None]

    def windows(samples: torch.Tensor) -> Windows:
        n_frames = max(0, (len(samples) - size) // hop + 1)
        is_grouped = n_frames > 0 and front_norm(config) == "group"
        mean, scale = moments(samples) if is_grouped else (None, None)

        def window(start: int, stop: int) -> torch.Tensor:
            parts = []
            for at in range(start, stop, _BLOCK_FRAMES):
                end = min(stop, at + _BLOCK_FRAMES)
                x = samples[None, None, at * hop : (end - 1) * hop + size]
                if mean is None:
                    x = first(x)
                else:
                    norm = first.layer_norm
                    x = (first.conv(x) - mean) * scale
                    x = first.activation(x * norm.weight[:, None] + norm.bias[:, None])
                for layer in others:
                    x = layer(x)
                # HuBERT gives the projection alone, the others give its input as well.
                projected = network.feature_projection(x.transpose(1, 2))
                parts.append(projected[0] if isinstance(projected, tuple) else projected)
            return torch.cat(parts, dim=1)[0]

        return n_frames, window

    return FrontEnd(windows, hop, size / 2)


def filter_bank(config: Any, network: Any) -> FrontEnd:
    """Return the front end of w2v-BERT 2.0: stacked frames of an 80-bin mel filter bank.

    Mel frame k covers the samples [160k, 160k + 400); two of them are one frame. Each bin is
    normalised over the whole sound.
    """
    from transformers import SeamlessM4TFeatureExtractor

    bins = config.feature_projection_input_dim // _STACKED
    extract = SeamlessM4TFeatureExtractor(feature_size=bins, num_mel_bins=bins, stride=_STACKED)

    def windows(samples: torch.Tensor) -> Windows:
        n_frames = max(0, (len(samples) - _MEL_WINDOW) // _MEL_HOP + 1) // _STACKED
        mel = np.empty((0, 1), np.float32)
        if n_frames:
            settings = {"sampling_rate": SAMPLE_RATE, "pad_to_multiple_of": _STACKED}
            mel = extract(samples.cpu().numpy(), **settings).input_features[0][:n_frames]
        mels = torch.from_numpy(np.asarray(mel, np.float32)).to(samples.device)
        project = network.feature_projection
        return n_frames, lambda start, stop: project(mels[None, start:stop])[0][0]

    return FrontEnd(windows, _STACKED * _MEL_HOP, (_MEL_HOP * (_STACKED - 1) + _MEL_WINDOW) / 2)


def log_mel_frames(config: Any, network: Any) -> FrontEnd:
    """Return the front end of Whisper: its log-mel spectrogram, as its convolutions take it.

    Mel frame k is centred at sample 160k and every second one is the centre of a frame. The
    encoder takes windows of one length (30 s); a window holds the sound that follows its last
    frame too, and silence beyond the end. The dynamic range is limited over the whole sound.
    """
    from transformers import WhisperFeatureExtractor

    longest, hop = int(config.max_source_positions), 2 * _MEL_HOP
    extract = WhisperFeatureExtractor(feature_size=config.num_mel_bins)

    def windows(samples: torch.Tensor) -> Windows:
        n_frames = math.ceil(len(samples) / hop)
        # transformers pads to the length of the window; a longer sound ends in a frame of silence,
        # as the spectrogram mirrors the sound at its end.
        padded = np.zeros((longest if n_frames <= longest else n_frames + 1) * hop, np.float32)
        padded[: len(samples)] = samples.cpu().numpy()
        settings = {"sampling_rate": SAMPLE_RATE, "truncation": False, "padding": False}
        mel = extract(padded, **settings).input_features[0]
        mels = torch.from_numpy(np.asarray(mel, np.float32)).to(samples.device)
        silence = max(_SILENCE, float(mels.max()) - _RANGE)

        def window(start: int, stop: int) -> torch.Tensor:
            there = mels[:, 2 * start : 2 * (start + longest)]
            missing = 2 * longest - there.shape[1]
            return torch.nn.functional.pad(there, (0, missing), value=silence)

        return n_frames, window

    return FrontEnd(windows, hop, 0.0, longest)


_FRONT_ENDS: dict[str, Any] = {"wav2vec2-bert": filter_bank, "whisper": log_mel_frames}
"""Front ends of encoders that take no waveform, by their model_type."""
_ONE_AT_A_TIME = threading.Lock()  # hooks would see the layers of another thread's sound


class Layers:
    """Layers of an encoder; those above `top` are removed from the network.

    Args:
        network: a network of `read_encoder`.
        top: highest hidden state that is needed.
    """

    def __init__(self, network: Any, top: int) -> None:
        self._whisper = hasattr(network, "conv1")
        self._encoder = network if self._whisper else network.encoder
        layers = self._encoder.layers
        self._depth = len(layers)
        # State 0 is the input of the first layer, so that one layer always remains.
        self._encoder.layers = layers[: max(1, top)]
        # The normalisation of the topmost state, and whether that gives the network's output.
        self.final_norm: Any = getattr(self._encoder, "layer_norm", None)
        self.ends_in_norm = not self._whisper and "Stable" in type(self._encoder).__name__

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
            states[-1] = self.final_norm(states[-1])
        yield from states
