"""What is drawn for real and for unknown skeletons."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rigs import PERSON, rig_of
from scipy.spatial.transform import Rotation

from gesturekit.errors import FormatError
from gesturekit.motion import Motion, Skeleton
from gesturekit.viewer import anatomy
from gesturekit.viewer.anatomy import LEFT, MIDDLE, RIGHT
from gesturekit.viewer.figure import Figure

RECORDINGS = {
    "paired/zeggs_067_Speech_2/067_Speech_2_x_1_0.bvh": (1.5, 1.95),
    "motion/aitviewer/sample.bvh": (1.5, 1.95),
    "motion/reactidle/003_genuine.bvh": (1.3, 1.95),
    "motion/bandai/dataset-2_wave-both-hands_normal_001.bvh": (1.4, 1.95),
}


def at_rest(skeleton: Skeleton, n_frames: int, height: float = 0.0) -> Motion:
    rotations = np.tile([0.0, 0.0, 0.0, 1.0], (n_frames, skeleton.n_joints, 1))
    return Motion(skeleton, rotations, np.tile([0.0, height, 0.0], (n_frames, 1)), 30.0)


@pytest.fixture(scope="module", params=RECORDINGS)
def recording(request: pytest.FixtureRequest, shared_data: Path) -> tuple[Motion, Figure]:
    motion = Motion.load(shared_data / request.param)
    motion = motion[:150]
    figure = Figure.of(motion)
    low, high = RECORDINGS[request.param]
    assert low < figure.height < high
    return motion, figure


def test_a_person_has_a_head_two_sides_and_stands_on_the_floor(recording):
    _, figure = recording
    assert figure.head is not None
    assert {limb.side for limb in figure.limbs} == {LEFT, MIDDLE, RIGHT}
    lowest = figure.points[:, :, 1].min(axis=1)
    assert np.median(np.abs(lowest - figure.floor)) < 0.06


def test_a_person_looks_to_the_front_with_its_left_on_the_left(recording):
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


def test_still_hands_have_no_speed_and_moving_hands_have_theirs():
    skeleton = rig_of({"root": (None, (0.0, 0.0, 0.0)), "a": ("root", (1.0, 0.0, 0.0))})
    fps, n_frames = 60.0, 240
    walk = np.stack([np.arange(n_frames) / 10, np.zeros(n_frames), np.zeros(n_frames)], axis=1)
    still = np.tile([0.0, 0, 0, 1], (n_frames, 2, 1))
    assert Figure.of(Motion(skeleton, still, walk, fps)).hand_speed.max() == pytest.approx(0)
    turning = still.copy()
    # One radian a second at one metre from the root, averaged over two joints of which one is it.
    turning[:, 0] = Rotation.from_rotvec(np.outer(np.arange(n_frames) / fps, [0, 1, 0])).as_quat()
    speed = Figure.of(Motion(skeleton, turning, walk, fps)).hand_speed
    np.testing.assert_allclose(speed, 0.5, rtol=1e-3)


def test_hand_speed_is_relative_to_the_hips_under_a_still_root(shared_data):
    motion = Motion.load(shared_data / "motion/bandai/dataset-1_bye_old_001.bvh")
    assert list(motion.joint_translations) == ["Hips"]
    still = Figure.of(motion).hand_speed
    walk = np.outer(np.arange(motion.n_frames) / motion.fps, [1.0, 0.0, 0.0])
    hips = motion.joint_translations["Hips"]
    walking = replace(motion, joint_translations={"Hips": hips + walk})
    np.testing.assert_allclose(Figure.of(walking).hand_speed, still, atol=1e-9)


def test_hands_without_wrists_are_the_ends_of_the_forearms(shared_data):
    motion = Motion.load(shared_data / "motion/reactidle/003_genuine.bvh")[:200]
    figure = Figure.of(motion)
    ends = motion.end_positions()
    for hand, forearm in zip(figure.hands, ("forearm.L", "forearm.R"), strict=True):
        np.testing.assert_allclose(figure.points[:, hand], ends[forearm][:, 0], atol=1e-9)
    elbows = [motion.skeleton.index(name) for name in ("forearm.L", "forearm.R")]
    relative = motion.positions()[:, elbows] - motion.positions()[:, :1]
    speed = np.linalg.norm(np.diff(relative, axis=0), axis=-1).sum(axis=1).mean() * motion.fps
    assert figure.hand_speed.mean() > 1.1 * speed


@pytest.mark.parametrize("front", [0.0, 1.2, -2.5])
def test_a_quadruped_faces_where_its_head_is(quadruped, front):
    motion = at_rest(quadruped, 5, 0.75)
    # Its shoulders are lower than its hips, as an elephant's are.
    turn = Rotation.from_rotvec([0, front, 0]) * Rotation.from_rotvec([0.2, 0, 0])
    motion.rotations[:, 0] = turn.as_quat()
    figure = Figure.of(motion)
    assert figure.front == pytest.approx(front)
    head = figure.points[0, figure.head.face] - figure.points[0, figure.head.base]
    assert head @ [np.sin(front), 0, np.cos(front)] > 0.9 * figure.head.size


@pytest.mark.parametrize("factor", [0.1, 2.0, 10.0])
def test_a_figure_is_drawn_alike_at_any_size(skeleton, factor):
    motion = at_rest(skeleton, 5, 0.9)
    one, other = Figure.of(motion), Figure.of(motion.scaled(factor))
    assert np.allclose(other.points, factor * one.points)
    assert [limb.ends for limb in other.limbs] == [limb.ends for limb in one.limbs]
    radii = [[limb.radii for limb in figure.limbs] for figure in (one, other)]
    assert np.allclose(radii[1], factor * np.array(radii[0]))


@pytest.mark.parametrize("factor", [0.1, 1.0, 2.0])
def test_a_view_from_the_waist_up_has_the_hips_and_not_the_knees(skeleton, factor):
    motion = at_rest(skeleton, 5, 0.9).scaled(factor)
    figure = Figure.of(motion)
    hips, knee = (motion.positions()[0, skeleton.index(name), 1] for name in ("Hips", "LeftLeg"))
    assert knee < figure.floor + figure.below("waist") < hips
    assert figure.below("whole") == 0.0


def test_ends_that_no_limb_can_have_are_not_drawn(skeleton):
    """Mixamo's rigs from Blender: as long as the last bone, and up."""
    ends = {"LeftHand": (np.array([0.0, 0.25, 0.0]),), "LeftFoot": (np.array([0.0, 0.42, 0.0]),)}
    figure = Figure.of(at_rest(replace(skeleton, end_sites=ends), 1))
    high = {end for limb in figure.limbs for end in limb.ends if end >= skeleton.n_joints}
    # What is added is a hand along its forearm.
    assert all(
        abs(figure.points[0, end, 1] - figure.points[0, skeleton.index("LeftHand"), 1]) < 0.01
        for end in high
    )


