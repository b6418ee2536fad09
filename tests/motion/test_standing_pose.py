"""Standing poses: limits of what stands at rest, and the frame or T-pose of what does not."""

from dataclasses import replace

import numpy as np
import pytest
from rigs import PERSON, at_rest, rig_of, with_offsets
from scipy.spatial.transform import Rotation

from gesturekit.errors import MotionError
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.retarget.body_frames import standing_pose, standing_rig
from gesturekit.motion.skeleton import forward_kinematics

RIG = rig_of(PERSON).scaled(1.4 / 1.44)
"""A person whose `body_scale` is 1, with a torso along Y."""
REST = at_rest(RIG, 1).rotations[0]


def leaning(length: float, degrees: float) -> tuple[float, float, float]:
    """A bone that goes down and forward."""
    angle = np.radians(degrees)
    return 0.0, -length * np.cos(angle), length * np.sin(angle)


def both(**offsets: tuple[float, float, float]) -> Skeleton:
    """The person with other offsets on the left, and their mirror images on the right."""
    left = {f"Left{name}": at for name, at in offsets.items()}
    right = {f"Right{name}": (-x, y, z) for name, (x, y, z) in offsets.items()}
    return with_offsets(RIG, **left, **right)


def askew(x: float, z: float) -> Skeleton:
    """The person with hips on a line that is turned about Y."""
    return with_offsets(RIG, LeftUpLeg=(x, -0.05, z), RightUpLeg=(-x, -0.05, -z))


@pytest.mark.parametrize(
    ("rig", "stands"),
    [
        # Thighs and shanks along the torso or rather level, each by itself.
        (both(Leg=leaning(0.42, 25)), True),
        (both(Leg=leaning(0.42, 70)), False),
        (both(Foot=leaning(0.42, -25)), True),
        (both(Foot=leaning(0.42, -70)), False),
        # The line of the hips: 11 and 50 degrees from the level.
        (with_offsets(RIG, LeftUpLeg=(0.1, -0.03, 0), RightUpLeg=(-0.1, -0.07, 0)), True),
        (with_offsets(RIG, LeftUpLeg=(0.1, 0.07, 0), RightUpLeg=(-0.1, -0.17, 0)), False),
        # Hips turned against the shoulders by 17 and 72 degrees.
        (askew(0.1, 0.03), True),
        (askew(0.03, 0.09), False),
        # Upper arms that cross the body by little and by nearly all of their length.
        (both(ForeArm=(-0.06, -0.27, 0.0)), True),
        (both(ForeArm=(-0.26, -0.1, 0.0)), False),
    ],
)
def test_a_rig_stands_at_rest_if_its_limbs_lie_as_in_standing_people(rig, stands):
    for size in (1.0, 100.0):
        motion = at_rest(rig.scaled(size), 2)
        if stands:
            np.testing.assert_array_equal(standing_pose(motion), REST)
            np.testing.assert_array_equal(standing_rig(motion.skeleton), REST)
            continue
        with pytest.raises(MotionError, match="upright"):
            standing_pose(motion)


def seated(*frames: dict[str, float]) -> Motion:
    """Legs point ahead at rest; in each frame joints are turned about x by degrees."""
    rig = both(Leg=(0.0, 0.0, 0.42), Foot=(0.0, 0.0, 0.42))
    motion = at_rest(rig, len(frames))
    for k, turns in enumerate(frames):
        for name, degrees in turns.items():
            turn = Rotation.from_euler("z" if "Arm" in name else "x", degrees, degrees=True)
            motion.rotations[k, rig.index(name)] = turn.as_quat()
    return motion


def legs(degrees: float) -> dict[str, float]:
    return {"LeftUpLeg": 90 - degrees, "RightUpLeg": 90 - degrees}


LOWERED = {"LeftArm": -90.0, "RightArm": 90.0}


@pytest.mark.parametrize(("lean", "chosen"), [(12.0, 2), (42.0, 1)])
def test_the_most_upright_frame_counts_and_lowered_arms_a_little(lean, chosen):
    """Lowered arms make up for legs that lean by 12 degrees, and not by 42.

    A frame that stands with raised arms, or half seated with lowered ones, is none.
    """
    raised = {"LeftArm": 90.0, "RightArm": -90.0}
    motion = seated({}, legs(0), legs(lean) | LOWERED, legs(0) | raised, legs(60) | LOWERED)
    np.testing.assert_array_equal(standing_pose(motion), motion.rotations[chosen])


