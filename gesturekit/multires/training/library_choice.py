"""Choice of the recordings that a model recalls, of a corpus that is longer than its library.

The library has the corpus's speakers and styles, each with its share, and of each as many calm and
lively parts as were recorded: parts are sorted by how much they move and divided into levels, of
which each gives one. The part is chosen that brings the library nearest to the poses and movements
of all others (greedy facility location, Nemhauser et al. 1978), from a take that is not in the
library yet where there is one. So usual gestures and rare ones can be recalled.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.distance import cdist
from torch import Tensor

from gesturekit.multires.config import MultiresConfig
from gesturekit.multires.recall.parts import motion_parts
from gesturekit.multires.training.data import TrainingData
from gesturekit.multires.training.sequences import Cut

_LONGEST, _SHORTEST = 30.0, 6.0
"""Seconds of a part."""
_SAME_TAKE = 0.5
"""Factor on the gain of a part whose take is in the library already."""
_PACE = 5.0
"""Frames a second that are compared."""
_MOST_COMPARED = 1000
"""Number of parts that stand for all of them where distances are summed."""


def chosen_parts(data: TrainingData, config: MultiresConfig) -> tuple[Cut, ...] | None:
    """Return the parts of the recordings that are recalled; None for all of them.

    Args:
        data: of the run.
        config: of the run; `recall.minutes` is the length of the library.
    """
    assert config.recall is not None
    wanted = round(60 * config.recall.minutes * config.fps)
    total = sum(sequence.n_frames for sequence in data.paired)
    if total <= wanted:
        return None
    groups = [(sequence.speaker, sequence.style) for sequence in data.paired]
    share = wanted / config.fps / len(set(groups))
    length = round(config.fps * min(_LONGEST, max(_SHORTEST, share)))
    cuts = [
        (i, start, stop)
        for i, sequence in enumerate(data.paired)
        for start, stop in _parts(sequence.n_frames, length)
    ]
    of_group: dict[tuple[str | None, int], list[int]] = {}
    for k, (i, _, _) in enumerate(cuts):
        of_group.setdefault(groups[i], []).append(k)
    columns = np.unique(
        np.concatenate(
            [part.columns for part in motion_parts(data.representation, True) if part.is_arm]
            or [np.arange(data.representation.layout.rotations.stop)]
        )
    )
    every = max(1, round(config.fps / _PACE))
    features = np.stack(
        [_features(data.paired[i].motion[:, a:b][columns, ::every]) for i, a, b in cuts]
    )
    takes = [data.paired[i].take for i, _, _ in cuts]
    lengths = np.array([stop - start for _, start, stop in cuts])
    chosen: list[int] = []
    for own in of_group.values():
        frames = wanted * lengths[own].sum() / total
        count = max(1, round(frames / lengths[own].mean()))
        chosen += [own[k] for k in _chosen(features[own], [takes[k] for k in own], count)]
    # Those that were chosen may be longer than the mean.
    kept = min(1.0, wanted / lengths[chosen].sum())
    parts = (cuts[k] for k in sorted(chosen))
    return tuple((i, start, start + int(kept * (stop - start))) for i, start, stop in parts)


def _parts(n_frames: int, length: int) -> list[tuple[int, int]]:
    """Return first frame and end of equal parts of a recording, of about this length."""
    edges = np.linspace(0, n_frames, max(1, round(n_frames / length)) + 1).round().astype(int)
    return list(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True))


def _features(motion: Tensor) -> np.ndarray:
    """Return how much motion (C, T) moves, and the mean and spread of its channels, (1 + 2 C,)."""
    values = motion.double().numpy()
    steps = np.diff(values)
    level = np.square(steps).mean() if steps.size else 0.0
    return np.concatenate([[level], values.mean(axis=1), values.std(axis=1)])


def _chosen(features: np.ndarray, takes: Sequence[str], count: int) -> list[int]:
    """Return the numbers of `count` of N parts.

    Args:
        features: (N, 1 + 2 C), see `_features`.
        takes: of each part.
        count: at most N.
    """
    order = np.argsort(features[:, 0], kind="stable")
    poses = features[:, 1:].astype(np.float32)
    few = np.linspace(0, len(order) - 1, min(len(order), _MOST_COMPARED)).round().astype(int)
    far = cdist(poses, poses[order[few]])
    nearest = np.full(len(few), far.max())
    level_of = np.empty(len(order), int)
    for level, members in enumerate(np.array_split(order, min(count, len(order)))):
        level_of[members] = level
    chosen: list[int] = []
    while len(chosen) < min(count, len(order)):
        gains = np.maximum(nearest - far, 0.0).sum(axis=1)
        gains[np.isin(takes, [takes[k] for k in chosen])] *= _SAME_TAKE
        gains[np.isin(level_of, level_of[chosen])] = -1.0  # one part of each level
        chosen.append(int(gains.argmax()))
        nearest = np.minimum(nearest, far[chosen[-1]])
    return chosen
