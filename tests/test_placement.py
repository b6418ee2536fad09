"""Start and end pose, heading and standing in place, in both systems."""

from dataclasses import replace

import numpy as np
import pytest
from rigs import PERSON, rig_of
from scipy.spatial.transform import Rotation
from small_models import small_diffusion

import audio_features as af
import gesturekit as gk
from gesturekit.evaluation import foot_skate
from gesturekit.motion.root_path import RootPath, heading
from gesturekit.motion.rotations import rotation_angles
from gesturekit.systems import bundled_speech

ARMS = ("LeftArm", "LeftForeArm", "RightArm", "RightForeArm")
WITHIN = 15
"""Frames of half a second."""


@pytest.fixture(scope="module")
def demo() -> gk.Model:
    return gk.load("demo")


@pytest.fixture(scope="module", params=["multires", "diffusion"])
def model(request, demo, gesture) -> gk.Model:
    return demo if request.param == "multires" else small_diffusion(gesture)


@pytest.fixture(scope="module")
def wave() -> af.Wave:
    return af.Wave.load(bundled_speech(), duration=2.0)


def bent(model: gk.Model) -> gk.Motion:
    """Two frames of the model's rig at (2, -3), facing 40 degrees to +X, with the left arm up."""
    rig = model.skeleton
    turns = np.tile([0.0, 0, 0, 1], (2, rig.n_joints, 1))
    turns[:, rig.index("LeftForeArm")] = Rotation.from_euler(
        "z", [[50], [90]], degrees=True
    ).as_quat()
    turns[:, rig.index("Spine")] = Rotation.from_euler("x", 20, degrees=True).as_quat()
    turns[:, 0] = Rotation.from_euler("y", 40, degrees=True).as_quat()
    return gk.Motion(rig, turns, np.tile([2.0, 0.95, -3.0], (2, 1)), 30.0)


def local(motion: gk.Motion, names=ARMS) -> np.ndarray:
    return motion.rotations[:, [motion.skeleton.index(name) for name in names]]


def test_a_motion_begins_in_a_pose_and_goes_on_by_itself(model, wave):
    pose, own = bent(model), model.generate(wave)
    made = model.generate(wave, start_pose=pose)
    np.testing.assert_allclose(made.positions()[0], pose.positions()[0], atol=1e-6)
    assert rotation_angles(made.rotations[0], pose.rotations[0]).max() < 1e-6
    assert made.n_frames == own.n_frames
    after = rotation_angles(local(made), local(own)).max(axis=1)
    assert after[WITHIN:].max() < 1e-6 < after[WITHIN - 3]
    # Where the pose stands, the motion goes on: about as far from it as it goes by itself.
    paths = [m.positions()[:, 0][:, [0, 2]] for m in (made, own)]
    away, usual = (np.linalg.norm(path - path[0], axis=1).max() for path in paths)
    assert away < usual + 0.15
    named = model.generate(wave, start_pose=pose, facing=-90.0)
    assert np.degrees(heading(named[:1])) == pytest.approx(-90)
    np.testing.assert_allclose(named.positions()[0, 0], [2.0, 0.95, -3.0], atol=1e-6)
    assert rotation_angles(named.rotations[0, 1:], pose.rotations[0, 1:]).max() < 1e-6


def test_a_motion_ends_in_a_pose_where_the_body_is(model, wave):
    pose, own = bent(model), model.generate(wave)
    made = model.generate(wave, end_pose=pose, samples=2)[0]
    before = rotation_angles(local(made), local(own)).max(axis=1)
    assert before[: -WITHIN - 1].max() < 1e-6 < before[-WITHIN + 3]
    assert rotation_angles(made.rotations[-1, 1:], pose.rotations[1, 1:]).max() < 1e-6
    assert made.translation[-1, 1] == pytest.approx(0.95)
    turn = (
        Rotation.from_quat(made.rotations[-1, 0]) * Rotation.from_quat(pose.rotations[1, 0]).inv()
    )
    assert np.abs(turn.as_rotvec()[[0, 2]]).max() < 1e-6, "the tilt is that of the pose"
    ends = [m.positions()[-1, 0, [0, 2]] for m in (made, own)]
    assert np.linalg.norm(ends[0] - ends[1]) < 0.3, "not at (2, -3)"
    both = model.generate(wave, start_pose=pose, end_pose=pose)
    for frame in (0, -1):
        assert rotation_angles(both.rotations[frame, 1:], pose.rotations[frame, 1:]).max() < 1e-6
    for seconds in (0.04, 0.2):  # shorter than the changes
        short = model.generate(seconds=seconds, start_pose=pose, end_pose=pose)
        first = 0 if short.n_frames > 1 else 1  # the end has the only frame
        assert rotation_angles(short.rotations[0, 1:], pose.rotations[first, 1:]).max() < 1e-6


def test_feet_of_a_motion_that_begins_in_a_pose_do_not_slide(demo, wave):
    pose = demo.generate(wave, seed=1)[:1]
    made = demo.generate(wave, start_pose=pose)
    assert foot_skate(made) < foot_skate(demo.generate(wave, foot_lock=False))
    np.testing.assert_allclose(made.positions()[0], pose.positions()[0], atol=1e-6)


