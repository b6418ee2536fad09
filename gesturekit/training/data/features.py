"""What a model hears: the setting, and the features of a corpus."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

import audio_features as af
from gesturekit.corpus.item import Item
from gesturekit.corpus.speech import Normalisation, SpeechConditioner, extract
from gesturekit.progress import Progress


@dataclass(frozen=True)
class FeatureConfig:
    """What a model hears."""

    extractors: tuple[dict, ...] = ({"kind": "logmel", "n_mels": 24}, {"kind": "prosody"})
    """Extractors by name and settings, side by side."""
    weights: Path | None = None
    """The WavLM weights, where an extractor asks for them."""
    align: Literal["mean", "gaussian", "linear"] = "mean"
    """How features reach the motion's frames: mean of each frame's span, those means averaged with
    a standard deviation of a frame, or linear in time."""
    normalise: Normalisation = "clip"
    """clip brings speech to one level, and the features of each clip to zero mean and comparable
    spread; corpus brings features to zero mean and unit variance over all training speech; none
    takes them as they are. Without clip, quieter speech gives another motion."""

    def extractor(self) -> Any:
        """The extractor.

        Raises:
            FeatureError: an unknown extractor or setting.
            WeightsError: weights that are missing or cannot be read.
        """
        parts = {"kind": "stack", "parts": list(self.extractors)}
        return af.extractor_from_spec(parts, weights=self.weights)


def extract_features(
    items: Sequence[Item],
    most: Sequence[int | None],
    extractor: Any,
    fps: float,
    settings: FeatureConfig,
) -> tuple[SpeechConditioner, list[np.ndarray]]:
    """What a model hears of each item, (T, S) float32, and what makes it of a wave.

    Args:
        items: with sound.
        most: frames of each that are wanted, or None for all.
        extractor: see `FeatureConfig.extractor`.
        fps: frames per second of the motion.
        settings: how features reach the motion's frames, and whether they are normalised.

    Raises:
        AudioError: a file cannot be read.
    """
    progress = Progress(items, desc="Extracting speech features", unit="file")
    align, level = settings.align, settings.normalise == "clip"
    heard = [extract(item.load_wave(), extractor, fps, align, level=level) for item in progress]
    conditioner = SpeechConditioner.fit(heard, extractor, fps, align, settings.normalise)
    # From the first to the last, each making room for what becomes of it.
    heard.reverse()
    speeches = []
    for n_frames in most:
        values, active = heard.pop()
        speeches.append(conditioner.normalise(values[:n_frames], active[:n_frames]))
    return conditioner, speeches


def conditioner_tensors(conditioner: SpeechConditioner | None) -> dict[str, Tensor]:
    """What a conditioner has learnt, under the names that models and runs keep it by."""
    if conditioner is None:
        return {}
    return {
        "features.centre": torch.from_numpy(conditioner.centre),
        "features.scale": torch.from_numpy(conditioner.scale),
    }


def conditioner_values(conditioner: SpeechConditioner) -> dict[str, Any]:
    """Return what a model's configuration holds of a conditioner; see `load_conditioner`."""
    return {
        "spec": conditioner.extractor.spec,
        "align": conditioner.align,
        "normalise": conditioner.normalisation,
    }


def load_conditioner(
    values: Mapping[str, Any],
    tensors: Mapping[str, Tensor],
    fps: float,
    weights: str | Path | None,
    device: str = "cpu",
) -> SpeechConditioner:
    """Return the conditioner of which these are `conditioner_values` and `conditioner_tensors`.

    The extractor's spec knows its weights. Values without `normalise` are older than the setting.

    Raises:
        WeightsError: WavLM weights are asked for, or are not those of training.
    """
    return SpeechConditioner(
        af.extractor_from_spec(values["spec"], weights=weights, device=device),
        fps,
        values["align"],
        tensors["features.centre"].numpy(),
        tensors["features.scale"].numpy(),
        values.get("normalise", "clip"),
    )
