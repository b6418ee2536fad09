"""A motion: a rig and how its joints turn over time."""

from __future__ import annotations

import math
import os
import stat
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np

from gesturekit.errors import FormatError, MotionError, gesturekit_errors
from gesturekit.motion import kinematics
from gesturekit.motion.rotations import rotate_vectors
from gesturekit.motion.skeleton import FARTHEST, Skeleton

LOWEST_FPS, HIGHEST_FPS = 1e-5, 1e5
"""Frame rates beyond these are damage."""

# The one step upwards: files are read and written by packages that build on this one.
_READERS = {
    ".bvh": ("gesturekit.formats.bvh.bvh", "read_bvh"),
    ".npz": ("gesturekit.formats.npz", "read_npz"),
    ".json": ("gesturekit.formats.smpl.easymocap", "read_easymocap"),
    "a folder": ("gesturekit.formats.smpl.easymocap", "read_easymocap"),
}
_WRITERS = {
    ".bvh": ("gesturekit.formats.bvh.bvh", "write_bvh"),
    ".npz": ("gesturekit.formats.npz", "write_npz"),
    ".obj": ("gesturekit.formats.obj", "write_obj"),
    ".html": ("gesturekit.viewer", "write_html"),
    ".png": ("gesturekit.viewer", "write_picture"),
}