def test_one_frame_is_enough():
    skeleton = rig_of({"root": (None, (0.0, 0.0, 0.0)), "a": ("root", (0.0, 1.0, 0.0))})
    figure = Figure.of(at_rest(skeleton, 1))
    assert figure.points.shape == (1, 2, 3)
    assert len(figure.limbs) == 1


HAND = {
    "LeftHandIndex1": ("LeftHand", (0.09, 0, 0)),
    "LeftHandIndex2": ("LeftHandIndex1", (0.03, 0, 0)),
    "LeftHandIndex3": ("LeftHandIndex2", (0.02, 0, 0)),
}
WHOLE = {
    "Root": (None, (0, 0, 0)), **PERSON, **HAND, "Hips": ("Root", (0, 0.9, 0)),
    "Jaw": ("Head", (0, 0, 0.1)),
    "LeftToeBase": ("LeftFoot", (0, -0.05, 0.12)),
    "LeftLegTwist": ("LeftUpLeg", (0, -0.2, 0)),
    "Tail": ("Hips", (0, 0, -0.2)),
}  # fmt: skip


def drawn_limbs(figure: Figure, rig: Skeleton) -> dict[str, tuple]:
    """Return {end: (radius at its start, at its end, in units of the height, side, width)}."""
    return {
        rig.names[limb.ends[1]] if limb.ends[1] < rig.n_joints else f"+{rig.names[limb.ends[0]]}": (
            *(round(radius / figure.height, 6) for radius in limb.radii), limb.side, limb.width,
        )
        for limb in figure.limbs
    }  # fmt: skip


def looks(shape: anatomy.Shape, side: int = MIDDLE) -> tuple:
    return shape.start, shape.end, side, shape.width


