"""Motion: a skeleton with joint rotations and a root translation for each frame."""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from gesturekit import lazy
from gesturekit.errors import FormatError, MotionError, gesturekit_errors
from gesturekit.motion.face import FaceTrack
from gesturekit.motion.parts import left_right_pairs
from gesturekit.motion.parts.body_size import body_height, body_scale, first_fork
from gesturekit.motion.resampling import Resampler, checked_fps
from gesturekit.motion.rotations import (
    euler_from_quaternion,
    invert_quaternions,
    multiply_quaternions,
    rotate_vectors,
    rotation_angles,
)
from gesturekit.motion.skeleton import (
    FARTHEST,
    ROTATION_ORDERS,
    Skeleton,
    checked,
    forward_kinematics,
    global_rotations,
)

_STILL = 2.5e-6
"""Metres on the reference body; a position that varies by less is a constant offset."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Local joint rotations and a root translation for each frame; frame k is at k / fps seconds.

    Attributes:
        skeleton: the rig, J joints.
        rotations: (T, J, 4) float64 local unit quaternions, xyzw.
        translation: (T, 3) float64 root positions, metres, Y up; they replace the root's offset.
        fps: frames per second, 1e-5 to 1e5.
        joint_translations: joint name to (T, 3) positions in the parent's frame, metres. They
            replace that joint's offset, for files that move joints other than the root.
        info: metadata on the origin (source file, detected unit, ...).
        face: channels of the face for each frame, or None.

    Raises:
        MotionError: shapes that do not match, values that are not finite, or no frames.

    Examples:
        A joint at 1 m that is lifted by 0.5 m, for two frames:

        >>> rig = gk.Skeleton(("hips",), (-1,), [[0, 1, 0]])
        >>> still = np.tile([0.0, 0, 0, 1], (2, 1, 1))
        >>> motion = gk.Motion(rig, still, [[0, 1, 0], [0, 1.5, 0]], 30)
        >>> motion.positions()[:, 0, 1].tolist(), motion.n_frames
        ([1.0, 1.5], 2)
    """

    skeleton: Skeleton
    rotations: np.ndarray
    translation: np.ndarray
    fps: float
    joint_translations: Mapping[str, np.ndarray] = field(default_factory=dict)
    info: dict[str, Any] = field(default_factory=dict)
    face: FaceTrack | None = None

    def __post_init__(self) -> None:
        rotations = np.atleast_1d(np.asarray(self.rotations, dtype=np.float64))
        length = np.linalg.norm(rotations, axis=-1, keepdims=True)
        for problem in self._problems(rotations, length):
            raise MotionError(problem)
        # Unit quaternions are not normalised again, so that a file round trip is bit-exact.
        if (off := np.abs(length - 1) > 1e-12).any():
            rotations = np.where(off, rotations / length, rotations)
        fields: dict[str, Any] = {"rotations": rotations, "fps": checked_fps(self.fps)}
        shape = (len(rotations), 3)
        fields["translation"] = checked("translation", self.translation, shape, "frame")
        fields["joint_translations"] = {
            name: checked(f"translation of joint {name!r}", values, shape, "frame")
            for name, values in self.joint_translations.items()
        }
        for key, value in fields.items():
            object.__setattr__(self, key, value)

    def _problems(self, rotations: np.ndarray, length: np.ndarray) -> Iterator[str]:
        """Yield what is wrong, but for positions; `length` (T, J, 1) is that of the quaternions."""
        if rotations.shape[1:] != (self.skeleton.n_joints, 4):
            need = f"(frames, joints, 4) for {self.skeleton.n_joints} joints"
            yield f"rotations have shape {rotations.shape}; expected {need}"
        if not len(rotations):
            yield "a motion needs at least one frame"
        if not (valid := np.isfinite(length) & (length >= 1e-6)).all():
            bad = np.argwhere(~valid)[0]
            at = f"joint {self.skeleton.names[bad[1]]!r} in frame {bad[0]}"
            value = rotations[bad[0], bad[1]].tolist()
            yield f"the rotation of {at} is {value}, not a quaternion"
        for name in self.joint_translations:
            if self.skeleton.index(name) == 0:
                yield f"{name!r} is the root: its position is the motion's translation"
        if self.face is not None and not isinstance(self.face, FaceTrack):
            yield f"face is {type(self.face).__name__}; expected a FaceTrack"
        if self.face is not None and len(self.face) != len(rotations):
            yield f"the face has {len(self.face)} frames, the motion {len(rotations)}"

    def __repr__(self) -> str:
        return (
            f"Motion({self.n_frames} frames at {self.fps:g} fps = {self.duration:.2f} s, "
            f"{self.skeleton.n_joints} joints from {self.skeleton.names[0]!r})"
        )

    def __array__(self, *_: Any, **__: Any) -> np.ndarray:
        ways = "motion.positions(), motion.euler() or motion.rotations (quaternions)"
        raise MotionError(f"a motion is not one array: take {ways}")

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the J joints, in the order of the arrays."""
        return self.skeleton.names

    @property
    def n_frames(self) -> int:
        """Number of frames T."""
        return len(self.rotations)

    def __len__(self) -> int:
        return self.n_frames

    def __getitem__(self, frames: slice) -> Motion:
        """Return a range of frames, such as `motion[10:40]` or `motion[-1:]`, as arrays have them.

        The arrays of the result are views. A step as in `motion[::2]` lowers the frame rate, so
        that the motion stays as fast as it was. For seconds, see `trim`.

        Raises:
            MotionError: not a range, an empty one, or a step below 1.
        """
        if not isinstance(frames, slice):
            raise MotionError(f"frame {frames!r}: a motion is cut by a range: motion[10:11]")
        step = 1 if frames.step is None else frames.step
        if step < 1:
            raise MotionError(f"step {step}: frames are taken in order, with a step of at least 1")
        if not len(range(*frames.indices(self.n_frames))):
            start, stop = ("" if at is None else at for at in (frames.start, frames.stop))
            raise MotionError(f"no frames in motion[{start}:{stop}]: it has {self.n_frames}")
        return self._changed(lambda values: values[frames], self.rotations[frames], self.fps / step)

    @property
    def duration(self) -> float:
        """Duration T / fps in seconds; each frame lasts 1 / fps."""
        return self.n_frames / self.fps

    @property
    def times(self) -> np.ndarray:
        """(T,) frame times k / fps, seconds."""
        return np.arange(self.n_frames) / self.fps

    def positions(self, joint: str | None = None) -> np.ndarray:
        """(T, J, 3) world positions of the joints, metres; (T, 3) of one joint if it is named.

        Raises:
            MotionError: no such joint, or not the name of one.
        """
        if not isinstance(joint, str | None):
            raise MotionError(f"positions({joint!r}): give the name of one joint, or nothing")
        which = slice(None) if joint is None else self.skeleton.index(joint)
        return forward_kinematics(
            self.rotations, self.translation, self.skeleton, self.joint_translations
        )[:, which]

    def local_positions(self, joint: str) -> np.ndarray:
        """(T, 3) positions of a joint in its parent's frame, metres; constant if it stands still.

        Raises:
            MotionError: no such joint.
        """
        rest = self.skeleton.offsets[self.skeleton.index(joint)]
        return self.joint_translations.get(joint, np.tile(rest, (self.n_frames, 1)))

    def end_positions(self) -> dict[str, np.ndarray]:
        """Return, for each joint with E end sites, their (T, E, 3) world positions, metres."""
        positions, world = self.positions(), self.global_rotations()
        ends = {}
        for name, sites in self.skeleton.end_sites.items():
            j = self.skeleton.index(name)
            ends[name] = positions[:, j, None] + rotate_vectors(world[:, j, None], np.stack(sites))
        return ends

    def global_rotations(self) -> np.ndarray:
        """(T, J, 4) quaternions from each joint's frame to the world."""
        return global_rotations(self.rotations, self.skeleton)

    def euler(self, order: str = "ZXY") -> np.ndarray:
        """(T, J, 3) intrinsic local Euler angles, degrees, columns as in `order`.

        "ZXY" rotates about Z, then about the new X, then about the newest Y, as in BVH. In gimbal
        lock the third angle is set to 0; the rotation is still correct.

        Raises:
            MotionError: not an order of three different axes.
        """
        if order not in ROTATION_ORDERS:
            raise MotionError(f"order {order!r}; expected one of {', '.join(ROTATION_ORDERS)}")
        return euler_from_quaternion(self.rotations, order)

    def resample(self, fps: float, n_frames: int | None = None, antialias: bool = False) -> Motion:
        """Return the motion at another frame rate; after its last frame it stands still.

        Rotations are interpolated by slerp, positions linearly.

        Args:
            fps: frames per second of the result; its frame k is at k / fps seconds.
            n_frames: number of frames; by default floor(duration fps + 1/2).
            antialias: filter out frequencies above fps / 2, which would otherwise alias. No effect
                if the rate rises.

        Raises:
            MotionError: an invalid rate, fewer than one frame, or more than 8 GB of frames.
        """
        rig, here = self.skeleton, self.fps
        resampler = Resampler(self.n_frames, rig.n_joints, here, fps, n_frames, antialias)
        return self._changed(resampler.values, resampler.rotations(self.rotations), resampler.fps)

    def _changed(
        self, change: Callable[[np.ndarray], np.ndarray], rotations: np.ndarray, fps: float
    ) -> Motion:
        """Return the motion of other frames; `change` makes values (T', D) of values (T, D)."""
        return replace(
            self,
            rotations=rotations,
            translation=change(self.translation),
            fps=fps,
            joint_translations={k: change(v) for k, v in self.joint_translations.items()},
            face=None if self.face is None else self.face.changed(change),
            info=dict(self.info),
        )

    def mirror(self) -> Motion:
        """Return the motion with left and right exchanged and x reflected.

        The skeleton is mirrored too (a longer left arm becomes a longer right arm), so that joint
        positions are exact mirror images. Counterparts come from
        `gesturekit.motion.parts.left_right_pairs`; a joint without one is its own; for the
        face see `FaceTrack.mirror`.

        Raises:
            MotionError: a rig with limbs whose left and right cannot be identified.
        """
        rig = self.skeleton
        if not can_be_mirrored(rig):
            how = "name limbs (parts: left_elbow: JOINT, ...)"
            raise MotionError(f"cannot tell left from right; {how}")
        other = _counterparts(rig)
        kinds = _reflections(self, other)
        parent = np.array([kinds[p] if p >= 0 else _WORLD for p in rig.parents])
        mirrored, offsets = np.empty_like(self.rotations), np.empty_like(rig.offsets)
        mirrored[:, other] = _reflected(self.rotations, parent, kinds)
        offsets[other] = rig.offsets * _REFLECTIONS[parent]
        ends, moving = {}, {}
        for name, twin, own, above in zip(rig.names, other, kinds, parent):
            if name in rig.end_sites:
                sites = rig.end_sites[name]
                ends[rig.names[twin]] = tuple(site * _REFLECTIONS[own] for site in sites)
            if name in self.joint_translations:
                moving[rig.names[twin]] = self.joint_translations[name] * _REFLECTIONS[above]
        return replace(
            self,
            skeleton=replace(rig, offsets=offsets, end_sites=ends),
            rotations=mirrored,
            translation=self.translation * _REFLECTIONS[_WORLD],
            joint_translations=moving,
            face=None if self.face is None else self.face.mirror(),
            info=dict(self.info),
        )

    def keep(self, joints: Sequence[str] | str) -> Motion:
        """Return the motion without all other joints; kept ones stay where they are in the world.

        A joint whose parent is removed becomes a child of its nearest kept ancestor; it gets
        `joint_translations` if a removed joint between them rotates. A joint that loses all its
        children gets an end site at the removed child, or at the mean of several (the knuckles of
        a hand).

        Args:
            joints: names, in any order; or one name.

        Raises:
            MotionError: no names, an unknown one, or no kept joint above all others.
        """
        rig, joints = self.skeleton, [joints] if isinstance(joints, str) else joints
        if set(joints) == set(rig.names):
            return self
        kept = sorted({rig.index(name) for name in joints})
        parent = _kept_parents(rig, kept)
        below_others = [j for j in kept if parent[j] != rig.parents[j]]
        if below_others:  # not if leaves go, such as fingers
            world, positions = self.global_rotations(), self.positions()
        rotations, translation = self.rotations.copy(), self.translation
        offsets, moving = rig.offsets.copy(), dict(self.joint_translations)
        still = _STILL * body_scale(rig)
        for j in below_others:
            moving.pop(rig.names[j], None)
            if j == kept[0]:
                rotations[:, j], translation = world[:, j], positions[:, j]
                offsets[j] = rig.offsets[[j, *rig.ancestors(j)]].sum(axis=0)
                continue
            back = invert_quaternions(world[:, parent[j]])
            rotations[:, j] = multiply_quaternions(back, world[:, j])
            local = rotate_vectors(back, positions[:, j] - positions[:, parent[j]])
            low, high = local.min(axis=0), local.max(axis=0)
            offsets[j] = (low + high) / 2
            if (high - low > still).any():
                moving[rig.names[j]] = local
        made = _kept_rig(rig, kept, parent, offsets)
        return replace(
            self,
            skeleton=made,
            rotations=rotations[:, kept],
            translation=translation,
            joint_translations={k: v for k, v in moving.items() if k in made.names},
            info=dict(self.info),
        )

    def with_joint_at(
        self, joint: int, place: np.ndarray, world: np.ndarray | None = None
    ) -> Motion:
        """Return the motion with one joint at `place` (T, 3), metres.

        Joints above it stay where they are; those below keep their local pose. `world` (T, 4) is
        the joint's world rotation; by default its local one is kept.
        """
        changes: dict[str, Any] = {"translation": place}
        if joint:
            parent = self.skeleton.parents[joint]
            back = invert_quaternions(self.global_rotations()[:, parent])
            local = rotate_vectors(back, place - self.positions()[:, parent])
            moving = {**self.joint_translations, self.skeleton.names[joint]: local}
            changes = {"joint_translations": moving}
            world = None if world is None else multiply_quaternions(back, world)
        if world is not None:
            changes["rotations"] = self.rotations.copy()
            changes["rotations"][:, joint] = world
        return replace(self, **changes)

    def scaled(self, factor: float) -> Motion:
        """Multiply all lengths by `factor`: skeleton, translation and joint translations.

        Raises:
            MotionError: a factor that is not positive and finite.
        """
        return replace(
            self,
            skeleton=self.skeleton.scaled(factor),
            translation=self.translation * factor,
            joint_translations={k: v * factor for k, v in self.joint_translations.items()},
            info=dict(self.info),
        )

    def with_parts(self, parts: Mapping[str, str]) -> Motion:
        """Return the motion with more body parts of its rig specified by hand.

        Args:
            parts: part to joint, such as {"left_elbow": "Joint12"}; see `Skeleton.parts`.

        Raises:
            MotionError: no such joint.
        """
        return replace(self, skeleton=self.skeleton.with_parts(parts)) if parts else self

    def with_height(self, metres: float) -> Motion:
        """Return the motion scaled to a body height; the factor is stored as `info["scale"]`.

        Args:
            metres: sole to crown, standing upright; see `motion.parts.body_size`.

        Raises:
            MotionError: an invalid height, or a rig without bones.
        """
        if not 0 < metres < FARTHEST:
            raise MotionError(f"height is {metres!r}; expected metres, such as 1.75")
        scale = metres / body_height(self.skeleton)
        return replace(self.scaled(scale), info=self.info | {"scale": scale})

    def trim(self, start: float = 0.0, stop: float | None = None) -> Motion:
        """Return seconds `start` to `stop` (default: the end), both rounded to whole frames.

        Raises:
            MotionError: the range is empty or exceeds the motion.
        """
        last = self.n_frames / self.fps if stop is None else stop
        if not (math.isfinite(start) and math.isfinite(last)):
            raise MotionError(f"seconds {start} to {stop} are not a range")
        frames = [math.floor(seconds * self.fps + 0.5) for seconds in (start, last)]
        if not 0 <= frames[0] < frames[1] <= self.n_frames:
            held = f"{start:g} to {last:g} s of a motion of {self.duration:g} s"
            raise MotionError(f"{held}; give seconds within it, at least {1 / self.fps:.3f} apart")
        return self[slice(*frames)]

    @classmethod
    def load(
        cls, path: str | os.PathLike[str], *, height: float | None = None, **options: Any
    ) -> Motion:
        """Read a .bvh, .npz, .glb, .gltf, .vrma or .fbx file, or an EasyMocap folder.

        Args:
            path: the file or folder.
            height: body height in metres to scale the motion to, see `with_height`.
            options: keyword arguments of the format's reader.

        Raises:
            FormatError: the file is missing, of another kind or broken, or its format does not
                have an option.
            MotionError: an invalid height.
        """
        # Reading a pipe may never end.
        if not (os.path.isfile(path) or os.path.isdir(path)):  # noqa: PTH112, PTH113 (any text)
            raise FormatError(f"{path}: no such file, or not a regular file")
        motion = lazy.formats().reader_of(path, options)(path, **options)
        return motion if height is None else motion.with_height(height)

    @gesturekit_errors()
    def save(self, path: str | os.PathLike[str], **options: Any) -> None:
        """Write a .bvh, .npz, .glb, .vrma, .fbx, .obj, .html, .mp4, .png, .svg, .pdf or .csv file.

        Args:
            path: the file; its suffix selects the format.
            options: keyword arguments of the format's writer.

        Raises:
            FormatError: an unknown format, one that cannot hold this motion, or an option that the
                format does not have.
        """
        lazy.formats().writer_of(path, options)(self, path, **options)

    @gesturekit_errors()
    def show(self, audio: Any = None, **options: Any) -> Any:
        """Return a player with sound that a notebook displays as the output of a cell.

        Args:
            audio: the speech: a file, a `Wave`, or (samples, rate).
            options: `title`, `body`, `framing`, `body_model` and `height` in pixels; see
                `gesturekit.viewer.display`.
        """
        return lazy.formats().notebook_player()(self, audio, **options)

    def plot(self, audio: Any = None, **options: Any) -> Any:
        """Return the picture that `save` writes as .png: a PIL image, which a notebook displays.

        The arguments are those of `gesturekit.viewer.write_picture`; without a title by default.
        """
        from PIL import Image

        with tempfile.TemporaryDirectory(prefix="gesturekit-") as folder:
            self.save(file := Path(folder, "a.png"), audio=audio, **{"title": "", **options})
            return Image.open(BytesIO(file.read_bytes()))