@dataclass(frozen=True, eq=False)
class Motion:
    """Local rotations of a rig's joints and the path of its root; frame k is at k / fps seconds.

    Attributes:
        skeleton: the rig, J joints.
        rotations: (T, J, 4) float64 local unit quaternions, x y z w.
        translation: (T, 3) float64 of the root joint, metres, Y up; replaces the root's offset.
        fps: frames per second, from `LOWEST_FPS` to `HIGHEST_FPS`.
        joint_translations: joint name to (T, 3), metres, in the parent's frame: replaces that
            joint's offset, for files that move joints other than the root.
        info: what is known of its origin (source file, unit found, ...).
        expressions: (T, E) coefficients of the face, as SMPL-X has them, or None. They are carried
            along and resampled; nothing else looks at them.

    Raises:
        MotionError: shapes that do not fit, numbers that are not finite, or no frame at all.
    """

    skeleton: Skeleton
    rotations: np.ndarray
    translation: np.ndarray
    fps: float
    joint_translations: Mapping[str, np.ndarray] = field(default_factory=dict)
    info: dict[str, Any] = field(default_factory=dict)
    expressions: np.ndarray | None = None

    def __post_init__(self) -> None:
        rotations = np.asarray(self.rotations, dtype=np.float64)
        if rotations.ndim != 3 or rotations.shape[1:] != (self.skeleton.n_joints, 4):
            raise MotionError(
                f"rotations have shape {rotations.shape}; a rig of {self.skeleton.n_joints} "
                f"joints needs (frames, {self.skeleton.n_joints}, 4)"
            )
        n_frames = len(rotations)
        if not n_frames:
            raise MotionError("a motion needs at least one frame")
        length = np.linalg.norm(rotations, axis=-1, keepdims=True)
        if not np.isfinite(length).all() or (length < 1e-6).any():
            bad = np.argwhere(~(np.isfinite(length) & (length >= 1e-6)))[0]
            raise MotionError(
                f"the rotation of joint {self.skeleton.names[bad[1]]!r} in frame {bad[0]} is "
                f"{rotations[bad[0], bad[1]].tolist()}, no quaternion"
            )
        # Unit ones stay as they are, to the last bit: what is read again is what was written.
        if (off := np.abs(length - 1) > 1e-12).any():
            rotations = np.where(off, rotations / length, rotations)
        moving = {}
        for name, places in self.joint_translations.items():
            if self.skeleton.index(name) == 0:
                raise MotionError(f"{name!r} is the root: its place is the motion's translation")
            moving[name] = _places(places, n_frames, f"translation of joint {name!r}")
        fps = checked_fps(self.fps)
        translation = _places(self.translation, n_frames, "translation")
        expressions = self.expressions
        if expressions is not None:
            expressions = _rows(expressions, n_frames, "expressions")
        for key, value in (
            ("rotations", rotations),
            ("translation", translation),
            ("fps", fps),
            ("joint_translations", moving),
            ("expressions", expressions),
        ):
            object.__setattr__(self, key, value)

    def __repr__(self) -> str:
        return (
            f"Motion({self.n_frames} frames at {self.fps:g} fps = {self.duration:.2f} s, "
            f"{self.skeleton.n_joints} joints from {self.skeleton.names[0]!r})"
        )

    @property
    def n_frames(self) -> int:
        """Number of frames T."""
        return len(self.rotations)

    @property
    def duration(self) -> float:
        """Seconds, T / fps: each frame stands for 1 / fps."""
        return self.n_frames / self.fps

    @property
    def times(self) -> np.ndarray:
        """(T,) seconds, k / fps."""
        return np.arange(self.n_frames) / self.fps

    def positions(self) -> np.ndarray:
        """(T, J, 3) world positions of the joints, metres."""
        return kinematics.forward_kinematics(
            self.rotations, self.translation, self.skeleton, self.joint_translations
        )

    def end_positions(self) -> dict[str, np.ndarray]:
        """Joint name to (T, E, 3), world positions of its E end sites, metres."""
        positions, turned = self.positions(), self.global_rotations()
        ends = {}
        for name, sites in self.skeleton.end_sites.items():
            j = self.skeleton.index(name)
            ends[name] = positions[:, j, None] + rotate_vectors(turned[:, j, None], np.stack(sites))
        return ends

    def global_rotations(self) -> np.ndarray:
        """(T, J, 4) quaternions from each joint's frame to the world."""
        return kinematics.global_rotations(self.rotations, self.skeleton)

    def resample(self, fps: float, n_frames: int | None = None, antialias: bool = False) -> Motion:
        """At another frame rate; see `gesturekit.motion.resampling.resample_motion`."""
        from gesturekit.motion.resampling import resample_motion

        return resample_motion(self, fps, n_frames, antialias)

    def mirror(self) -> Motion:
        """Left and right exchanged; see `gesturekit.motion.mirroring.mirror_motion`."""
        from gesturekit.motion.mirroring import mirror_motion

        return mirror_motion(self)

    def scaled(self, factor: float) -> Motion:
        """Multiply all lengths by `factor`: rig, path of the root, joints that move.

        Raises:
            MotionError: a factor that is not above 0 and finite.
        """
        return replace(
            self,
            skeleton=self.skeleton.scaled(factor),
            translation=self.translation * factor,
            joint_translations={k: v * factor for k, v in self.joint_translations.items()},
            info=dict(self.info),
        )

    def with_parts(self, parts: Mapping[str, str]) -> Motion:
        """With parts of the rig named by hand, beside those that already are.

        Args:
            parts: such as {"left_elbow": "Joint12"}, see `Skeleton.parts`.

        Raises:
            MotionError: no such joint.
        """
        if not parts:
            return self
        return replace(self, skeleton=self.skeleton.with_parts(parts))

    def with_height(self, metres: float) -> Motion:
        """Return the motion scaled so that its body is this tall; `info` keeps the `scale`.

        Args:
            metres: sole to crown, standing upright; see `gesturekit.motion.body_size.body_height`.

        Raises:
            MotionError: no such height, or a rig without bones.
        """
        from gesturekit.motion.body_size import body_height

        if not 0 < metres < FARTHEST:
            raise MotionError(f"height is {metres!r}; expected metres, such as 1.75")
        scale = metres / body_height(self.skeleton)
        return replace(
            self,
            skeleton=self.skeleton.scaled(scale),
            translation=self.translation * scale,
            joint_translations={k: v * scale for k, v in self.joint_translations.items()},
            info=self.info | {"scale": scale},
        )

    def slice(self, start_frame: int, stop_frame: int) -> Motion:
        """Frames start_frame (included) to stop_frame (not included).

        Raises:
            MotionError: the range is empty or leaves the motion.
        """
        if not 0 <= start_frame < stop_frame <= self.n_frames:
            raise MotionError(
                f"frames {start_frame} to {stop_frame} of a motion of {self.n_frames} frames"
            )
        part = np.s_[start_frame:stop_frame]
        return replace(
            self,
            rotations=self.rotations[part],
            translation=self.translation[part],
            joint_translations={k: v[part] for k, v in self.joint_translations.items()},
            expressions=None if self.expressions is None else self.expressions[part],
            info=dict(self.info),
        )

    def trim(self, start: float = 0.0, stop: float | None = None) -> Motion:
        """Seconds `start` to `stop`, the end by default; both are rounded to whole frames.

        Raises:
            MotionError: nothing is left, or the range leaves the motion.
        """
        last = self.n_frames / self.fps if stop is None else stop
        if not (math.isfinite(start) and math.isfinite(last)):
            raise MotionError(f"seconds {start} to {stop} are no range")
        frames = [math.floor(seconds * self.fps + 0.5) for seconds in (start, last)]
        if not 0 <= frames[0] < frames[1] <= self.n_frames:
            raise MotionError(
                f"{start:g} to {last:g} s of a motion of {self.duration:g} s; "
                f"give seconds within it, at least {1 / self.fps:.3f} apart"
            )
        return self.slice(*frames)

    @classmethod
    def load(
        cls, path: str | os.PathLike[str], *, height: float | None = None, **options: Any
    ) -> Motion:
        """Read a .bvh or .npz file, or a folder of EasyMocap.

        Args:
            path: the file or folder.
            height: of the body, metres: the motion is scaled to it, see `with_height`.
            options: those of the reader.

        Raises:
            FormatError: the file is missing, of another kind, or broken, or an option that its
                format does not have.
            MotionError: a height that cannot be.
        """
        _refuse_special(Path(path))
        motion = _dispatch(_READERS, path, "read", options)(path, **options)
        return motion if height is None else motion.with_height(height)

    @gesturekit_errors()
    def save(self, path: str | os.PathLike[str], **options: Any) -> None:
        """Write a .bvh, .npz, .obj, .html or .png file; `options` are those of the writer.

        Raises:
            FormatError: no such format, one that cannot hold this motion, or an option that it
                does not have.
        """
        _dispatch(_WRITERS, path, "write", options)(self, path, **options)


