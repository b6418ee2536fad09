"""Parts of the body that are recalled separately, measures of their movement, and the channels that
are recalled but not modelled: fingers, other held joints, and the face."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from gesturekit.errors import MotionError
from gesturekit.motion.defects import defective_joints
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import SIDES, Arm, find_parts, leg_joints
from gesturekit.motion.rotations import quaternion_from_sixd, sixd_from_quaternion
from gesturekit.motion.skeleton import Skeleton
from gesturekit.multires.kinematics import VectorKinematics
from gesturekit.multires.motion_vector import MultiresRepresentation
from gesturekit.state.prediction import slow_part

SPEED_FLOOR = 0.05
"""Added to speeds before the logarithm, m/s on the reference body."""
_SMOOTHING_SECONDS = 0.1
_DIRECTION_SECONDS, _DIRECTION_SPEED = 0.067, 0.1
"""Smoothing of `hand_directions`, and the speed in m/s above which they are compressed."""
_ARM_DETAIL, _TRUNK_DETAIL = 0.35, 1.0
"""`MotionPart.full_detail` of an arm and of the trunk. In profiles, the trunk's movement is mapped
to the hand speed of the same quantile."""
_REST_LENGTH = 2.0
"""`MotionPart.length` of all parts but the arms. They are longer because feet slide at the joins of
pieces with different stances, and only arms have to follow every word."""

_WIDTH_FLOOR = 0.01
"""Added to widths before the logarithm, m on the reference body."""

_FRAMES_AT_ONCE = 1024
"""Frames decoded in one call, which bounds the memory of long motions."""
_STILL = 0.01
"""Standard deviation of a rotation's six numbers below which a joint does not move."""


@dataclass(frozen=True, eq=False)
class MotionPart:
    """Part of the body that is recalled on its own.

    Attributes:
        name: left, right, rest or body.
        columns: (C,) columns of the motion vector.
        joints: names of all the rig's joints that belong to it.
        moving: names of the modelled joints whose speed is the part's movement.
        calmed: (C',) columns that finer levels do not change while the part rests.
        full_detail: speed from which finer levels add all their detail to them, m/s on the
            reference body.
        length: of its pieces, as a multiple of the library's.
    """

    name: str
    columns: np.ndarray
    joints: tuple[str, ...]
    moving: tuple[str, ...]
    calmed: np.ndarray
    full_detail: float
    length: float

    @property
    def is_arm(self) -> bool:
        """True for the left and the right arm."""
        return self.name in SIDES


def motion_parts(representation: MultiresRepresentation, separate: bool) -> tuple[MotionPart, ...]:
    """Return the parts of a rig: both arms and the rest, or the whole body.

    Args:
        representation: of the motion vectors.
        separate: recall each arm on its own, where the arms are known and modelled.
    """
    skeleton, every = representation.skeleton, np.arange(representation.n_features)
    hands = _hands(representation)
    if not separate or len(hands) < 2:
        moving = hands or representation.joints
        return (MotionPart("body", every, tuple(skeleton.names), moving, every[:0], 0.0, 1.0),)
    body = find_parts(skeleton)
    arms = []
    for side, hand in zip(SIDES, hands, strict=True):
        joints = _limb(skeleton, body.arms, side)
        columns = _columns(representation, joints)
        arms.append(MotionPart(side, columns, joints, (hand,), columns, _ARM_DETAIL, 1.0))
    taken = {name for arm in arms for name in arm.joints}
    others = tuple(name for name in skeleton.names if name not in taken)
    columns = np.setdiff1d(every, np.concatenate([arm.columns for arm in arms]))
    legs = leg_joints(skeleton, body.legs)
    trunk = _columns(representation, [name for name in others if name not in legs])
    moving = (body.head,) if body.head in representation.joints else hands
    rest = MotionPart("rest", columns, others, moving, trunk, _TRUNK_DETAIL, _REST_LENGTH)
    return (*arms, rest)


def _columns(representation: MultiresRepresentation, joints: Sequence[str]) -> np.ndarray:
    """Return the columns of these joints' rotations, as far as they are modelled."""
    every = np.arange(representation.n_features)
    own = [every[representation.joint_columns(n)] for n in representation.joints if n in joints]
    return np.concatenate([every[:0], *own])


