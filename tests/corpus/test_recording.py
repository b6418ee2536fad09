import re

import numpy as np
import pytest
from rigs import rig_of, with_offsets, without_joints
from scipy.spatial.transform import Rotation

from gesturekit.corpus.checks import first_difference, reference_pose, usual_skeleton
from gesturekit.corpus.recording import Recording, examine
from gesturekit.motion import Motion


@pytest.mark.parametrize(
    ("offset", "limits", "interval"),
    [
        # 4 s of motion at 30 fps and 3 s of sound that begins 1.5 s before it, with it, 0.5 s or
        # 0.52 s after it (frame 15.6 of the motion), or so that it reaches beyond the motion.
        (1.5, (0.0, 10.0), (0.0, 1.5)),
        (-0.5, (0.0, 10.0), (0.5, 3.5)),
        (-0.52, (0.0, 10.0), (16 / 30, 3.52)),
        (-2.0, (0.0, 10.0), (2.0, 4.0)),
        (0.0, (31 / 30, 2.0), (31 / 30, 2.0)),  # frame 31, though 31 / 30 * 30 is above it
        (0.0, (1.0, 1.5), (1.0, 1.5)),  # half a second is enough
        (2.75, (0.0, 10.0), None),  # too little
    ],
)
def test_what_both_files_share_is_used(tmp_path, gesture, write_speech, offset, limits, interval):
    gesture(4.0).save(tmp_path / "a.bvh")
    write_speech(tmp_path / "a.wav", 3.0)
    files = {"audio": tmp_path / "a.wav", "motion": tmp_path / "a.bvh"}
    found, problems = examine(Recording("a", **files, audio_offset=offset, limits=limits), 0.5)
    if interval is None:
        assert found is None and "0.5 s" in problems[-1].text
    else:
        assert (found.start, found.stop) == pytest.approx(interval, abs=1e-9)


def held(skeleton, degrees_below_level, step=0.0) -> Motion:
    """Both arms straight, at an angle below the horizontal by frame; after 12 frames steps."""
    n = len(degrees_below_level)
    angles = np.full((n, skeleton.n_joints, 3), np.radians(0.6))  # nowhere the rest pose
    angles[:, 0] = 0.0
    angles[:, skeleton.index("LeftArm"), 2] = -np.radians(degrees_below_level)
    angles[:, skeleton.index("RightArm"), 2] = np.radians(degrees_below_level)
    rotations = Rotation.from_euler("xyz", angles.reshape(-1, 3)).as_quat().reshape(n, -1, 4)
    translation = np.tile([0.0, 0.9, 0.0], (n, 1))
    translation[12:, 2] += step * np.arange(1, n - 11)
    return Motion(skeleton, rotations, translation, 30.0)


def test_a_t_pose_ends_when_the_actor_walks_or_lowers_the_arms(skeleton):
    assert reference_pose(held(skeleton, np.zeros(30))) == (30, 30)
    assert reference_pose(held(skeleton, np.zeros(30), step=0.4)) == (12, 1)
    swaying = held(skeleton, np.zeros(30))
    swaying.translation[12:] += [0.04, 0.0, 0.0]  # every joint, by less than 10 cm
    assert reference_pose(swaying) == (30, 30)
    # By some centimetres only, but out of level.
    sinking = np.repeat([22.0, 28.5], [12, 18])
    assert reference_pose(held(skeleton, sinking)) == (12, 0)
    assert reference_pose(held(skeleton, sinking[::-1])) == (0, 12)


def bent(skeleton, **degrees) -> Motion:
    """A T-pose with joints turned about the vertical (positive: the left arm to the front)."""
    motion = held(skeleton, np.zeros(20))
    for name, angle in degrees.items():
        turn = Rotation.from_euler("y", angle, degrees=True)
        joint = skeleton.index(name)
        own = Rotation.from_quat(motion.rotations[:, joint])
        motion.rotations[:, joint] = (turn * own).as_quat()
    return motion


def test_arms_of_a_t_pose_are_straight_and_opposite(skeleton):
    """Level arms in front of the body, or bent at an elbow, are gestures."""
    assert reference_pose(bent(skeleton, LeftArm=-20, RightArm=20)) == (20, 20)
    for degrees in ({"LeftArm": -30, "RightArm": 30}, {"RightForeArm": 30}, {"LeftArm": -90}):
        assert reference_pose(bent(skeleton, **degrees)) == (0, 0), degrees
    # Without hands the upper arms alone are looked at.
    assert reference_pose(without_joints(held(skeleton, np.zeros(30), step=0.4), "Hand")) == (12, 1)


def test_a_rest_pose_is_one_of_every_joint(skeleton):
    hanging = [f"{side}{joint}" for side in ("Left", "Right") for joint in ("ForeArm", "Hand")]
    rig = with_offsets(skeleton, **dict.fromkeys(hanging, (0.0, -0.25, 0.0)))
    motion = held(rig, np.full(20, 10))
    motion.rotations[:12] = [0.0, 0.0, 0.0, 1.0]
    motion.rotations[:12, 0] = [0.0, 1.0, 0.0, 0.0]  # the root may be turned
    assert reference_pose(motion) == (12, 0)
    motion.rotations[:12, rig.index("Head")] = Rotation.from_euler("x", 1, degrees=True).as_quat()
    assert reference_pose(motion) == (0, 0)


def test_the_first_difference_of_two_rigs_is_described():
    usual = {"Hips": (None, (0, 0, 0)), "Spine": ("Hips", (0, 1, 0)), "Head": ("Spine", (0, 1, 0))}
    rig = rig_of(usual)
    taller = rig_of({name: (above, (0, 9, 0)) for name, (above, _) in usual.items()})
    hanging = rig_of(usual | {"Head": ("Hips", (0, 1, 0))})
    more = rig_of(usual | {"Arm": ("Spine", (1, 0, 0))})
    assert first_difference(taller, rig) is None
    for pair in ((more, rig), (rig, more)):
        assert re.search(r"(?=.*\b4\b)(?=.*\b3\b).*'Arm'", first_difference(*pair))
    assert re.search("(?=.*'Head')(?=.*'Hips').*'Spine'", first_difference(hanging, rig))
    assert usual_skeleton([hanging, rig, taller]) is rig


@pytest.mark.parametrize(
    ("sound", "tolerance", "says"),
    [
        # 4 s of motion at 30 fps: a frame is 0.0333 s.
        (4.02, 0.5, None),
        (4.1, 0.5, "warning.*trimmed"),
        (4.6, 0.5, r"error(?=.*0.60 s)(?=.*\b0.5 s).*--trim a$"),
        (3.4, 0.5, r"error(?=.*0.60 s)(?=.*\b0.5 s).*--trim a$"),
    ],
)
def test_lengths_may_differ_by_a_frame_or_the_tolerance(
    tmp_path, gesture, write_speech, sound, tolerance, says
):
    gesture(4.0).save(tmp_path / "a.bvh")
    write_speech(tmp_path / "a.wav", sound)
    files = {"audio": tmp_path / "a.wav", "motion": tmp_path / "a.bvh"}
    found, problems = examine(Recording("a", **files), tolerance)
    said = [f"{p.severity}: {p.message}" for p in problems]
    if says is None:
        assert found is not None and not said
    else:
        assert any(re.match(says, line) for line in said), said
        assert (found is None) == says.startswith("error")