def test_each_limb_is_as_thick_as_its_part_of_the_body_and_on_its_side():
    """From the pelvis to the neck the trunk is 0.5 m long; its joints are at 0.2, 0.6 and 1 of it.

    There it is 0.055 - 0.005 * 0.2 / 0.35 and 0.05 + 0.01 * 0.25 / 0.35 thick, and 0.034.
    """
    names = [name for name in WHOLE if WHOLE[name][0] == "Root"]
    names = ["Root", *names, *(name for name in WHOLE if name not in ("Root", *names))]
    ends = {
        "LeftToeBase": (np.array([0.01, 0, 0.06]), np.array([-0.03, 0, 0.06])),
        "RightFoot": (np.array([0, -0.05, 0.15]),),
        "RightHand": (np.array([-0.1, 0, 0]),),
        "LeftHandIndex3": (np.array([0.02, 0, 0]),),
        "Head": (np.array([0, 0.15, 0]),),
        "Tail": (np.array([0, 0, -0.1]),),
    }
    rig = rig_of({name: WHOLE[name] for name in names}, end_sites=ends)
    figure = Figure.of(at_rest(rig, 3))
    found = drawn_limbs(figure, rig)
    trunk = (0.055, 0.052143, 0.057143, 0.034)
    expected = {
        name: (trunk[k], trunk[k + 1], MIDDLE, 1.45)
        for k, name in enumerate(("Spine", "Chest", "Neck"))
    }
    expected |= {"Head": looks(anatomy.NECK), "Tail": looks(anatomy.PLAIN)}
    expected["+Tail"] = (anatomy.PLAIN.end, anatomy.PLAIN.end, MIDDLE, 1.0)
    for name, side in (("Left", LEFT), ("Right", RIGHT)):
        expected |= {
            f"{name}Shoulder": looks(anatomy.CLAVICLE), f"{name}Arm": looks(anatomy.CLAVICLE),
            f"{name}ForeArm": looks(anatomy.UPPER_ARM, side),
            f"{name}Hand": looks(anatomy.FOREARM, side),
            f"{name}UpLeg": looks(anatomy.HIP), f"{name}Leg": looks(anatomy.THIGH, side),
            f"{name}Foot": looks(anatomy.SHIN, side),
        }  # fmt: skip
    finger = anatomy.FINGER
    expected |= {
        "LeftHandIndex1": looks(anatomy.PALM, LEFT),
        "LeftHandIndex2": looks(finger, LEFT),
        "LeftHandIndex3": looks(finger, LEFT),
        "+LeftHandIndex3": (finger.end, finger.end, LEFT, 1.0),
        "LeftLegTwist": looks(anatomy.PLAIN),
        "LeftToeBase": looks(anatomy.FOOT, LEFT),
        # One limb to the mean of a toe's ends.
        "+LeftToeBase": looks(anatomy.TOE, LEFT),
        "+RightFoot": looks(anatomy.FOOT, RIGHT),
        "+RightHand": looks(anatomy.HAND, RIGHT),
    }
    assert found == expected
    toe = next(limb for limb in figure.limbs if limb.ends[0] == rig.index("LeftToeBase"))
    away = figure.points[0, toe.ends[1]] - figure.points[0, toe.ends[0]]
    np.testing.assert_allclose(away, [-0.01, 0, 0.06], atol=1e-12)
    assert toe.length == pytest.approx(np.hypot(0.01, 0.06))
    left, right = (rig.index(f"{side}Arm") for side in ("Left", "Right"))
    flat = {limb.across for limb in figure.limbs if limb.width != 1}
    assert flat == {(right, left)} and {one.across for one in figure.limbs} == {None, *flat}
    plain = drawn_limbs(Figure.of(at_rest(rig, 3), plain=True), rig)
    assert set(plain.values()) == {looks(anatomy.PLAIN)} and "Jaw" in plain and "Hips" in plain


def test_an_arm_without_a_hand_ends_in_one_along_the_forearm():
    motion = at_rest(rig_of(PERSON), 3)
    turn = Rotation.from_euler("z", 90, degrees=True).as_quat()
    motion.rotations[:, motion.skeleton.index("LeftForeArm")] = turn
    figure = Figure.of(motion)
    wrist = motion.skeleton.index("LeftHand")
    (hand,) = (limb for limb in figure.limbs if limb.ends[0] == wrist)
    away = figure.points[0, hand.ends[1]] - figure.points[0, wrist]
    np.testing.assert_allclose(away, [0, anatomy.HAND_LENGTH * figure.height, 0], atol=1e-9)
    assert hand.side == LEFT and figure.hands == (wrist, motion.skeleton.index("RightHand"))