def _kept_parents(skeleton: Skeleton, kept: Sequence[int]) -> dict[int, int]:
    """Return kept joint to its nearest kept ancestor, -1 for the root, which comes first."""
    if not kept:
        raise MotionError("no joints to keep; name at least one")
    staying = set(kept)
    above = {j: next((a for a in skeleton.ancestors(j) if a in staying), -1) for j in kept}
    roots = [j for j in kept if above[j] < 0]
    if len(roots) > 1:
        joints = (*roots[:2], skeleton.common_ancestor(*roots[:2]))
        one, two, three = (skeleton.names[j] for j in joints)
        raise MotionError(f"no kept joint lies above both {one!r} and {two!r}; keep {three!r} too")
    return above


def _kept_rig(
    skeleton: Skeleton, kept: Sequence[int], parent: Mapping[int, int], offsets: np.ndarray
) -> Skeleton:
    """Return the rig of the kept joints, with new parents and offsets (J, 3)."""
    number = {j: k for k, j in enumerate(kept)}
    ends = {j: skeleton.end_sites.get(skeleton.names[j], ()) for j in kept}
    for j in kept:
        children = list(skeleton.children(j))
        if children and not ends[j] and number.keys().isdisjoint(skeleton.descendants(j)):
            ends[j] = (skeleton.offsets[children].mean(axis=0),)
    return Skeleton(
        names=tuple(skeleton.names[j] for j in kept),
        parents=tuple(number.get(parent[j], -1) for j in kept),
        offsets=offsets[list(kept)],
        end_sites={skeleton.names[j]: sites for j, sites in ends.items() if sites},
        rotation_orders=tuple(skeleton.rotation_orders[j] for j in kept),
        parts={p: name for p, name in skeleton.parts.items() if skeleton.index(name) in number},
        body_shape=skeleton.body_shape,
    )


