"""The interface that models of every system have, and the controls that all of them take."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypedDict, overload, runtime_checkable

from gesturekit.errors import ModelError
from gesturekit.motion.motion import Motion
from gesturekit.motion.skeleton import Skeleton

if TYPE_CHECKING:
    from gesturekit.corpus.speech import Speech
    from gesturekit.motion.root_path import RootPath


@dataclass(frozen=True, kw_only=True)
class Controls:
    """Controls of `generate` that models of every system take; each system adds its own.

    The docstrings of the fields are also the help texts of `gesturekit render`.
    """

    style: str | None = None
    """A style that the model knows, or several over time: old@0-10,angry@10-20 (seconds)."""
    path: str | Path | RootPath | Motion | None = None
    """The path of the root: a table time,x,z[,heading] (s, m, degrees), or a motion whose path to
    follow."""
    like: str | Path | Motion | None = None
    """A motion, of any rig of a person, to redo in the style of the model's recordings."""
    speaker: str | None = None
    """The speaker whose skeleton to use, one of the model's `speakers`."""
    foot_lock: bool = True
    """Lock planted feet in place; without it, feet stay as the model generated them."""
    smooth: float | None = None
    """Smooth upper-body movements shorter than this many seconds; beats keep their time and
    height. 0 turns smoothing off; the default is stored with the model."""
    fps: float | None = None
    """Frames per second of the result; by default those of the training recordings."""

    @classmethod
    def build(cls, keywords: Mapping[str, Any], kind: str) -> Controls:
        """Build the controls of one call.

        Args:
            keywords: by field name. None stands for a control that is not given.
            kind: name of the system, for errors.

        Raises:
            UnknownControlError: a control that this system does not have.
        """
        names = [field.name for field in dataclasses.fields(cls)]
        for name, value in keywords.items():
            if name not in names and value is not None:
                near = difflib.get_close_matches(name, names, n=1)
                hint = f"; did you mean {near[0]}?" if near else ""
                raise UnknownControlError(
                    f"{name}={value!r}: {kind} models have no control {name}{hint}"
                )
        return cls(**{name: value for name, value in keywords.items() if name in names})


class UnknownControlError(ModelError, TypeError):
    """A control of `generate` that a system does not have."""


class ControlArguments(TypedDict, total=False):
    """Keywords of `Controls`, for type checkers; each system extends it as `Controls`."""

    style: str | None
    path: str | Path | RootPath | Motion | None
    like: str | Path | Motion | None
    speaker: str | None
    foot_lock: bool
    smooth: float | None
    fps: float | None


@runtime_checkable
class Model(Protocol):
    """A trained model, as `gesturekit.load` gives it.

    Attributes:
        kind: name of its system.
        fps: frames per second at which its networks work.
        recorded_fps: the training recordings' rate, which generated motion gets.
        speakers: a reference skeleton for each speaker that the corpus named.
    """

    kind: str
    fps: float
    recorded_fps: float
    speakers: dict[str, Skeleton]

    @property
    def skeleton(self) -> Skeleton:
        """The rig, with all the joints of the training files."""
        ...

    @property
    def styles(self) -> tuple[str, ...]:
        """Names of the styles it knows; empty for a model without styles."""
        ...

    @overload
    def generate(
        self,
        speech: Speech | None = None,
        sample_rate: int | None = None,
        *,
        seconds: float | None = None,
        samples: Literal[1] = 1,
        seed: int = 0,
        **controls: Any,
    ) -> Motion: ...

    @overload
    def generate(
        self,
        speech: Speech | None = None,
        sample_rate: int | None = None,
        *,
        seconds: float | None = None,
        samples: int,
        seed: int = 0,
        **controls: Any,
    ) -> list[Motion]: ...

    def generate(self, *args: Any, **controls: Any) -> Motion | list[Motion]:
        """Generate motion, as long as the speech or `seconds`; a list where `samples` > 1.

        Further `controls` are those of the system: see `MultiresModel.generate` and
        `DiffusionModel.generate`.

        Raises:
            ModelError: a control, style or speaker this model does not have.
            AudioError, FormatError: a file cannot be read, or an array is no sound.
        """
        ...

    def save(self, folder: str | Path, *, notes: Mapping[str, str] | None = None) -> None:
        """Write the model folder: config.yaml, skeleton.json, model.safetensors, README.md."""
        ...
