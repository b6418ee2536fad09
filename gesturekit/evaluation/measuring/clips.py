"""Clips in memory: a motion and its recording on one rig, at one frame rate, with their sound."""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np

from audio_features import FeatureTrack, Wave
from gesturekit.errors import FormatError, MotionError
from gesturekit.evaluation.metrics.inputs import at_rate
from gesturekit.evaluation.metrics.mouth import with_mouth_alone
from gesturekit.evaluation.metrics.physical import joint_speed
from gesturekit.evaluation.metrics.rhythm import music_beats, speech_onsets
from gesturekit.evaluation.pairs import WINDOW_SECONDS, ItemInterval, Pair
from gesturekit.formats.tables import load_semantics
from gesturekit.motion import Motion
from gesturekit.motion.defects import MAX_SPEED, format_speed, speed_limit
from gesturekit.motion.parts import body_joints, find_legs, is_upper_body, leg_joints
from gesturekit.motion.parts.body_size import body_scale
from gesturekit.motion.retarget import retarget
from gesturekit.motion.rotations import IDENTITY
from gesturekit.motion.skeleton import Skeleton, forward_kinematics

LENGTH_TOLERANCE = 0.1
"""Largest difference in length between a clip and its recording without a note, seconds."""
STILL = 1e-4
"""m/s on the reference body; a frame stands still if no joint is faster."""

MATCHED = 0.5
"""Rigs match if at least this fraction of the recording's body joints is found by name."""
SAME_BONES = 0.05
"""Largest relative difference of the bones of one body."""
RETARGETED = "another rig: retargeted to the recording's before it was measured"
"""Note on a clip."""

_SHORTEST = 0.01  # metres on the reference body; shorter bones differ by rounding
_CACHED = 8  # semantic tracks kept in memory; samples of one recording are consecutive
_CACHED_BYTES = 100_000_000  # of motions, and of sounds: 24 minutes of 75 joints, 26 of sound


_Value = TypeVar("_Value")


class ByteCache(Generic[_Value]):
    """Keeps the values that were used last, up to a number of bytes.

    A value that is larger is not kept at all.

    Args:
        most: bytes to keep.
        size: returns the bytes of a value.
    """

    def __init__(self, most: int, size: Callable[[_Value], int]) -> None:
        self._most, self._size = most, size
        self._values: dict[Hashable, _Value] = {}  # the value used last is the last

    def get(self, key: Hashable, load: Callable[[], _Value]) -> _Value:
        """Return the value of a key, which `load` makes unless it is kept."""
        value = self._values.pop(key) if key in self._values else load()
        self._values[key] = value
        while self._values and sum(map(self._size, self._values.values())) > self._most:
            del self._values[next(iter(self._values))]
        return value

    def clear(self) -> None:
        """Forget all values."""
        self._values.clear()


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
        own, other = (
            np.linalg.norm(
                [m.skeleton.offsets[m.skeleton.index(name)] for name in self.joints[1:]], axis=-1
            )
            for m in (self.generated, self.recording)
        )
        rounding = 1e-3 * body_scale(self.recording.skeleton)
        return bool(np.allclose(own, other, rtol=0.01, atol=rounding))


def load_clip(pair: Pair, fps: float | None = None, without: frozenset[str] = frozenset()) -> Clip:
    """Read a pair, and bring the generated motion to the recording's rig (`matched`).

    Args:
        pair: from `find_pairs`.
        fps: frame rate of both motions; None keeps that of the generated motion.
        without: bare names of joints that other models lack, which are left out.

    Raises:
        FormatError, MotionError: a file that cannot be read (numbers that are not finite, one
            frame), or rigs that do not match.
        FeatureError: the semantic track cannot be read.
    """
    generated = with_mouth_alone(read_motion(pair.generated))
    rate = fps or generated.fps
    recording = load_recording(pair.reference, rate)
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
    joints = tuple(name for name in joints if without_namespace(name) not in without)
    if len(joints) < 2:
        raise MotionError(f"{pair.generated}: fewer than 2 joints are common to all models")
    return Clip(pair, generated, recording, joints, semantic, (*notes, *remarks))


