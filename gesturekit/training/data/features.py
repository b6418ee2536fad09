"""Speech features of a model: settings, and extraction for a corpus."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

import audio_features as af
from audio_features.extractor import folder_in_spec, needs_weights
from audio_features.weight_files import WeightPlaces
from gesturekit.corpus.item import Item
from gesturekit.corpus.speech import (
    Normalisation,
    SpeechConditioner,
    detects_voice,
    extract,
    wide_columns,
)
from gesturekit.progress import Progress
from gesturekit.training.run_config import check_positive

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FeatureConfig:
    """Speech features of a model."""

    extractors: tuple[dict, ...] = ({"kind": "logmel", "n_mels": 24}, {"kind": "prosody"})
    """Feature extractors, each with its `kind` and settings; their features are concatenated."""
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
    components: int | None = None
    """Number of principal components (fitted to the training speech) to which wide features are
    reduced; null for no reduction. Extractors with no more columns than this, and vocal effort, are
    not reduced: WavLM is, prosody is not. Minutes of motion are too few for the 768 columns of an
    encoder."""
    vad: bool | None = None
    """Voice activity detection: stretches of at least 3 s without voice (noise floor, hum, typing)
    are replaced by silence before features are extracted, here and in generation. By default it is
    on, except with features of music. Turn it off for whispered speech."""

    def __post_init__(self) -> None:
        if self.components is not None:
            check_positive(components=self.components)

    @property
    def encoder_places(self) -> dict[str, Path]:
        """Folder or file of the weights of each encoder, by its kind."""
        places = {}
        for spec in self.extractors:
            folder = folder_in_spec(spec) or self.weights
            if needs_weights(spec) and folder is not None:
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


def extract_features(
    items: Sequence[Item],
    most: Sequence[int | None],
    extractor: Any,
    fps: float,
    settings: FeatureConfig,
    fitted: SpeechConditioner | None = None,
) -> tuple[SpeechConditioner, list[np.ndarray]]:
    """Return a fitted conditioner and the features (T, S), float32, of each item.

    Args:
        items: with audio.
        most: largest number of frames of each; None for all.
        extractor: see `FeatureConfig.extractor`.
        fps: frames per second of the motion.
        settings: resampling, normalisation and reduction.
        fitted: conditioner of a model with the same extractor and settings, which is kept; None
            fits one to these items.

    Raises:
        AudioError: a file cannot be read.
    """
    progress = Progress(items, desc="Extracting speech features", unit="file")
    align, level = settings.align, settings.normalise == "clip"
    extracted, voiceless, vad = [], [], detects_voice(extractor, settings.vad)
    for item in progress:
        wave = item.load_wave()
        speech = af.speech_only(wave) if vad else wave
        if speech.is_silent and not wave.is_silent:
            voiceless.append(item.id)
        extracted.append(extract(speech, extractor, fps, align, level=level))
    if voiceless:
        log.warning(
            "%d of %d sounds have no voice and count as silence (%s); features.vad=false uses them "
            "as speech",
            *(len(voiceless), len(items), ", ".join(voiceless[:3])),
        )
    conditioner = fitted
    if conditioner is None:
        conditioner = SpeechConditioner.fit(extracted, extractor, fps, align, settings.normalise)
        conditioner = replace(conditioner, vad=vad)
        if settings.components is not None:
            conditioner = conditioner.reduced(extracted, settings.components)
    # Each array is released as soon as it is normalised: features of a large corpus fill memory.
    extracted.reverse()
    speeches = []
    for n_frames in most:
        values, active = extracted.pop()
        speeches.append(conditioner.normalise(values[:n_frames], active[:n_frames]))
    return conditioner, speeches


def conditioner_tensors(conditioner: SpeechConditioner | None) -> dict[str, Tensor]:
    """Return the statistics of a conditioner by their names in model and run folders."""
    if conditioner is None:
        return {}
    tensors = {
        "features.centre": torch.from_numpy(conditioner.centre),
        "features.scale": torch.from_numpy(conditioner.scale),
    }
    if conditioner.components is not None:
        tensors["features.components"] = torch.from_numpy(conditioner.components)
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


def feature_values(extractor: Any, settings: FeatureConfig) -> dict[str, Any]:
    """Return the `conditioner_values` of a conditioner with these settings."""
    count = settings.components
    return {
        "spec": extractor.spec,
        "align": settings.align,
        "normalise": settings.normalise,
        "components": count if count and wide_columns(extractor, count).any() else None,
        "vad": detects_voice(extractor, settings.vad),
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
        WeightsError: the weights are missing, or differ from those of training.
    """
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
