"""Skeleton: named joints, their tree, rest offsets, the body's shape, and forward kinematics.

The kinematics are in numpy; `torch_kinematics` has the differentiable version.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.rotations import product_components, rotated_components
from gesturekit.wording import did_you_mean, listed

FARTHEST = 1e9
"""Largest plausible coordinate, metres; sums of larger ones could overflow."""
GENDERS = ("female", "male", "neutral")
MAX_BETAS = 1000


def has_shape(array: np.ndarray, shape: tuple[int | None, ...]) -> bool:
    """Return whether an array has a shape, in which None is any number."""
    fits = [n in (None, m) for n, m in zip(shape, array.shape)]
    return array.ndim == len(shape) and all(fits)


def checked(name: str, values: Any, shape: tuple[int | None, ...], row: str = "row") -> np.ndarray:
    """Return values as float64 of a shape, in which None is any number.

    Raises:
        MotionError: another shape, or values that are not finite; `name` and `row` name them.
    """
    array = np.asarray(values, dtype=np.float64)
    if not has_shape(array, shape):
        expected = str(shape).replace("None", "any")
        raise MotionError(f"{name} has shape {array.shape}; expected {expected}")
    if not (near := np.abs(array) <= FARTHEST).all():
        bad = int(np.argwhere(~near)[0, 0])
        value = array[bad].tolist()
        raise MotionError(f"{name} is not finite, or over {FARTHEST:g}, in {row} {bad}: {value}")
    return array


@dataclass(frozen=True)
class BodyShape:
    """Body shape of the person on a rig; a person without a known shape has the default one.

    Attributes:
        betas: (B,) shape coefficients; trailing zeros, which change nothing, are dropped.
        gender: of GENDERS, the body model that `betas` belong to; None if unknown.
        version: of that model, such as "smplx2020"; None if unknown.
        pelvis: (3,) rest position of the pelvis in the body model, metres, to which the `trans` of
            a file is added; None if unknown.

    Raises:
        MotionError: an unknown gender, numbers that are not finite, or too many of them.
    """

    betas: tuple[float, ...] = ()
    gender: str | None = None
    version: str | None = None
    pelvis: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        betas = checked("betas", self.betas, (None,))
        if len(betas) > MAX_BETAS:
            raise MotionError(f"{len(betas)} betas; a body has up to {MAX_BETAS}")
        if self.gender not in (None, *GENDERS):
            raise MotionError(f"gender {self.gender!r}; expected {', '.join(GENDERS)}")
        object.__setattr__(self, "betas", tuple(np.trim_zeros(betas, "b").tolist()))
        if self.pelvis is not None:
            pelvis = checked("pelvis", self.pelvis, (3,))
            object.__setattr__(self, "pelvis", tuple(pelvis.tolist()))

    def to_json(self) -> dict[str, Any]:
        """Return the known attributes as JSON values."""
        return {name: value for name, value in asdict(self).items() if value not in (None, ())}


SKELETON_FORMAT = 1
ROTATION_ORDERS = ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX")
LONGEST_NAME = 200
"""Characters of a joint's name."""


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Tree of J named joints with their rest offsets, metres, Y up.

    Attributes:
        names: unique joint names; the root comes first and parents before their children.
        parents: index of each joint's parent, -1 for the root.
        offsets: (J, 3) float64, rest position of each joint in its parent's frame, metres. That of
            the root is replaced by a motion's translation.
        end_sites: joint name to the (3,) offsets of its end sites, metres (`End Site` of BVH: not a
            joint, it marks the end of a bone).
        rotation_orders: axes of each joint's intrinsic Euler angles in a file, such as "ZXY".
        parts: body parts specified by hand, such as {"left_elbow": "Joint12"}, if names and shape
            of the rig do not identify them; see `gesturekit.motion.parts.find_parts`.
        body_shape: shape of the person on a rig of the SMPL family.

    Raises:
        MotionError: several roots, a child before its parent, repeated names, wrong shapes, or
            values that are not finite.

    Examples:
        >>> rig = gk.Skeleton(("hips", "spine"), (-1, 0), [[0, 1, 0], [0, 0.5, 0]])
        >>> rig.n_joints, rig.index("spine")
        (2, 1)
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: np.ndarray
    end_sites: Mapping[str, Sequence[np.ndarray]] = field(default_factory=dict)
    rotation_orders: tuple[str, ...] = ()
    parts: Mapping[str, str] = field(default_factory=dict)
    body_shape: BodyShape = BodyShape()

    def __post_init__(self) -> None:
        names = tuple(str(name) for name in self.names)
        parents = tuple(int(parent) for parent in self.parents)
        orders = tuple(self.rotation_orders) or ("ZXY",) * len(names)
        fields = {"names": names, "parents": parents, "rotation_orders": orders}
        for key, value in (fields | {"parts": dict(self.parts)}).items():
            object.__setattr__(self, key, value)
        for problem in self._problems():
            raise MotionError(problem)
        offsets = checked("offsets", np.array(self.offsets, float), (len(names), 3), "joint")
        object.__setattr__(self, "offsets", offsets)
        ends = {
            name: tuple(
                checked(f"an end site of joint {name!r}", np.array(site), (3,)) for site in sites
            )
            for name, sites in self.end_sites.items()
        }
        object.__setattr__(self, "end_sites", ends)

    def _problems(self) -> Iterator[str]:
        """Yield why names, parents and orders are not those of one tree, parents first."""
        names, orders = self.names, self.rotation_orders
        if not names:
            yield "a skeleton needs at least one joint"
        if len(names) != len(self.parents):
            yield f"{len(names)} joint names but {len(self.parents)} parents"
        seen: set[str] = set()
        for name in names:
            if not name.strip() or not name.isprintable() or len(name) > LONGEST_NAME:
                need = f"up to {LONGEST_NAME} printable characters"
                yield f"{name[:40]!r} is not a joint name, {need}"
            if name in seen:
                yield f"two joints are called {name!r}; names must be unique"
            seen.add(name)
        for j, parent in enumerate(self.parents):
            if not (0 <= parent < j if j else parent == -1):
                rule = f"the only root (parent -1) is {names[0]!r}, and parents come first"
                yield f"joint {names[j]!r} (index {j}) has parent {parent}; {rule}"
        if len(orders) != len(names):
            yield f"{len(orders)} rotation orders for {len(names)} joints"
        for name, order in zip(names, orders):
            if order not in ROTATION_ORDERS:
                known = ", ".join(ROTATION_ORDERS)
                yield f"rotation order {order!r} of joint {name!r}; expected {known}"
        for name in self.end_sites:
            if name not in seen:
                yield f"end site on {name!r}, which is not a joint of the skeleton"
        for part, name in self.parts.items():
            if name not in seen:
                yield f"part {part!r}: {self._unknown(name)}"

    @property
    def n_joints(self) -> int:
        """Number of joints J (end sites are not joints)."""
        return len(self.names)

    @cached_property
    def _index(self) -> dict[str, int]:
        return {name: j for j, name in enumerate(self.names)}

    def index(self, name: str) -> int:
        """Return the index of the joint called `name`.

        Raises:
            MotionError: there is none; the message suggests similar names.
        """
        if name not in self._index:
            raise MotionError(self._unknown(name))
        return self._index[name]

    def _unknown(self, name: str) -> str:
        hint = did_you_mean(name, self.names, most=3, cutoff=0.4)
        return f"the skeleton has no joint {name!r}; {hint or f'it has {listed(self.names, 12)}'}"

    @cached_property
    def _children(self) -> tuple[tuple[int, ...], ...]:
        children: list[list[int]] = [[] for _ in self.names]
        for j, parent in enumerate(self.parents[1:], start=1):
            children[parent].append(j)
        return tuple(map(tuple, children))

    def children(self, joint: int) -> tuple[int, ...]:
        """Return the indices of the children of `joint`."""
        return self._children[joint]

    @cached_property
    def depth(self) -> tuple[int, ...]:
        """Depth of each joint in the tree; 0 for the root."""
        depth = [0]
        for parent in self.parents[1:]:
            depth.append(depth[parent] + 1)
        return tuple(depth)

    @cached_property
    def levels(self) -> list[tuple[list[int], list[int]]]:
        """(joints, their parents) for each depth 1, 2, ..., to vectorise over a level."""
        levels: list[list[int]] = [[] for _ in range(max(self.depth) + 1)]
        for j, depth in enumerate(self.depth):
            levels[depth].append(j)
        return [(joints, [self.parents[j] for j in joints]) for joints in levels[1:]]

    @cached_property
    def rest_positions(self) -> np.ndarray:
        """(J, 3) positions of the joints in the rest pose, the root at the origin, metres."""
        places = self.offsets.copy()
        places[0] = 0.0
        for joints, parents in self.levels:
            places[joints] += places[parents]
        return places

    def ancestors(self, joint: int) -> tuple[int, ...]:
        """Return the joints above `joint`, the nearest first."""
        above = []
        while (joint := self.parents[joint]) >= 0:
            above.append(joint)
        return tuple(above)

    def descendants(self, joint: int) -> tuple[int, ...]:
        """Return all joints below `joint`, in the skeleton's order."""
        below = {joint}
        for j in range(joint + 1, self.n_joints):
            if self.parents[j] in below:
                below.add(j)
        return tuple(sorted(below - {joint}))

    def common_ancestor(self, *joints: int) -> int:
        """Return the lowest joint that all `joints` are, or are below."""
        return max(set.intersection(*({joint, *self.ancestors(joint)} for joint in joints)))

    def scaled(self, factor: float) -> Skeleton:
        """Return the rig with every offset and end site multiplied by `factor`.

        Raises:
            MotionError: a factor that is not positive and finite.
        """
        if not 0 < factor < math.inf:
            raise MotionError(f"scaled: factor is {factor!r}; give a number above 0")
        ends = {name: tuple(s * factor for s in sites) for name, sites in self.end_sites.items()}
        return replace(self, offsets=self.offsets * factor, end_sites=ends)

    def with_parts(self, parts: Mapping[str, str]) -> Skeleton:
        """Return the rig with more body parts specified by hand; see `parts`.

        Raises:
            MotionError: no such joint.
        """
        return replace(self, parts={**self.parts, **parts})

    def to_json(self) -> dict[str, Any]:
        """Return JSON values, for `skeleton.json` of a model folder."""
        values = {
            "format": SKELETON_FORMAT,
            "names": list(self.names),
            "parents": list(self.parents),
            "offsets": self.offsets.tolist(),
            "end_sites": {k: [site.tolist() for site in v] for k, v in self.end_sites.items()},
            "rotation_orders": list(self.rotation_orders),
        }
        if self.parts:
            values["parts"] = dict(self.parts)
        if shape := self.body_shape.to_json():
            values["body_shape"] = shape
        return values

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Skeleton:
        """Return the skeleton of the values from `to_json`.

        Raises:
            MotionError: a newer format, a missing field, or an invalid skeleton.
        """
        try:
            if (version := values["format"]) != SKELETON_FORMAT:
                raise ValueError(f"format {version!r}; we read {SKELETON_FORMAT}")
            return cls(
                names=tuple(values["names"]),
                parents=tuple(values["parents"]),
                offsets=np.array(values["offsets"], dtype=np.float64),
                end_sites={k: tuple(v) for k, v in values.get("end_sites", {}).items()},
                rotation_orders=tuple(values.get("rotation_orders", ())),
                parts=dict(values.get("parts", {})),
                body_shape=BodyShape(**values.get("body_shape", {})),
            )
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            why = f"it lacks the field {error}" if isinstance(error, KeyError) else error
            raise MotionError(f"the skeleton cannot be read: {why}") from None


