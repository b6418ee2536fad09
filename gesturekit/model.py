"""Interface of the models of both systems, and the controls that all models take."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Any,
    ClassVar,
    Literal,
    Protocol,
    TypedDict,
    overload,
    runtime_checkable,
)

from gesturekit.errors import FormatError, ModelError
from gesturekit.motion.motion import Motion
from gesturekit.motion.skeleton import Skeleton
from gesturekit.wording import counted, did_you_mean

if TYPE_CHECKING:
    from audio_features.weight_files import WeightPlaces
    from gesturekit.corpus.speech import Speech
    from gesturekit.motion.root_path import RootPath


@dataclass(frozen=True, kw_only=True)
class Controls:
    """Controls of `generate` that models of every system take; each system adds its own.

    The docstrings of the fields are also the help texts of `gesturekit render`.
    """

    _files = ("path", "like")  # controls that may be the path of a file

    style: str | None = None
    """A style of the model, or several over time: old@0-10,angry@10-20 (seconds)."""
    path: str | Path | RootPath | Motion | None = None
    """The path of the root: a table time,x,z[,heading] (s, m, degrees), or a motion whose path is
    followed."""
    like: str | Path | Motion | None = None
    """A motion on any human rig, to be regenerated in the manner of the model's recordings."""
    speaker: str | None = None
    """One of the model's `speakers`: their skeleton is used, and a model with recall recalls their
    recordings only. Without it, gestures are those of all speakers, on a skeleton of median
    size."""
    foot_lock: bool = True
    """Lock planted feet in place; without it, feet stay as the model generated them."""
    smooth: float | None = None
    """Smooth upper-body movements shorter than this many seconds, but keep the time and size of
    beat gestures. 0 turns smoothing off; the default is stored with the model."""
    vad: bool | None = None
    """Voice activity detection: stretches of at least 3 s of the sound without voice, such as a
    noise floor, hum or typing, give idle motion. By default as in training; off, everything in the
    sound moves the body, for example a whisper."""
    fps: float | None = None
    """Frames per second of the result; by default those of the training recordings."""

    @classmethod
    def build(cls, keywords: Mapping[str, Any], kind: str) -> Controls:
        """Build the controls of one call.

        Args:
            keywords: controls by field name. None means that a control is not given.
            kind: name of the system, for errors.

        Raises:
            UnknownControlError: a control that this system does not have.
            FormatError: a file that does not exist.
        """
        names = [field.name for field in dataclasses.fields(cls)]
        for name, value in keywords.items():
            if name not in names and value is not None:
                hint = did_you_mean(name, names, "; did you mean {}?", cutoff=0.75)
                given = f"{name}={value!r}" if isinstance(value, str | int | float) else name
                raise UnknownControlError(f"{given}: {kind} models have no control {name}{hint}")
        given = {name: value for name, value in keywords.items() if value is not None}
        for name in cls._files:
            value = given.get(name)
            for file in value.values() if isinstance(value, Mapping) else [value]:
                if isinstance(file, str | Path) and not Path(file).exists():
                    raise FormatError(f"{name}: {file}: no such file")
        return cls(**given)


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
    vad: bool | None
    fps: float | None


@dataclass(frozen=True)
class Inputs:
    """Inputs of a model besides style and speaker.

    Attributes:
        speech: whether it was trained with speech (or music) features.
        words: whether these features include the words beside a recording.
        path: whether it was trained with the path of the root.
        events: names of the events with which it was trained.
    """

    speech: bool = False
    words: bool = False
    path: bool = False
    events: tuple[str, ...] = ()


def rate_text(fps: float, recorded_fps: float) -> str:
    """Return a description of the frame rate of a model's motion."""
    return f"{fps:g} fps" + ("" if recorded_fps == fps else f", resampled to {recorded_fps:g} fps")


