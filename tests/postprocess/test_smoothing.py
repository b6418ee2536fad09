"""Jitter goes, beats and feet stay."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rigs import at_rest
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks
from scipy.special import erf

import audio_features as af
from gesturekit import Motion
from gesturekit.errors import MotionError
from gesturekit.evaluation import arm_speed, sync
from gesturekit.motion.rotations import (
    multiply_quaternions,
    quaternion_from_euler,
    quaternion_from_rotation_vector,
    rotation_angles,
)
from gesturekit.postprocess import smooth_motion


@pytest.fixture
def beating(gesture) -> Motion:
    """Three strokes of an arm, half a second each, on a body that trembles."""
    motion = gesture(8.0)
    angles = np.zeros((motion.n_frames, 3))
    for at in (2.0, 4.0, 6.0):
        angles[:, 0] += 60 / (1 + np.exp(-(motion.times - at) / 0.06))
    rotations = motion.rotations * 0 + [0.0, 0.0, 0.0, 1.0]
    rotations[:, motion.skeleton.index("RightArm")] = quaternion_from_euler(angles, "XYZ")
    tremble = np.random.default_rng(0).normal(0, 0.006, (*rotations.shape[:2], 3))
    turns = quaternion_from_rotation_vector(tremble)
    return replace(motion, rotations=multiply_quaternions(rotations, turns))


def test_trembling_goes_and_strokes_keep_time_and_height(beating):
    smooth = smooth_motion(beating, 0.4)
    before, after = arm_speed(beating), arm_speed(smooth)
    between = (np.abs(beating.times[:, None] - [2.0, 4.0, 6.0]) > 0.5).all(axis=1)
    assert after[between].mean() < 0.25 * before[between].mean()
    steady = gaussian_filter1d(before, 1)
    for at in (60, 120, 180):
        near = np.s_[at - 10 : at + 10]
        assert abs(int(after[near].argmax()) - int(steady[near].argmax())) <= 1
        assert after[near].max() > 0.85 * steady[near].max()


def test_legs_and_the_path_stay(beating):
    smooth = smooth_motion(beating, 0.4)
    legs = [j for j, name in enumerate(beating.skeleton.names) if "Leg" in name or "Foot" in name]
    turned = np.abs((smooth.global_rotations() * beating.global_rotations()).sum(axis=-1))[:, legs]
    assert turned.min() > 1 - 1e-12
    moved = np.linalg.norm(smooth.positions() - beating.positions(), axis=-1)[:, legs]
    assert 0 < moved.max() < 0.005
    assert (smooth.translation == beating.translation).all()


def test_trembling_hips_do_not_shake_the_head(beating):
    def jerk(motion: Motion) -> float:
        head = motion.positions()[:, motion.skeleton.index("Head")]
        return float(np.linalg.norm(np.diff(head, 3, axis=0), axis=-1).mean())

    assert jerk(smooth_motion(beating, 0.4)) < 0.2 * jerk(beating)


def test_quaternions_of_the_other_sign_are_the_same_motion(beating):
    flipped = beating.rotations.copy()
    flipped[::3] *= -1
    one, other = (smooth_motion(m, 0.2) for m in (beating, replace(beating, rotations=flipped)))
    assert np.abs(one.positions() - other.positions()).max() < 1e-9


def swinging(skeleton, joint: str, hertz: float, fps: float = 60.0) -> tuple[Motion, np.ndarray]:
    """Twenty seconds in which one joint turns about Y by 0.1 rad, to and fro; and its angles."""
    motion = at_rest(skeleton, round(20 * fps), fps=fps)
    angles = 0.1 * np.sin(2 * np.pi * hertz * motion.times)
    turns = quaternion_from_rotation_vector(angles[:, None] * [0.0, 1.0, 0.0])
    motion.rotations[:, skeleton.index(joint)] = turns
    return motion, angles


def gain(smooth: Motion, joint: str, angles: np.ndarray) -> float:
    """Amplitude that is left in the middle, against the turn's; also shown to be in phase."""
    inner = np.s_[len(angles) // 4 : -len(angles) // 4]
    q = smooth.rotations[inner, smooth.skeleton.index(joint)]
    left = 2 * np.arctan2(q[:, 1], q[:, 3])
    share = float(left @ angles[inner] / (angles[inner] @ angles[inner]))
    np.testing.assert_allclose(left, share * angles[inner], atol=1e-4)
    return share


@pytest.mark.parametrize(
    ("seconds", "hertz", "expected"),
    [(0.5, 0.5, 0.942), (0.5, 1.0, 0.5), (0.5, 2.0, 0.0582), (0.25, 2.0, 0.5), (1.0, 0.5, 0.5)],
)
def test_what_is_shorter_than_the_seconds_is_removed(skeleton, seconds, hertz, expected):
    """A Butterworth filter of order 2, run forwards and backwards, halves its cutoff frequency,
    1 / (2 seconds) Hz, and has the gain 1 / (1 + r^4) at others; r is tan(pi f / fps) over that
    of the cutoff. At 60 fps, 0.5 Hz against 1 Hz: 1 / (1 + 0.4995^4); 2 Hz: 1 / (1 + 2.0055^4).
    """
    motion, angles = swinging(skeleton, "Hips", hertz)
    assert gain(smooth_motion(motion, seconds), "Hips", angles) == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize(("hertz", "expected"), [(3.0, 0.9466), (6.0, 0.5), (12.0, 0.0385)])
@pytest.mark.parametrize("seconds", [0.01, 1 / 12])
def test_jitter_above_six_hertz_is_removed_even_from_beats(skeleton, seconds, hertz, expected):
    """tan(pi f / 60) is 0.1584, 0.3249 and 0.7265 at 3, 6 and 12 Hz."""
    motion, angles = swinging(skeleton, "LeftArm", hertz)
    found = gain(smooth_motion(motion, seconds), "LeftArm", angles)
    assert found == pytest.approx(expected, abs=1e-3)


def test_beats_pass_only_the_filter_of_six_hertz(skeleton):
    """At 3 Hz an arm's speed has a peak every 1/6 s, so that all frames are within 0.1 s of one."""
    motion, angles = swinging(skeleton, "LeftArm", 3.0)
    found = gain(smooth_motion(motion, 1.0), "LeftArm", angles)
    assert found == pytest.approx(0.9466, abs=1e-3)


def test_frame_rates_too_low_for_a_filter_change_nothing(skeleton):
    """6 Hz is beyond what 12 fps holds, 0.5 Hz is not; 2 Hz beside 0.5 Hz is removed."""
    motion, _ = swinging(skeleton, "Hips", 3.0, 10.0)
    same = smooth_motion(motion, 1 / 9).rotations  # 4.5 Hz, 0.45 of the frame rate
    np.testing.assert_allclose(same, motion.rotations, rtol=0, atol=1e-9)
    for fps, seconds, expected in ((12.0, 0.01, 1.0), (12.0, 1.0, 0.0028), (1.1, 1.0, 1.0)):
        hertz = min(2.0, 0.1 * fps * 2)
        motion, angles = swinging(skeleton, "Hips", hertz, fps)
        found = gain(smooth_motion(motion, seconds), "Hips", angles)
        assert found == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("seconds", [0.2, 0.5, 2.0])
def test_a_steady_turn_is_not_delayed_or_bent(skeleton, seconds):
    motion, _ = swinging(skeleton, "Hips", 1.0)
    angles = 0.03 * motion.times
    motion.rotations[:, 0] = quaternion_from_rotation_vector(angles[:, None] * [0.0, 1.0, 0.0])
    apart = rotation_angles(smooth_motion(motion, seconds).rotations, motion.rotations)
    assert apart.max() < 1e-4, "neither inside nor at ends"


@pytest.mark.parametrize(("bump", "is_beat"), [(0.045, False), (0.055, True)])
def test_only_movement_near_a_peak_of_speed_is_kept(skeleton, bump, is_beat):
    """An arm turns by 1 rad/s, and a little faster at 10 s; hips sway at 2.5 Hz all the time.

    A peak is a beat if it stands out by 0.05 rad/s, 5 % of the usual speed. It is kept for 6
    frames on either side, blended by a Gaussian of 0.05 s: 0.1 s from it, at a crest of the sway,
    that is a share of Phi((6.5 / 60 - 0.1) / 0.05) = 0.566 between the gains 0.9738 (below 6 Hz)
    and 0.0016 (0.5 Hz); 0.3 s from it, one of Phi(-3.8) = 0.0001.
    """
    motion, _ = swinging(skeleton, "Hips", 2.5)
    at = (motion.times - (10.0 - 0.5 / 60)) / 0.1  # speed 600 is from frame 599 to 600
    angle = motion.times + bump * 0.1 * np.sqrt(np.pi / 2) * erf(at / np.sqrt(2))
    turns = quaternion_from_rotation_vector(angle[:, None] * [0.0, 0.0, 1.0])
    motion.rotations[:, skeleton.index("LeftArm")] = turns
    q = smooth_motion(motion, 1.0).rotations[:, 0]
    sway = np.abs(2 * np.arctan2(q[:, 1], q[:, 3])) / 0.1
    assert sway[[594, 606]] == pytest.approx(0.552 if is_beat else 0.0016, abs=5e-3)
    assert sway[[582, 618]] == pytest.approx(0.0017, abs=5e-4)


@pytest.mark.parametrize("n_frames", [1, 2, 3, 4, 7])
def test_motions_of_four_frames_are_smoothed_and_shorter_ones_are_not(beating, n_frames):
    short = beating[:n_frames]
    smooth = smooth_motion(short, 0.3)
    assert smooth.n_frames == n_frames
    same = np.allclose(smooth.rotations, short.rotations, rtol=0, atol=1e-9)
    assert same == (n_frames < 4)


@pytest.mark.parametrize("seconds", [0.0, -1.0, float("nan"), float("inf")])
def test_invalid_durations_are_refused(beating, seconds):
    with pytest.raises(MotionError, match="smooth"):
        smooth_motion(beating, seconds)


def test_a_speaker_keeps_the_beat(shared_data):
    path = shared_data / "paired/zeggs_067_Speech_2/067_Speech_2_x_1_0"
    motion, wave = Motion.load(path.with_suffix(".bvh")), af.Wave.load(path.with_suffix(".wav"))
    smooth = smooth_motion(motion, 0.2)
    assert sync(smooth, wave).r > sync(motion, wave).r - 0.03
    before, after = (gaussian_filter1d(arm_speed(m), 1) for m in (motion, smooth))
    peaks, there = find_peaks(before, prominence=0.5)[0], find_peaks(after)[0]
    late = np.array([there[np.abs(there - peak).argmin()] - peak for peak in peaks])
    assert np.mean(np.abs(late) <= 1) > 0.85
    assert np.mean([after[p - 2 : p + 3].max() / before[p] for p in peaks]) > 0.85