_REFLECTIONS = np.array([[-1.0, 1, 1], [1, -1, 1], [1, 1, -1], [-1, -1, -1]])
_HALF_TURNS = np.eye(4)
"""Reflections of a joint's frame, as diagonals, and S = -H: half turns H as quaternions.

A reflection is not a rotation, so each joint's frame is reflected too. With M = diag(-1, 1, 1) the
mirror of the world, G_j the rotation from joint j's frame to the world, j' the counterpart of j and
p the parent of j,

    G'_j' = M G_j S_j,    and locally    L'_j' = S_p L_j S_j.

Offsets, end sites and joint translations within frame j are multiplied by S_j. Each S_j is one of
diag(-1, 1, 1), diag(1, -1, 1), diag(1, 1, -1) and -I. The mirrored joint positions are exact for
every choice; the right choice also gives the mirrored angles the meaning they have on the rig.

- If one S reflects all left offsets onto the right ones, that S is used for all joints. This holds
  for every rig whose rest pose is a T-pose with parallel frames (ZEGGS, Mixamo, SMPL).
- Otherwise (rigs with bones along their own x axes, such as Bandai-Namco's) each S_j is the one
  that reflects the offsets best. Where the offsets allow several, the mirrored local rotations
  should resemble those of the motion itself, because people move alike on both sides.
"""
_WORLD = 0
_PARALLEL = 0.1
"""Largest mismatch of left and right offsets, as a share of their lengths, for parallel frames."""
_METRES_PER_RADIAN = 1e-3
"""Offset mismatch (metres on the reference body) that costs as much as one radian."""
_ALIKE = 0.1
"""Quantile over frames of the angle between the two sides: people are symmetric in some frames."""
_CHANGE = 1.0
"""Cost, radians, of a joint frame that is reflected by another S than its parent's."""
_FRAMES = 300
"""Number of frames that are compared, evenly spaced."""


