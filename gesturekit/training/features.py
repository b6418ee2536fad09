"""Speech features of a model: settings, and extraction for a corpus."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor

import audio_features as af
from audio_features.extractor import folder_in_spec, needs_weights
from audio_features.files import own_files
from audio_features.track import ALIGNMENTS
from audio_features.weight_files import WeightPlaces
from audio_features.words import takes_words
from gesturekit.corpus.manifest import Item, file_fingerprint
from gesturekit.corpus.speech import (
    Normalisation,
    RawFeatures,
    SpeechConditioner,
    detects_voice,
    extract,
    wide_columns,
)
from gesturekit.progress import Progress
from gesturekit.training.arrays import Array, ArrayInMemory, StoredFrames
from gesturekit.training.config import Positive, Settings

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FeatureConfig(Settings):
    """Speech features of a model."""

    extractors: tuple[dict, ...] = ({"kind": "logmel", "n_mels": 24}, {"kind": "prosody"})
    """Feature extractors, each with its `kind` and settings; their features are concatenated.
    Kinds: logmel, mfcc, prosody, onset, prosodic_range, effort, music, words, wavlm, hf, files
    (your own features, `{kind: files, dim: 64, suffix: .npy, rate: 50}`), and those of installed
    packages."""
    weights: Path | None = None
    """Folder or file of WavLM weights, or folder of a Hugging Face encoder whose extractor has no
    `path` or `encoder` of its own."""
    align: Literal["mean", "gaussian", "linear"] = "mean"
    """Resampling of features to motion frames: the mean over each frame, those means smoothed by a
    Gaussian of one frame, or linear interpolation."""
    normalise: Normalisation = "clip"
    """Normalisation of features. `clip` normalises the loudness of the speech, and the features of
    each clip to zero mean and comparable spread; `corpus` normalises features to zero mean and unit
    variance over all training speech; `none` does neither. Without `clip`, loudness changes the
    features of encoders; acoustic features normalise it themselves."""
    components: Positive[int | None] = None
    """Number of principal components (fitted to the training speech) to which wide features are
    reduced; null for no reduction. Extractors with no more columns than this, and vocal effort, are
    not reduced: WavLM is, prosody is not. Minutes of motion are too few for the 768 columns of an
    encoder."""
    vad: bool | None = None
    """Voice activity detection: stretches of at least 3 s without voice (noise floor, hum, typing)
    are replaced by silence before features are extracted, here and in generation. By default it is
    on, except with features of music. Turn it off for whispered speech."""

    @property
    def encoder_places(self) -> dict[str, Path]:
        """Folder or file of the weights of each encoder, by its kind, and that of own features."""
        places = {}
        for spec in self.extractors:
            folder = folder_in_spec(spec) or (self.weights if needs_weights(spec) else None)
            if folder is not None:
                places[spec["kind"]] = Path(folder)
        return places

    def extractor(self, device: str = "cpu") -> Any:
        """Make the extractor, whose encoders compute on a device.

        Raises:
            FeatureError: an unknown extractor or setting.
            WeightsError: weights that are missing or cannot be read.
        """
        kinds = [spec["kind"] for spec in self.extractors if needs_weights(spec)]
        twice = next((kind for kind in kinds if kinds.count(kind) > 1), None)
        if twice is not None:
            raise af.FeatureError(
                f"features.extractors: {kinds.count(twice)} of kind {twice}: a model takes at most "
                "one encoder of each kind: leave one, which may have a list of layers"
            )
        parts = {"kind": "stack", "parts": list(self.extractors)}
        return af.extractor_from_spec(parts, weights=self.weights, device=device)


@dataclass(frozen=True)
class SpeechArrays:
    """Makes arrays (T, D + 1): D features, not normalised, and speech activity, 0 or 1.

    Attributes:
        settings: of the features.
        fps: frames per second.
        device: on which encoders compute.
        extractor: see `FeatureConfig.extractor`; its weights are not handed to worker processes.
    """

    settings: FeatureConfig
    fps: float
    device: str
    extractor: Any

    @classmethod
    def open(cls, settings: FeatureConfig, fps: float, device: str) -> SpeechArrays:
        """Return a maker with an extractor of its own."""
        return cls(settings, fps, device, settings.extractor(device))

    def __reduce__(self) -> tuple[Any, ...]:
        return SpeechArrays.open, (self.settings, self.fps, self.device)

    @property
    def _vad(self) -> bool:
        return detects_voice(self.extractor, self.settings.vad)

    @property
    def _level(self) -> bool:
        return self.settings.normalise == "clip"

    def in_memory(self, items: Sequence[Item]) -> list[ArrayInMemory]:
        """Extract the features of items into arrays that are not written to disk."""
        progress = Progress(items, desc="Extracting speech features", unit="file")
        return [ArrayInMemory(*self.make(item)) for item in progress]

    def fit(
        self, clips: Iterable[tuple[Array, int, int]], known: SpeechConditioner | None
    ) -> SpeechConditioner:
        """Return a conditioner that is known, of a model to start from, or fit one.

        Args:
            clips: arrays that this has made, first frame and end of each clip.
            known: a conditioner with the same extractor and settings; None fits one.
        """
        if known is not None:
            return known
        settings, raw = self.settings, [raw_speech(*clip) for clip in clips]
        about = self.extractor, self.fps, settings.align, settings.normalise
        conditioner = replace(SpeechConditioner.fit(raw, *about), vad=self._vad)
        if settings.components is None:
            return conditioner
        return conditioner.reduced(raw, settings.components)

    def origin(self, item: Item) -> dict[str, Any]:
        """Return all that the features of an item depend on."""
        words = item.conditions.get("words") if takes_words(self.extractor) else None
        assert item.audio is not None
        files = [path and file_fingerprint(path) for path in own_files(self.extractor, item.audio)]
        return ({"features": files} if files else {}) | {
            "audio": file_fingerprint(item.audio),
            "words": None if words is None else file_fingerprint(words),
            "interval": [item.audio_start, item.duration],
            "audible": [list(interval) for interval in item.audible],
            "channel": item.channel,
            "spec": self.extractor.spec,
            "settings": [self.fps, self.settings.align, self._level, self._vad],
        }

    def make(self, item: Item) -> tuple[np.ndarray, dict[str, Any]]:
        """Extract the features of an item."""
        wave = item.load_wave()
        speech = af.speech_only(wave) if self._vad else wave
        align = self.settings.align
        values, active = extract(speech, self.extractor, self.fps, align, level=self._level)
        return np.column_stack([values, active]), {
            "id": item.id,
            "has_voice": wave.is_silent or not speech.is_silent,
            "spoken": int(active.sum()),
            "total": values[active].sum(axis=0, dtype=np.float64).tolist(),
        }


def speech_frames(
    arrays: Sequence[Array], conditioner: SpeechConditioner, lengths: Sequence[int]
) -> list[StoredFrames]:
    """Return the normalised features (S, T) of arrays that `SpeechArrays` made.

    Args:
        arrays: of each item.
        conditioner: normalises them.
        lengths: frames of each; those beyond them are left out.
    """

    def of(array: Array, n_frames: int) -> StoredFrames:
        n_frames = min(n_frames, array.shape[0])
        total, spoken = array.facts["total"], array.facts["spoken"]
        if n_frames < array.shape[0]:
            values, active = raw_speech(array, 0, n_frames)
            total, spoken = values[active].sum(axis=0, dtype=np.float64), active.sum()
        centre = conditioner.clip_centre(total, spoken)

        def convert(rows: np.ndarray) -> Tensor:
            scaled = conditioner.scaled(rows[:, :-1], centre)
            return torch.from_numpy(np.ascontiguousarray(scaled.T))

        return StoredFrames(array, (conditioner.dim, n_frames), convert)

    if silent := [array.facts["id"] for array in arrays if not array.facts["has_voice"]]:
        log.warning(
            "%d of %d sounds have no voice and count as silence (%s); features.vad=false uses them "
            "as speech",
            *(len(silent), len(arrays), ", ".join(silent[:3])),
        )
    return list(map(of, arrays, lengths))


def raw_speech(array: Array, start: int, stop: int) -> RawFeatures:
    """Read the features of some frames as `extract` returned them."""
    rows = array.rows(start, stop)
    return rows[:, :-1], rows[:, -1] > 0


def conditioner_tensors(conditioner: SpeechConditioner | None) -> dict[str, Tensor]:
    """Return the statistics of a conditioner by their names in model and run folders."""
    if conditioner is None:
        return {}
    tensors = {}
    for name in ("centre", "scale", "components"):
        if (values := getattr(conditioner, name)) is not None:
            tensors[f"features.{name}"] = torch.from_numpy(values)
    return tensors


def conditioner_values(conditioner: SpeechConditioner) -> dict[str, Any]:
    """Return the settings of a conditioner for a model's config.yaml."""
    components = conditioner.components
    return {
        "spec": conditioner.extractor.spec,
        "align": conditioner.align,
        "normalise": conditioner.normalisation,
        "components": None if components is None else components.shape[1],
        "vad": conditioner.vad,
    }


