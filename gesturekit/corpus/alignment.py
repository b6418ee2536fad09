"""Shift between sound and motion of a corpus, by its speech energy and the speed of the arms.

Recordings whose devices were started one after the other are apart by the same time throughout. The
lag at which arm speed and speech energy correlate most says by how much, if the correlation there
stands out from that at other lags. It does for a minute or two of a speaker whose arms follow the
speech; shorter recordings say it together.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from audio_features import Wave
from gesturekit.corpus.checks import Problem
from gesturekit.errors import MotionError
from gesturekit.motion import Motion
from gesturekit.motion.parts import arm_joints
from gesturekit.wording import counted

WINDOW = 0.05  # seconds of sound in the RMS of one envelope value
FLOOR = 1e-4  # added to the RMS before the logarithm: -80 dB of full scale
SIGMA = 0.1  # seconds, standard deviation of the Gaussian that smooths both curves

LONGEST = 4.0
"""Largest lag that is tried, seconds."""
LEAD = 0.15
"""Seconds by which arms are ahead of the sound in recordings that are in time: 0.12 to 0.2 s of one
speaker in three takes, 0.2 to 0.28 s of others."""
CLEAR = 4.5
"""Standard deviations from which on a correlation is not chance: with the sound of another
recording the largest of 1,400 excerpts of 20 to 60 s was 4.4."""
NOTABLE = 0.25
"""Shift of which `prepare` warns, seconds: 0.3 s, and what rounds to it."""

_RATE = 25.0
_SLOW = 2.0  # seconds; the Gaussian mean of both curves, which is taken off: calm and lively parts
_REST, _STILL = 0.05, 1e-6  # of the mean arm speed, and rad/s: added before the logarithm
_FLAT = 0.05  # standard deviation, nepers; of speech it is ten times as large


@dataclass(frozen=True, eq=False)
class Correlation:
    """Correlation of arm speed and speech energy of a recording, or of several, at each lag.

    Attributes:
        values: (L,) at the lags from -`LONGEST` to `LONGEST` at 25 per second; at a positive one
            the motion comes after the sound.
        sd: standard deviation by chance, over all circular shifts of the sound.
        n_frames: number of frames.
    """

    values: np.ndarray
    sd: float
    n_frames: int

    @cached_property
    def shift(self) -> float:
        """Seconds by which the motion comes later than in a recording that is in time."""
        return (int(self.values.argmax()) - len(self.values) // 2) / _RATE + LEAD

    @property
    def z(self) -> float:
        """The largest correlation in standard deviations by chance."""
        return float(self.values.max() / self.sd)

    @property
    def is_clear(self) -> bool:
        """True if the shift is not chance."""
        return self.z >= CLEAR

    @property
    def is_notable(self) -> bool:
        """True if the shift is not chance, and long enough to be corrected."""
        return self.is_clear and abs(self.shift) >= NOTABLE

    def __str__(self) -> str:
        when = "after" if self.shift > 0 else "before"
        sure = f"a correlation {self.z:.1f} standard deviations above chance"
        return f"the motion comes {abs(self.shift):.2f} s {when} the sound ({sure})"


def correlate(motion: Motion, wave: Wave) -> Correlation | None:
    """Correlate the arm speed of a motion with the energy of a sound that begins with it.

    Returns:
        the correlation; None for less than 4 s, constant sound, and arms that do not move or
        cannot be identified.
    """
    n_frames = min(wave.n_frames(_RATE), math.floor(motion.duration * _RATE))
    reach = round(LONGEST * _RATE)
    if n_frames <= reach:
        return None
    try:
        speed = arm_speed(motion)
    except MotionError:
        return None
    speed = smoothed(np.log(speed + _REST * speed.mean() + _STILL), motion.fps)
    times = np.arange(n_frames) / _RATE
    speed = np.interp(times, np.arange(motion.n_frames) / motion.fps, speed)
    energy = smoothed(speech_envelope(wave, _RATE, n_frames), _RATE)
    curves = np.stack([speed, energy])
    curves -= [smoothed(curve, _RATE, _SLOW) for curve in curves]
    curves -= curves.mean(axis=1, keepdims=True)
    if (sds := curves.std(axis=1)).min() < _FLAT:
        return None
    curves /= sds[:, None]

    def cross(length: int) -> np.ndarray:
        moves, sounds = np.fft.rfft(curves, length)
        return np.fft.irfft(moves * np.conj(sounds), length) / n_frames

    values = cross(2 * n_frames)[np.arange(-reach, reach + 1)]  # zeros beyond the ends
    return Correlation(values, float(cross(n_frames).std()), n_frames)


def pooled(each: Sequence[Correlation]) -> Correlation | None:
    """Return the correlation over all frames of several recordings; None without any."""
    if not each:
        return None
    weights = np.array([correlation.n_frames for correlation in each], float)
    total = weights.sum()
    values = weights @ np.stack([correlation.values for correlation in each]) / total
    sd = np.linalg.norm(weights * [correlation.sd for correlation in each]) / total
    return Correlation(values, float(sd), int(total))


def shift_problems(
    correlations: Sequence[tuple[Path, Correlation]], taken_back: float = 0.0
) -> list[Problem]:
    """Return warnings of a shift of the corpus, and of recordings that have another one.

    Args:
        correlations: motion file and correlation of each recording.
        taken_back: shift of all that was taken back before, seconds.
    """
    every, usual, problems = pooled([each for _, each in correlations]), 0.0, []
    if every is not None and every.is_notable:
        usual, count = every.shift, len(correlations)
        over = f" in {counted(count, 'recording')} together" if count > 1 else ""
        option = f"--shift {usual + taken_back:.2f}"
        text = f"{every}{over}: {option} corrects it, --shift auto for each recording"
        problems.append(Problem("warning", correlations[0][0] if count == 1 else None, text))
    return problems + [
        Problem("warning", file, f"{each}: --shift auto corrects it")
        for file, each in correlations
        if each.is_clear and abs(each.shift - usual) >= NOTABLE
    ]


def corrections(correlations: Sequence[Correlation | None]) -> list[float]:
    """Return the shift of each recording that is to be corrected, seconds.

    It is the recording's own if that is not chance, else that of all together; 0 if neither is
    notable.
    """
    every = pooled([each for each in correlations if each is not None])
    chosen = [each if each is not None and each.is_clear else every for each in correlations]
    return [each.shift if each is not None and each.is_notable else 0.0 for each in chosen]


def arm_speed(motion: Motion) -> np.ndarray:
    """Return the summed local angular speed of both shoulder and elbow joints for each frame.

    The value of a frame is the mean of the steps before and after it, so that the speed is not
    delayed by half a frame. The first and last frames have only one step.

    Returns:
        (T,) radians per second.

    Raises:
        MotionError: fewer than 2 frames, or no shoulders and elbows in the skeleton.

    Examples:
        The left elbow turns by one radian per second:

        >>> rig = gk.load("demo").skeleton
        >>> turns, half = np.tile([0.0, 0, 0, 1], (30, rig.n_joints, 1)), np.arange(30) / 60
        >>> turns[:, rig.index("LeftForeArm"), 2:] = np.stack([np.sin(half), np.cos(half)], axis=1)
        >>> arm_speed(gk.Motion(rig, turns, np.zeros((30, 3)), 30))[:3].round(6).tolist()
        [1.0, 1.0, 1.0]
    """
    if motion.n_frames < 2:
        raise MotionError("a motion of one frame has no speed: give at least 2 frames")
    joints = [motion.skeleton.index(name) for name in arm_joints(motion.skeleton)]
    q = motion.rotations[:, joints]
    # |q1 - q0| = 2 sin(angle / 4) for unit quaternions of one hemisphere: exact near zero,
    # where the arc cosine of a dot product loses half of its digits.
    step, flipped = q[1:] - q[:-1], q[1:] + q[:-1]
    chord = np.minimum(np.linalg.norm(step, axis=-1), np.linalg.norm(flipped, axis=-1))
    steps = (4.0 * np.arcsin(chord / 2.0)).sum(axis=1) * motion.fps
    padded = np.concatenate([steps[:1], steps, steps[-1:]])
    return 0.5 * (padded[:-1] + padded[1:])


def speech_envelope(wave: Wave, fps: float, n_frames: int) -> np.ndarray:
    """Return ln(RMS + 1e-4) of the 50 ms of sound around each motion frame.

    Frame k is centred at k/fps seconds. Windows are cut off at the ends of the sound; outside it
    there is silence.

    Returns:
        (n_frames,) nepers of full scale, not smoothed.

    Examples:
        Silence, ln(1e-4), and a sound at full scale from 0.5 s on:

        >>> samples = np.repeat([0.0, 1.0], 8000) * np.resize([1.0, -1.0], 16000)
        >>> speech_envelope(af.Wave(samples, 16000), fps=4, n_frames=4).round(2).tolist()
        [-9.21, -9.21, -0.35, 0.0]
    """
    return np.log(wave.rms(np.arange(n_frames) / fps, window=WINDOW) + FLOOR)


def smoothed(curve: np.ndarray, fps: float, sigma: float = SIGMA) -> np.ndarray:
    """Smooth a curve by a Gaussian of `sigma` seconds."""
    from scipy.ndimage import gaussian_filter1d

    return gaussian_filter1d(curve, sigma * fps, mode="nearest")
