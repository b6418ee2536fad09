"""Interface of the models of both systems, and the controls that all models take."""

# No `from __future__ import annotations` here: `control_entries` reads annotations as objects.
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from numbers import Integral, Real
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Literal,
    Protocol,
    TypedDict,
    TypeVar,
    overload,
    runtime_checkable,
)

import numpy as np

from gesturekit.errors import FormatError, ModelError
from gesturekit.field_docs import field_docs
from gesturekit.motion.motion import Motion
from gesturekit.motion.skeleton import Skeleton
from gesturekit.wording import did_you_mean

if TYPE_CHECKING:
    from audio_features.files import Files
    from gesturekit.corpus.speech import Speech
    from gesturekit.motion.root_path import RootPath


@dataclass(frozen=True)
class Control:
    """Default, type, range and command-line syntax of a control; its help stands beside it.

    Attributes:
        default: value of a control that is not given.
        kind: str, int, float or bool; Path for a file, files by key, or a motion; None for what
            only the system itself can check.
        above: exclusive lower bound of a number.
        least: inclusive lower bound of a number.
        most: inclusive upper bound of a number.
        choices: all values.
        metavar: placeholder of the value in the help of `gesturekit render`.
        note: further help on the syntax of the command line.
        option: name of the option if it is not that of the control; it may then be repeated.
        excludes: controls that cannot be combined with this one.
        convert: function of a value that returns what `generate` uses.
        raw: value under the control `raw`; None if that does not change it.
    """

    default: Any = None
    kind: type | None = str
    above: float | None = None
    least: float | None = None
    most: float | None = None
    choices: tuple[str, ...] = ()
    metavar: str | None = None
    note: str = ""
    option: str | None = None
    excludes: tuple[str, ...] = ()
    convert: Callable[[Any], Any] | None = None
    raw: Any = None

    def is_default(self, value: Any) -> bool:
        """Return True for the default; an array, which is compared by element, is none."""
        return value is self.default or (
            not isinstance(value, np.ndarray) and bool(value == self.default)
        )

    def check(self, name: str, value: Any) -> None:
        """Check a value that was given.

        Raises:
            ModelError: a value of another type, or out of range.
            FormatError: a file that does not exist.
        """
        if self.kind is Path:
            for file in value.values() if isinstance(value, Mapping) else [value]:
                if isinstance(file, str | Path) and not Path(file).exists():
                    raise FormatError(f"{name}: {file}: no such file")
        elif self.kind is not None and not self._allows(value):
            raise ModelError(f"{name}={value!r}: expected {self._allowed()}")

    def _allows(self, value: Any) -> bool:
        if self.kind in (str, bool):
            # No NumPy bool is a bool; everything else of another type is a mistake, such as "no".
            is_right = isinstance(value, (str,) if self.kind is str else (bool, np.bool_))
            return is_right and (not self.choices or value in self.choices)
        is_number = isinstance(value, Integral if self.kind is int else Real)
        if not is_number or isinstance(value, bool) or not math.isfinite(value):
            return False
        return (
            (self.above is None or value > self.above)
            and (self.least is None or value >= self.least)
            and (self.most is None or value <= self.most)
        )

    def _allowed(self) -> str:
        if self.choices:
            return f"one of {', '.join(self.choices)}"
        if self.kind in (str, bool):
            return "text" if self.kind is str else "True or False"
        bounds = {"above": self.above, "at least": self.least, "at most": self.most}
        text = " and ".join(f"{w} {value:g}" for w, value in bounds.items() if value is not None)
        return f"{'an integer' if self.kind is int else 'a number'} {text}".strip()


def split_seconds(text: str) -> tuple[str, float | None]:
    """Return a file name and its seconds from FILE@SECONDS; None without, or for an @ in a name."""
    name, _, seconds = text.rpartition("@")
    try:
        return (name, float(seconds)) if name else (text, None)
    except ValueError:
        return text, None


