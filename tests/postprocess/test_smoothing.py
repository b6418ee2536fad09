"""Jitter goes, beats and feet stay."""

from dataclasses import replace

import numpy as np
import pytest
from rigs import at_rest
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks

import audio_features as af
from gesturekit import Motion
from gesturekit.errors import MotionError
from gesturekit.evaluation import arm_speed, sync
from gesturekit.motion.rotations import (
    multiply_quaternions,
    quaternion_from_euler,
    quaternion_from_rotation_vector,
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
    assert turned.min() > 1 - 1e-9
    moved = np.linalg.norm(smooth.positions() - beating.positions(), axis=-1)[:, legs]
    assert 0 < moved.max() < 0.005
    assert (smooth.translation == beating.translation).all()


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


KEPT, HALVED, REMOVED = (0.85, 1.01), (0.4, 0.6), (-0.01, 0.15)


@pytest.mark.parametrize(
    ("seconds", "hertz", "share"),
    [(0.5, 0.5, KEPT), (0.5, 1.0, HALVED), (0.5, 2.0, REMOVED), (0.25, 2.0, HALVED)],
)
def test_what_is_shorter_than_the_seconds_is_removed(skeleton, seconds, hertz, share):
    """A swing to one side lasts 1 / (2 hertz) seconds."""
    motion, angles = swinging(skeleton, "Hips", hertz)
    least, most = share
    assert least < gain(smooth_motion(motion, seconds), "Hips", angles) < most


@pytest.mark.parametrize(("hertz", "share"), [(3.0, KEPT), (12.0, REMOVED)])
@pytest.mark.parametrize("seconds", [0.01, 1 / 12])
def test_jitter_above_six_hertz_is_removed_even_from_beats(skeleton, seconds, hertz, share):
    motion, angles = swinging(skeleton, "LeftArm", hertz)
    least, most = share
    assert least < gain(smooth_motion(motion, seconds), "LeftArm", angles) < most


@pytest.mark.parametrize("seconds", [0.0, -1.0, float("nan"), float("inf")])
def test_invalid_durations_are_refused(beating, seconds):
    with pytest.raises(MotionError, match=f"smooth.*{seconds}"):
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