def test_a_body_that_lies_or_never_stands_is_no_standing_one():
    motion = seated({}, legs(60), legs(60) | LOWERED)
    with pytest.raises(MotionError, match="(?=.*'Hips')(?=.*'LeftLeg').*'LeftForeArm'"):
        standing_pose(motion)
    bust = {name: bone for name, bone in PERSON.items() if "Leg" not in name and "Foot" not in name}
    hanging = at_rest(with_offsets(rig_of(bust), Head=(0.0, -0.9, 0.0)), 2)
    with pytest.raises(MotionError, match="(?=.*'Hips').*'LeftForeArm'") as caught:
        standing_pose(hanging)
    assert "Leg" not in str(caught.value)
    standing = seated({}, legs(30), legs(60))
    np.testing.assert_array_equal(standing_pose(standing), standing.rotations[1])
    np.testing.assert_array_equal(standing_pose(at_rest(RIG, 3)), REST)


TOES = {f"{side}ToeBase": (f"{side}Foot", (0.0, -0.05, 0.14)) for side in ("Left", "Right")}
BONES = [("Spine", "Waist"), ("Waist", "Chest"), ("Chest", "Neck"), ("Neck", "Head")]
DRAWN = {bone: (0.0, 1.0, 0.0) for bone in BONES}
for _side, _x in (("Left", 1.0), ("Right", -1.0)):
    for _bone in (("Shoulder", "Arm"), ("Arm", "ForeArm"), ("ForeArm", "Hand")):
        DRAWN[tuple(_side + end for end in _bone)] = (_x, 0.0, 0.0)
    for _bone in (("UpLeg", "Leg"), ("Leg", "Foot")):
        DRAWN[tuple(_side + end for end in _bone)] = (0.0, -1.0, 0.0)
"""Directions of bones in a T-pose."""


def t_pose(rig: Skeleton) -> np.ndarray:
    """(J, 3) places of the joints of a rig that does not stand at rest."""
    pose = standing_rig(rig)
    assert np.abs(pose[:, 3]).min() < 0.9, "it is no rest pose"
    return forward_kinematics(pose, np.zeros(3), rig)


@pytest.mark.parametrize("size", [1.0, 100.0])
@pytest.mark.parametrize("clavicles", ["both", "left", "none"])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_heap_of_bones_stands_in_a_t_pose(seed, clavicles, size):
    """All bones point anywhere at rest; arms hang on the chest where there are no clavicles.

    The line from hips to chest is upright in the frame of the hips, the one between them is not.
    """
    rows = {name: PERSON[name] for name in ("Hips", "Spine")}
    rows |= {"Waist": ("Spine", (0.0, 0.1, 0.0)), "Chest": ("Waist", (0.0, 0.1, 0.0))}
    rows |= {name: bone for name, bone in (PERSON | TOES).items() if name not in rows}
    gone = {"both": (), "left": ("Right",), "none": ("Left", "Right")}[clavicles]
    for side in gone:
        rows = {name: bone for name, bone in rows.items() if name != f"{side}Shoulder"}
        rows[f"{side}Arm"] = ("Chest", (0.17 if side == "Left" else -0.17, 0.15, 0.0))
    turns = Rotation.random(len(rows), random_state=seed)
    by_hand = {"left_clavicle": "LeftShoulder"} if clavicles == "left" else {}
    heap = rig_of(rows, parts=by_hand)
    heap = replace(heap, offsets=size * turns.apply(heap.offsets))
    places = t_pose(heap)
    for (start, end), drawn in DRAWN.items():
        if start not in rows:
            continue
        bone = places[heap.index(end)] - places[heap.index(start)]
        np.testing.assert_allclose(
            bone / np.linalg.norm(bone), drawn, atol=1e-6, err_msg=f"{start} to {end}"
        )
    for side in ("Left", "Right"):
        toes = places[heap.index(f"{side}ToeBase")] - places[heap.index(f"{side}Foot")]
        assert toes[2] > 0.7 * np.linalg.norm(toes) and toes[1] < 0, "forward and down"
    for joints in ("UpLeg", "Shoulder") if clavicles == "both" else ("UpLeg",):
        left, right = (places[heap.index(f"{side}{joints}")] for side in ("Left", "Right"))
        assert (left - right)[0] > 0 and abs((left - right)[2]) < 1e-6 * size