@dataclass(frozen=True)
class PoseSource:
    """A frame of a motion.

    Attributes:
        motion: the motion, or its file.
        seconds: time of the frame; None for the first or the last one.
    """

    motion: Path | Motion
    seconds: float | None = None

    @classmethod
    def of(cls, value: Any) -> "PoseSource":
        """Return the source of a motion, a file, or FILE@SECONDS.

        Raises:
            ModelError: it is none of these.
            FormatError: there is no such file.
        """
        if isinstance(value, PoseSource):
            return value
        if isinstance(value, Motion):
            return cls(value)
        if not isinstance(value, str | Path):
            raise ModelError(f"{type(value).__name__}: expected a motion or its file, FILE@SECONDS")
        name, seconds = (str(value), None) if Path(value).exists() else split_seconds(str(value))
        if not Path(name).exists():
            raise FormatError(f"{name}: no such file")
        return cls(Path(name), seconds)

    def read(self, default: int) -> tuple[Motion, int]:
        """Return the motion and the index of the frame; `default` is that without seconds.

        Raises:
            ModelError: the motion does not have the frame.
            FormatError: a file that cannot be read.
        """
        motion = self.motion if isinstance(self.motion, Motion) else Motion.load(self.motion)
        if self.seconds is None:
            return motion, default % motion.n_frames
        if not 0 <= self.seconds < motion.duration:
            raise ModelError(
                f"{self.motion}@{self.seconds:g}: the motion has {motion.duration:g} s; give "
                "seconds within it"
            )
        return motion, min(int(self.seconds * motion.fps + 0.5), motion.n_frames - 1)


PLACING = ("start_pose", "end_pose", "facing", "in_place")
"""Controls that place the body."""


class UnknownControlError(ModelError, TypeError):
    """A control of `generate` that a system does not have."""


