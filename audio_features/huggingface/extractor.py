"""Hidden states of any supported Hugging Face speech encoder as features."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np

from audio_features.errors import AudioError, FeatureError
from audio_features.speech_encoders import (
    SAMPLE_RATE,
    HiddenStateExtractor,
    LayerChoice,
    Options,
    check_names,
    checked_device,
    chunk_slices,
    normalized,
)
from audio_features.track import FeatureTrack
from audio_features.wave import Wave
from audio_features.weight_files import check_fingerprint, weights_needed

if TYPE_CHECKING:
    from audio_features.speech_encoders import Layer

_SECONDS = {"full_context": 30.0, "chunk": 30.0, "context": 5.0}
_KNOWN = ("layer", "normalize", *_SECONDS, "fingerprint", "model")


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

    Attributes:
        weights: description of the encoder; `weights.describe()` summarises it in one line.
        normalize: number added to the waveform's variance; None if it is not normalised.

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
        from audio_features.huggingface.network import Layers, front_end
        from audio_features.huggingface.weights import read_encoder

        check_names("HuggingFace", options, _KNOWN, ["path"])
        self._options = Options(**{**_SECONDS, **options})
        self._device = checked_device(device)
        self.weights, network = read_encoder(weights)
        self.stem = self.weights.model_type.replace("-", "_")
        check_fingerprint(weights, self.fingerprint, fingerprint)
        if self.weights.family.inputs != "waveform" and self._options.normalize is not None:
            raise FeatureError(
                f"normalize={self._options.normalize!r}: {self.weights.family.title} takes no "
                "waveform: leave it out"
            )
        self.normalize = self._options.eps(self.weights.normalize)
        self._choice = LayerChoice(layer, None, self.weights.layers)
        network = network.to(self._device)
        self._front = front_end(self.weights, network)
        self._layers = Layers(network, max(self._choice.indices))

    @classmethod
    def from_spec(
        cls,
        settings: dict[str, Any],
        weights: str | os.PathLike[str] | None,
        device: str = "cpu",
    ) -> HuggingFace:
        """Build the extractor that a spec describes, with the weights of its fingerprint.

        Args:
            settings: the spec without its kind; `path` names the folder, and `model` and
                `fingerprint` the encoder that it must hold.
            weights: folder, if `path` is missing.
            device: "cpu" or "cuda".

        Raises FeatureError for unknown settings, WeightsError if weights are missing or are not
        those of the spec.
        """
        settings = dict(settings)
        folder = settings.pop("path", None) or weights
        check_names("HuggingFace", settings, _KNOWN, ["path"])
        model = settings.pop("model", None)
        if folder is None:
            raise weights_needed(
                model or "a Hugging Face speech encoder",
                settings.get("fingerprint"),
                "path: FOLDER in the config to train, else --weights hf=FOLDER",
            )
        return cls(folder, **settings, device=device)

    @property
    def spec(self) -> dict[str, Any]:
        """Kind, every setting that affects the values, and the weights' fingerprint."""
        spec = {"kind": "hf", "model": self.weights.model_type, "layer": self.layer}
        if self.weights.family.inputs == "waveform":
            spec["normalize"] = False if self.normalize is None else self.normalize
        return {**spec, **self._options.seconds, "fingerprint": self.fingerprint}

    def extract(self, wave: Wave) -> FeatureTrack:
        """Extract the hidden states of a sound at any sample rate: values (T, D).

        Raises AudioError for a sound shorter than one frame.
        """
        values = self.hidden_states(normalized(wave.resample(SAMPLE_RATE).samples, self.normalize))
        if len(values) == 0:
            raise AudioError(
                f"{wave.source or 'the sound'}: {wave.duration:.4f} s is shorter than one frame of "
                f"{self.weights.family.title}: give a longer sound"
            )
        times = (self._front.first + self._front.hop * np.arange(len(values))) / SAMPLE_RATE
        return FeatureTrack(values, times, self.spec, self.names)

    def hidden_states(self, samples: np.ndarray) -> np.ndarray:
        """Compute (T, D) float32 from (N,) samples at 16 kHz, without normalising them."""
        import torch

        with torch.inference_mode(), torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
            tensor = torch.from_numpy(np.ascontiguousarray(samples)).to(self._device)
            sound = self._front.sound(tensor)
            values = np.empty((sound.n_frames, self.dim), dtype=np.float32)
            if sound.n_frames == 0:
                return values
            for chunk, keep in self._chunks(sound.n_frames):
                states = self._layers.states(sound.window(chunk.start, chunk.stop)[None])
                picked = self._choice.pick(self._layers, states)[0]
                values[keep] = picked[keep.start - chunk.start : keep.stop - chunk.start].cpu()
        return values

    def _chunks(self, n_frames: int) -> list[tuple[slice, slice]]:
        full, chunk, context = self._options.frames(self._front.hop)
        longest = self._front.longest
        if longest is not None:
            if chunk > longest:
                context = min(context, longest // 4)
            full, chunk = min(full, longest), min(chunk, longest)
        longest = n_frames if n_frames <= full else max(chunk, 2 * context + 1)
        return list(chunk_slices(n_frames, longest, context))
