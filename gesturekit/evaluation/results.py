"""What an evaluation found, as values: for the page, the JSON, and anyone else."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gesturekit.atomic import atomic_write
from gesturekit.evaluation.definitions import DEFINITIONS, Definition, PatchOptions
from gesturekit.evaluation.intervals import Interval
from gesturekit.evaluation.metrics.distributions import SpeedHistogram
from gesturekit.evaluation.pairs import Excluded, Pair

FORMAT = 1


@dataclass
class ClipResult:
    """One clip: its figures, its recording's, and what is odd about it.

    Attributes:
        pair: names and files.
        seconds: how long the clip is.
        figures: by key of `definitions`, with `_chance` and `_z` of speech measures beside them.
        recording: the recording's own.
        mismatched: the clip's beside other recordings' sounds (CCA: beside another recording).
        notes: of the reader.
    """

    pair: Pair
    seconds: float
    figures: dict[str, float]
    recording: dict[str, float]
    mismatched: dict[str, float]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Figure:
    """One measure of one model.

    Attributes:
        key: of `definitions`.
        interval: the model's mean, with its interval.
        recording: what the recordings reach themselves, or None.
        chance: mean chance level by circular shifts of the sound, or None.
        mismatched: mean beside other recordings, or None.
        note: "" or what to mind.
    """

    key: str
    interval: Interval
    recording: float | None = None
    chance: float | None = None
    mismatched: float | None = None
    note: str = ""


@dataclass
class ModelResult:
    """One folder of generated motion."""

    label: str
    path: Path
    figures: dict[str, Figure] = field(default_factory=dict)
    by_recording: dict[str, dict[str, Interval]] = field(default_factory=dict)
    clips: list[ClipResult] = field(default_factory=list)
    excluded: list[Excluded] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    speeds: SpeedHistogram = field(default_factory=SpeedHistogram)
    wrists: np.ndarray = field(default_factory=lambda: np.zeros(0))


@dataclass
class Evaluation:
    """All that was measured, and how.

    Attributes:
        models: the first is the one in question, the others are compared with it.
        reference: the folder of recordings.
        fps: frame rate at which everything was measured.
        protocol: "" or whose.
        settings: seeds and options, as plain values.
        versions: of what computed it.
        recorded_speeds: histogram of the recordings that were compared with.
        recorded_wrists: (N,) wrist speeds of the same, m/s; a sample of at most some thousands.
    """

    models: list[ModelResult]
    reference: Path
    fps: float
    protocol: str
    settings: dict[str, Any]
    versions: dict[str, str]
    recorded_speeds: SpeedHistogram
    recorded_wrists: np.ndarray

    @property
    def is_complete(self) -> bool:
        """Whether no clip was left out."""
        return not any(item.what == "clip" for model in self.models for item in model.excluded)

    def definitions(self) -> list[Definition]:
        """Of the measures that came out for at least one model, as they were taken."""
        keys = {key for model in self.models for key in model.figures}
        patches = PatchOptions(**self.settings["patches"])
        return [DEFINITIONS[key].at(self.fps, patches) for key in DEFINITIONS if key in keys]

    def to_json(self) -> dict[str, Any]:
        """Plain values: format, versions, settings, definitions, and every figure."""
        return {
            "format": FORMAT,
            "reference": str(self.reference),
            "fps": self.fps,
            "protocol": self.protocol,
            "settings": self.settings,
            "versions": self.versions,
            "definitions": {d.key: d.to_json() for d in self.definitions()},
            "models": [_model(model) for model in self.models],
        }

    def write_json(self, path: str | os.PathLike[str]) -> None:
        """Write `to_json` to a file."""
        text = json.dumps(self.to_json(), indent=1, ensure_ascii=False, allow_nan=False)
        with atomic_write(path) as temporary:
            temporary.write_text(text + "\n", encoding="utf-8")


def _model(model: ModelResult) -> dict[str, Any]:
    return {
        "label": model.label,
        "path": str(model.path),
        "figures": {
            key: {
                **asdict(figure.interval),
                "recording": figure.recording,
                "chance": figure.chance,
                "mismatched": figure.mismatched,
                "note": figure.note,
            }
            for key, figure in model.figures.items()
        },
        "by_recording": {
            stem: {key: asdict(interval) for key, interval in figures.items()}
            for stem, figures in model.by_recording.items()
        },
        "clips": [
            {
                "name": clip.pair.name,
                "recording": clip.pair.stem,
                "window": clip.pair.window,
                "seconds": round(clip.seconds, 4),
                "figures": clip.figures,
                "recording_figures": clip.recording,
                "mismatched": clip.mismatched,
                "notes": list(clip.notes),
            }
            for clip in model.clips
        ],
        "excluded": [asdict(item) for item in model.excluded],
        "notes": model.notes,
    }
