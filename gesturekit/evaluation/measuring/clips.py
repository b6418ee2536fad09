"""Motion in memory: clips with their recording and sound, samples of sets, the training split.

A clip is a motion and its recording on one rig, at one frame rate.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from audio_features import FeatureTrack, Wave
from gesturekit.corpus.manifest import Item
from gesturekit.errors import FormatError, GestureKitError, MotionError
from gesturekit.evaluation.metrics.hands import FPS
from gesturekit.evaluation.metrics.inputs import at_rate
from gesturekit.evaluation.metrics.mouth import with_mouth_alone
from gesturekit.evaluation.metrics.physical import joint_speed
from gesturekit.evaluation.metrics.rhythm import music_beats, speech_onsets
from gesturekit.evaluation.pairs import WINDOW_SECONDS, Excluded, Pair
from gesturekit.formats.tables import load_semantics
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.defects import MAX_SPEED, format_speed, speed_limit
from gesturekit.motion.parts import body_joints, find_legs, is_upper_body, leg_joints
from gesturekit.motion.parts.body_size import body_scale
from gesturekit.motion.retarget import retarget

LENGTH_TOLERANCE = 0.1
"""Largest difference in length between a clip and its recording without a note, seconds."""
STILL = 1e-4
"""m/s on the reference body; a frame stands still if no joint is faster."""

MOST_BYTES = 300_000_000
"""Memory of the rotations of a sample, at most: 70 minutes at 30 fps with 75 joints."""
PIECE_SECONDS = 10.0
"""Length of pieces that are drawn from larger sets, at least; shorter motions are one piece."""
TRAINING_SECONDS = 1200.0
"""Length of training motion that is compared with, at most; of more, items are drawn at random."""

MATCHED = 0.5
"""Rigs match if at least this fraction of the recording's body joints is found by name."""
SAME_BONES = 0.05
"""Largest relative difference of the bones of one body."""
SHORTER = "shorter than"
"""Words of a note on a clip that ends before its recording."""
RETARGETED = "another rig: retargeted to the recording's before it was measured"
"""Note on a clip."""

_SHORTEST = 0.01  # metres on the reference body; shorter bones differ by rounding
_CACHED_BYTES = 200_000_000  # of motions and sounds in memory: 24 minutes of 75 joints and of sound

_T = TypeVar("_T")
_Sliced = TypeVar("_Sliced", list[Any], np.ndarray)
_kept: dict[Hashable, tuple[Any, int]] = {}  # (value, its bytes); the one used last is the last


def _cached(key: Hashable, load: Callable[[], _T], size: Callable[[_T], int]) -> _T:
    """Return the value of a key, which `load` makes unless it is among the last used ones."""
    if key not in _kept:
        value = load()
        _kept[key] = value, size(value)
    _kept[key] = value, _ = _kept.pop(key)
    while sum(n for _, n in _kept.values()) > _CACHED_BYTES:
        del _kept[next(iter(_kept))]
    return value


def forget_files() -> None:
    """Forget files in memory, which may have changed on disk since the last evaluation."""
    _kept.clear()


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

    @functools.cached_property
    def same_body(self) -> bool:
        """True if the motion was made on the recording's bones, to 1 %."""
        bones = self.generated, self.recording, self.joints
        return not self.is_retargeted and _same_bones(*bones, 0.01, 1e-3)

    @property
    def is_retargeted(self) -> bool:
        """True if the motion was made on another rig."""
        return RETARGETED in self.notes


def load_clip(pair: Pair, fps: float, without: frozenset[str] = frozenset()) -> Clip:
    """Read a pair, and bring the generated motion to the recording's rig (`matched`).

    Args:
        pair: from `find_pairs`.
        fps: frame rate of both motions.
        without: bare names of joints that other models lack, which are left out.

    Raises:
        FormatError, MotionError: a file that cannot be read (numbers that are not finite, one
            frame), or rigs that do not match.
        FeatureError: the semantic track cannot be read.
    """
    made, recording = _read(pair.generated), load_recording(pair.reference, fps)
    generated = at_rate(made, fps)
    notes = [] if generated is made else [f"resampled from {made.fps:g} to {fps:g} fps"]
    semantic = None
    if (path := pair.semantic) is not None:
        semantic = _cached(path, lambda: read_semantic(path), lambda track: track.values.nbytes)
    try:
        if pair.window is not None:
            start = pair.window * WINDOW_SECONDS
            first, n_frames = (round(time * recording.fps) for time in (start, WINDOW_SECONDS))
            if recording.n_frames - first < 2:
                raise MotionError(f"it ends before its window {pair.window} ({start:g} s) begins")
            recording = recording[first : first + n_frames]
            if semantic is not None:
                semantic = replace(semantic, times=semantic.times - start)
        joints, generated, remarks = matched(generated, recording)
        joints = tuple(name for name in joints if without_namespace(name) not in without)
        if len(joints) < 2:
            raise MotionError("fewer than 2 joints are common to all models")
    except MotionError as error:
        raise MotionError(f"{pair.generated}: {pair.stem}: {error}") from None
    return Clip(pair, generated, recording, joints, semantic, (*notes, *remarks))


