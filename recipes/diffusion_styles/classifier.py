"""Style classifier: ridge regression from statistics of pose and movement to styles."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

import gesturekit as gk
from gesturekit.corpus.manifest import Manifest

WINDOW_SECONDS = 1.5
RIDGE = 30.0
LEAST = 0.01
"""Least scale of a feature in metres. In some recordings, feet stand still to a tenth of a
millimetre, and small movements of a foot should not decide the style."""


def windows(motion: gk.Motion) -> np.ndarray:
    """Return statistics (W, F) of root-relative joint positions in half-overlapping windows."""
    places = motion.positions()
    places = (places - places[:, :1]).reshape(len(places), -1)
    size = round(WINDOW_SECONDS * motion.fps)
    parts = [places[i : i + size] for i in range(0, len(places) - size + 1, size // 2)]
    steps = [np.abs(np.diff(part, axis=0)) for part in parts]
    return np.array(
        [
            np.concatenate([part.mean(0), part.std(0), step.mean(0)])
            for part, step in zip(parts, steps, strict=True)
        ]
    )


class Classifier:
    """Ridge regression from normalised windows onto one-hot styles."""

    def __init__(self, features: np.ndarray, styles: np.ndarray, count: int) -> None:
        self.mean, self.scale = features.mean(0), np.maximum(features.std(0), LEAST)
        x = self._prepared(features)
        target = np.eye(count)[styles]
        self.weights = np.linalg.solve(x.T @ x + RIDGE * np.eye(x.shape[1]), x.T @ target)

    def _prepared(self, features: np.ndarray) -> np.ndarray:
        x = (features - self.mean) / self.scale
        return np.concatenate([x, np.ones((len(x), 1))], axis=1)

    def __call__(self, features: np.ndarray) -> np.ndarray:
        return (self._prepared(features) @ self.weights).argmax(1)


@dataclass(frozen=True)
class Recording:
    """A training recording, encoded and decoded by the model's representation, and its style."""

    motion: gk.Motion
    style: int


def styled_recordings(
    model, manifest: Manifest, encode: Callable[[gk.Motion], np.ndarray]
) -> list[Recording]:
    """Return the manifest's motions with styles of the model, encoded and decoded."""
    found = []
    for item in manifest:
        if item.motion is not None and item.style in model.styles:
            values = encode(item.load_motion().resample(model.fps))
            motion = model.representation.decode(values, model.fps)
            found.append(Recording(motion, model.styles.index(item.style)))
    return found


def fit_classifier(known: Sequence[Recording], count: int) -> tuple[Classifier, float, int]:
    """Fit a classifier of `count` styles.

    Returns:
        The classifier, the accuracy on each recording's last quarter of one trained without it, and
        the number of windows in these quarters.
    """
    found = [windows(recording.motion) for recording in known]
    features = np.concatenate(found)
    labels = [np.full(len(part), r.style) for part, r in zip(found, known, strict=True)]
    styles = np.concatenate(labels)
    held = np.concatenate([np.arange(len(part)) >= 0.75 * len(part) for part in found])
    right = Classifier(features[~held], styles[~held], count)(features[held]) == styles[held]
    return Classifier(features, styles, count), float(right.mean()), int(held.sum())
