"""The human body with motion of other rigs, in pages, videos and pictures."""

from dataclasses import replace

import matplotlib.image
import numpy as np
import pytest
from pages import bundled, data_of, opened
from recordings import AITVIEWER, RUN, ZEGGS
from rigs import at_rest, rig_of
from scipy.spatial.transform import Rotation

from gesturekit.formats.smpl import smpl_skeleton
from gesturekit.motion import Motion
from gesturekit.motion.ik import two_bone_ik
from gesturekit.motion.parts import find_parts
from gesturekit.motion.parts.body_size import body_height
from gesturekit.viewer import write_html, write_picture, write_video
from gesturekit.viewer.drawn_body import DrawnBody
from gesturekit.viewer.scene import SkinnedBody

NEAR = 0.09
"""Distance from the elbow of the faces that are looked at, metres."""
RIGS = {
    "zeggs": ZEGGS,
    "bandai": "motion/bandai/dataset-1_bow_happy_001.bvh",
    "reactidle": "motion/reactidle/000_genuine.bvh",
    "smpl": RUN,
    "aitviewer": AITVIEWER,
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


def check(motion: Motion, n_frames: int = 4) -> None:
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


@pytest.mark.parametrize("rig", [*RIGS, "gesture", "smplx"])
def test_any_rig_is_retargeted_to_the_body(rig, gesture, request):
    if rig in ("gesture", "smplx"):
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
    check(motion[:60])


def test_twists_of_hands_and_arms_are_shared_with_the_skin_around(skeleton):
    """A forearm takes half of the hand's twist, a shoulder gives back half of the upper arm's."""
    motion = at_rest(skeleton, 20, (0, 0.94, 0))
    angles = np.linspace(-1.2, 1.2, 20)
    for name in ("LeftHand", "RightArm"):
        turns = Rotation.from_rotvec(np.outer(angles, [1.0, 0, 0]))
        motion.rotations[:, skeleton.index(name)] = turns.as_quat()
    made = DrawnBody.of(motion, "human").motion
    for name in ("LeftForeArm", "RightArm"):
        twist = Rotation.from_quat(made.rotations[:, made.skeleton.index(f"{name}Twist")])
        assert (twist[0].inv() * twist[-1]).magnitude() == pytest.approx(1.2, abs=0.1)


@bundled
def test_the_page_counts_the_joints_of_the_file(tmp_path, gesture):
    write_html(gesture(1.0), tmp_path / "x.html", body="human")
    (figure,) = data_of(tmp_path / "x.html")["figures"]
    assert figure["file_joints"] == 19 < figure["n_joints"]


@bundled
@pytest.mark.stress
def test_a_page_with_the_body_opens_in_a_browser(tmp_path, gesture, open_browser):
    write_html(gesture(1.0), tmp_path / "x.html", body="human")
    assert opened(open_browser, tmp_path / "x.html").lines == []


def test_videos_and_pictures_show_the_same_body(tmp_path, gesture, read_video):
    motion = gesture(0.04)
    write_picture(motion, tmp_path / "human.png", body="human", frames=1)
    write_video(motion, tmp_path / "human.mp4", body="human")
    picture = matplotlib.image.imread(tmp_path / "human.png")[..., :3]
    for image in (picture, read_video(tmp_path / "human.mp4")[0][0] / 255):
        red, _, blue = np.moveaxis(image, -1, 0)
        assert ((blue > 0.3) & (blue > 1.5 * red)).mean() > 0.005, "its trousers"


def test_a_rig_of_no_known_anatomy_is_drawn_as_a_mannequin():
    rig = rig_of({"a": (None, (0, 0, 0)), "b": ("a", (0, 1, 0)), "c": ("b", (0, 1, 0))})
    motion = Motion(rig, np.tile([0.0, 0, 0, 1], (3, 3, 1)), np.zeros((3, 3)), 30.0)
    with pytest.warns(UserWarning, match="mannequin"):
        assert not DrawnBody.of(motion, "human").skins
