"""Speed histograms and their Hellinger distance, as in the GENEA challenges."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.evaluation.metrics.physical import relative_speed
from gesturekit.motion import Motion

BIN = 0.01
"""m/s on the reference body, 1 cm/s: the width of GENEA's histogram bins."""
TOP = 0.49
"""m/s on the reference body; the end of GENEA's last bin. Faster values are not counted."""


@dataclass
class SpeedHistogram:
    """Histogram of joint speeds, filled clip by clip.

    Attributes:
        width: width of a bin, m/s.
        top: end of the last bin, m/s.
        counts: (top / width,) values in each bin.
        beyond: number of values above `top`, which are not in the distribution.

    Examples:
        Bins of 1 cm/s; 3 m/s is beyond the last one:

        >>> histogram = SpeedHistogram.of([np.array([0.002, 0.005, 0.015, 3.0])])
        >>> histogram.counts[:3].tolist(), histogram.beyond
        ([2, 1, 0], 1)
    """

    width: float = BIN
    top: float = TOP
    counts: np.ndarray = field(init=False)
    beyond: int = 0

    def __post_init__(self) -> None:
        if not 0 < self.width <= self.top:
            raise MotionError(
                f"bins of {self.width:g} m/s up to {self.top:g} m/s hold nothing; give a width "
                "above 0 and below the top"
            )
        self.counts = np.zeros(round(self.top / self.width), dtype=np.int64)

    def add(self, speeds: np.ndarray) -> None:
        """Count speeds (any shape), m/s."""
        edges = np.linspace(0.0, self.top, len(self.counts) + 1)
        counts, _ = np.histogram(speeds, edges)
        self.counts += counts
        self.beyond += int(np.size(speeds) - counts.sum())

    def to_json(self) -> dict[str, float | list[int]]:
        """Return plain values."""
        counts = self.counts.tolist()
        return {"width": self.width, "top": self.top, "counts": counts, "beyond": self.beyond}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> SpeedHistogram:
        """Return the histogram that `to_json` described."""
        made = cls(values["width"], values["top"], beyond=int(values["beyond"]))
        made.counts = np.array(values["counts"], dtype=np.int64)
        return made

    @classmethod
    def of(
        cls, speeds: Iterable[np.ndarray], *, width: float = BIN, top: float = TOP
    ) -> SpeedHistogram:
        """Return the histogram of the speeds (any shape) of several clips."""
        made = cls(width, top)
        for part in speeds:
            made.add(part)
        return made

    @classmethod
    def sum_of(cls, histograms: Iterable[SpeedHistogram]) -> SpeedHistogram:
        """Return the sum of histograms with the default bins."""
        whole = cls()
        for histogram in histograms:
            whole.counts += histogram.counts
            whole.beyond += histogram.beyond
        return whole


def hellinger(one: SpeedHistogram, other: SpeedHistogram) -> float:
    """Return the Hellinger distance sqrt(1 - Σ sqrt(h₁ h₂)): 0 for equal, 1 for disjoint ones.

    Speeds of all joints are pooled, as in genea_numerical_evaluations.

    Raises:
        MotionError: different bins, or an empty histogram.

    Examples:
        Equal histograms, and two that have no bin in common:

        >>> slow, fast = (SpeedHistogram.of([np.array([speed])]) for speed in (0.105, 0.305))
        >>> hellinger(slow, slow), round(hellinger(slow, fast), 6)
        (0.0, 1.0)
    """
    if (one.width, one.top) != (other.width, other.top):
        raise MotionError(
            f"histograms of {one.width:g} and {other.width:g} m/s bins (up to {one.top:g} and "
            f"{other.top:g} m/s) cannot be compared; take the same bins"
        )
    if not one.counts.sum() or not other.counts.sum():
        raise MotionError(f"no speed up to {one.top:g} m/s was counted; take a higher top")
    roots = [np.sqrt(h.counts / h.counts.sum()) for h in (one, other)]
    # 1 - Σ sqrt(h1 h2) = Σ (sqrt h1 - sqrt h2)² / 2, which is exactly 0 for equal ones.
    return float(np.linalg.norm(roots[0] - roots[1]) / np.sqrt(2.0))


def speed_distance(motion: Motion, recording: Motion, joints: Sequence[str]) -> float:
    """Return `hellinger` of the joint speeds of a motion and its recording.

    Raises:
        MotionError: see `hellinger`.

    Examples:
        A recording against itself, and a body that never moves against one at 0.3 m/s:

        >>> rig = gk.Skeleton(("hips",), (-1,), [[0, 1, 0]])
        >>> still, path = np.tile([0.0, 0, 0, 1], (9, 1, 1)), np.arange(9)[:, None] * [0.0101, 0, 0]
        >>> stands, goes = (gk.Motion(rig, still, speed * path, 30) for speed in (0, 1))
        >>> speed_distance(goes, goes, ["hips"]), round(speed_distance(stands, goes, ["hips"]), 6)
        (0.0, 1.0)
    """
    both = (SpeedHistogram.of([relative_speed(m, joints)]) for m in (motion, recording))
    return hellinger(*both)
