"""Joints stand where other readers have them, and still do after we wrote the file anew."""

import re
from dataclasses import replace
from pathlib import Path

import bvhio
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gesturekit.formats import read_bvh, write_bvh
from gesturekit.formats.conventions import METRES
from gesturekit.motion import Motion
from gesturekit.motion.rotations import rotation_angles

FILES = (
    "paired/zeggs_067_Speech_2/067_Speech_2_x_1_0.bvh",
    "motion/aitviewer/sample.bvh",
    "motion/reactidle/000_genuine.bvh",
    "motion/reactidle/012_genuine.bvh",
    "motion/bandai/dataset-1_bye_happy_001.bvh",
)


def places_by_the_book(path: Path, frame: int) -> np.ndarray:
    """(J, 3) world positions in the file's unit: by scipy, one token after the other."""
    words = iter(re.split(r"\s+", path.read_text(encoding="utf-8").strip()))
    joints, stack, frames = [], [], []
    for word in words:
        if word in ("ROOT", "JOINT", "End"):
            next(words)
            joints.append({"parent": stack[-1] if stack else None, "channels": []})
            joints[-1]["end"] = word == "End"
        elif word == "{":
            stack.append(len(joints) - 1)
        elif word == "}":
            stack.pop()
        elif word == "OFFSET":
            joints[stack[-1]]["offset"] = np.array([float(next(words)) for _ in range(3)])
        elif word == "CHANNELS":
            joints[stack[-1]]["channels"] = [next(words) for _ in range(int(next(words)))]
        elif word == "Time:":
            next(words)
            frames = [float(value) for value in words]
    n = sum(len(joint["channels"]) for joint in joints)
    values = iter(frames[n * frame : n * (frame + 1)])
    for joint in joints:
        place, turn = joint["offset"].copy(), Rotation.identity()
        for channel in joint["channels"]:
            value, axis = next(values), "XYZ".index(channel[0])
            if channel.endswith("position"):
                place[axis] = value
            else:
                turn = turn * Rotation.from_rotvec(np.radians(value) * np.eye(3)[axis])
        if joint["parent"] is not None:
            above = joints[joint["parent"]]
            place = above["place"] + above["turn"].apply(place)
            turn = above["turn"] * turn
        joint["place"], joint["turn"] = place, turn
    return np.array([joint["place"] for joint in joints if not joint["end"]])


def places_by_bvhio(path: Path, frames: list[int]) -> np.ndarray:
    """(frames, J, 3) world positions in the file's unit."""
    root = bvhio.readAsHierarchy(str(path))
    joints = [joint for joint, _, _ in root.layout()]
    places = []
    for frame in frames:
        root.loadPose(frame)
        places.append([list(joint.PositionWorld) for joint in joints])
    return np.array(places)


def shortened(path: Path, to: Path, n_frames: int = 3) -> Path:
    """Every so manieth frame of a file, so that slow readers are done soon."""
    head, rows = re.split(r"(?<=\n)(?=[-\d])", path.read_text(), maxsplit=1)
    rows = rows.strip().split("\n")
    rows = rows[:: max(1, len(rows) // n_frames)][:n_frames]
    to.write_text(re.sub(r"Frames:.*", f"Frames: {len(rows)}", head) + "\n".join(rows) + "\n")
    return to


def same_motion(one: Motion, two: Motion) -> None:
    """Rotations to a thousandth of a degree, joints and end sites to one of a centimetre."""
    order = [one.skeleton.index(name) for name in two.skeleton.names]
    assert np.degrees(rotation_angles(one.rotations[:, order], two.rotations)).max() < 1e-3
    np.testing.assert_allclose(one.positions()[:, order], two.positions(), atol=1e-5)
    ends = one.end_positions()
    for name, places in two.end_positions().items():
        np.testing.assert_allclose(ends[name], places, atol=1e-5)


@pytest.mark.parametrize("file", FILES)
def test_real_files_have_the_positions_of_bvhio_and_the_reference(shared_data, tmp_path, file):
    path = shortened(shared_data / file, tmp_path / "short.bvh")
    motion = read_bvh(path)
    write_bvh(motion, tmp_path / "again.bvh")
    places = motion.positions()
    frames = list(range(motion.n_frames))
    again = read_bvh(tmp_path / "again.bvh")
    order = [motion.skeleton.index(name) for name in again.skeleton.names]
    for of, scale, joints in (
        (path, METRES[motion.info["unit"]], slice(None)),
        (tmp_path / "again.bvh", 0.01, order),
    ):
        ours = places[:, joints]
        np.testing.assert_allclose(ours, places_by_bvhio(of, frames) * scale, atol=1e-5)
        book = np.array([places_by_the_book(of, frame) for frame in frames])
        # Positions that vary by their last digit alone are read as an offset.
        np.testing.assert_allclose(ours, book * scale, atol=1e-5)


def test_written_files_have_the_same_positions_in_bvhio(gesture, tmp_path):
    motion = gesture(0.5)
    orders = ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX") * 4
    skeleton = replace(motion.skeleton, rotation_orders=orders[: motion.skeleton.n_joints])
    sway = np.sin(np.arange(motion.n_frames))[:, None] * [0.02, 0.01, 0.03]
    for moving in ({}, {"Chest": sway + [0, 0.2, 0], "LeftHand": sway + [0.25, 0, 0]}):
        written = replace(motion, skeleton=skeleton, joint_translations=moving)
        write_bvh(written, tmp_path / "a.bvh")
        places = places_by_bvhio(tmp_path / "a.bvh", list(range(motion.n_frames)))
        again = read_bvh(tmp_path / "a.bvh")
        order = [skeleton.index(name) for name in again.skeleton.names]
        np.testing.assert_allclose(written.positions()[:, order], places / 100, atol=1e-5)
        same_motion(again, written)


def test_units_and_axes_detected_in_real_files(shared_data):
    zeggs, sample, idle, _, bandai = (read_bvh(shared_data / file) for file in FILES)
    assert (zeggs.n_frames, zeggs.skeleton.n_joints, zeggs.fps) == (2065, 75, 30.0)
    assert (sample.fps, idle.fps, bandai.fps) == (40.0, 24.0, 30.0)
    assert [m.info["unit"] for m in (zeggs, sample, idle, bandai)] == ["cm", "cm", "m", "cm"]
    for motion in (zeggs, sample, idle, bandai):
        assert (motion.info["up"], motion.info["forward"]) == ("y", "z")
    # Six channels on every joint, but only the hips move.
    assert list(bandai.joint_translations) == ["Hips"]
    # The rest is what the file says; what the channels say replaces it.
    bow = read_bvh(shared_data / "motion/bandai/dataset-1_bow_active_001.bvh")
    assert bow.skeleton.offsets[1, 2] == pytest.approx(-4.52225)
    assert bow.positions()[0, 1, 2] == pytest.approx(-0.0902016)
    assert zeggs.skeleton.offsets[0, 1] == pytest.approx(0.87035881)
