"""Inspecting motion: what is said of rigs and of how they move."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from avatars import BONES, avatar_json, packed
from rigs import PERSON, rig_of
from scipy.spatial.transform import Rotation

from gesturekit.errors import GestureKitError
from gesturekit.inspection import Summary, inspect
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.face import FaceTrack


def row(summary: Summary, label: str) -> str:
    return dict(summary.rows)[label]


def test_a_gesture(gesture, tmp_path):
    gesture(4.0, t_pose=15).save(tmp_path / "take.bvh")
    summary = inspect(tmp_path / "take.bvh")
    assert summary.kind == "motion"
    assert re.search(r"(?=.*\b4(.0+)? s)(?=.*120 frames)(?=.*30 fps)", row(summary, "time"))
    assert re.search(r"(?=.*\bcm\b)(?=.*Y up)(?=.*\+Z)", row(summary, "axes"))
    assert re.search("(?=.*19 joints)(?=.*5 end sites)", row(summary, "body"))
    assert any(re.search(r"(?=.*RightHand)(?=.*\b15\b)", text) for text in summary.problems)
    assert any("15 frames" in text for text in summary.problems)
    facts = json.loads(json.dumps(summary.to_json(), allow_nan=False))
    assert facts["parts"]["LeftForeArm"] == "left elbow"
    assert 0 < facts["hand_speed_mean"] < 0.5 * facts["hand_speed_max"]
    assert 1.2 < facts["height"] < 2.2 and {"left", "right"} <= facts["contact_share"].keys()
    assert facts["travelling_joints"] == [] and facts["path_length"] == 0


@pytest.fixture
def walk():
    """walk(degrees=0): 41 frames at 20 fps. Half a second of 2 m/s ahead, a quarter back, then the
    body stands; the left forearm turns by 2 rad/s all the time, its hand on a circle of 0.25 m.
    """
    rig = rig_of(PERSON, end_sites={"Head": (np.array([0.0, 0.15, 0.0]),)})

    def make(degrees: float = 0.0) -> Motion:
        frames = np.arange(41)
        rotations = np.tile([0.0, 0.0, 0.0, 1.0], (41, rig.n_joints, 1))
        turns = {"LeftArm": (2, -1.2), "RightArm": (2, 1.2), "LeftForeArm": (1, 0.1 * frames)}
        for name, (axis, angle) in turns.items():
            rotations[:, rig.index(name), [axis, 3]] = np.stack(
                np.broadcast_arrays(np.sin(np.asarray(angle) / 2), np.cos(np.asarray(angle) / 2)),
                -1,
            )
        turn = Rotation.from_euler("y", degrees, degrees=True)
        rotations[:, 0] = turn.as_quat()
        ahead = 0.1 * np.minimum(frames, 10) - 0.1 * np.clip(frames - 10, 0, 5)
        place = turn.apply(ahead[:, None] * [0.0, 0.0, 1.0]) + [0.0, 0.9, 0.0]
        return Motion(rig, rotations, place, 20.0)

    return make


@pytest.mark.parametrize(("degrees", "side"), [(0, "+Z"), (90, "+X"), (136, "-Z"), (-90, "-X")])
def test_a_walk_of_known_size(walk, tmp_path, degrees, side):
    walk(degrees).save(tmp_path / "walk.bvh")
    summary = inspect(tmp_path / "walk.bvh")
    rows, facts = dict(summary.rows), summary.facts
    assert re.search("(?=.*2.05 s)(?=.*41 frames)(?=.*20 fps)", rows["time"])
    assert (round(facts["facing_degrees"]) - degrees) % 360 == 0
    assert side in rows["axes"]
    assert re.search(r"(?=.*\b1\b)(?=.*\b19\b)(?=.*\b1\.5 m)(?=.*\b0\.5 m)", rows["moves"])
    # The hand's 2 rad/s at 0.25 m.
    assert facts["hand_speed_mean"] == pytest.approx(0.5, abs=0.02)
    # It stands in the last 25 of 41 frames.
    assert all(0.5 < share < 0.7 for share in facts["contact_share"].values())
    low = walk(degrees)
    replace(low, translation=low.translation - [0.0, 0.4, 0.0]).save(tmp_path / "low.bvh")
    sunk = inspect(tmp_path / "low.bvh").facts["floor"]
    assert sunk == pytest.approx(facts["floor"] - 0.4, abs=1e-6)
    assert facts["path_length"] == pytest.approx(1.5, abs=1e-6)
    assert facts["displacement"] == pytest.approx(0.5, abs=1e-6)
    assert facts["turning_joints"] == ["LeftForeArm"] and not summary.problems


def test_an_upper_body_is_said_to_be_one(walk, tmp_path):
    motion = walk()
    names = motion.skeleton.names
    motion.keep([n for n in names if "Leg" not in n and "Foot" not in n]).save(tmp_path / "a.npz")
    rows = dict(inspect(tmp_path / "a.npz").rows)
    assert "13 joints" in rows["body"]
    assert "legs" in rows and "feet" not in rows


def test_suspicious_motion_is_reported_with_its_frame(gesture, tmp_path):
    motion = gesture(4.0)
    rotations = motion.rotations.copy()
    rotations[30:70] = rotations[30]
    rotations[100, motion.skeleton.index("LeftArm")] = [1.0, 0.0, 0.0, 0.0]
    rotations[20, motion.skeleton.index("Head")] = [0.0, 0.3, 0.0, 0.95]
    rotations[-10:] = [0.0, 0.0, 0.0, 1.0]
    replace(motion, rotations=rotations).save(tmp_path / "take.npz")
    problems = "\n".join(inspect(tmp_path / "take.npz").problems)
    assert re.search(r"(?=.*\b30\b)(?=.*\b69\b)", problems) and "10 frames" in problems
    assert re.search(r"(?=.*Hand)(?=.*\b100\b)(?=.*\b101\b)", problems)
    # The arm's pop is the jump of its hand, as in `prepare`.
    # Its sine and cosine are .3 and .95: twice 17.5 degrees, and those of the gesture.
    (pop,) = (text for text in problems.splitlines() if re.search(r"(?=.*Head)(?=.*\b20\b)", text))
    assert 20 < int(re.search(r"(\d+)°", pop)[1]) < 50
    rotations = gesture(4.0).rotations.copy()
    swing = Rotation.from_rotvec([[0.0, 0.0, 0.06], [0.0, 0.0, -0.06]] * 60)
    for joint in range(1, motion.skeleton.n_joints):
        rotations[:, joint] = (Rotation.from_quat(rotations[:, joint]) * swing).as_quat()
    replace(motion, rotations=rotations).save(tmp_path / "take.npz")
    assert "tremble" in " ".join(inspect(tmp_path / "take.npz").problems)


def test_a_face_is_listed_with_its_origin(gesture, tmp_path):
    motion = gesture(1.0)
    face = FaceTrack(("jawOpen", "tongueOut"), np.zeros((motion.n_frames, 2)), "rules")
    for name, shown in (("a.glb", face), ("b.bvh", None)):
        replace(motion, face=face).save(tmp_path / name)
        summary = inspect(tmp_path / name)
        assert summary.facts["face"] == (list(face.names) if shown else [])
        assert ("face" in dict(summary.rows)) == bool(shown)
    listed = row(inspect(tmp_path / "a.glb"), "face")
    assert listed == "2 channels, made by rules from speech: jawOpen, tongueOut"


def test_parts_can_be_named_by_hand(gesture, tmp_path):
    gesture(1.0).save(tmp_path / "take.bvh")
    named = inspect(tmp_path / "take.bvh", parts={"head": "Neck"})
    assert named.facts["parts"]["Neck"] == "head"
    for parts, says in (
        ({"left_elbo": "LeftArm"}, "'left_elbo'"),
        ({"left_elbow": "Elbow"}, "'Elbow'"),
    ):
        with pytest.raises(GestureKitError, match=says):
            inspect(tmp_path / "take.bvh", parts=parts)
    wrong = inspect(tmp_path / "take.bvh", parts={"left_elbow": "RightFoot"})
    assert "'RightFoot'" in wrong.problems[0] and wrong.facts["parts"]["Head"] == "head"


def test_a_rig_that_is_not_a_body_is_described(tmp_path, save_as_others):
    names = ("rope", "rope1", "rope2", "tail")
    rope = Skeleton(names, (-1, 0, 1, 0), [[0, 0, 0], [0, 0.5, 0], [0, 0.5, 0], [0.1, 0, 0]])
    turned = np.tile([0.0, 0.0, 0.0, 1.0], (5, 4, 1))
    save_as_others(Motion(rope, turned, np.zeros((5, 3)), 30.0), tmp_path / "rope.bvh")
    summary = inspect(tmp_path / "rope.bvh")
    assert all(name in " ".join(summary.tree) for name in names)
    assert summary.facts["parts"] == {} and summary.problems
    assert "guessed" in row(summary, "axes") and "feet" not in dict(summary.rows)


@pytest.mark.parametrize(
    "version, meta, named",
    [
        (1, {"name": "Ann", "authors": ["B", "C"], "licenseUrl": "vrm.dev/1.0"}, ("Ann", "B, C")),
        (0, {"title": "Ann", "author": 3, "licenseName": "vrm.dev/1.0"}, ("Ann",)),
    ],
)
def test_an_avatar(version, meta, named, tmp_path):
    found, data = avatar_json(version)
    found["extensions"]["VRMC_vrm" if version else "VRM"]["meta"] = meta
    (tmp_path / "me.vrm").write_bytes(packed(found, data))
    summary = inspect(tmp_path / "me.vrm")
    for fact in (f"VRM {'1.0' if version else '0.x'}", f"{len(BONES)} humanoid bones", *named):
        assert fact in row(summary, "avatar")
    assert row(summary, "licence") == "vrm.dev/1.0"
    assert "1 mesh" in row(summary, "contents") and not summary.problems
    assert f"{len(BONES) + 1} joints" in row(summary, "body")  # and one of the hair


def test_a_mirrored_body_is_doubted(gesture, tmp_path):
    motion = gesture(2.0)
    rig = motion.skeleton
    names, parents, offsets = list(rig.names), list(rig.parents), list(rig.offsets)
    for side in ("Left", "Right"):
        names.append(f"{side}ToeBase")
        parents.append(rig.index(f"{side}Foot"))
        offsets.append(np.array([0.0, -0.05, 0.12]))
    still = np.tile([0.0, 0.0, 0.0, 1.0], (motion.n_frames, 2, 1))
    rotations = np.concatenate([motion.rotations, still], axis=1)
    swap = {"Left": "Right", "Right": "Left"}
    swapped = [re.sub("^(Left|Right)", lambda m: swap[m[0]], name) for name in names]
    for sides, is_told in ((names, False), (swapped, True)):
        skeleton = Skeleton(tuple(sides), tuple(parents), np.array(offsets))
        replace(motion, skeleton=skeleton, rotations=rotations).save(tmp_path / "a.npz")
        problems = inspect(tmp_path / "a.npz").problems
        assert any("toes" in text for text in problems) == is_told