def matched(motion: Motion, recording: Motion) -> tuple[tuple[str, ...], Motion, list[str]]:
    """Return a generated motion on the rig of its recording.

    The legs of the recording are not compared with a motion that has none. A rig with joints of the
    same names (in any case, in any name space) and bones of the same
    lengths is cut to the common joints. Any other is retargeted or, where its body parts cannot be
    identified, compared by name.

    Returns:
        the common body joints, in the recording's order; the motion with the recording's joint
        names; notes.

    Raises:
        MotionError: neither joints of the same names nor body parts are found, or the recording has
            a single body joint.
    """
    rig = recording.skeleton
    names = body_joints(rig)
    if len(names) < 2:
        raise MotionError("the recording has 1 body joint; a motion to be measured has at least 2")
    legs = leg_joints(rig, find_legs(rig) or {}) if is_upper_body(motion.skeleton) else set()
    names = tuple(name for name in names if name not in legs)
    own = {without_namespace(name): name for name in reversed(motion.skeleton.names)}
    renamed = {
        own[without_namespace(name)]: name for name in names if without_namespace(name) in own
    }
    found = set(renamed.values())
    joints = tuple(name for name in names if name in found)
    by_name = len(joints) >= max(2, MATCHED * len(names))
    named = _renamed(motion, renamed) if by_name else motion
    notes = ["the generated rig has no legs"] if legs else []
    if not by_name or not _same_bones(named, recording, joints):
        try:
            moved = retarget(motion, rig)
            if legs:  # they would be measured as if they had been generated
                moved = moved.keep([name for name in rig.names if name not in legs])
            return names, moved, [RETARGETED, *notes]
        except MotionError as error:
            if not by_name:
                missing = [name for name in names if name not in found]
                raise MotionError(
                    f"rigs do not match: {len(joints)} of {len(names)} body joints of the "
                    f"recording are found by name (missing: {', '.join(missing[:5])} ...), and it "
                    f"cannot be retargeted: {error}"
                ) from None
            notes.append(f"another body, which cannot be retargeted ({error})")
    if len(joints) < len(names):
        notes.append(
            f"{len(names) - len(joints)} of {len(names)} body joints are not in the generated rig"
        )
    return joints, named, notes


def without_namespace(name: str) -> str:
    """Return a joint name in lower case without name space: `leftarm` for `mixamorig:LeftArm`."""
    return name.rpartition(":")[2].lower()


def _renamed(motion: Motion, renamed: dict[str, str]) -> Motion:
    """Return the motion with other joint names, {own name: new name}."""
    if all(old == new for old, new in renamed.items()):
        return motion
    skeleton = motion.skeleton
    rename = {name: renamed.get(name, name) for name in skeleton.names}
    rig = replace(
        skeleton,
        names=tuple(rename.values()),
        end_sites={rename[name]: sites for name, sites in skeleton.end_sites.items()},
    )
    moved = {rename[name]: places for name, places in motion.joint_translations.items()}
    return replace(motion, skeleton=rig, joint_translations=moved)


def _same_bones(motion: Motion, recording: Motion, joints: tuple[str, ...]) -> bool:
    """Return whether distances between neighbours among common joints agree, at rest."""
    one, other = motion.skeleton, recording.skeleton
    moving = {*motion.joint_translations, *recording.joint_translations}
    known = {other.index(name) for name in joints}
    pairs = []
    for j in known:
        above = next((a for a in other.ancestors(j) if a in known), None)
        if above is not None and other.names[j] not in moving:
            pairs.append((other.names[above], other.names[j]))
    own, wanted = _distances(one, pairs), _distances(other, pairs)
    rounding = _SHORTEST * body_scale(other)
    return bool(np.allclose(own, wanted, rtol=SAME_BONES, atol=rounding))


def _distances(rig: Skeleton, pairs: list[tuple[str, str]]) -> np.ndarray:
    rest = np.broadcast_to(IDENTITY, (rig.n_joints, 4))
    places = forward_kinematics(rest, np.zeros(3), rig)
    ends = np.array([[rig.index(name) for name in pair] for pair in pairs], int).reshape(-1, 2)
    return np.linalg.norm(places[ends[:, 1]] - places[ends[:, 0]], axis=-1)


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


def load_recording(path: Path | ItemInterval, fps: float) -> Motion:
    """Read a recording and resample it to `fps`.

    Raises:
        FormatError, MotionError: the file cannot be read.
    """
    return _motions.get((path, fps), lambda: _resampled(path, fps))


