from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from rigs import at_rest

from gesturekit.errors import MotionError
from gesturekit.motion import Motion
from gesturekit.motion.rotations import quaternion_from_rotation_vector, rotation_angles


def shaking(motion: Motion, hertz: float, fps: float = 120.0, seconds: float = 4.0) -> Motion:
    """The left elbow and the root go to and fro, by 0.3 rad and 0.1 m."""
    n = round(seconds * fps)
    wave = np.sin(2 * np.pi * hertz * np.arange(n) / fps)
    place = np.stack([0.1 * wave, 0.9 + 0 * wave, 0 * wave], axis=-1)
    made = at_rest(motion.skeleton, n, place, fps)
    # Far from the identity, where averaging numbers would not be averaging rotations.
    angle = np.stack([2.0 + 0.3 * wave, 0 * wave, 0.5 + 0 * wave], axis=-1)
    made.rotations[:, made.skeleton.index("LeftForeArm")] = quaternion_from_rotation_vector(angle)
    return made


def swing(motion: Motion) -> tuple[float, float]:
    """Half of how far the elbow turns, and the root moves, away from the edges."""
    inner = motion.trim(1.0, motion.duration - 1.0)
    q = inner.rotations[:, motion.skeleton.index("LeftForeArm")]
    far = max(rotation_angles(a, q).max() for a in q)
    return far / 2, np.ptp(inner.translation[:, 0]) / 2


@pytest.mark.parametrize("fps", [25.0, 30.0, 24.0])
def test_frequencies_above_the_new_rate_are_filtered_out(moving_person, fps):
    fast = shaking(moving_person, hertz=22.0)
    folded = swing(fast.resample(fps))
    assert folded[0] > 0.2 and folded[1] > 0.08
    filtered = swing(fast.resample(fps, antialias=True))
    assert filtered[0] < 0.03 and filtered[1] < 0.01


@pytest.mark.parametrize("fps", [30.0, 50.0, 110.0])
def test_the_filter_is_pillows_lanczos(moving_person, fps):
    """Pillow resizes pixels, whose centres are at k + 1/2, and lets us choose the first one."""
    ratio, first, n = 120.0 / fps, 12, 20
    rng = np.random.default_rng(0)
    values = rng.normal(0, 0.3, 200).astype(np.float32)
    start = first * ratio + 0.5 - ratio / 2
    box = (start, 0, start + n * ratio, 1)
    image = Image.fromarray(values[None]).resize((n, 1), Image.Resampling.LANCZOS, box=box)
    noisy = shaking(moving_person, hertz=0.0)
    noisy.translation[:200, 2] = values
    joint = noisy.skeleton.index("LeftForeArm")
    turns = quaternion_from_rotation_vector(values[:, None] * [0.0, 0.6, 0.8])
    noisy.rotations[:200, joint] = turns
    made = noisy.resample(fps, antialias=True)[first : first + n]
    expected = np.asarray(image)[0].astype(np.float64)
    np.testing.assert_allclose(made.translation[:, 2], expected, atol=1e-5)
    turns = quaternion_from_rotation_vector(expected[:, None] * [0.0, 0.6, 0.8])
    assert rotation_angles(made.rotations[:, joint], turns).max() < 1e-5


def test_a_still_motion_and_a_rising_rate_are_left_alone(moving_person):
    still = shaking(moving_person, hertz=0.0).resample(30.0, antialias=True)
    assert rotation_angles(still.rotations[:1], still.rotations).max() < 1e-9
    up = moving_person.resample(60.0, antialias=True)
    np.testing.assert_array_equal(up.rotations, moving_person.resample(60.0).rotations)
    one = moving_person[:1].resample(10.0, antialias=True)
    np.testing.assert_allclose(one.translation, moving_person.translation[:1])


@pytest.mark.parametrize("fps", [0.0, 1e-6, 1e9, float("nan"), float("inf")])
def test_rates_that_no_motion_has(moving_person, fps):
    for change in (moving_person.resample, lambda fps: replace(moving_person, fps=fps)):
        with pytest.raises(MotionError, match=f"fps .*{fps}"):
            change(fps)


def test_more_frames_than_memory_holds_are_refused(moving_person):
    slow = replace(moving_person, fps=1e-5)
    with pytest.raises(MotionError, match="1e-05 fps"):
        slow.resample(30.0)
