"""Rhythm: alignment of motion beats with beats or onsets of the sound.

Two published metrics, each with its chance level. Kernels and windows are in seconds, where the
published code (variant "bailando") counts frames: they do not depend on the frame rate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from audio_features import Wave
from audio_features.acoustic import import_librosa
from gesturekit.evaluation.metrics.hands import upper_joints
from gesturekit.evaluation.metrics.inputs import check_choice, check_frames
from gesturekit.evaluation.metrics.physical import CUTOFF, derivative, joint_paths
from gesturekit.evaluation.metrics.sync import MIN_SHIFT, against_chance
from gesturekit.motion import Motion
from gesturekit.motion.parts.body_size import body_scale

SMOOTHING = 5 / 60
"""Seconds; σ of the Gaussian over the speed curve in beat alignment: 5 frames at 60 fps."""
KERNEL = 3 / 60
"""Seconds; σ of beat alignment: 3 frames at 60 fps."""
SMOOTHING_FRAMES, KERNEL_FRAMES = 5, 3
"""The same in frames of any rate, for the variant "bailando"."""
CONSISTENCY_KERNEL = 0.3
"""Seconds; σ of beat consistency."""
CONSISTENCY_ORDER = 7 / 30
"""Seconds to either side within which a beat is the minimum: 7 frames at 30 fps."""
CONSISTENCY_SPEED = 0.1
"""Least speed of a beat in beat consistency, as a fraction of the joint's mean speed."""
SHIFT_STEP = 0.1
"""Seconds between two circular shifts of the sound, for the chance level."""

MOST_SHIFTS = 1000
"""Shifts of the sound, at most; of longer clips than 102 s, evenly spaced ones are taken."""

_BLOCK = 1_000_000  # shifts times beats that are compared at a time
_ONSET_RATE, _ONSET_HOP = 16_000, 512
_STILL = 1e-6  # m/s on the reference body; a speed that varies less has no beats


@dataclass(frozen=True)
class BeatResult:
    """Result of a beat metric.

    Attributes:
        score: 0 to 1; mean over the sound's beats of the kernel at the nearest motion beat.
        chance_mean: mean of the score over all circular shifts of the sound of more than 1 s.
        chance_sd: their standard deviation.
        z: (score - chance_mean) / chance_sd.
        motion_beats: number of motion beats (mean over joints for beat consistency).
        sound_beats: number of beats of the sound.
        note: "" or why a value is 0 without having been measured.

    Examples:
        Beats of a motion that all meet beats of the sound:

        >>> result = alignment(np.array([1.0, 2.5, 3.0]), np.array([1.0, 2.5, 3.0]), 10)
        >>> result.score, result.motion_beats, result.sound_beats, result.z > 3
        (1.0, 3.0, 3, True)
    """

    score: float
    chance_mean: float
    chance_sd: float
    z: float
    motion_beats: float
    sound_beats: int
    note: str = ""

    @property
    def value(self) -> float:
        """The score."""
        return self.score


def beat_alignment(
    motion: Motion,
    beats: np.ndarray,
    *,
    variant: Literal["seconds", "bailando"] = "seconds",
    joints: Sequence[str] | None = None,
) -> BeatResult:
    """Return BAS: 1/|B| Σ over beats b of the sound of exp(-min_m (b - m)² / 2σ²), σ = 50 ms.

    The form of AIST++ and Bailando (utils/beat_align_score.py), for one clip; published values are
    means over clips.

    Args:
        motion: the motion; beats after its end do not count.
        beats: (B,) seconds of the sound's beats, such as `music_beats` gives.
        variant: "seconds" takes the speed of the motion low-passed at 6 Hz (`derivative`) and
            places beats between frames by a parabola through three of them. "bailando" takes
            frame differences, beats at the first frame of their step, σ of 5 frames for the speed
            and of 3 frames here, and no beats of the sound from the last frame on, as its code
            does: the score depends on the frame rate.
        joints: names; None for the body joints.

    Raises:
        MotionError: fewer than 6 frames, a frame rate of 12 fps or less, or joints that cannot
            be identified.

    Examples:
        A body that slows down at 0.5 s, 1.5 s, ..., and a sound with beats there:

        >>> rig = gk.load("demo").skeleton
        >>> still, times = np.tile([0.0, 0, 0, 1], (120, rig.n_joints, 1)), np.arange(120) / 30
        >>> path = np.outer(times + 0.1 * np.sin(2 * np.pi * times), [1, 0, 0])
        >>> round(beat_alignment(gk.Motion(rig, still, path, 30), np.arange(4) + 0.5).score, 2)
        1.0
    """
    found = motion_beats(motion, variant=variant, joints=joints)
    rate = motion.fps if variant == "bailando" else None
    return alignment(found, beats, motion.duration, rate)


