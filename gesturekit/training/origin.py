"""Origin of a model: the recordings it was trained on, and the model that the run started from.

The record of the recordings is stored with run and model. A model to start from (`start_from`) is
checked against the run.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from audio_features.atomic import write_text
from gesturekit.corpus.checks import first_difference
from gesturekit.corpus.manifest import Item, file_fingerprint
from gesturekit.errors import ConfigError
from gesturekit.motion.skeleton import Skeleton
from gesturekit.wording import counted, roughly

FILE = "trained_on.json"
"""Name of the file in a model folder."""


@dataclass(frozen=True)
class TrainedSegment:
    """Segment of a recording that a model was trained on.

    Attributes:
        id: the item's id in its manifest.
        motion: fingerprint of the motion file's content.
        audio: fingerprint of the audio file's content; None for motion alone.
        start: start of the segment in the motion file, seconds.
        duration: its length, seconds.
        fps: frame rate of the motion file.
        style, speaker: as the manifest names them; None if it does not.
    """

    id: str
    motion: str
    audio: str | None
    start: float
    duration: float
    fps: float
    style: str | None = None
    speaker: str | None = None

    @classmethod
    def of(cls, item: Item, fps: float, *, read: bool = True) -> TrainedSegment:
        """Describe an item whose motion file has `fps` frames per second.

        Without `read`, paths replace the fingerprints of its files.
        """
        content: Callable[[Path], str] = file_fingerprint if read else str
        assert item.motion is not None
        return cls(
            id=item.id,
            motion=content(item.motion),
            audio=None if item.audio is None else content(item.audio),
            start=item.motion_start,
            duration=item.duration,
            fps=fps,
            style=item.style,
            speaker=item.speaker,
        )


def describe_recordings(sources: Sequence[TrainedSegment], seconds: float, fps: float) -> str:
    """Return "2 recordings in 3 parts, 14 min at 30 fps, trained at 25 fps"."""
    files = sorted({(source.fps, source.motion) for source in sources})  # in a certain order
    rates = Counter(f"{rate:.6g} fps" for rate, _ in files)
    trained = f"{fps:.6g} fps"
    if not rates or set(rates) == {trained}:
        at = f"at {trained}"
    elif len(rates) == 1:
        at = f"at {next(iter(rates))}, trained at {trained}"
    else:
        each = ", ".join(f"{n} at {rate}" for rate, n in rates.most_common())
        at = f"({each}), trained at {trained}"
    count = len({source.motion for source in sources})  # one that is cut into parts counts once
    parts = f" in {len(sources)} parts" if len(sources) > count else ""
    return f"{counted(count, 'recording')}{parts}, {roughly(seconds)} {at}"


def unused_labels(
    sources: Iterable[TrainedSegment], styles: Sequence[str], *, state: bool = False
) -> list[str]:
    """Return a sentence for the styles, and one for the speakers, that a model does not use.

    Args:
        sources: of the model.
        styles: of the model; empty for a model without.
        state: whether it draws the movement of a chosen speaker.
    """
    unused, known = [], list(sources)
    names = {source.style for source in known} - {None}
    if len(names) > 1 and not styles:
        unused.append(f"{len(names)} styles in the corpus, none used; styles={{}} trains with them")
    names = {source.speaker for source in known} - {None}
    if len(names) > 1 and not state:
        unused.append(
            f"{len(names)} speakers in the corpus, none used: gestures are those of all of them, "
            "and --speaker only chooses a skeleton"
        )
    return unused


def is_trained_on(
    sources: Iterable[TrainedSegment],
    motion: Path | None,
    audio: Path | None = None,
    *,
    start: float = 0.0,
    duration: float = math.inf,
) -> bool:
    """Return True if a segment of a recording overlaps a model's training recordings.

    Args:
        sources: of the model.
        motion: the recording's motion file; files are compared by their content.
        audio: its audio file; an equal one counts even if motion files differ.
        start: start of the segment, seconds.
        duration: its length, seconds; of the whole recording by default.
    """
    files = {file_fingerprint(path) for path in (motion, audio) if path is not None}
    return any(
        files & {source.motion, source.audio}
        and min(start + duration, source.start + source.duration) - max(start, source.start) > 0.05
        for source in sources
    )


def from_values(values: Iterable[dict[str, Any]]) -> tuple[TrainedSegment, ...]:
    """Return sources from their fields as plain values."""
    return tuple(TrainedSegment(**value) for value in values)


def save_sources(folder: Path, sources: Iterable[TrainedSegment]) -> None:
    """Write `trained_on.json` into a model folder."""
    write_text(folder / FILE, json.dumps([*map(asdict, sources)], indent=1))


def load_sources(folder: Path) -> tuple[TrainedSegment, ...]:
    """Read `trained_on.json` of a model folder; empty if it is missing or damaged."""
    try:
        return from_values(json.loads((folder / FILE).read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return ()


_PREFIX = "start."


def model_of(folder: Path) -> Path:
    """Return a model folder, given itself or its run folder."""
    inside = folder / "model"
    return inside if (inside / "config.yaml").is_file() else folder


def widened(
    weights: Mapping[str, Tensor], network: nn.Module, has_inputs: Callable[[str], bool]
) -> dict[str, Tensor]:
    """Return the weights of a model to start from, in the shapes of a network.

    Where the network has more inputs than the model, their weights are zeros, so that training
    begins with the model's output.

    Args:
        weights: of the model, by name.
        network: to be trained.
        has_inputs: whether the weights of this name have a column for each input.
    """
    result = dict(weights)
    for name, value in network.state_dict().items():
        if has_inputs(name):
            result[name] = torch.zeros_like(value)
            if (known := weights.get(name)) is not None:
                result[name][tuple(map(slice, known.shape))] = known
    return result


def check_settings(
    setting: str, folder: Path, known: Mapping[str, Any], wanted: Mapping[str, Any]
) -> None:
    """Check that a run has the settings of a model.

    Args:
        setting: key that names the model, such as `start_from`.
        folder: of the model.
        known: settings of the model by name.
        wanted: settings of the run by name, at least those of the model.

    Raises:
        ConfigError: a setting that differs.
    """
    for name, value in known.items():
        if value != wanted[name]:
            raise ConfigError(
                f"{setting}: {folder} has {name} {value}, this run {wanted[name]}; set it to what "
                "the model has"
            )


def check_conditions(folder: Path, known: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    """Check that a model to start from has the conditions of a run.

    A corpus may lack some of the model's styles and events (lists of names).

    Args:
        folder: of the model.
        known: conditions of the model by name, at least those of the run.
        wanted: conditions of the run by name.

    Raises:
        ConfigError: a condition that differs.
    """
    for name, value in wanted.items():
        lists = isinstance(value, list) and bool(value) == bool(known[name])
        if not (set(value) <= set(known[name]) if lists else value == known[name]):
            raise ConfigError(
                f"start_from: {folder} has {name} {known[name]}, this run {value}; a model's "
                "conditions cannot change"
            )


def check_rig(
    setting: str, folder: Path, known: Skeleton, skeleton: Skeleton, corpus: Path
) -> None:
    """Check that recordings have the joints and parents of a model; bone lengths may differ.

    Args:
        setting: key that names the model, such as `start_from`.
        folder: of the model.
        known: rig of the model.
        skeleton: rig of the recordings.
        corpus: manifest of the recordings.

    Raises:
        ConfigError: another rig.
    """
    if different := first_difference(skeleton, known):
        raise ConfigError(f"{setting}: {folder} has another rig than {corpus}: {different}")


def start_tensors(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the weights to start from by their names in a run folder's data.

    There they let a run that is resumed before its first checkpoint start from the same weights.
    """
    return {f"{_PREFIX}{name}": value.contiguous() for name, value in weights.items()}


def read_start(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the inverse of `start_tensors`; empty for a run that starts from random weights."""
    started = {name: value for name, value in tensors.items() if name.startswith(_PREFIX)}
    return {name.removeprefix(_PREFIX): value for name, value in started.items()}