def test_the_speed_of_hands_is_that_of_both(skeleton):
    """The chest turns by a radian a second from the middle on: each hand, 0.7 m away, at 0.7 m/s.

    A Gaussian of 0.1 s makes it half at the start, and 0.84 of it a tenth of a second later.
    """
    motion = at_rest(skeleton, 101)
    motion = replace(motion, fps=50.0)
    yaw = np.maximum(motion.times - 1.0, 0.0)
    motion.rotations[:, skeleton.index("Chest")] = Rotation.from_euler("y", yaw[:, None]).as_quat()
    figure = Figure.of(motion)
    assert figure.speed_of == "hand speed"
    np.testing.assert_allclose(
        figure.hand_speed[[0, 50, 55, 45, 80, 100]],
        1.4 * np.array([0, 0.5, 0.8413, 0.1587, 1, 1]), atol=0.01,
    )  # fmt: skip
    np.testing.assert_array_equal(Figure.of(motion[:1]).hand_speed, [0.0])
    assert Figure.of(motion[60:62]).hand_speed == pytest.approx(1.4, rel=1e-3)


@pytest.mark.parametrize(
    ("speeds", "top"),
    [([1.0] * 99 + [10.0], 1.5), ([1.0] * 99 + [1.2], 1.2), ([0.0] * 9, 1e-6),
     ([1.0] * 90 + [10.0] * 10, 10.0)],
)  # fmt: skip
def test_one_fast_frame_does_not_flatten_the_curve(skeleton, speeds, top):
    figure = replace(Figure.of(at_rest(skeleton, 2)), hand_speed=np.array(speeds))
    assert figure.top_speed == pytest.approx(top)


def test_the_floor_is_below_most_frames(skeleton):
    """The quarter of five heights is the second; end sites of the feet are 0.94 m below."""
    motion = at_rest(skeleton, 5)
    motion.translation[:, 1] = [4, 0, 3, 1, 2]
    assert Figure.of(motion).floor == pytest.approx(1 - 0.94)


def test_a_figure_that_turns_around_faces_as_it_begins(skeleton):
    motion = at_rest(skeleton, 120)
    yaw = 0.4 + np.linspace(0, 2 * np.pi, 120, endpoint=False)
    motion.rotations[:, 0] = Rotation.from_euler("y", yaw[:, None]).as_quat()
    assert Figure.of(motion).front == pytest.approx(0.4)
    swing = np.where(np.arange(120) % 2, 0.2, 1.0)
    motion.rotations[:, 0] = Rotation.from_euler("y", swing[:, None]).as_quat()
    assert Figure.of(motion).front == pytest.approx(0.6)
    # Nearly a whole turn: the mean of (cos, sin) over it is 0.25 long, and is enough.
    arc = np.linspace(-2.48, 2.48, 1201)
    turning = replace(at_rest(skeleton, 1201), fps=30.0)
    turning.rotations[:, 0] = Rotation.from_euler("y", arc[:, None] + 1.0).as_quat()
    assert Figure.of(turning).front == pytest.approx(1.0)


def test_a_bust_sits_on_its_pelvis(skeleton):
    """Without legs three quarters of the whole person are drawn, from the hips on."""
    trunk = {
        name: bone for name, bone in PERSON.items() if "Leg" not in name and "Foot" not in name
    }
    motion = at_rest(rig_of(trunk), 5)
    motion.translation[:, 1] = [4, 0, 3, 1, 2]
    figure = Figure.of(motion)
    assert figure.extent == pytest.approx(0.75 * figure.height)
    assert figure.floor == pytest.approx(1 - 0.055 * figure.height)
    assert figure.below("waist") == figure.below("whole") == 0
    whole = Figure.of(at_rest(skeleton, 5))
    assert whole.extent == whole.height and whole.below("waist") == pytest.approx(
        0.45 * whole.height
    )
    with pytest.raises(FormatError, match="framing is 'knee'; expected whole or waist"):
        whole.below("knee")


def test_the_head_is_upright_with_the_body_and_turns_with_its_joint(skeleton):
    """Its size is 0.142 of the height; its axes are those of the trunk in the mean."""
    motion = at_rest(skeleton, 40, 0.9)
    nod = np.where(np.arange(40) < 20, -0.5, 0.5)
    turns = Rotation.from_euler("y", nod[:, None])
    motion.rotations[:, skeleton.index("Head")] = turns.as_quat()
    figure = Figure.of(motion)
    head, points = figure.head, figure.points
    assert head.size == pytest.approx(0.142 * figure.height)
    up, face = (points[:, point] - points[:, head.base] for point in (head.up, head.face))
    np.testing.assert_allclose(up, np.tile([0, head.size, 0], (40, 1)), atol=1e-9)
    expected = np.stack([np.sin(nod), 0 * nod, np.cos(nod)], axis=1) * head.size
    np.testing.assert_allclose(face, expected, atol=1e-9)