def beat_consistency(
    motion: Motion,
    onsets: np.ndarray,
    *,
    mean_speed: np.ndarray | None = None,
    joints: Sequence[str] | None = None,
) -> BeatResult:
    """Return BC of BEAT and EMAGE: the same sum over onsets, σ = 0.3 s, averaged over joints.

    A joint's beats are its local speed minima over ±7/30 s that are faster than a tenth of its
    mean speed (a joint at rest has no beats); speeds are central differences. The kernel is wide,
    so that the chance level is high: compare the score with it.

    Args:
        motion: the motion; onsets after its end do not count.
        onsets: (B,) seconds, such as `speech_onsets` gives.
        mean_speed: (J,) m/s, each joint's mean speed over the reference set; None takes the
            motion's own.
        joints: names; None for the upper body without fingers.

    Raises:
        MotionError: fewer than 3 frames, or joints that cannot be identified.

    Examples:
        A body that slows down at 0.5 s, 1.5 s, ..., and a sound with onsets 0.3 s later, exp(-1/2):

        >>> rig = gk.load("demo").skeleton
        >>> still, times = np.tile([0.0, 0, 0, 1], (120, rig.n_joints, 1)), np.arange(120) / 30
        >>> path = np.outer(times + 0.1 * np.sin(2 * np.pi * times), [1, 0, 0])
        >>> round(beat_consistency(gk.Motion(rig, still, path, 30), np.arange(4) + 0.8).score, 2)
        0.61
    """
    found = joint_beats(motion, mean_speed=mean_speed, joints=joints)
    return consistency(found, onsets, motion.duration)


def alignment(
    beats: np.ndarray, pulse: np.ndarray, duration: float, frame_rate: float | None = None
) -> BeatResult:
    """Return the beat alignment of beats that are known, see `beat_alignment`.

    Args:
        beats: (M,) beats of the motion, seconds.
        pulse: (B,) beats of the sound, seconds.
        duration: of the motion, seconds.
        frame_rate: of the motion, for the variant "bailando"; None for "seconds".

    Examples:
        All beats of the motion are 50 ms late, exp(-1/2):

        >>> round(alignment(np.array([1.05, 2.05]), np.array([1.0, 2.0]), 10).score, 3)
        0.607
    """
    if frame_rate is None:
        return beat_result([beats], pulse, duration, KERNEL)
    steps = round(duration * frame_rate) - 1
    return beat_result([beats], pulse, steps / frame_rate, KERNEL_FRAMES / frame_rate)


def consistency(
    beats_by_joint: Sequence[np.ndarray], onsets: np.ndarray, duration: float
) -> BeatResult:
    """Return the beat consistency of beats (M,) of each joint, see `beat_consistency`.

    Examples:
        The beats of one of two joints are all met, those of the other are 0.3 s late, exp(-1/2):

        >>> onsets = np.array([1.0, 3.0])
        >>> round(consistency([onsets, onsets + 0.3], onsets, 10).score, 3)
        0.803
    """
    return beat_result(beats_by_joint, onsets, duration, CONSISTENCY_KERNEL)


def joint_beats(
    motion: Motion, *, mean_speed: np.ndarray | None = None, joints: Sequence[str] | None = None
) -> list[np.ndarray]:
    """Return the beats (M,) of each joint, seconds; see `beat_consistency`."""
    names = upper_joints(motion.skeleton) if joints is None else joints
    speed = central_speed(motion, names)
    usual = speed.mean(axis=0) if mean_speed is None else np.asarray(mean_speed)
    order = max(1, round(CONSISTENCY_ORDER * motion.fps))
    still = _STILL * body_scale(motion.skeleton)
    found = []
    for curve, mean in zip(speed.T, usual, strict=True):
        at, times = _minima(curve, order)
        found.append(times[curve[at] > max(CONSISTENCY_SPEED * mean, still)] / motion.fps)
    return found


def motion_beats(
    motion: Motion,
    *,
    variant: Literal["seconds", "bailando"] = "seconds",
    joints: Sequence[str] | None = None,
) -> np.ndarray:
    """Return the local minima of the mean joint speed, smoothed with σ = 83 ms, or 5 frames.

    Returns:
        (M,) seconds; see `beat_alignment` for the variants.

    Examples:
        A body that slows down once a second:

        >>> rig = gk.load("demo").skeleton
        >>> still, times = np.tile([0.0, 0, 0, 1], (120, rig.n_joints, 1)), np.arange(120) / 30
        >>> path = np.outer(times + 0.1 * np.sin(2 * np.pi * times), [1, 0, 0])
        >>> motion_beats(gk.Motion(rig, still, path, 30)).round(2).tolist()
        [0.5, 1.5, 2.5, 3.5]
    """
    from scipy.ndimage import gaussian_filter1d
    from scipy.signal import argrelextrema

    check_choice("beat alignment variant", variant, ("seconds", "bailando"))
    is_published = variant == "bailando"
    cutoff, sigma = (None, SMOOTHING_FRAMES) if is_published else (CUTOFF, SMOOTHING * motion.fps)
    velocity = derivative(joint_paths(motion, joints), motion.fps, 1, cutoff)
    smooth = gaussian_filter1d(np.linalg.norm(velocity, axis=-1).mean(axis=1), sigma)
    if np.ptp(smooth) < _STILL * body_scale(motion.skeleton):
        return np.empty(0)
    if is_published:
        return argrelextrema(smooth, np.less)[0] / motion.fps
    return _minima(smooth, 1)[1] / motion.fps