class Controls(TypedDict, total=False):
    """Controls of `generate` that models of every system take; each system adds its own.

    A key is the one entry of its control: from it follow the typed keyword of `generate`, the
    checks, the option and the help of `gesturekit render` (its docstring), and the field of the
    HTTP service.
    """

    speaker: Annotated[str | None, Control(metavar="NAME")]
    """One of the model's `speakers`: their skeleton is used, and a model with a state of movement
    moves as they do. Without it, gestures are those of all speakers, on a skeleton of median
    size."""
    style: Annotated[
        str | None,
        Control(
            metavar="NAME",
            note="Diffusion models also take mixtures by weights that add up to 1: "
            "old:0.25,angry:0.75.",
        ),
    ]
    """A style of the model, or several over time: old@0-10,angry@10-20 (seconds)."""
    path: Annotated[
        "str | Path | RootPath | Motion | None",
        Control(kind=Path, metavar="PATH.csv", excludes=("facing", "in_place")),
    ]
    """The path of the root: a table time,x,z[,heading] (s, m, degrees), or a motion whose path is
    followed."""
    like: Annotated[str | Path | Motion | None, Control(kind=Path, metavar="OTHER.bvh")]
    """A motion on any human rig, to be regenerated in the manner of the model's recordings."""
    keep: Annotated[
        "Mapping[float, str | Path | Motion] | None",
        Control(
            kind=Path,
            metavar="FILE[@SECONDS],...",
            excludes=(*PLACING, "path", "like", "speaker"),
            note="clip.bvh is continued up to --seconds; a.bvh@0,b.bvh@6 is filled in between.",
        ),
    ]
    """Motions to keep, each with its start time in seconds. They appear unchanged and at their own
    position; the model generates the motion before, between and after them (in-betweening)."""
    state: Annotated["str | Path | np.ndarray | None", Control(kind=Path, metavar="FILE.npy")]
    """State of movement in place of a drawn one, as the model's `state` returns it; cut to the
    motion, or held to its end."""
    liveliness: Annotated[float, Control(1.0, kind=float, above=0, metavar="AMOUNT")]
    """Factor on the hand speed that is drawn for the speech, about 0.5 (calmer) to 1.5 (livelier).
    For models with a state of movement."""
    mood_seed: Annotated[int | None, Control(kind=int, least=0, metavar="N")]
    """Seed of the drawn state of movement: calm or lively, and where the hands are held; by default
    that of everything else. With a fixed mood_seed, seed changes the details and keeps the state.
    For models with a state of movement."""
    start_pose: Annotated[
        str | Path | Motion | PoseSource | None,
        Control(kind=None, convert=PoseSource.of, metavar="FILE[@SECONDS]"),
    ]
    """A frame of a motion on any human rig, by default its first: the motion begins in this pose,
    at its place and heading (with a path, at that of the path), and its own movement takes over
    within half a second. Feet stay, or step."""
    end_pose: Annotated[
        str | Path | Motion | PoseSource | None,
        Control(kind=None, convert=PoseSource.of, metavar="FILE[@SECONDS]"),
    ]
    """A frame of a motion on any human rig, by default its last: the motion comes to rest in this
    pose in its last half second, where the body then stands and faces."""
    facing: Annotated[float | None, Control(kind=float, least=-360, most=360, metavar="DEGREES")]
    """Heading of the body in the first frame: 0 faces +Z, 90 faces +X. It replaces that of
    `start_pose`."""
    in_place: Annotated[bool, Control(False, kind=bool)]
    """Keep the feet about where they begin: the body neither wanders nor turns away, but shifts its
    weight and steps. A walk becomes a walk on the spot."""
    raw: Annotated[bool, Control(False, kind=bool)]
    """Sample as the papers do: without `foot_lock`, `smooth`, `vad` and, in diffusion models,
    `clip_denoised`; one of these that is given still counts. The frame rate is still `fps`."""
    foot_lock: Annotated[bool, Control(True, kind=bool, raw=False)]
    """Lock planted feet in place; without it, feet stay as the model generated them."""
    smooth: Annotated[
        float | None, Control(kind=float, least=0, most=2, metavar="SECONDS", raw=0.0)
    ]
    """Smooth upper-body movements shorter than this many seconds, but keep the time and size of
    beat gestures. 0 turns smoothing off; the default is stored with the model."""
    vad: Annotated[bool | None, Control(kind=bool, raw=False)]
    """Voice activity detection: stretches of at least 3 s of the sound without voice, such as a
    noise floor, hum or typing, give idle motion. By default as in training; off, everything in the
    sound moves the body, for example a whisper."""
    fps: Annotated[float | None, Control(kind=float, above=0, most=1000, metavar="RATE")]
    """Frames per second of the result; by default those of the training recordings."""
    face: Annotated[str, Control("off", choices=("energy", "phones", "off"))]
    """Make mouth, blinks and small eye movements by rules: from the energy and voicing of the
    speech (energy, for any language) or from its phones (phones, for English, with
    gesturekit[face]). They replace a face that the model plays from recordings; off keeps that."""
    transcript: Annotated[
        str | None,
        Control(metavar="TEXT", note="By default that of a word list or NAME.txt beside NAME.wav."),
    ]
    """English text of the speech, for `face` from phones; without it, phones are recognised."""


AnyControls = TypeVar("AnyControls", bound=Controls)
Generate = TypeVar("Generate", bound=Callable[..., Any])


def control_entries(schema: type[Controls]) -> dict[str, Control]:
    """Return the entry of each control of a system, by name."""
    return {name: hint.__metadata__[0] for name, hint in schema.__annotations__.items()}


def document_controls(schema: type[Controls]) -> Callable[[Generate], Generate]:
    """Return a decorator that adds the controls of a system to the docstring of a function."""
    docs = field_docs(Controls) | field_docs(schema)
    lines = "".join(f"            {name}: {text}\n" for name, text in docs.items())

    def documented(generate: Generate) -> Generate:
        generate.__doc__ = f"{generate.__doc__}\n        Controls:\n{lines}"
        return generate

    return documented


