"""Which style is this? A ridge regression onto styles of how the body is held and how it moves."""

from __future__ import annotations

import numpy as np

import gesturekit as gk
from gesturekit.corpus.manifest import Manifest

WINDOW_SECONDS = 1.5
RIDGE = 30.0


def windows(motion: gk.Motion) -> np.ndarray:
    """(W, F): means and spreads of places about the root, half a window apart."""
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
    """Ridge regression from standardised windows onto one-hot styles."""

    def __init__(self, features: np.ndarray, styles: np.ndarray, count: int) -> None:
        self.mean, self.scale = features.mean(0), features.std(0) + 1e-6
        x = self._prepared(features)
        target = np.eye(count)[styles]
        self.weights = np.linalg.solve(x.T @ x + RIDGE * np.eye(x.shape[1]), x.T @ target)

    def _prepared(self, features: np.ndarray) -> np.ndarray:
        x = (features - self.mean) / self.scale
        return np.concatenate([x, np.ones((len(x), 1))], axis=1)

    def __call__(self, features: np.ndarray) -> np.ndarray:
        return (self._prepared(features) @ self.weights).argmax(1)


def fit_classifier(model, manifest: Manifest) -> tuple[Classifier, float]:
    """The classifier of the model's styles, and the share of held-out windows it gets right."""
    found, labels = [], []
    for item in manifest:
        if item.motion is not None and item.style in model.styles:
            # As the model would write it: the same joints move, and it faces the same way.
            motion = item.load_motion().resample(model.fps)
            values = model.representation.encode(motion)
            motion = model.representation.decode(values, model.fps)
            found.append(windows(motion))
            labels.append(np.full(len(found[-1]), model.styles.index(item.style)))
    features, styles = np.concatenate(found), np.concatenate(labels)
    held = np.concatenate([np.arange(len(part)) >= 0.75 * len(part) for part in found])
    count = len(model.styles)
    right = Classifier(features[~held], styles[~held], count)(features[held]) == styles[held]
    return Classifier(features, styles, count), float(right.mean())