def speech_onsets(wave: Wave) -> np.ndarray:
    """Return (B,) onsets of the sound, seconds: librosa at 16 kHz, hop 512, as in EMAGE.

    Examples:
        Clicks after one and two seconds:

        >>> samples = np.zeros(48000)
        >>> samples[[16000, 32000]] = 1
        >>> speech_onsets(af.Wave(samples, 16000)).round(1).tolist()
        [1.0, 2.0]
    """
    if wave.is_silent:
        return np.empty(0)
    sound = wave.resample(_ONSET_RATE)
    return import_librosa().onset.onset_detect(
        y=sound.samples, sr=_ONSET_RATE, hop_length=_ONSET_HOP, units="time"
    )


def music_beats(wave: Wave) -> np.ndarray:
    """Return (B,) beats of librosa's beat tracker, seconds; it finds beats in speech too.

    Examples:
        Clicks at 120 a minute:

        >>> clicks = np.zeros(8 * 22050)
        >>> clicks[::11025] = 1
        >>> np.diff(music_beats(af.Wave(clicks, 22050))).mean().round(1).tolist()
        0.5
    """
    if wave.is_silent:
        return np.empty(0)
    return import_librosa().beat.beat_track(y=wave.samples, sr=wave.sample_rate, units="time")[1]


def central_speed(motion: Motion, joints: Sequence[str]) -> np.ndarray:
    """Return (T, J) speeds by central differences, one-sided at both ends, as in BEAT, m/s."""
    check_frames(motion, 3, motion.fps)
    return np.linalg.norm(np.gradient(joint_paths(motion, joints), 1 / motion.fps, axis=0), axis=-1)


def _minima(curve: np.ndarray, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Return indices (M,) of local minima of (T,) within ±order, and sub-sample positions (M,).

    Two equal lowest samples are one minimum between them; a longer plateau is rest, not a minimum.
    """
    from scipy.signal import argrelextrema

    (low,) = argrelextrema(curve, np.less_equal, order=order)
    runs = np.split(low, np.flatnonzero(np.diff(low) > 1) + 1)
    at = np.array([run[0] for run in runs if len(run) <= 2], dtype=np.int64)
    at = at[(at > 0) & (at < len(curve) - 1)]
    before, here, after = curve[at - 1], curve[at], curve[at + 1]
    bend = before - 2 * here + after
    return at, at + 0.5 * (before - after) / np.maximum(bend, 1e-30)


def beat_result(
    found: Sequence[np.ndarray], beats: np.ndarray, duration: float, sigma: float
) -> BeatResult:
    """Compare beats of a motion with those of a sound; see `beat_alignment`.

    Args:
        found: beats (M,) of the motion or of each of its joints, seconds.
        beats: (B,) beats of the sound, seconds; those after the motion's end do not count.
        duration: of the motion, seconds.
        sigma: of the kernel, seconds.
    """
    beats = np.asarray(beats, dtype=np.float64)
    beats = beats[(beats >= 0) & (beats < duration)]
    count = float(np.mean([len(times) for times in found]))
    if len(beats) == 0:
        return BeatResult(0.0, 0.0, 0.0, 0.0, count, 0, "the sound has no beats (silence?)")
    if count == 0:
        return BeatResult(0.0, 0.0, 0.0, 0.0, 0.0, len(beats), "the motion has no beats")
    score = float(np.mean([_met(beats[None], times, sigma)[0] for times in found]))
    shifts = np.arange(MIN_SHIFT + SHIFT_STEP, duration - MIN_SHIFT, SHIFT_STEP)
    shifts = shifts[:: max(1, -(-len(shifts) // MOST_SHIFTS))]
    chance = []
    for block in np.array_split(shifts, len(shifts) * len(beats) // _BLOCK + 1):
        moved = (beats[None] + block[:, None]) % duration
        chance.append(np.mean([_met(moved, times, sigma) for times in found], axis=0))
    mean, sd, z, note = against_chance(score, np.concatenate(chance), duration)
    return BeatResult(score, mean, sd, z, count, len(beats), note)


def _met(beats: np.ndarray, times: np.ndarray, sigma: float) -> np.ndarray:
    """Return (S,) means over beats (S, B) of exp(-d²/2σ²), d the distance to the nearest time."""
    if len(times) == 0:
        return np.zeros(len(beats))
    after = np.searchsorted(times, beats)
    near = np.minimum(
        np.abs(beats - times[np.minimum(after, len(times) - 1)]),
        np.abs(beats - times[np.maximum(after - 1, 0)]),
    )
    return np.exp(-(near**2) / (2 * sigma**2)).mean(axis=1)
