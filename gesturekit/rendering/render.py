"""Batch rendering: many sounds with one model; a broken file never stops the others."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import audio_features as af
from gesturekit.corpus.item import Item
from gesturekit.errors import ConfigError, GestureKitError
from gesturekit.formats.conversion import writer_options
from gesturekit.formats.rig import Rig
from gesturekit.formats.sources import EXISTING, Job, refuse_existing, refuse_leaving
from gesturekit.model import Model
from gesturekit.motion.motion import Motion
from gesturekit.rendering.record import Record, described, model_fingerprint, path_digest
from gesturekit.rendering.tasks import Source, Task, find_tasks
from gesturekit.systems import controls_type

FORMATS = ("bvh", "npz", "html", "png")
# torch raises RuntimeError when memory runs out.
_FAILURES = (GestureKitError, af.AudioFeaturesError, OSError, MemoryError, RuntimeError)


@dataclass(frozen=True)
class Output:
    """Settings of the files that are written.

    Attributes:
        formats: of bvh, npz, html (a player with sound), png (a picture); `"bvh,html"` or
            `(".BVH", "html")` mean the same as `("bvh", "html")`.
        existing: treatment of existing files that were made with another model, settings or
            input: refuse, skip or replace. Files made with the same ones are kept.
        rig: skeleton to retarget to: a motion file with any joint names, size and rest pose, or
            smpl, smplh or smplx; see `gesturekit.formats.rig`. None for the model's own.
        unit: unit of BVH files; None for cm.
        up: up axis of SMPL npz files, "y" or "z"; None for y.
    """

    formats: str | Sequence[str] = ("bvh",)
    existing: str = "refuse"
    rig: str | os.PathLike[str] | Rig | None = None
    unit: str | None = None
    up: str | None = None

    def __post_init__(self) -> None:
        formats = self.formats.split(",") if isinstance(self.formats, str) else self.formats
        plain = (name.strip().lower().removeprefix(".") for name in formats)
        object.__setattr__(self, "formats", tuple(dict.fromkeys(filter(None, plain))))


@dataclass(frozen=True)
class Outcome:
    """The result of one input.

    Attributes:
        source: the input.
        files: files that were written.
        kept: existing files that were left unchanged.
        fps: frames per second of the written motion.
        error: reason why some or all files are missing.
    """

    source: str
    files: tuple[Path, ...] = ()
    kept: tuple[Path, ...] = ()
    fps: float | None = None
    error: str | None = None


def render(
    model: Model,
    sources: Source | Sequence[Source],
    out: str | Path,
    *,
    output: Output | None = None,
    seconds: float | None = None,
    channel: int | None = None,
    progress: Callable[[list[Task]], Iterable[Task]] = iter,
    **controls: Any,
) -> Iterator[Outcome]:
    """Generate motion for each input and write it as NAME.bvh (NAME_s1.bvh ... for samples).

    NAME is the stem of a sound file, the path within its folder for one found in a folder, and
    the id of a manifest's item. Faults of a sound (`Wave.faults`) are logged as warnings, and it
    is rendered all the same. A hidden file beside the results records the model, settings and
    input of each (`gesturekit.rendering.record`), so that an interrupted run can be continued.

    Args:
        model: model from `gesturekit.load`.
        sources: sound files; folders, for all sounds below them; items of a manifest. An item's
            sound is cut to its interval, and its style, speaker, path and events are used where
            the model has them as inputs and `controls` does not set them. Items without sound, or
            for a model without speech input, are as long as their duration. Without any source,
            one motion of length `seconds` is generated.
        out: folder for the results.
        output: settings of the written files.
        seconds: length of the motion without sources.
        channel: channel of each file to use, counted from 1; None for the mean of all.
        progress: wraps the list of tasks, as tqdm does.
        controls: arguments of the model's `generate`: seed, samples, style, foot_lock, smooth ...

    Yields:
        an outcome for each input as soon as it is done.

    Raises:
        ModelError: a control that this kind of model does not have.
        ConfigError: an unknown format, a folder without audio, two sources that would write the
            same file, an existing result with `existing="refuse"`, or an output folder that
            cannot be written to.
        FormatError, MotionError: a rig cannot be read, or its body parts cannot be found.
    """
    run = _Run(model, Path(out), output or Output(), seconds, channel, controls)
    model.check_controls(**run.controls)
    tasks = find_tasks(sources, run.out) if sources else [Task("motion", "motion")]
    refuse_leaving([Job(Path(task.source), run.targets(task)) for task in tasks], run.out)
    kept = run.settle_existing(tasks)
    _make_folder(run.out)
    for task in progress(tasks):
        yield run.outcome(task, kept)


class _Run:
    """One call of `render`: the model, its controls, and the output folder."""

    def __init__(
        self,
        model: Model,
        out: Path,
        output: Output,
        seconds: float | None,
        channel: int | None,
        controls: Mapping[str, Any],
    ) -> None:
        unknown = [name for name in output.formats if name not in FORMATS]
        if unknown or not output.formats:
            raise ConfigError(
                f"format {', '.join(unknown) or '(none)'}: known: {', '.join(FORMATS)}"
            )
        if output.existing not in EXISTING:
            raise ConfigError(f"existing is {output.existing!r}; expected {', '.join(EXISTING)}")
        self.model, self.out, self.output = model, out, output
        self.seconds, self.channel = seconds, channel
        self.controls = _without_defaults(controls, model.kind)
        self.samples = controls.get("samples", 1)
        rig = output.rig
        self.body = rig if rig is None or isinstance(rig, Rig) else Rig.load(rig)
        written = {"unit": output.unit, "up": output.up}
        self.options = writer_options(
            output.formats, {name: value for name, value in written.items() if value is not None}
        )
        self.record = Record(out, model.folder)
        self.input_digest = cache(path_digest)
        settings = {k: v for k, v in self.controls.items() if k != "samples"}
        self.settings = {"model": model_fingerprint(model), "seed": 0} | described(settings)
        if self.body is not None:
            self.settings["rig"] = described(self.body)

    def names(self, task: Task) -> list[str]:
        """Return the name of each sample."""
        if self.samples == 1:
            return [task.name]
        return [f"{task.name}_s{number}" for number in range(1, self.samples + 1)]

    def targets(self, task: Task) -> tuple[Path, ...]:
        """Return all output files of a task."""
        if task.error is not None:
            return ()
        return tuple(
            self.out / f"{name}.{kind}" for name in self.names(task) for kind in self.output.formats
        )

    def made_with(self, task: Task) -> dict[str, Any]:
        """Return everything that the motions of a task depend on, as in the record."""
        made_with = dict(self.settings)
        if task.audio is not None:
            made_with["input"] = self.input_digest(task.audio)
        for name, value in {"seconds": self.seconds, "channel": self.channel}.items():
            if value is not None:
                made_with[name] = value
        if task.item is not None:
            item = task.item
            made_with |= {"start": item.audio_start, "duration": item.duration}
            made_with |= {"channel": item.channel} if item.channel is not None else {}
            made_with |= described(self.item_controls(item))
        return made_with

    def item_controls(self, item: Item) -> dict[str, Any]:
        """Return the controls of a manifest's item that the model has as inputs."""
        inputs = self.model.inputs
        found: dict[str, Any] = {}
        if item.style in self.model.styles:
            found["style"] = item.style
        if item.speaker in self.model.speakers:
            found["speaker"] = item.speaker
        if inputs.path and (item.motion or "path" in item.conditions):
            n_frames = max(1, int(item.duration * self.model.fps + 0.5))
            found["path"] = item.load_path(self.model.fps, n_frames) or item.load_motion()
        if events := [event for event in item.load_events() if event.name in inputs.events]:
            found["events"] = ",".join(
                f"{event.name}@{event.time:g}" + (f":{event.duration:g}" if event.duration else "")
                for event in events
            )
        return {name: value for name, value in found.items() if name not in self.controls}

    def settle_existing(self, tasks: Sequence[Task]) -> set[Path]:
        """Return the existing files that are kept.

        Raises:
            ConfigError: `existing` is "refuse", and a file was made with other settings.
        """
        kept: set[Path] = set()
        refused: list[Path] = []
        another: set[str] = set()
        count = 0
        for task in tasks:
            targets = self.targets(task)
            count += len(targets)
            there = [file for file in targets if os.path.lexists(file) and not file.is_dir()]
            if self.output.existing == "skip":
                kept.update(there)
                continue
            try:
                base = self.made_with(task) if there else {}
            except (GestureKitError, OSError):
                continue  # the item fails when its turn comes, and nothing is written
            for file in there:
                made_with = base | self.options[file.suffix[1:]]
                state = self.record.state(file, made_with)
                if state == "same":
                    kept.add(file)
                elif state == "other" and self.output.existing == "refuse":
                    refused.append(file)
                    another.update(self.record.differences(file, made_with))
        if refused:
            named = (
                f"{'other' if name.endswith('s') else 'another'} {name}" for name in sorted(another)
            )
            reason = f", made with {', '.join(named)}" if another else ""
            reason += (
                f" ({len(refused)} refused, {len(kept)} kept, "
                f"{count - len(refused) - len(kept)} to make: nothing was done)"
            )
            refuse_existing(refused, reason)
        return kept

    def outcome(self, task: Task, kept: set[Path]) -> Outcome:
        """Write the files of one task, except those in `kept`."""
        left = tuple(file for file in self.targets(task) if file in kept)
        if task.error is not None or len(left) == len(self.targets(task)):
            return Outcome(task.source, kept=left, error=task.error)
        files: list[Path] = []
        fps = None
        try:
            made_with = self.made_with(task)
            wave, motions = self.generate(task)
            # The player embeds the original file, unless only a part of it was used.
            whole = task.item is None and self.channel is None
            sound = task.audio if whole else wave
            for motion, name in zip(motions, self.names(task), strict=True):
                motion = motion if self.body is None else self.body.put(motion)
                fps = motion.fps
                for kind in self.output.formats:
                    file = self.out / f"{name}.{kind}"
                    if file not in kept:
                        self.write(motion, file, sound, made_with)
                        files.append(file)
        except _FAILURES as error:
            return Outcome(task.source, tuple(files), left, fps, _reason(error, task.source))
        return Outcome(task.source, tuple(files), left, fps)

    def generate(self, task: Task) -> tuple[af.Wave | None, list[Motion]]:
        """Return the sound of a task, and its motions."""
        wave, item = task.load_wave(self.channel), task.item
        controls, seconds = self.controls, self.seconds
        if item is not None:
            controls = self.item_controls(item) | controls
            seconds = item.duration if wave is None or not self.takes_speech() else None
        speech = wave if seconds is None else None
        made = self.model.generate(speech, seconds=seconds, **controls)
        return wave, made if isinstance(made, list) else [made]

    def takes_speech(self) -> bool:
        """Return whether the model or one of its experts has speech input."""
        models = [self.model, *(expert[0] for expert in self.controls.get("experts", ()))]
        return any(model.inputs.speech for model in models)

    def write(
        self, motion: Motion, file: Path, sound: Path | af.Wave | None, made_with: dict[str, Any]
    ) -> None:
        """Write one file, and record its model, settings and input."""
        options = dict(self.options[file.suffix[1:]])
        made_with = made_with | options
        if self.body is not None:
            options |= self.body.options.get(file.suffix, {})
        if file.suffix in (".html", ".png") and sound is not None:
            options["audio"] = sound
        self.record.begin(file, made_with)
        motion.save(file, **options)
        self.record.finish(file, made_with)