def unique_names(names: Sequence[str]) -> list[str]:
    """Return names with a number added to repeated ones: "arm", "arm_2"."""
    taken, times, unique = set(names), dict.fromkeys(names, 0), []
    for name in names:
        times[name] += 1
        new = name
        if times[name] > 1:
            while (new := f"{name}_{times[name]}") in taken:
                times[name] += 1
        unique.append(new)
    return unique


GROUND = [0, 2]
"""Columns x and z of positions (..., 3): the ground plane, Y up."""


def global_rotations(rotations: np.ndarray, skeleton: Skeleton) -> np.ndarray:
    """(..., J, 4) rotations from each joint's frame to the world, from local ones (..., J, 4)."""
    return _components_last(_global_components(rotations, skeleton))


def forward_kinematics(
    rotations: np.ndarray,
    translation: np.ndarray,
    skeleton: Skeleton,
    joint_translations: Mapping[str, np.ndarray] | None = None,
) -> np.ndarray:
    """Return the world positions of all joints.

    Args:
        rotations: (..., J, 4) local unit quaternions.
        translation: (..., 3) root position, metres; it replaces the root's offset.
        skeleton: the rig.
        joint_translations: joint name to (..., 3), metres; it replaces that joint's offset.

    Returns:
        (..., J, 3), metres.
    """
    world = _global_components(rotations, skeleton)
    frames = world.shape[2:]
    local = skeleton.offsets.T.reshape(3, -1, *(1 for _ in frames))
    if joint_translations:
        local = np.broadcast_to(local, (3, *world.shape[1:])).copy()
        for name, values in joint_translations.items():
            local[:, skeleton.index(name)] = np.moveaxis(np.asarray(values), -1, 0)
    positions = np.empty((3, *world.shape[1:]))
    positions[:, 0] = np.moveaxis(np.broadcast_to(translation, (*frames, 3)), -1, 0)
    for joints, parents in skeleton.levels:
        steps = rotated_components(world[:, parents], local[:, joints])
        for axis, step in zip(positions, steps, strict=True):
            axis[joints] = axis[parents] + step
    return _components_last(positions)


def _global_components(rotations: np.ndarray, skeleton: Skeleton) -> np.ndarray:
    """Return the components (4, J, ...) of `global_rotations`."""
    local = _components_first(np.asarray(rotations, dtype=np.float64))
    world = local.copy()
    for joints, parents in skeleton.levels:
        products = product_components(world[:, parents], local[:, joints])
        for component, values in zip(world, products, strict=True):
            component[joints] = values
    return world


def _components_first(values: np.ndarray) -> np.ndarray:
    """Return values (..., J, D) as (D, J, ...): numpy is faster with frames next to each other."""
    return np.ascontiguousarray(np.moveaxis(values, (-1, -2), (0, 1)))


def _components_last(values: np.ndarray) -> np.ndarray:
    """Return values (D, J, ...) as (..., J, D)."""
    return np.ascontiguousarray(np.moveaxis(values, (0, 1), (-1, -2)))
