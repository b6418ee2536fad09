"""What is drawn for real and for unknown skeletons."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gesturekit.motion import Motion, Skeleton
from gesturekit.viewer.anatomy import LEFT, MIDDLE, RIGHT
from gesturekit.viewer.figure import Figure

RECORDINGS = {
    "paired/zeggs_067_Speech_2/067_Speech_2_x_1_0.bvh": (1.5, 1.95),
    "motion/aitviewer/sample.bvh": (1.5, 1.95),
    "motion/reactidle/003_genuine.bvh": (1.3, 1.95),
    "motion/bandai/dataset-2_wave-both-hands_normal_001.bvh": (1.4, 1.95),
}


@pytest.fixture(scope="module", params=RECORDINGS)
def recording(request: pytest.FixtureRequest, shared_data: Path) -> tuple[Motion, Figure]:
    motion = Motion.load(shared_data / request.param)
    motion = motion.slice(0, min(150, motion.n_frames))
    figure = Figure.of(motion)
    low, high = RECORDINGS[request.param]
    assert low < figure.height < high
    return motion, figure


def test_a_person_has_a_head_two_sides_and_stands_on_the_floor(
    recording: tuple[Motion, Figure],
) -> None:
    _, figure = recording
    assert figure.head is not None
    assert {limb.side for limb in figure.limbs} == {LEFT, MIDDLE, RIGHT}
    lowest = figure.points[:, :, 1].min(axis=1)
    assert np.median(np.abs(lowest - figure.floor)) < 0.06


def test_a_person_looks_to_the_front_with_its_left_on_the_left(
    recording: tuple[Motion, Figure],
) -> None:
    _, figure = recording
    front = np.array([np.sin(figure.front), 0, np.cos(figure.front)])
    left = np.cross([0, 1, 0], front)
    face = figure.points[:, figure.head.face] - figure.points[:, figure.head.base]
    assert np.mean(face @ front) > 0.5 * figure.head.size
    sides = {
        side: np.mean(
            [figure.points[:, limb.ends[1]] @ left for limb in figure.limbs if limb.side == side]
        )
        for side in (LEFT, RIGHT)
    }
    assert sides[LEFT] > sides[RIGHT]


def test_still_hands_have_no_speed_and_moving_hands_have_theirs() -> None:
    skeleton = Skeleton(
        names=("root", "a"),
        parents=(-1, 0),
        offsets=np.array([[0, 0, 0], [1, 0, 0]], dtype=float),
        rotation_orders=("ZXY", "ZXY"),
    )
    fps, n_frames = 60.0, 240
    walk = np.stack([np.arange(n_frames) / 10, np.zeros(n_frames), np.zeros(n_frames)], axis=1)
    still = np.tile([0.0, 0, 0, 1], (n_frames, 2, 1))
    assert Figure.of(Motion(skeleton, still, walk, fps)).hand_speed.max() == pytest.approx(0)
    turning = still.copy()
    # One radian a second at one metre from the root, averaged over two joints of which one is it.
    turning[:, 0] = Rotation.from_rotvec(np.outer(np.arange(n_frames) / fps, [0, 1, 0])).as_quat()
    speed = Figure.of(Motion(skeleton, turning, walk, fps)).hand_speed
    np.testing.assert_allclose(speed, 0.5, rtol=1e-3)


def test_one_frame_is_enough() -> None:
    skeleton = Skeleton(
        ("root", "a"), (-1, 0), np.array([[0, 0, 0], [0, 1.0, 0]]), {}, ("XYZ",) * 2
    )
    figure = Figure.of(Motion(skeleton, np.tile([0.0, 0, 0, 1], (1, 2, 1)), np.zeros((1, 3)), 30))
    assert figure.points.shape == (1, 2, 3)
    assert len(figure.limbs) == 1
