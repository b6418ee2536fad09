"""FeatureTrack: features on a time base, and their file format."""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from audio_features.archive import open_archive, read_number_table
from audio_features.atomic import atomic_write
from audio_features.errors import FeatureError
from audio_features.wave import exact_rate

FORMAT = 1
LARGEST = 1e18
"""Largest magnitude of a value; the squares of larger ones are no float32 numbers."""
NO_NUMBER = f"is not finite, or beyond {LARGEST:g}"
Method = Literal["linear", "mean", "gaussian"]
ALIGNMENTS = get_args(Method)
"""Methods of `to_rate` for aligning features with motion frames."""


@dataclass(frozen=True, eq=False)
class FeatureTrack:
    """Features of a sound over time.

    Args:
        values: (T, D) float32, of magnitude `LARGEST` at most.
        times: (T,) float64 seconds, ascending; centres of the frames.
        spec: JSON-serialisable settings of the extractor, as for `extractor_from_spec`.
        names: names of the D columns; by default "0", "1", …

    Raises FeatureError if shapes disagree or a value is not finite, or too large.

    Examples:
        A value that rises by 10 within a second, at 4 frames per second:

        >>> track = af.FeatureTrack([[0.0], [10.0]], times=[0.0, 1.0])
        >>> track.to_rate(4.0).values.ravel()
        array([ 0. ,  2.5,  5. ,  7.5, 10. ], dtype=float32)
    """

    values: np.ndarray
    times: np.ndarray
    spec: dict[str, Any] = field(default_factory=dict)
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        with np.errstate(over="ignore"):
            values = np.ascontiguousarray(self.values, dtype=np.float32)
        times = np.ascontiguousarray(self.times, dtype=np.float64)
        if values.ndim != 2 or times.shape != values.shape[:1] or len(times) == 0:
            raise FeatureError(f"values {values.shape}, times {times.shape}: expected (T, D), (T,)")
        names, problem = tuple(self.names) or tuple(map(str, range(values.shape[1]))), ""
        if len(names) != values.shape[1]:
            problem = f"{len(names)} names for {values.shape[1]} columns"
        elif (bad := bad_value(values)) is not None:
            value = np.asarray(self.values)[bad]
            problem = f"column {names[bad[1]]!r}, frame {bad[0]}: {value:g} {NO_NUMBER}"
        elif not np.isfinite(times).all() or np.any(np.diff(times) <= 0):
            problem = "times must be finite and ascend"
        if problem:
            raise FeatureError(problem)
        for name, value in {"values": values, "times": times, "names": names}.items():
            object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        kind = f" of {self.spec['kind']}" if "kind" in self.spec else ""
        frames, features = self.values.shape
        what = f"{frames} frames of {features} features{kind}"
        return f"FeatureTrack({what}, {self.times[0]:.3f} to {self.times[-1]:.3f} s)"

    def at(self, times: np.ndarray) -> FeatureTrack:
        """Interpolate at times (M,) in seconds: linear, constant beyond both ends."""
        times = np.asarray(times, dtype=np.float64)
        if len(self.times) == 1:
            return self._with(np.repeat(self.values, len(times), axis=0), times)
        lo = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.times) - 2)
        span = self.times[lo + 1] - self.times[lo]
        w = np.clip((times - self.times[lo]) / span, 0.0, 1.0).astype(np.float32)[:, None]
        return self._with(self.values[lo] * (1 - w) + self.values[lo + 1] * w, times)

    def to_rate(
        self, fps: float, n_frames: int | None = None, method: Method = "linear"
    ) -> FeatureTrack:
        """Align the track with motion frames: frame k is at k/fps.

        Args:
            fps: frames per second.
            n_frames: number of frames, as `wave.n_frames(fps)` or the motion's. By default all
                frames up to the time of this track's last frame.
            method: "linear" interpolates by true time. "mean" averages the frames within half
                a motion frame, and interpolates if there are none; it avoids aliasing.
                "gaussian" smooths these means with a standard deviation of one motion frame,
                for models whose output jitters when features flicker.
        """
        rate = exact_rate(fps)
        if n_frames is None:
            # The tolerance absorbs rounding: 0.29 · 100 is 28.999999999999996.
            n_frames = math.floor(self.times[-1] * float(rate) + 1e-6) + 1
        if n_frames < 1 or method not in ALIGNMENTS:
            expected = f"at least 1 frame, and one of {', '.join(ALIGNMENTS)}"
            raise FeatureError(f"n_frames={n_frames}, method={method!r}: give {expected}")
        times = np.arange(n_frames) * rate.denominator / rate.numerator
        track = self.at(times)
        if method == "linear":
            return track
        # The tolerance assigns a frame on an edge to the later window, whatever the rounding.
        edges = np.append(times, n_frames / float(rate)) - 0.5 / float(rate) - 1e-9
        first = np.searchsorted(self.times, edges, side="left")
        full = np.flatnonzero(first[1:] > first[:-1])
        # Windows are contiguous, so the sum from one non-empty window's start to the next one's
        # is the sum over the window. Frames after the last edge are excluded.
        sums = np.add.reduceat(self.values[: first[-1]], first[full], axis=0) if len(full) else 0
        values = track.values.copy()
        values[full] = sums / (first[full + 1] - first[full])[:, None]
        if method == "gaussian":
            from scipy.ndimage import gaussian_filter1d

            values = gaussian_filter1d(values, 1.0, axis=0, mode="nearest")
        return self._with(values, times)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a feature file: npz of `values`, `times` and `spec` (a JSON string).

        The JSON also holds the format number and the column names. The write is atomic.
        """
        text = json.dumps({**self.spec, "format": FORMAT, "names": self.names}, allow_nan=False)
        with atomic_write(path) as temporary, temporary.open("wb") as file:
            np.savez(file, values=self.values, times=self.times, spec=np.array(text))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> FeatureTrack:
        """Read a feature file; `spec` may be missing, in files that other programs wrote.

        A csv has a header, and rows of seconds and values.

        Raises FeatureError for other files and newer formats.
        """
        name, problem = os.fspath(path), ""
        try:
            if name.lower().endswith(".csv"):
                rows = read_number_table(Path(name), FeatureError)
                return cls(rows[:, 1:], rows[:, 0])
            with open_archive(name, FeatureError) as archive:
                values, times = archive.numbers("values", np.float32), archive.numbers("times")
                spec = json.loads("".join(archive.texts("spec"))) if "spec" in archive else {}
        except (ValueError, RecursionError) as error:
            reason = str(error).removeprefix(f"{Path(name)}: ")
            how = f"{reason}: make it again with `gesturekit features`"
            raise FeatureError(f"{name}: not a feature file (npz, csv): {how}") from error
        try:
            if not isinstance(spec, dict):
                raise TypeError(f"spec is {type(spec).__name__}, expected a JSON object")
            number, names = spec.pop("format", FORMAT), spec.pop("names", ())
            if number == FORMAT:
                return cls(values, times, spec, tuple(map(str, names)))
            problem = f"format {number!r}, this version reads {FORMAT}: upgrade"
        except (FeatureError, TypeError, ValueError) as error:
            problem = str(error)
        raise FeatureError(f"{name}: {problem}")

    def _with(self, values: np.ndarray, times: np.ndarray) -> FeatureTrack:
        return FeatureTrack(values, times, self.spec, self.names)


def bad_value(values: np.ndarray) -> tuple[int, int] | None:
    """Return row and column of the first value that is not finite, or beyond `LARGEST`."""
    near = np.abs(values) <= np.float64(LARGEST)  # float16 has no such number
    return None if near.all() else tuple(np.argwhere(~near)[0])
