"""Kinetic and geometric features of a clip, for FID_k, FID_g, Div_k and Div_g.

They follow fairmotion (Onuma et al. 2008; Müller et al. 2005), as AIST++, Bailando and Alexanderson
et al. 2023 use it. Their constants disagree (frame times of 1/60 and 1/120 s for any data, bone
lengths of one dancer). Only kinetic features can have their values (variant "released"). Here:

- 30 fps: motions at other rates are resampled (`frame_rate`), dt = 1/30 s.
- Kinetic: means over each frame and two on either side; frames outside the clip are skipped. For
  the earlier velocity of an acceleration, the released code divides only one of the two positions
  by dt; here both are divided, unless the variant is "released".
- Geometric: thresholds are in units of the clip's own upper arm, shoulder width and hip width.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import chain
from typing import Any

import numpy as np

from gesturekit.errors import EvaluationError
from gesturekit.evaluation.metrics.inputs import (
    at_rate,
    check_choice,
    check_frames,
    check_joints,
    motion_name,
)
from gesturekit.evaluation.metrics.physical import joint_paths, wrist_positions
from gesturekit.motion import Motion
from gesturekit.motion.contacts import foot_points, foot_positions
from gesturekit.motion.parts import SIDES, body_joints, find_parts

FPS = 30.0
CLIP_SECONDS = 10.0
"""Length of a clip in Alexanderson et al. 2023."""
KINDS = ("kinetic", "geometric")
_VARIANTS = ("corrected", "released")
_RELEASED_FPS = 60.0  # frames per second in Bailando's code, whatever the rate of the motion
_UNITS = {"arm": ("lshoulder", "lelbow"), "shoulders": ("lshoulder", "rshoulder"),
          "hips": ("lhip", "rhip")}  # fmt: skip
_AROUND = 2  # frames on either side in a running mean

# Relation, joints, threshold and its unit of length (angles: lower and upper limit, degrees). As in
# the released code, "move" does not use its fourth joint. Joints with a dash are on either side: a
# relation of them stands for two, the second of which has left and right exchanged.
_RELATIONS: tuple[tuple[Any, ...], ...] = (
    ("nmove", "neck", "r-hip", "l-hip", "r-wrist", 1.8, "arm"),
    ("nplane", "chest", "neck", "neck", "r-wrist", 0.2, "arm"),
    ("move", "belly", "chest", "chest", "r-wrist", 1.8, "arm"),
    ("angle", "r-elbow", "r-shoulder", "r-elbow", "r-wrist", 0.0, 110.0),
    ("nplane", "lshoulder", "rshoulder", "lwrist", "rwrist", 2.5, "shoulders"),
    ("move", "lwrist", "rwrist", "rwrist", "lwrist", 1.4, "arm"),
    ("move", "r-wrist", "root", "l-wrist", "root", 1.4, "arm"),
    ("fast", "r-wrist", "", "", "", 2.5, "arm"),
    ("plane", "root", "l-hip", "l-toes", "r-ankle", 0.38, "arm"),
    ("nplane", "zero", "up", "lowest", "r-ankle", 1.2, "arm"),
    ("nplane", "lhip", "rhip", "lankle", "rankle", 2.1, "hips"),
    ("angle", "r-knee", "r-hip", "r-knee", "r-ankle", 0.0, 110.0),
    ("fast", "r-ankle", "", "", "", 2.5, "arm"),
    ("angle", "neck", "root", "r-shoulder", "r-elbow", 25.0, 180.0),
    ("angle", "neck", "root", "r-hip", "r-knee", 50.0, 180.0),
    ("plane", "rankle", "neck", "lankle", "root", 0.5, "arm"),
    ("angle", "neck", "root", "zero", "up", 70.0, 110.0),
    ("nplane", "zero", "down", "lowest", "r-wrist", -1.2, "arm"),
    ("fast", "root", "", "", "", 2.3, "arm"),
)


def _relations() -> Iterator[tuple[Any, ...]]:
    """Yield `_RELATIONS`, those of joints on either side twice."""
    for relation, *joints, limit, unit in _RELATIONS:
        for right, left in ("rl", "lr") if "-" in "".join(joints) else ("rl",):
            names = (name.replace("r-", right).replace("l-", left) for name in joints)
            yield relation, *names, limit, unit


def kinetic_features(
    motion: Motion, *, joints: Sequence[str] | None = None, variant: str = "corrected"
) -> np.ndarray:
    """Return (3 J,) energies of each joint: horizontal, vertical, and expenditure.

    With v(i) the mean velocity around frame i and a(i) the mean acceleration, over frames
    i = 1 ... T - 1: the means of |v_xz|² and v_y² (m²/s²), and of |a| (m/s²). Positions are
    in the world, so that walking counts; the start position and heading do not.

    Args:
        motion: at least 4 frames at 30 fps.
        joints: names; by default the body's (no fingers, face, end joints).
        variant: "corrected", or "released" for the values of Bailando's code
            (utils/features/kinetic.py), which published numbers rest on: dt = 1/60 s for the same
            frames, and v(t) = p(t) - p(t - 1) / dt as the earlier velocity of an acceleration, so
            that it depends on positions; these are relative to where the first joint begins.

    Raises:
        EvaluationError: no such variant.
        MotionError: fewer frames, no such joint, or body parts that cannot be identified.

    Examples:
        A body that moves straight on at 2 m/s: (2 m/s)², nothing vertical, no acceleration:

        >>> rig = gk.Skeleton(("hips",), (-1,), [[0, 1, 0]])
        >>> still, path = np.tile([0.0, 0, 0, 1], (30, 1, 1)), np.zeros((30, 3))
        >>> path[:, 0] = 2 * np.arange(30) / 30
        >>> kinetic_features(gk.Motion(rig, still, path, 30), joints=["hips"]).round(6).tolist()
        [4.0, 0.0, 0.0]
    """
    check_choice("kinetic variant", variant, _VARIANTS)
    motion = at_rate(motion, FPS)
    check_frames(motion, 4, FPS)
    positions = joint_paths(motion, joints)
    fps, turns = FPS, np.diff(positions, n=2, axis=0)
    if variant == "released":
        fps, here = _RELEASED_FPS, (positions - positions[0, 0])[1:-1]
        turns += here - here / fps  # p(t) / dt in place of p(t) / dt²
    velocity = _mean_around(np.diff(positions, axis=0) * fps)
    acceleration = _mean_around(turns * fps**2, ahead=1)
    energies = (
        (velocity[..., [0, 2]] ** 2).sum(axis=-1),
        velocity[..., 1] ** 2,
        np.linalg.norm(acceleration, axis=-1),
    )
    return np.stack([energy.mean(axis=0) for energy in energies], axis=-1).reshape(-1)


def geometric_features(motion: Motion) -> np.ndarray:
    """Return (32,) fractions of the frames in which a relation between joints holds.

    Joints are identified as body parts (`gesturekit.motion.parts`), on any rig: root is the pelvis,
    belly and chest are the first and last joint of the spine, toes are the toe points of the feet.
    Relations, with p a joint, p' its position one frame earlier and θ the threshold:
    fast: |p - p'| / dt > θ; move: velocity of one joint relative to another, in the direction of a
    third; nmove: the same along the normal of a plane; plane, nplane: distance from a plane; angle:
    between two bones.

    Args:
        motion: at least 4 frames at 30 fps.

    Raises:
        EvaluationError: a rig without legs.
        MotionError: fewer frames, a forearm without an end, or body parts that cannot be
            identified.

    Examples:
        The last one: the pelvis moves at more than 2.3 upper arms (0.64 m here) a second:

        >>> rig = gk.load("demo").skeleton
        >>> still, path = np.tile([0.0, 0, 0, 1], (30, rig.n_joints, 1)), np.zeros((30, 3))
        >>> path[:, 2] = np.arange(30) / 30
        >>> slow, fast = (gk.Motion(rig, still, speed * path, 30) for speed in (0.5, 1))
        >>> geometric_features(slow)[-1].tolist(), geometric_features(fast)[-1].tolist()
        (0.0, 1.0)
    """
    motion = at_rate(motion, FPS)
    check_frames(motion, 4, FPS)
    places = _places(motion)
    before = {name: path[:-1] for name, path in places.items()}
    now = {name: path[1:] for name, path in places.items()}
    lengths = {
        unit: float(np.median(np.linalg.norm(now[a] - now[b], axis=-1)))
        for unit, (a, b) in _UNITS.items()
    }

    def velocity(name: str, seen_from: str) -> np.ndarray:
        return (now[name] - now[seen_from] - before[name] + before[seen_from]) * FPS

    shares = []
    for relation, a, b, c, d, limit, unit in _relations():
        if relation == "angle":
            degrees = _angle(now[b] - now[a], now[d] - now[c])
            shares.append(((degrees > limit) & (degrees < unit)).mean())
            continue
        if relation == "fast":
            value = np.linalg.norm(now[a] - before[a], axis=-1) * FPS
        elif relation == "move":
            value = _along(velocity(c, a), now[b] - now[a])
        elif relation == "nmove":
            value = _along(velocity(d, a), np.cross(now[c] - now[a], now[b] - now[a]))
        elif relation == "plane":
            value = _along(now[d] - now[a], np.cross(now[c] - now[a], now[b] - now[a]))
        else:  # nplane
            value = _along(now[d] - now[c], now[b] - now[a])
        shares.append((value > limit * lengths[unit]).mean())
    return np.array(shares)


def clip_features(
    sets: Sequence[Sequence[Motion]],
    kind: str,
    seconds: float = CLIP_SECONDS,
    joints: Sequence[str] | None = None,
    variant: str = "corrected",
) -> list[list[np.ndarray]]:
    """Return the clip features of sets of motions: an array (clips, D) for each set and motion.

    Motions are cut into consecutive clips; the remainder, and motions shorter than a clip, are left
    out. Each feature is divided by its standard deviation in the last set, if it varies there.

    Args:
        sets: such as generated and reference.
        kind: "kinetic" or "geometric".
        seconds: length of a clip.
        joints: names of joints of all motions, for kinetic features; by default the body joints
            of the first motion of the last set.
        variant: of kinetic features.

    Raises:
        EvaluationError: no such kind, an empty set, rigs that differ, or no clip in a set.
        MotionError: clips of fewer than 4 frames at 30 fps.
    """
    check_choice("kind", kind, KINDS)
    if not all(sets):
        raise EvaluationError("a set of motions is empty")
    features: Callable[[Motion], np.ndarray] = geometric_features
    if kind == "kinetic":
        joints = body_joints(sets[-1][0].skeleton) if joints is None else joints
        features = partial(kinetic_features, joints=joints, variant=variant)
        for motion in chain.from_iterable(sets):
            check_joints(motion, joints)
    n_frames, made = max(1, round(seconds * FPS)), []
    for motions in sets:
        cut = ([*_cut(at_rate(motion, FPS), n_frames)] for motion in motions)
        made.append([np.stack([features(clip) for clip in clips]) for clips in cut if clips])
        if not made[-1]:
            raise EvaluationError(
                f"none of {len(motions)} motions is as long as a clip of {seconds:g} s; "
                "give longer motions, or shorter clips (seconds=)"
            )
    reference = np.concatenate(made[-1])
    spread = reference.std(axis=0)
    moves = spread > 1e-9 * (1 + np.abs(reference).max(axis=0))
    return [[clips / np.where(moves, spread, 1.0) for clips in one] for one in made]


def _cut(motion: Motion, n_frames: int) -> Iterator[Motion]:
    for start in range(0, motion.n_frames - n_frames + 1, n_frames):
        yield motion[start : start + n_frames]


def _mean_around(values: np.ndarray, ahead: int = 0) -> np.ndarray:
    """Return (T - 1, ...) running means over i - 2 ... i + 2 for the frames i = 1 ... T - 1.

    `values` (T - 1 - ahead, ...) begin with frame 1; the last `ahead` frames have none.
    """
    n = len(values)
    sums = np.concatenate([np.zeros_like(values[:1]), np.cumsum(values, axis=0)])
    frames = np.arange(n + ahead)
    low, high = np.maximum(frames - _AROUND, 0), np.minimum(frames + _AROUND + 1, n)
    counts = (high - low).reshape(-1, *(1,) * (values.ndim - 1))
    return (sums[high] - sums[low]) / counts


def _places(motion: Motion) -> dict[str, np.ndarray]:
    """Return {name: (T, 3) positions} of the joints that `_RELATIONS` names."""
    skeleton, parts = motion.skeleton, find_parts(motion.skeleton)
    if not parts.legs:
        raise EvaluationError(f"{motion_name(motion)} has no legs, which geometric features need")
    positions, feet = motion.positions(), foot_positions(motion)
    names = {"root": parts.pelvis, "belly": parts.spine[0], "chest": parts.spine[-1]}
    names["neck"] = parts.neck or parts.head or parts.spine[-1]
    for side in SIDES:
        for limb, joints in (
            (parts.arms[side], ("shoulder", "elbow")),
            (parts.legs[side], ("hip", "knee", "ankle")),
        ):
            names |= {side[0] + joint: getattr(limb, joint) for joint in joints}
    places = {part: positions[:, skeleton.index(name)] for part, name in names.items()}
    places["lwrist"], places["rwrist"] = wrist_positions(motion).swapaxes(0, 1)
    # Heel and, where the rig has one, toe of the left foot, then of the right.
    n_left = len(foot_points(skeleton)) // 2
    places["ltoes"], places["rtoes"] = feet[:, n_left - 1], feet[:, -1]
    body = positions[:, [skeleton.index(name) for name in body_joints(skeleton)]]
    lowest = np.minimum(body[..., 1].min(axis=1), feet[..., 1].min(axis=1))
    places["lowest"] = np.stack([0 * lowest, lowest, 0 * lowest], axis=-1)
    for name, y in (("zero", 0.0), ("up", 1.0), ("down", -1.0)):
        places[name] = np.tile([0.0, y, 0.0], (motion.n_frames, 1))
    return places


def _along(vectors: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return (T,) components of vectors along directions; 0 for a direction of no length."""
    length = np.linalg.norm(direction, axis=-1)
    return (vectors * direction).sum(axis=-1) / np.where(length > 1e-9, length, np.inf)


def _angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return (T,) angles between vectors, degrees; 0 if one has no length."""
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(axis=-1)))
