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
from gesturekit.corpus.manifest import Item
from gesturekit.corpus.speech import SpeechConditioner, extract
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

    def extractor(self) -> Any:
        """The extractor.

        Raises:
            FeatureError: an unknown extractor or setting.
            WeightsError: weights that are missing or cannot be read.
        """
        parts = {"kind": "stack", "parts": list(self.extractors)}
        return af.extractor_from_spec(parts, weights=self.weights)


def listen(
    items: Sequence[Item],
    most: Sequence[int | None],
    extractor: Any,
    fps: float,
    align: str,
) -> tuple[SpeechConditioner, list[np.ndarray]]:
    """What a model hears of each item, (T, S) float32, and what makes it of a wave.

    Args:
        items: with sound.
        most: frames of each that are wanted, or None for all.
        extractor: see `FeatureConfig.extractor`.
        fps: frames per second of the motion.
        align: see `FeatureConfig`.

    Raises:
        AudioError: a file cannot be read.
    """
    progress = Progress(items, desc="Speech features", unit="files")
    heard = [extract(item.load_wave(), extractor, fps, align) for item in progress]
    conditioner = SpeechConditioner.fit(heard, extractor, fps, align)
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


def load_conditioner(
    spec: dict[str, Any],
    align: str,
    tensors: Mapping[str, Tensor],
    fps: float,
    weights: str | Path | None,
    device: str = "cpu",
) -> SpeechConditioner:
    """A conditioner of its extractor's spec, which knows its weights, and of what it has learnt.

    Raises:
        WeightsError: WavLM weights are asked for, or are not those of training.
    """
    return SpeechConditioner(
        af.extractor_from_spec(spec, weights=weights, device=device),
        fps,
        align,
        tensors["features.centre"].numpy(),
        tensors["features.scale"].numpy(),
    )