def _refuse_special(path: Path) -> None:
    """Reading a pipe or a device may never end."""
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        raise FormatError(f"{path}: no such file") from None
    except (OSError, ValueError):
        return  # whoever reads it says what is wrong with it
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise FormatError(f"{path}: not a regular file")


def checked_fps(fps: float) -> float:
    """The frame rate as a float.

    Raises:
        MotionError: it is no rate that a motion can have.
    """
    if not LOWEST_FPS <= float(fps) <= HIGHEST_FPS:
        raise MotionError(f"fps is {fps!r}; expected {LOWEST_FPS:g} to {HIGHEST_FPS:g}")
    return float(fps)


def _dispatch(
    table: Mapping[str, tuple[str, str]],
    path: str | os.PathLike[str],
    verb: str,
    options: Iterable[str],
) -> Callable[..., Any]:
    """The reader or writer of a file, which has these options."""
    suffix = "a folder" if Path(path).is_dir() else Path(path).suffix.lower()
    if suffix not in table:
        raise FormatError(
            f"{path}: cannot {verb} motion as {suffix or 'a file without suffix'}; "
            f"expected {', '.join(table)}"
        )

    def function(suffix: str) -> Callable[..., Any]:
        module, name = table[suffix]
        return getattr(import_module(module), name)

    def known(suffix: str) -> list[str]:
        parameters = signature(function(suffix)).parameters.values()
        return [each.name for each in parameters if each.default is not each.empty]

    for option in options:
        if option not in (own := known(suffix)):
            others = ", ".join(other for other in table if option in known(other))
            raise FormatError(
                f"{path}: {suffix} has no option {option!r} to {verb} it with, "
                f"{f'only {others}' if others else 'nor has any other format'}; "
                f"{suffix} has {', '.join(own) or 'no options'}"
            )
    return function(suffix)


def _places(values: np.ndarray, n_frames: int, what: str) -> np.ndarray:
    values = np.asarray(values, dtype=np.float64)
    if values.shape != (n_frames, 3):
        raise MotionError(
            f"{what} has shape {values.shape}; {n_frames} frames need ({n_frames}, 3)"
        )
    return _rows(values, n_frames, what)


def _rows(values: np.ndarray, n_frames: int, what: str) -> np.ndarray:
    values = np.asarray(values, dtype=np.float64)
    if values.ndim != 2 or len(values) != n_frames:
        raise MotionError(f"{what} has shape {values.shape}; {n_frames} frames need as many rows")
    if not (near := np.abs(values) <= FARTHEST).all():
        frame = int(np.argwhere(~near)[0, 0])
        raise MotionError(f"{what} is not finite, or over {FARTHEST:g}, in frame {frame}")
    return values