def feature_values(speech: SpeechArrays) -> dict[str, Any]:
    """Return the `conditioner_values` of a conditioner with these settings."""
    settings, count = speech.settings, speech.settings.components
    return {
        "spec": speech.extractor.spec,
        "align": settings.align,
        "normalise": settings.normalise,
        "components": count if count and wide_columns(speech.extractor, count).any() else None,
        "vad": detects_voice(speech.extractor, settings.vad),
    }


def load_conditioner(
    values: Mapping[str, Any],
    tensors: Mapping[str, Tensor],
    fps: float,
    weights: WeightPlaces | None,
    device: str = "cpu",
) -> SpeechConditioner:
    """Build a conditioner from its `conditioner_values` and `conditioner_tensors`.

    The extractor's spec holds the fingerprint of its weights.

    Raises:
        FeatureError: an unknown extractor, alignment or normalisation.
        WeightsError: the weights are missing, or differ from those of training.
    """
    for name, known in (("align", ALIGNMENTS), ("normalise", get_args(Normalisation))):
        if values[name] not in known:
            given = str(values[name])[:40]
            raise af.FeatureError(f"{name} is {given!r}: expected one of {', '.join(known)}")
    reduced = values["components"] is not None
    return SpeechConditioner(
        af.extractor_from_spec(values["spec"], weights=weights, device=device),
        fps,
        values["align"],
        tensors["features.centre"].numpy(),
        tensors["features.scale"].numpy(),
        values["normalise"],
        tensors["features.components"].numpy() if reduced else None,
        values["vad"],
    )