def _hands(representation: MultiresRepresentation) -> tuple[str, ...]:
    """Return the last modelled joint of each arm; none if the arms are not known or modelled."""
    try:
        arms = find_parts(representation.skeleton).arms
    except MotionError:
        return ()
    hands = []
    for side in SIDES:
        chain = [arms[side].wrist, arms[side].elbow]
        known = [name for name in chain if name in representation.joints]
        if not known or arms[side].shoulder not in representation.joints:
            return ()
        hands.append(known[0])
    return tuple(hands)


def _limb(skeleton: Skeleton, arms: Mapping[str, Arm], side: str) -> tuple[str, ...]:
    """Return the joints of an arm: all below the last common ancestor of both arms."""
    other = next(s for s in SIDES if s != side)
    both = skeleton.ancestors(skeleton.index(arms[other].shoulder))
    top = skeleton.index(arms[side].shoulder)
    while skeleton.parents[top] >= 0 and skeleton.parents[top] not in both:
        top = skeleton.parents[top]
    return tuple(skeleton.names[j] for j in (top, *skeleton.descendants(top)))


def joint_places(representation: MultiresRepresentation, fps: float, values: Tensor) -> np.ndarray:
    """Return the positions (K, 3, T) of all modelled joints, relative to the root.

    Args:
        representation: of the motion vectors.
        fps: frames per second.
        values: (D, T) motion vectors in their own units.
    """
    kinematics = VectorKinematics(representation, fps, arms=False)
    with torch.no_grad():
        places = kinematics.places(values[None])[0].double().numpy()
    return places - places[:1]


def movements(
    parts: Sequence[MotionPart], joints: Sequence[str], fps: float, places: np.ndarray
) -> list[np.ndarray]:
    """Return each part's movement (T,): the smoothed log speed of its hands, relative to the root.

    Args:
        parts: of the rig.
        joints: names of the K modelled joints.
        fps: frames per second.
        places: (K, 3, T), see `joint_places`.
    """
    velocity = _velocities(places, fps, 1.0)
    speed = np.log(np.linalg.norm(velocity, axis=1) + SPEED_FLOOR)
    smooth = gaussian_filter1d(speed, _SMOOTHING_SECONDS * fps, mode="nearest")
    return [smooth[[joints.index(name) for name in part.moving]].mean(axis=0) for part in parts]


def slow_channels(part: MotionPart) -> tuple[str, ...]:
    """Return the names of a part's S slow channels, see `slow_states`."""
    return ("movement", "height", "distance", "width") if part.is_arm else ("movement",)


def slow_rows(parts: Sequence[MotionPart]) -> tuple[slice, ...]:
    """Return the rows of each part among the slow channels of all parts."""
    ends = np.cumsum([0, *(len(slow_channels(part)) for part in parts)]).tolist()
    return tuple(map(slice, ends[:-1], ends[1:]))


def slow_states(
    part: MotionPart, joints: Sequence[str], fps: float, places: np.ndarray, movement: np.ndarray
) -> np.ndarray:
    """Return the slow channels of a part, (S, T): its movement and, for an arm, where its hand is.

    The slow movement is the logarithm of the mean speed. The mean logarithm would depend on how
    much of the time the hand is still, more than on how calm or lively it looks.

    The hand's height above the root and its distance from the root's vertical are in metres on the
    reference body; its width is the logarithm of its local standard deviation in both. None depends
    on where the body faces.

    Args:
        part: of the body.
        joints: names of the K modelled joints.
        fps: frames per second.
        places: (K, 3, T), see `joint_places`.
        movement: (T,) of the part, see `movements`.
    """
    slow = np.log(slow_part(np.exp(movement), fps))[None]
    if not part.is_arm:
        return slow
    x, y, z = places[joints.index(part.moving[0])]
    place = np.stack([y, np.hypot(x, z)])
    held = slow_part(place, fps)
    variance = np.maximum(slow_part(np.square(place), fps) - np.square(held), 0.0)
    width = np.log(np.sqrt(variance.sum(axis=0)) + _WIDTH_FLOOR)
    return np.concatenate([slow, held, width[None]])


def hand_directions(
    part: MotionPart, joints: Sequence[str], fps: float, places: np.ndarray
) -> np.ndarray:
    """Return how the hand of an arm moves upwards and away from the body, (2, T).

    Velocities are relative to the root, and compressed as the logarithm of speeds is, with their
    sign. Neither depends on where the body faces.

    Args:
        part: the arm.
        joints: names of the K modelled joints.
        fps: frames per second.
        places: (K, 3, T), see `joint_places`.
    """
    x, y, z = places[joints.index(part.moving[0])]
    velocity = _velocities(np.stack([y, np.hypot(x, z)]), fps, _DIRECTION_SECONDS * fps)
    return np.sign(velocity) * np.log1p(np.abs(velocity) / _DIRECTION_SPEED)


