"""The interface that models of every system have, as type checkers and editors know it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, overload, runtime_checkable

from gesturekit.motion.motion import Motion
from gesturekit.motion.skeleton import Skeleton

if TYPE_CHECKING:
    from gesturekit.corpus.speech import Speech
    from gesturekit.motion.root_path import RootPath


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
        style: str | None = None,
        path: str | Path | RootPath | Motion | None = None,
        events: str | Path | None = None,
        guidance: float | None = None,
        like: str | Path | Motion | None = None,
        speaker: str | None = None,
        foot_lock: bool = True,
        smooth: float | None = None,
        fps: float | None = None,
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
        style: str | None = None,
        path: str | Path | RootPath | Motion | None = None,
        events: str | Path | None = None,
        guidance: float | None = None,
        like: str | Path | Motion | None = None,
        speaker: str | None = None,
        foot_lock: bool = True,
        smooth: float | None = None,
        fps: float | None = None,
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