def reduction_text(shape: Sequence[int]) -> str:
    """Return a description of the projection (W, N) of W speech features to N components."""
    return f"{shape[0]} features reduced to {counted(shape[-1], 'component')}"


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class BaseModel:
    """Fields of every trained model; each system adds its networks and its generation.

    The value goes whole to whoever samples from it.

    Attributes:
        fps: frames per second at which the network (its finest level) works.
        representation: the motion vector of the rig.
        conditions: inputs of the model beside noise or the noisy motion.
        speakers: a reference skeleton for each speaker that the corpus named.
        smooth: default of the control `smooth`, in seconds; None for no smoothing.
        recorded_fps: the recordings' rate, which generated motion gets.
        folder: folder that it was loaded from; None for one that was not loaded.
    """

    kind: ClassVar[str]

    fps: float
    representation: Any
    conditions: Any
    speakers: Mapping[str, Skeleton] = field(default_factory=dict)
    smooth: float | None = None
    recorded_fps: float
    folder: Path | None = None

    def __repr__(self) -> str:
        folder = "" if self.folder is None else f"{str(self.folder)!r}: "
        return f"{type(self).__name__}({folder}{self.motion_row()})"

    @property
    def skeleton(self) -> Skeleton:
        """The rig, with all the joints of the training files."""
        return self.representation.skeleton

    @property
    def styles(self) -> tuple[str, ...]:
        """Names of its styles; empty for a model without styles."""
        return self.conditions.styles

    def first_values(self) -> dict[str, Any]:
        """Return the first lines of config.yaml."""
        return {
            "kind": self.kind,
            "fps": self.fps,
            "recorded_fps": self.recorded_fps,
            "joints": list(self.representation.joints),
        }

    def motion_row(self) -> str:
        """Return the rates and joints of the motion, for the README of the model folder."""
        joints = f"{len(self.representation.joints)} of {self.skeleton.n_joints} joints modelled"
        return f"{rate_text(self.fps, self.recorded_fps)}, {joints}"

    def speech_rows(self) -> dict[str, str]:
        """Return the speech features, for the README; empty without speech input."""
        conditioner = self.conditions.conditioner
        if conditioner is None:
            return {}
        rows = {"Speech features": json.dumps(conditioner.extractor.spec)}
        if conditioner.components is not None:
            rows["Reduced features"] = reduction_text(conditioner.components.shape)
        return rows


@runtime_checkable
class Model(Protocol):
    """A trained model, as returned by `gesturekit.load`.

    Attributes:
        kind: name of its system.
        fps: frames per second of its networks.
        recorded_fps: frames per second of the training recordings, and by default of the output.
        speakers: reference skeleton of each speaker of the corpus.
        folder: folder from which it was loaded; None if it was not loaded from a folder.

    Examples:
        >>> model = gk.load("demo")
        >>> isinstance(model, gk.Model), model.kind, model.fps
        (True, 'multires', 30.0)
    """

    kind: str
    fps: float
    recorded_fps: float
    speakers: dict[str, Skeleton]
    folder: Path | None

    @property
    def skeleton(self) -> Skeleton:
        """The skeleton, with all joints of the training files."""
        ...

    @property
    def styles(self) -> tuple[str, ...]:
        """Names of its styles; empty for a model without styles."""
        ...

    @property
    def inputs(self) -> Inputs:
        """Inputs besides style and speaker."""
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
        """Generate motion as long as the speech or `seconds`; a list where `samples` > 1.

        `controls` are the fields of the system's `Controls`: see `MultiresControls` and
        `DiffusionControls`.

        Raises:
            ModelError: a control, style or speaker that this model does not have.
            AudioError, FormatError: a file cannot be read, or an array is not a sound.
        """
        ...

    def check_controls(self, *, samples: int = 1, seed: int = 0, **controls: Any) -> Controls:
        """Return the controls of `generate`, after the checks that do not depend on the speech.

        Raises:
            ModelError: a control, style or speaker that this model does not have.
        """
        ...

    def fingerprint(self) -> str:
        """Return the SHA-256 of what `save` writes, its README apart."""
        ...

    def save(self, folder: str | Path, *, notes: Mapping[str, str] | None = None) -> None:
        """Write the model folder: config.yaml, skeleton.json, model.safetensors, README.md."""
        ...

    @classmethod
    def load(
        cls,
        folder: str | Path,
        *,
        weights: WeightPlaces | None = None,
        device: str = "cpu",
        dtype: Literal["fp32"] = "fp32",
    ) -> Model:
        """Read a model folder; see `gesturekit.load`."""
        ...