def load_wave(source: Path | ItemInterval) -> Wave:
    """Read a recording's sound.

    Raises:
        AudioError: it cannot be read.
    """
    return source.item.load_wave() if isinstance(source, ItemInterval) else Wave.load(source)


def _window(recording: Motion, start: float, pair: Pair) -> Motion:
    first = round(start * recording.fps)
    stop = min(recording.n_frames, first + round(WINDOW_SECONDS * recording.fps))
    if stop - first < 2:
        raise MotionError(
            f"{pair.generated}: {pair.reference.name} ends before its window {pair.window} "
            f"({start:g} s) begins"
        )
    return recording[first:stop]


def _later(track: FeatureTrack, start: float) -> FeatureTrack:
    keep = track.times >= start
    if not keep.any():
        keep[-1] = True
    return FeatureTrack(track.values[keep], track.times[keep] - start, track.spec, track.names)


def _resampled(path: Path | ItemInterval, fps: float) -> Motion:
    motion = with_mouth_alone(read_motion(path))
    if motion.n_frames < 2:
        raise FormatError(f"{path.name}: one frame; a motion to be measured has at least 2")
    return at_rate(motion, fps)


_motions = ByteCache[Motion](_CACHED_BYTES, lambda motion: motion.rotations.nbytes)


def read_motion(path: Path | ItemInterval) -> Motion:
    """Read a motion at its own frame rate; its errors name the file."""
    if isinstance(path, ItemInterval):
        return path.item.load_motion()
    try:
        return Motion.load(path)
    except (FormatError, MotionError) as error:
        # The error of an invalid motion does not name its file.
        text = str(error)
        raise type(error)(text if path.name in text else f"{path}: {text}") from error


_STEP = 0.01  # seconds between values of a track read from intervals


def read_semantic(path: Path) -> FeatureTrack:
    """Read a semantic track: (T, 1) scores from 0 to 1 at times in seconds.

    A feature file (npz) of one column, or BEAT's table (txt): tab-separated lines of gesture
    name, start, end, duration (seconds), score, keywords; 0 where there is no gesture.

    Raises:
        FormatError: the table is invalid.
        FeatureError: the feature file is invalid.
    """
    if path.suffix.lower() == ".npz":
        track = FeatureTrack.load(path)
        if track.values.shape[1] != 1:
            raise FormatError(
                f"{path}: {track.values.shape[1]} columns; a semantic track has one, the score"
            )
        return track
    intervals = load_semantics(path)
    if not intervals:
        raise FormatError(f"{path}: no line with a gesture in it")
    times = np.arange(round(max(end for _, end, _ in intervals) / _STEP) + 2) * _STEP
    values = np.zeros((len(times), 1), dtype=np.float32)
    for start, end, score in intervals:
        values[(times >= start) & (times <= end)] = score
    return FeatureTrack(values, times, {"kind": "semantic"}, ("score",))


_semantic = functools.lru_cache(maxsize=_CACHED)(read_semantic)


@dataclass(frozen=True, eq=False)
class RecordedSound:
    """A recording's sound and its beats.

    Attributes:
        wave: the sound.
    """

    wave: Wave

    @functools.cached_property
    def onsets(self) -> np.ndarray:
        """Speech onsets (B,), seconds."""
        return speech_onsets(self.wave)

    @functools.cached_property
    def pulse(self) -> np.ndarray:
        """Beats (B,) of the beat tracker, seconds."""
        return music_beats(self.wave)


_sounds = ByteCache[RecordedSound](_CACHED_BYTES, lambda sound: sound.wave.samples.nbytes)


def load_sound(path: Path | ItemInterval, window: int | None) -> RecordedSound:
    """Read a sound, or one 10 s window of it; recent ones are in memory.

    Raises:
        AudioError: it cannot be read.
    """

    def load() -> RecordedSound:
        wave = load_wave(path)
        at = None if window is None else window * WINDOW_SECONDS
        return RecordedSound(wave if at is None else wave.slice(at, WINDOW_SECONDS))

    return _sounds.get((path, window), load)


def forget_files() -> None:
    """Forget files in memory, which may have changed on disk since the last evaluation."""
    _motions.clear()
    _semantic.cache_clear()
    _sounds.clear()