def build_controls(
    schema: type[AnyControls], keywords: Mapping[str, Any], kind: str
) -> AnyControls:
    """Check the controls of one call, and return them all, with the defaults of those not given.

    Args:
        schema: the controls of the system.
        keywords: controls by name. None means that a control is not given.
        kind: name of the system, for errors.

    Raises:
        UnknownControlError: a control that this system does not have.
        ModelError: a value of another type, or out of range.
        FormatError: a file that does not exist.
    """
    entries = control_entries(schema)
    given = {name: value for name, value in keywords.items() if value is not None}
    for name, value in given.items():
        if name not in entries:
            hint = did_you_mean(name, entries, "; did you mean {}?", cutoff=0.75)
            shown = f"{name}={value!r}" if isinstance(value, str | int | float) else name
            raise UnknownControlError(f"{shown}: {kind} models have no control {name}{hint}")
        entries[name].check(name, value)
        if (convert := entries[name].convert) is not None:
            try:
                given[name] = convert(value)
            except (FormatError, ModelError) as error:
                raise type(error)(f"{name}: {error}") from None
    if given.get("raw"):
        given = {n: e.raw for n, e in entries.items() if e.raw is not None} | given
    for name in given:
        for other in entries[name].excludes:
            if other in given and given[other] != entries[other].default:
                raise ModelError(f"{other} cannot be combined with {name}: give one of them")
    return schema(**{name: entry.default for name, entry in entries.items()} | given)


@dataclass(frozen=True)
class Inputs:
    """Inputs of a model besides style and speaker.

    Attributes:
        speech: whether it was trained with speech (or music) features.
        words: whether these features include the words beside a recording.
        files: extractors among them that read files of own features.
        path: whether it was trained with the path of the root.
        events: names of the events with which it was trained.
    """

    speech: bool = False
    words: bool = False
    files: tuple["Files", ...] = ()
    path: bool = False
    events: tuple[str, ...] = ()


class MotionStream(Protocol):
    """Motion that is generated while sound comes in, as `Model.stream` returns it.

    Attributes:
        sample_rate: of the sound, Hz.
        fps: frames per second.
        skeleton: rig of the motion.
        n_frames: number of frames returned so far; frame k belongs to k / fps s of the sound.
        latency: seconds from a sound to the return of the frame that belongs to it, without the
            length of a block and the time of computing.
    """

    sample_rate: int
    fps: float
    skeleton: Skeleton
    n_frames: int
    latency: float

    def step(self, samples: np.ndarray) -> Motion | None:
        """Take samples (N,) float32 and return the frames that became final, if any did."""

    def finish(self) -> Motion | None:
        """Return the remaining frames: floor(duration fps + 1/2) in all."""

    def state(self) -> dict[str, Any]:
        """Return everything that `restore` needs, as numbers and arrays."""

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from the `state` of a stream with the same arguments."""


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
        speech: "Speech | None" = None,
        sample_rate: int | None = None,
        *,
        seconds: float | None = None,
        samples: Literal[1] = 1,
        seed: int = 0,
        item: str = "",
        **controls: Any,
    ) -> Motion: ...

    @overload
    def generate(
        self,
        speech: "Speech | None" = None,
        sample_rate: int | None = None,
        *,
        seconds: float | None = None,
        samples: int,
        seed: int = 0,
        item: str = "",
        **controls: Any,
    ) -> list[Motion]: ...

    def generate(self, *args: Any, **controls: Any) -> Motion | list[Motion]:
        """Generate motion as long as the speech or `seconds`; a list where `samples` > 1.

        `item` is the name of the utterance. Motions of different items are different draws; the
        same seed, item, request and sample number give the same motion. `controls` are the fields
        of the system's `Controls`: see `MultiresControls` and `DiffusionControls`.

        Raises:
            ModelError: a control, style or speaker that this model does not have, a seed below 0,
                or an item that is not text.
            AudioError, FormatError: a file cannot be read, or an array is not a sound.
        """
        ...

    def stream(
        self,
        sample_rate: int,
        look_ahead: float = 0.2,
        seed: int = 0,
        item: str = "",
        **controls: Any,
    ) -> MotionStream:
        """Return a stream that generates motion while sound comes in; see `MultiresModel.stream`.

        Raises:
            ModelError: the model cannot stream.
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