def matched(motion: Motion, recording: Motion) -> tuple[tuple[str, ...], Motion, list[str]]:
    """Return a generated motion on the rig of its recording.

    The legs of the recording are not compared with a motion that has none. A rig with joints of the
    same names (in any case, in any name space) and the same bones in the same rest pose is cut to
    the common joints. Any other is retargeted or, where its body parts cannot be identified,
    compared by name.

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
    bare = {name: without_namespace(name) for name in names}
    renamed = {own[bare[name]]: name for name in names if bare[name] in own}
    joints = tuple(name for name in names if name in renamed.values())
    by_name = len(joints) >= max(2, MATCHED * len(names))
    named = _renamed(motion, renamed) if by_name else motion
    notes = ["the generated rig has no legs"] if legs else []
    if not by_name or not _same_bones(named, recording, joints, SAME_BONES, _SHORTEST):
        try:
            moved = retarget(motion, rig)
            if legs:  # they would be measured as if they had been generated
                moved = moved.keep([name for name in rig.names if name not in legs])
            return names, moved, [RETARGETED, *notes]
        except MotionError as error:
            if not by_name:
                lost = ", ".join([name for name in names if name not in joints][:5])
                raise MotionError(
                    f"rigs do not match: {len(joints)} of {len(names)} body joints of the "
                    f"recording are found by name (missing: {lost} ...), and it cannot be "
                    f"retargeted: {error}"
                ) from None
            notes.append(f"another body, which cannot be retargeted ({error})")
    if missing := len(names) - len(joints):
        notes.append(f"{missing} of {len(names)} body joints are not in the generated rig")
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


def _same_bones(
    motion: Motion, recording: Motion, joints: tuple[str, ...], within: float, rounding: float
) -> bool:
    """Return whether bones between common joints are the same at rest, in length and direction.

    In another rest pose, the same rotations are other postures.

    Args:
        motion, recording: two motions.
        joints: names of common joints.
        within: largest difference as a share of the length of a bone.
        rounding: difference on the reference body that is always allowed, metres.
    """
    one, other = motion.skeleton, recording.skeleton
    moving = {*motion.joint_translations, *recording.joint_translations}
    known = {other.index(name) for name in joints}
    pairs = []
    for j in known:
        above = next((a for a in other.ancestors(j) if a in known), None)
        if above is not None and other.names[j] not in moving:
            pairs.append((other.names[above], other.names[j]))

    def bones(rig: Skeleton) -> np.ndarray:
        ends = np.array([[rig.index(name) for name in pair] for pair in pairs], int).reshape(-1, 2)
        places = rig.rest_positions[ends]
        return places[:, 1] - places[:, 0]

    own, wanted = bones(one), bones(other)
    allowed = within * np.linalg.norm(wanted, axis=-1) + rounding * body_scale(other)
    return bool((np.linalg.norm(own - wanted, axis=-1) <= allowed).all())


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
        notes.append(f"{abs(gap):.2f} s {'longer than' if gap > 0 else SHORTER} {what}")
    scale = body_scale(clip.generated.skeleton)
    fastest = joint_speed(clip.generated, clip.joints).max(axis=1)
    still = float((fastest < STILL * scale).mean())
    if still > 0.05:
        notes.append(f"stands still in {100 * still:.0f} % of its frames")
    if fastest.max() > (limit := MAX_SPEED * scale):
        at, speed = fastest.argmax() / fps, format_speed(fastest.max())
        notes.append(f"jumps at {at:.2f} s ({speed}, {speed_limit(limit)})")
    return notes


def load_recording(item: Item, fps: float) -> Motion:
    """Read a recording and resample it to `fps`.

    Raises:
        CorpusError, FormatError, MotionError: the file cannot be read.
    """
    return _cached(
        (item, fps), lambda: at_rate(_read(item), fps), lambda motion: motion.rotations.nbytes
    )


def _read(item: Item) -> Motion:
    motion = with_mouth_alone(item.load_motion())
    if motion.n_frames < 2:
        raise FormatError(f"{item}: one frame; a motion to be measured has at least 2")
    return motion


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


def load_sound(item: Item, window: int | None) -> RecordedSound:
    """Read a sound, or one 10 s window of it; recent ones are in memory.

    Raises:
        AudioError: it cannot be read.
    """

    def load() -> RecordedSound:
        wave = item.load_wave()
        at = None if window is None else window * WINDOW_SECONDS
        return RecordedSound(wave if at is None else wave.slice(at, WINDOW_SECONDS))

    return _cached(("sound", item, window), load, lambda sound: sound.wave.samples.nbytes)


class MotionSample:
    """Keeps all motions that are added; of more than `most` bytes, a random sample of pieces.

    Each piece gets a random number from (seed, number of its motion). Pieces whose number is below
    a threshold are kept, and the threshold is halved as long as they are too many: each piece of
    the set is kept with the same probability. Samples of one seed keep the same pieces of motions
    that are added in the same order, if they are equally large.

    Args:
        seed: seed of the random numbers.
        most: bytes of rotations to keep.

    Attributes:
        count: number of motions that were added.
        seconds: their length.
    """

    def __init__(self, seed: int, most: int = MOST_BYTES) -> None:
        self.count = 0
        self.seconds = 0.0
        self._seed = seed
        self._most = most
        self._kept: list[_Piece] = []
        self._bytes = 0
        self._threshold = 1.0

    def add(self, motion: Motion) -> None:
        """Add a motion; only copies of its pieces are kept if the set is larger than the limit."""
        piece: _Piece = (self.count, 0.0, motion)
        self.count += 1
        self.seconds += motion.duration
        added = [piece] if self.is_whole else self._drawn([piece])
        self._kept += added
        self._bytes += _size(added)
        while self._bytes > self._most:
            whole = self.is_whole
            self._threshold /= 2
            below = [piece for piece in self._kept if piece[1] < self._threshold]
            self._kept = self._drawn(self._kept) if whole else below
            self._bytes = _size(self._kept)

    @property
    def is_whole(self) -> bool:
        """True if all motion that was added is kept, uncut."""
        return self._threshold == 1.0

    @property
    def motions(self) -> list[Motion]:
        """The motions or pieces that are kept, in order."""
        return [motion for _, _, motion in self._kept]

    @property
    def owners(self) -> list[int]:
        """Number of the added motion, from 0, that each of `motions` is part of."""
        return [owner for owner, _, _ in self._kept]

    def _drawn(self, whole: Iterable[_Piece]) -> list[_Piece]:
        """Cut motions into pieces; return copies of those below the threshold."""
        kept = []
        for owner, _, motion in whole:
            count = max(1, int(motion.duration / PIECE_SECONDS))
            ends = [i * motion.n_frames // count for i in range(count + 1)]
            draws = np.random.default_rng([self._seed, owner]).random(count)
            kept += [
                (owner, draw, copied(motion, start, stop))
                for start, stop, draw in zip(ends, ends[1:], draws.tolist())
                if draw < self._threshold
            ]
        return kept


_Piece = tuple[int, float, Motion]
"""Number of a motion, random number, and the motion or piece of it."""


def copied(motion: Motion, start_frame: int, stop_frame: int) -> Motion:
    """Return a copy of some frames, which does not keep the whole motion in memory as a slice does.

    Raises:
        MotionError: the range is empty.
    """
    return chosen_frames(motion, np.arange(start_frame, min(stop_frame, motion.n_frames)))


def chosen_frames(motion: Motion, frames: np.ndarray) -> Motion:
    """Return chosen frames (T,) of a motion, in that order, at its frame rate."""
    return replace(
        motion,
        rotations=motion.rotations[frames],
        translation=motion.translation[frames],
        joint_translations={name: v[frames] for name, v in motion.joint_translations.items()},
        face=None,
    )


def _size(pieces: Iterable[_Piece]) -> int:
    return sum(motion.rotations.nbytes for _, _, motion in pieces)


def training_motion(
    items: Sequence[Item], seed: int
) -> tuple[list[tuple[Motion, str | None]], list[Excluded]]:
    """Return (motion at 25 fps, its speaker) of a training split, and the items left out.

    Args:
        items: of the split; of more than `TRAINING_SECONDS`, so much is drawn at random.
        seed: seed of the draw.
    """
    motions: list[tuple[Motion, str | None]] = []
    excluded: list[Excluded] = []
    order, left = list(items), TRAINING_SECONDS
    if sum(item.duration for item in items) > TRAINING_SECONDS:
        np.random.default_rng(seed).shuffle(order)
    for item in order:
        if left < 1.0:
            break
        try:
            motion = load_recording(item, FPS)
        except GestureKitError as error:
            excluded.append(Excluded(item.id, str(error), "the training split"))
            continue
        motion = copied(motion, 0, min(motion.n_frames, round(left * FPS)))
        left -= motion.duration
        motions.append((motion, item.speaker))
    return motions, excluded


def halves(motions: Sequence[Motion]) -> tuple[list[Motion], list[Motion]]:
    """Return every other recording, and the rest; of a single one its halves.

    Raises:
        MotionError: a single one has one frame.
    """
    if len(motions) > 1:
        return list(motions[::2]), list(motions[1::2])
    (motion,) = motions
    middle = motion.n_frames // 2
    if middle < 1:
        raise MotionError("the recording is too short to be cut into halves")
    return [motion[:middle]], [motion[middle:]]


def evenly(items: _Sliced, most: int) -> _Sliced:
    """Return every k-th item, with the least k that leaves at most `most`."""
    return items[:: max(1, -(-len(items) // most))]
