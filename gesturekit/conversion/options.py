"""Options of a conversion, and data that a format cannot hold."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from gesturekit.errors import ConfigError
from gesturekit.formats.conversion import describe_axes
from gesturekit.motion.motion import Motion
from gesturekit.wording import counted

_WITHOUT_FACES = {".bvh": "BVH", ".glb": "glTF", ".vrma": "a VRM animation", ".fbx": "FBX"}
"""Formats without expressions and body shape, by suffix."""


@dataclass(frozen=True)
class FormatOptions:
    """Options of readers and writers; each gets those that it has.

    Attributes:
        read: options of readers, such as `up`; also `fps` and `height`, see `load`.
        write: options of writers, such as `up`.
        body_model: npz file of an SMPL or SMPL-X model, or a folder of such files, for readers and
            writers that use one.
        parts: joints of the sources specified by hand, see `load`.
    """

    read: Mapping[str, Any] = field(default_factory=dict)
    write: Mapping[str, Any] = field(default_factory=dict)
    body_model: str | os.PathLike[str] | None = None
    parts: Mapping[str, str] = field(default_factory=dict)


def with_body_model(options: FormatOptions) -> FormatOptions:
    """Return options whose body model is among those of readers and writers."""
    if options.body_model is None:
        return options
    model = {"body_model": options.body_model}
    return replace(options, read={**options.read, **model}, write={**options.write, **model})


def describe(motion: Motion) -> str:
    """Return a summary of a motion: unit, axes, rate, frames, joints; "?" marks guesses."""
    words = describe_axes(motion.info, "?")
    if "scale" in motion.info:
        words.append(f"scaled by {motion.info['scale']:.4g}")
    words.append(f"{motion.fps:.6g} fps")
    words.append(counted(motion.n_frames, "frame"))
    words.append(counted(motion.skeleton.n_joints, "joint"))
    return ", ".join(words)


def without_mesh(formats: Sequence[str], out: Path) -> Sequence[str]:
    """Return the formats that can be written without a body model."""
    if "obj" not in (formats or [out.suffix.lower()[1:]]):
        return formats
    needs = "an obj needs the mesh of a body model: give --body-model SMPLX_NEUTRAL.npz"
    others = [name for name in formats if name != "obj"]
    if not others:
        raise ConfigError(needs)
    warnings.warn(f"no obj is written; {needs}", stacklevel=3)
    return others


def warn_of_losses(motion: Motion, target: Path) -> None:
    """Warn of data of a motion that the format of a target cannot hold."""
    name = _WITHOUT_FACES.get(target.suffix.lower())
    if name:
        lost = ["face expressions"] if motion.expressions is not None else []
        if motion.skeleton.body_shape.betas:
            lost.append("body shape (betas)")
        if lost:
            warnings.warn(
                f"{target}: {name} holds no {' and no '.join(lost)}; npz does", stacklevel=2
            )
