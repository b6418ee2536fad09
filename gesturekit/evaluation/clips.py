"""Clips in memory: a generated motion and its recording at one frame rate, with common joints."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from audio_features import FeatureTrack, Wave
from gesturekit.errors import FormatError, MotionError
from gesturekit.evaluation.frame_rate import at_rate
from gesturekit.evaluation.measuring.rigs import bare_name, matched
from gesturekit.evaluation.metrics.physical import joint_speed
from gesturekit.evaluation.pairs import WINDOW_SECONDS, Pair, Stretch
from gesturekit.evaluation.semantic_track import read_semantic
from gesturekit.motion import Motion
from gesturekit.motion.body_size import body_scale
from gesturekit.motion.defects import MAX_SPEED, format_speed, speed_limit

LENGTH_TOLERANCE = 0.1
"""Largest difference in length between a clip and its recording without a note, seconds."""
STILL = 1e-4
"""m/s on the reference body; a frame stands still if no joint is faster."""

_CACHED = 8  # files of each kind kept in memory; samples of one recording are consecutive


@dataclass(frozen=True, eq=False)
class Clip:
    """A pair in memory.

    Attributes:
        pair: names and files.
        generated: the motion, with the recording's joint names.
        recording: the recorded motion at the generated one's frame rate.
        joints: names of the common body joints, in the recording's order.
        semantic: the recording's semantic track, or None.
        notes: remarks on the pair, such as resampling.
    """

    pair: Pair
    generated: Motion
    recording: Motion
    joints: tuple[str, ...]
    semantic: FeatureTrack | None
    notes: tuple[str, ...]

    @property
    def n_frames(self) -> int:
        """Number of common frames."""
        return min(self.generated.n_frames, self.recording.n_frames)

    @functools.cached_property
    def same_body(self) -> bool:
        """True if the bone lengths of both bodies agree to 1 %."""
        bones = [
            np.linalg.norm(
                [m.skeleton.offsets[m.skeleton.index(name)] for name in self.joints[1:]], axis=-1
            )
            for m in (self.generated, self.recording)
        ]
        rounding = 1e-3 * body_scale(self.recording.skeleton)
        return bool(np.allclose(*bones, rtol=0.01, atol=rounding))


def load_clip(pair: Pair, fps: float | None = None, without: frozenset[str] = frozenset()) -> Clip:
    """Read a pair, and bring the generated motion to the recording's rig (`measuring.rigs`).

    Args:
        pair: from `find_pairs`.
        fps: frame rate of both motions; None keeps that of the generated motion.
        without: bare names of joints that other models lack, which are left out.

    Raises:
        FormatError, MotionError: a file that cannot be read (numbers that are not finite, one
            frame), or rigs that do not match.
        FeatureError: the semantic track cannot be read.
    """
    generated = _read(pair.generated)
    rate = fps or generated.fps
    recording = _resampled(pair.reference, rate)
    notes = []
    if generated.n_frames < 2:
        raise FormatError(f"{pair.generated}: one frame; a motion to be measured has at least 2")
    resampled = at_rate(generated, rate)
    if resampled is not generated:
        notes.append(f"resampled from {generated.fps:g} to {rate:g} fps")
        generated = resampled
    semantic = None if pair.semantic is None else _semantic(pair.semantic)
    if pair.window is not None:
        start = pair.window * WINDOW_SECONDS
        recording = _window(recording, start, pair)
        semantic = None if semantic is None else _later(semantic, start)
    try:
        joints, generated, remarks = matched(generated, recording)
    except MotionError as error:
        raise MotionError(f"{pair.generated}: {pair.reference.name}: {error}") from None
    joints = tuple(name for name in joints if bare_name(name) not in without)
    if len(joints) < 2:
        raise MotionError(f"{pair.generated}: fewer than 2 joints are common to all models")
    return Clip(pair, generated, recording, joints, semantic, (*notes, *remarks))


def clip_notes(clip: Clip, wanted: float = 1.0) -> list[str]:
    """Return notes on a clip: another length than expected, frames that stand still, jumps.

    Args:
        clip: a generated clip and its recording.
        wanted: expected length of the clip relative to its recording.
    """
    notes = []
    fps = clip.generated.fps
    gap = clip.generated.duration - wanted * clip.recording.duration
    if abs(gap) > max(LENGTH_TOLERANCE, 1.5 / fps):
        what = "its recording" if wanted == 1.0 else f"{wanted:g} times its recording"
        notes.append(f"{abs(gap):.2f} s {'longer' if gap > 0 else 'shorter'} than {what}")
    scale = body_scale(clip.generated.skeleton)
    fastest = joint_speed(clip.generated, clip.joints).max(axis=1)
    still = float((fastest < STILL * scale).mean())
    if still > 0.05:
        notes.append(f"stands still in {100 * still:.0f} % of its frames")
    if fastest.max() > (limit := MAX_SPEED * scale):
        at, speed = fastest.argmax() / fps, format_speed(fastest.max())
        notes.append(f"jumps at {at:.2f} s ({speed}, {speed_limit(limit)})")
    return notes


def load_recording(path: Path | Stretch, fps: float) -> Motion:
    """Read a recording and resample it to `fps`.

    Raises:
        FormatError, MotionError: the file cannot be read.
    """
    return _resampled(path, fps)


def load_wave(source: Path | Stretch) -> Wave:
    """Read a recording's sound.

    Raises:
        AudioError: it cannot be read.
    """
    return source.item.load_wave() if isinstance(source, Stretch) else Wave.load(source)


def _window(recording: Motion, start: float, pair: Pair) -> Motion:
    first = round(start * recording.fps)
    stop = min(recording.n_frames, first + round(WINDOW_SECONDS * recording.fps))
    if stop - first < 2:
        raise MotionError(
            f"{pair.generated}: {pair.reference.name} ends before its window {pair.window} "
            f"({start:g} s) begins"
        )
    return recording.slice(first, stop)


def _later(track: FeatureTrack, start: float) -> FeatureTrack:
    keep = track.times >= start
    if not keep.any():
        keep[-1] = True
    return FeatureTrack(track.values[keep], track.times[keep] - start, track.spec, track.names)


@functools.lru_cache(maxsize=_CACHED)
def _resampled(path: Path | Stretch, fps: float) -> Motion:
    motion = _read(path)
    if motion.n_frames < 2:
        raise FormatError(f"{path.name}: one frame; a motion to be measured has at least 2")
    return at_rate(motion, fps)


def _read(path: Path | Stretch) -> Motion:
    if isinstance(path, Stretch):
        return path.item.load_motion()
    try:
        return Motion.load(path)
    except (FormatError, MotionError) as error:
        # The error of an invalid motion does not name its file.
        text = str(error)
        raise type(error)(text if path.name in text else f"{path}: {text}") from error


_semantic = functools.lru_cache(maxsize=_CACHED)(read_semantic)


def forget_recordings() -> None:
    """Forget recordings in memory, which may have changed on disk since the last evaluation."""
    _resampled.cache_clear()
    _semantic.cache_clear()