def defects_of_parts(
    parts: Sequence[MotionPart], representation: MultiresRepresentation, fps: float, values: Tensor
) -> np.ndarray:
    """Return (P, T) bool, the frames in which a joint of each part jumps or pops.

    Args:
        parts: of the rig.
        representation: of the motion vectors.
        fps: frames per second.
        values: (D, T) motion vectors in their own units.
    """
    motion = representation.decode(values.T.double().numpy(), fps)
    joints, names = defective_joints(motion), motion.skeleton.names
    own = [[names.index(name) for name in part.joints] for part in parts]
    return np.stack([joints[:, indices].any(axis=1) for indices in own])


def _velocities(places: np.ndarray, fps: float, sigma: float) -> np.ndarray:
    """Return the velocities (..., T) of positions (..., T), smoothed by `sigma` frames."""
    if places.shape[-1] < 2:
        return np.zeros_like(places)
    return gaussian_filter1d(np.gradient(places, 1 / fps, axis=-1), sigma)


@dataclass(frozen=True)
class PassiveChannels:
    """Fingers and other joints that move in the recordings but are not modelled, and the face.

    Attributes:
        joints: names of the F joints.
        expressions: number E of SMPL-X face coefficients.
    """

    joints: tuple[str, ...] = ()
    expressions: int = 0

    @property
    def is_empty(self) -> bool:
        """True without such joints and without a face."""
        return not self.joints and not self.expressions

    @classmethod
    def find(cls, motions: Sequence[Motion], modelled: Sequence[str]) -> PassiveChannels:
        """Find the channels that move in the motions of one rig but are not modelled."""
        moving = []
        for j, name in enumerate(motions[0].skeleton.names):
            if name not in modelled:
                sixd = [sixd_from_quaternion(motion.rotations[:, j]) for motion in motions]
                if np.concatenate(sixd).std(axis=0).max() > _STILL:
                    moving.append(name)
        faces = [motion.expressions for motion in motions]
        widths = {0 if face is None else face.shape[1] for face in faces}
        return cls(tuple(moving), widths.pop() if len(widths) == 1 else 0)

    def encode(self, motion: Motion) -> Tensor:
        """Return (6 F + E, T) float32 rotations and face coefficients."""
        index = [motion.skeleton.index(name) for name in self.joints]
        rows = sixd_from_quaternion(motion.rotations[:, index]).reshape(motion.n_frames, -1)
        if self.expressions:
            rows = np.concatenate([rows, motion.expressions], axis=1)
        return torch.from_numpy(np.ascontiguousarray(rows.T)).float()

    def columns(self, parts: Sequence[MotionPart]) -> list[np.ndarray]:
        """Return the rows of `encode` for each part of the body; the last rows are the face."""
        owner = {name: i for i, part in enumerate(parts) for name in part.joints}
        own = np.repeat([owner[name] for name in self.joints], 6).astype(int)
        own = np.concatenate([own, np.full(self.expressions, len(parts) - 1, int)])
        return [np.flatnonzero(own == i) for i in range(len(parts))]

    def applied(self, motion: Motion, values: Callable[[slice], Tensor]) -> Motion:
        """Return the motion (T frames) with recalled channels.

        Args:
            motion: on the rig.
            values: returns the channels (6 F + E, N) of a range of its frames.
        """
        rotations = motion.rotations.copy()
        index = [motion.skeleton.index(name) for name in self.joints]
        face = np.empty((motion.n_frames, self.expressions))
        for start in range(0, motion.n_frames, _FRAMES_AT_ONCE):
            part = slice(start, min(start + _FRAMES_AT_ONCE, motion.n_frames))
            rows = values(part).T.double().numpy()
            if index:
                sixd = rows[:, : 6 * len(index)].reshape(len(rows), len(index), 6)
                rotations[part, index] = quaternion_from_sixd(sixd)
            face[part] = rows[:, 6 * len(index) :]
        expressions = face if self.expressions else motion.expressions
        return replace(motion, rotations=rotations, expressions=expressions)