def _without_defaults(arguments: Mapping[str, Any], kind: str) -> dict[str, Any]:
    """Return the arguments of `generate` that differ from their defaults.

    Raises:
        UnknownControlError: a control that models of this kind do not have.
    """
    defaults: dict[str, Any] = {"samples": 1, "seed": 0}
    names = defaults.keys() & arguments.keys()
    values = {name: arguments[name] for name in names}
    schema = controls_type(kind)
    controls = schema.build({k: v for k, v in arguments.items() if k not in defaults}, kind)
    for field in dataclasses.fields(schema):
        defaults[field.name], values[field.name] = field.default, getattr(controls, field.name)
    return {
        name: value
        for name, value in values.items()
        if value is not defaults[name] and value != defaults[name]
    }


def _reason(error: Exception, source: str) -> str:
    """Return the reason of a failure on one line that names the input."""
    reason = str(error) or "not enough memory"
    # Not every reason names the input: a model that gives NaN, a disk that is full.
    reason = reason if source in reason else f"{source}: {reason}"
    # One line, and printable: a file name need not be text.
    return " ".join(reason.encode("utf-8", "replace").decode().splitlines())


def _make_folder(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        writable = os.access(out, os.W_OK | os.X_OK)
    except OSError as error:
        raise ConfigError(f"{out}: cannot be made ({error.strerror})") from None
    if not writable:
        raise ConfigError(f"{out}: cannot be written to; give another folder")
