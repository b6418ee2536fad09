from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from rigs import rig_of, with_offsets, without_joints
from scipy.spatial.transform import Rotation

from gesturekit.corpus.checks import (
    Problem,
    first_difference,
    printed,
    reference_pose,
    usual_skeleton,
)
from gesturekit.corpus.recording import Examination, Recording, examine, examine_each
from gesturekit.jobs.workers import Failure
from gesturekit.motion import Motion


@pytest.mark.parametrize(
    ("offset", "limits", "interval"),
    [
        # 4 s of motion at 30 fps and 3 s of sound that begins 1.5 s before it, with it, 0.5 s or
        # 0.52 s after it (frame 15.6 of the motion), or so that it reaches beyond the motion.
        (1.5, (0.0, 10.0), (0.0, 1.5)),
        (0.0, (0.0, 10.0), (0.0, 3.0)),
        (-0.5, (0.0, 10.0), (0.5, 3.5)),
        (-0.52, (0.0, 10.0), (16 / 30, 3.52)),
        (-2.0, (0.0, 10.0), (2.0, 4.0)),
        (0.0, (31 / 30, 2.0), (31 / 30, 2.0)),  # frame 31, though 31 / 30 * 30 is above it
        (-0.5, (1.0, 2.0), (1.0, 2.0)),
        (0.0, (1.0, 1.5), (1.0, 1.5)),  # half a second is enough
        (2.75, (0.0, 10.0), None),  # too little
        (-3.73, (0.0, 10.0), None),
    ],
)
def test_what_both_files_share_is_used(tmp_path, gesture, write_speech, offset, limits, interval):
    gesture(4.0).save(tmp_path / "a.bvh")
    write_speech(tmp_path / "a.wav", 3.0)
    files = {"audio": tmp_path / "a.wav", "motion": tmp_path / "a.bvh"}
    found, problems = examine(Recording("a", **files, audio_offset=offset, limits=limits), 0.5)
    if interval is None:
        assert found is None and "at least 0.5 s are needed" in problems[-1].text
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
    for degrees in (
        {"LeftArm": -30, "RightArm": 30},
        {"LeftForeArm": -30},
        {"RightForeArm": 30},
        {"LeftArm": -90},
    ):
        assert reference_pose(bent(skeleton, **degrees)) == (0, 0), degrees
    assert reference_pose(bent(skeleton, LeftForeArm=-20)) == (20, 20)
    # Arms that hang by 20 degrees, one forearm by some more: straight, but not level.
    for more, frames in ((4, (20, 20)), (10, (0, 0))):
        motion = held(skeleton, np.full(20, 20))
        joint = skeleton.index("LeftForeArm")
        turn = Rotation.from_euler("z", -more, degrees=True)
        own = Rotation.from_quat(motion.rotations[:, joint])
        motion.rotations[:, joint] = (turn * own).as_quat()
        assert reference_pose(motion) == frames, more
    # Without hands the upper arms alone are looked at.
    assert reference_pose(without_joints(held(skeleton, np.zeros(30), step=0.4), "Hand")) == (12, 1)


@pytest.mark.parametrize(("size", "frames"), [(1.0, (12, 18)), (2.0, (30, 30))])
def test_a_tall_body_may_sway_more(skeleton, size, frames):
    """The sway is 15 cm: over 10 cm of the reference body, below those of one twice as tall."""
    motion = held(skeleton, np.zeros(30)).with_height(1.7 * size)
    motion.translation[12:, 0] += 0.15
    assert reference_pose(motion) == frames