def can_be_mirrored(skeleton: Skeleton) -> bool:
    """Return whether left and right of a rig can be identified, or it has no limbs at all."""
    forks = any(len(skeleton.children(j)) > 1 for j in range(skeleton.n_joints))
    return not forks or bool((_counterparts(skeleton) != np.arange(skeleton.n_joints)).any())


def _counterparts(skeleton: Skeleton) -> np.ndarray:
    """(J,) index of each joint's mirror image."""
    other = np.arange(skeleton.n_joints)
    for left, right in left_right_pairs(skeleton):
        i, j = skeleton.index(left), skeleton.index(right)
        # Names are not trusted if the parents are not counterparts of each other.
        if i and j and other[skeleton.parents[i]] == skeleton.parents[j]:
            other[i], other[j] = j, i
    return other


def _reflected(rotations: np.ndarray, parent: np.ndarray, kind: np.ndarray) -> np.ndarray:
    """Return S_p L S_j as quaternions (..., 4): the minus signs cancel and half turns remain."""
    turned = multiply_quaternions(_HALF_TURNS[parent], rotations)
    return multiply_quaternions(turned, invert_quaternions(_HALF_TURNS[kind]))


def _reflections(motion: Motion, other: np.ndarray) -> np.ndarray:
    """(J,) index of each joint's S in `_REFLECTIONS`; counterparts have the same.

    Without parallel frames it has the lowest total cost over the tree, by dynamic programming from
    leaves to root.
    """
    skeleton, n = motion.skeleton, motion.skeleton.n_joints
    # mismatch[j, s]: metres between the reflection of joint j's bone by S and its counterpart.
    bones = skeleton.offsets[:, None] * _REFLECTIONS - skeleton.offsets[other][:, None]
    mismatch = np.linalg.norm(bones, axis=2)
    fixed = [j for j in range(1, n) if skeleton.names[j] not in motion.joint_translations]
    lengths = np.linalg.norm(skeleton.offsets[fixed], axis=1).sum()
    total = mismatch[fixed].sum(axis=0)
    if total.min() <= _PARALLEL * max(lengths, 1e-9):
        return np.full(n, total.argmin())
    rotations = motion.rotations[:: max(1, motion.n_frames // _FRAMES)]
    # Rotations above the first fork place the body in the world. They do not resemble their
    # mirror image, so they carry no evidence.
    fork = first_fork(skeleton)
    # cost[j, s]: cost of reflecting the frame of j by s, all joints below included.
    cost = np.zeros((n, 4))
    choice = np.full((n, 4), _WORLD)
    radian = _METRES_PER_RADIAN * body_scale(skeleton)
    for j in fixed:
        cost[skeleton.parents[j]] += mismatch[j] / radian
    for j in reversed(range(fork, n)):
        for parent in range(4):
            total = cost[j].copy()
            if j != fork:
                total += _CHANGE * (np.arange(4) != parent)
                for s in range(4):
                    mirrored = _reflected(rotations[:, j], np.array(parent), np.array(s))
                    angle = rotation_angles(mirrored, rotations[:, other[j]])
                    total[s] += np.quantile(angle, _ALIKE)
            choice[j, parent] = total.argmin()
            if j != fork:
                cost[skeleton.parents[j], parent] += total.min()
    kind = np.zeros(n, dtype=np.int64)
    for j, parent in enumerate(skeleton.parents):
        kind[j] = choice[j, kind[parent] if parent >= 0 else _WORLD]
        if other[j] < j:
            kind[j] = kind[other[j]]
    return kind