@pytest.mark.parametrize(
    ("asked", "says"),
    [
        ({"start_pose": "gone.bvh@2"}, "start_pose & gone.bvh"),
        ({"end_pose": 3}, "end_pose & int"),
        ({"facing": 400}, "facing=400"),
        ({"path": "way.csv", "in_place": True}, "in_place & path"),
        ({"keyframes": "way.csv", "start_pose": "way.csv"}, "start_pose & keyframes"),
        ({"levels": 2, "facing": 90}, "facing & levels"),
    ],
)
def test_what_cannot_be_combined_is_an_error_before_generating(
    demo, asked, says, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "way.csv").touch()
    with pytest.raises(gk.GestureKitError) as caught:
        demo.check_controls(**asked)
    assert all(fact in str(caught.value) for fact in says.split(" & "))
    demo.check_controls(path="way.csv", in_place=False, facing=None)


def test_facing_turns_the_whole_motion(model, wave):
    own, made = model.generate(wave), model.generate(wave, facing=90.0)
    assert np.degrees(heading(made[:1])) == pytest.approx(90)
    turn = Rotation.from_euler("y", np.pi / 2 - heading(own[:1]))
    origin = own.positions()[0, 0]
    moved = turn.apply((own.positions() - origin).reshape(-1, 3)).reshape(own.positions().shape)
    np.testing.assert_allclose(made.positions(), moved + origin, atol=1e-9)


def test_a_body_in_place_neither_wanders_nor_turns_away(model, gesture):
    walk = gesture(6.0)
    way = np.linspace(0, 1, walk.n_frames)
    turns = walk.rotations.copy()
    turn = Rotation.from_euler("y", 120 * way[:, None], degrees=True)
    turns[:, 0] = (turn * Rotation.from_quat(turns[:, 0])).as_quat()
    walk = replace(walk, rotations=turns, translation=walk.translation + way[:, None] * [0, 0, 1.5])
    for lock in (True, False):
        asked = {"like": walk, "seconds": 6.0, "foot_lock": lock}
        free, made = (model.generate(**asked, in_place=stays) for stays in (False, True))
        wanders, turned = zip(*map(extent, (free, made)), strict=True)
        assert wanders[0] > 1.0 and wanders[1] < 0.4
        assert turned[0] > 60 and turned[1] < 30
        arms = rotation_angles(local(free), local(made))
        assert arms.max() < 1e-6, "gestures do not change"


def extent(motion: gk.Motion) -> tuple[float, float]:
    """Return how far the root goes from its first place, and the range of headings in degrees."""
    path = RootPath.of(motion)
    away = np.linalg.norm(path.positions - path.positions[0], axis=1)
    return away.max(), np.degrees(np.ptp(path.headings))


def test_a_pose_of_another_rig_is_retargeted(model, wave, gesture, tmp_path):
    """A body of half the size that stands on a floor at 1 m, with other joint names."""
    names = {"Hips": "pelvis", "Spine": "spine_01", "Chest": "spine_02", "Neck": "neck_01"}
    names |= {name: name.replace("Left", "l_").replace("Right", "r_") for name in PERSON} | names
    bones = {names[k]: (p and names[p], o) for k, (p, o) in PERSON.items()}
    own = gesture(3.0)
    other = gk.Motion(rig_of(bones), own.rotations, own.translation, 30.0).scaled(0.5)
    way = np.linspace(0, 1, other.n_frames)[:, None] * [3.0, 0.0, 0.0]
    other = replace(other, translation=other.translation + [0, 1, 0] + way)
    other.save(tmp_path / "other.npz")
    made = model.generate(wave, start_pose=f"{tmp_path / 'other.npz'}@2.0")
    apart = made.positions()[0, 0] - other.positions()[60, 0]
    assert np.linalg.norm(apart[[0, 2]]) < 0.03, "places in a scene are not scaled"
    bone = [m.positions()[f] for m, f in ((made, 0), (own, 60))]

    def arm(places, rig):
        ends = [places[rig.index(name)] for name in ("LeftArm", "LeftForeArm")]
        return (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])

    cosine = arm(bone[0], made.skeleton) @ arm(bone[1], own.skeleton)
    assert np.degrees(np.arccos(min(cosine, 1))) < 12
    lowest = made.positions()[..., 1].min(axis=1)
    assert abs(lowest[0] - np.median(lowest[30:])) < 0.06, "on the floor of the motion"


def test_a_frame_is_named_on_the_command_line(gesturekit, demo, tmp_path):
    pose = bent(demo)
    pose.save(tmp_path / "two@rest.bvh")
    command = ["render", "--seconds", 0.2, "--model", "demo", "--out", tmp_path / "out"]
    for at, frame in (("@0.034", 1), ("", 0)):
        asked = [*command, "--start-pose", f"{tmp_path / 'two@rest.bvh'}{at}"]
        done = gesturekit(*asked, "--existing", "replace").ok()
        assert "1 rendered" in done.err, "another frame is another motion"
        made = gk.Motion.load(tmp_path / "out" / "motion.bvh")
        assert rotation_angles(made.rotations[0], pose.rotations[frame]).max() < 1e-4
    assert "1 kept" in gesturekit(*asked).ok().err
    asked = [*command, "--end-pose", f"{tmp_path / 'two@rest.bvh'}@7", "--existing", "replace"]
    gesturekit(*asked).fails(1, "two@rest.bvh", "@7", "0.066")