def test_a_rest_pose_is_one_of_every_joint_to_half_a_degree(skeleton):
    hanging = [f"{side}{joint}" for side in ("Left", "Right") for joint in ("ForeArm", "Hand")]
    rig = with_offsets(skeleton, **dict.fromkeys(hanging, (0.0, -0.25, 0.0)))
    for name in ("Spine", "Head", "LeftHand"):
        for degrees, frames in ((0.45, (20, 20)), (0.55, (0, 0))):
            motion = held(rig, np.full(20, 10))
            motion.rotations[:] = [0.0, 0.0, 0.0, 1.0]
            turn = Rotation.from_euler("x", degrees, degrees=True).as_quat()
            motion.rotations[:, rig.index(name)] = turn
            assert reference_pose(motion) == frames, name
    motion.rotations[:, 0] = [0.0, 1.0, 0.0, 0.0]
    motion.rotations[:, rig.index(name)] = [0.0, 0.0, 0.0, 1.0]
    assert reference_pose(motion) == (20, 20), "the root may be turned"
    point = rig_of({"Root": (None, (0, 0, 0))})
    still = Motion(point, np.tile([0.0, 0, 0, 1], (5, 1, 1)), np.zeros((5, 3)), 30.0)
    assert reference_pose(still) == (0, 0)


def test_a_rest_pose_with_hanging_arms_is_trimmed_wherever_it_stands(skeleton):
    arms = [f"{side}{joint}" for side in ("Left", "Right") for joint in ("ForeArm", "Hand")]
    moving = held(with_offsets(skeleton, **dict.fromkeys(arms, (0.0, -0.25, 0.0))), np.full(30, 10))
    moving.rotations[:12] = [0.0, 0.0, 0.0, 1.0]
    moving.translation[:12, 0] = 0.3 * np.arange(12)
    assert reference_pose(moving) == (12, 0)


def test_the_first_difference_of_two_rigs_is_described():
    usual = {"Hips": (None, (0, 0, 0)), "Spine": ("Hips", (0, 1, 0)), "Head": ("Spine", (0, 1, 0))}
    rig = rig_of(usual)
    arm = {"Arm": ("Spine", (1, 0, 0))}
    taller = rig_of({name: (above, (0, 9, 0)) for name, (above, _) in usual.items()})
    hanging = rig_of(usual | {"Head": ("Hips", (0, 1, 0))})
    for one, other, says in (
        (taller, rig, None),
        (rig_of({**usual, **arm}), rig, "4 joints here and 3 in the others.* more is 'Arm'"),
        (rig, rig_of({**usual, **arm}), "3 joints here and 4 in the others.* more is 'Arm'"),
        (hanging, rig, "'Head' is under 'Hips' here and under 'Spine' in the others"),
        (rig, hanging, "'Head' is under 'Spine' here and under 'Hips' in the others"),
        (rig_of({"Root": usual["Hips"]}), rig, "joint 0 is 'Root' here and 'Hips' in"),
    ):
        found = first_difference(one, other)
        assert found is None if says is None else re.search(says, found), found
    assert usual_skeleton([hanging, rig, taller]) is rig
    assert usual_skeleton([hanging, rig]) is hanging, "the first of a tie"


def test_problems_are_printed_by_severity_and_equal_ones_together():
    files = [Path(f"{name}.bvh") for name in "abcde"]
    problems = [Problem("note", None, "two rates"), *(Problem("warning", f, "soft") for f in files)]
    problems += [Problem("error", f, "broken") for f in files[:2]]
    problems += [Problem("note", f, "short") for f in files[:3]]
    problems += [Problem("warning", files[0], "a.bvh, line 2: odd")]
    assert printed(problems) == [
        "error: a.bvh: broken",
        "error: b.bvh: broken",
        "warning: 5 files: soft: a.bvh, b.bvh, c.bvh and 2 more",
        "warning: a.bvh, line 2: odd",
        "note: two rates",
        "note: 3 files: short: a.bvh, b.bvh, c.bvh",
    ]


@pytest.mark.parametrize(
    ("sound", "tolerance", "says"),
    [
        # 4 s of motion at 30 fps: a frame is 0.0333 s.
        (4.03, 0.5, None),
        (4.04, 0.5, "warning: trimmed to the shorter"),
        (3.96, 0.5, "warning: trimmed to the shorter"),
        (4.5, 0.5, "warning: trimmed to the shorter"),
        (4.51, 0.5, "error: differ by 0.51 s, more than 0.5 s.*--trim a$"),
        (3.4, 0.5, "error: differ by 0.60 s, more than 0.5 s.*--trim a$"),
    ],
)
def test_lengths_may_differ_by_a_frame_or_the_tolerance(
    tmp_path, gesture, write_speech, sound, tolerance, says
):
    gesture(4.0).save(tmp_path / "a.bvh")
    write_speech(tmp_path / "a.wav", sound)
    files = {"audio": tmp_path / "a.wav", "motion": tmp_path / "a.bvh"}
    found, problems = examine(Recording("a", **files), tolerance)
    said = [f"{p.severity}: {p.message}" for p in problems if "s of motion" in p.message]
    if says is None:
        assert not said
    else:
        severity, _, text = says.partition(": ")
        assert len(said) == 1 and re.match(f"{severity}: .*{text}", said[0]), said
        assert (found is None) == (severity == "error")


@pytest.mark.parametrize(("pops", "times"), [(5, "5.00 s;"), (6, "5.00 s and 1 more;")])
def test_the_first_five_times_of_a_defect_are_named(tmp_path, gesture, pops, times):
    motion = gesture(8.0)
    frames = 30 * np.arange(1, pops + 1)
    motion.rotations[frames, motion.skeleton.index("Head")] = [0.0, 0.5, 0.0, 0.75**0.5]
    motion.save(tmp_path / "a.bvh")
    found, problems = examine(Recording("a", motion=tmp_path / "a.bvh"), 0.5)
    assert found is not None
    assert f"at 1.00 s, 2.00 s, 3.00 s, 4.00 s, {times}" in problems[-1].text


@pytest.mark.parametrize(("runs", "more"), [(5, ""), (6, " and 1 more")])
def test_the_first_five_frozen_stretches_are_named(tmp_path, gesture, runs, more):
    motion = gesture(20.0)
    for number in range(runs):
        motion.rotations[90 * number + 30 : 90 * number + 75] = motion.rotations[90 * number + 30]
    motion.save(tmp_path / "a.npz")
    _, problems = examine(Recording("a", motion=tmp_path / "a.npz"), 0.5)
    shown = ", ".join(f"{3 * n + 1}.00 s to {3 * n + 2}.50 s" for n in range(5))
    assert f"frozen (no joint moves at all) from {shown}{more}" in [p.message for p in problems]


def test_processes_give_results_in_the_order_of_the_recordings(monkeypatch):
    """Whichever is ready first; one whose process died is an error of its file."""

    class LastFirst:
        def __init__(self, function, workers) -> None:
            assert workers == 3

        def map(self, recordings, begin):
            for recording in recordings[::-1]:
                if recording.id == "b":
                    yield recording, Failure("its worker process ended")
                else:
                    yield recording, (recording, [])

    monkeypatch.setattr("gesturekit.corpus.recording.Pool", LastFirst)
    recordings = [Recording(name, motion=Path(f"{name}.bvh")) for name in "abc"]
    seen = []

    def progress(items):
        for item in items:
            seen.append(item.id)
            yield item
        seen.append("end")

    found = examine_each(recordings, Examination(0.5, (), None, None, {}), 3, progress)
    assert [one and one.id for one, _ in found] == ["a", None, "c"] and seen == [*"abc", "end"]
    (problem,) = found[1][1]
    assert (problem.severity, problem.text) == ("error", "b.bvh: its worker process ended")


def test_a_recording_of_one_kind_is_not_shifted():
    pair = Recording("a", audio=Path("a.wav"), motion=Path("a.bvh"), audio_offset=1.0)
    assert pair.shifted(0.25).audio_offset == 0.75 and pair.file == Path("a.bvh")
    for alone in (Recording("a", audio=Path("a.wav")), Recording("a", motion=Path("a.bvh"))):
        assert alone.shifted(0.25) is alone and alone.file == (alone.audio or alone.motion)
