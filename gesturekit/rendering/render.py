"""Many sounds through one model; a broken one never stops the others."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

import audio_features as af
from gesturekit.corpus.manifest import Item
from gesturekit.errors import ConfigError, GestureKitError, ModelError
from gesturekit.formats.conversion import writer_options
from gesturekit.formats.rig import Rig
from gesturekit.formats.sources import EXISTING, Job, refuse_existing, refuse_leaving
from gesturekit.motion.motion import Motion
from gesturekit.rendering.record import Record, described, model_fingerprint, path_digest
from gesturekit.rendering.tasks import Source, Task, find_tasks

FORMATS = ("bvh", "npz", "html", "png")
# torch says RuntimeError where memory runs out.
_FAILURES = (GestureKitError, af.AudioFeaturesError, OSError, MemoryError, RuntimeError)


@dataclass(frozen=True)
class Output:
    """Settings of the files that are written.

    Attributes:
        formats: of bvh, npz, html (a player with sound), png (a picture); `"bvh,html"` or
            `(".BVH", "html")` mean the same as `("bvh", "html")`.
        existing: what to do about files that are there and were not made with the same model,
            settings and input: refuse, skip or replace. Files that were are kept.
        rig: the body to move instead of the model's: a motion file, of any names, size and rest
            pose, or smpl, smplh or smplx; see `gesturekit.formats.rig`.
        unit: of BVH; None for cm.
        up: the axis that points up in SMPL npz, "y" or "z"; None for y.
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
        files: what was written.
        kept: what was there already and is left as it is.
        fps: frames per second of what was written.
        error: why some or all files are missing.
    """

    source: str
    files: tuple[Path, ...] = ()
    kept: tuple[Path, ...] = ()
    fps: float | None = None
    error: str | None = None


def render(
    model: Any,
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
    the id of a manifest's item. Faults of a sound (`Wave.faults`) are warned about, and it is
    rendered all the same. A hidden file beside the results records what each was made with
    (`gesturekit.rendering.record`), so that a run that was stopped goes on where it was.

    Args:
        model: as `gesturekit.load` gives it.
        sources: sound files; folders, for all sounds below them; items of a manifest, whose sound
            is cut as they say, and whose style, speaker, path and events are taken where the model
            knows them and `controls` do not say otherwise. Items without sound, or for a model
            without speech input, are as long as their duration. Without any source one motion of
            so many `seconds` is made.
        out: folder for the results.
        output: how they are written.
        seconds: without sources, how long an idle motion to make.
        channel: which channel of each file to take, counted from 1; None for the mean of all.
        progress: wraps the list of tasks while they are done, as tqdm does.
        controls: arguments of the model's `generate`: seed, samples, style, foot_lock, smooth ...

    Yields:
        an outcome for each input, as it is done.

    Raises:
        ModelError: a control that this kind of model does not have.
        ConfigError: an unknown format, a folder without audio, two sources that would write the
            same file, a result that exists and is to be refused, or a folder for the results that
            cannot be written to.
        FormatError, MotionError: a rig that cannot be read, or whose parts cannot be found.
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
    """One call of `render`: the model, what it is asked, and where the results go."""

    def __init__(
        self,
        model: Any,
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
        self.controls = _given(model, controls)
        self.samples = controls.get("samples", 1)
        rig = output.rig
        self.body = rig if rig is None or isinstance(rig, Rig) else Rig.load(rig)
        written = {"unit": output.unit, "up": output.up}
        self.options = writer_options(
            output.formats, {name: value for name, value in written.items() if value is not None}
        )
        self.record = Record(out, getattr(model, "folder", None))
        self.input_digest = cache(path_digest)
        settings = {k: v for k, v in self.controls.items() if k != "samples"}
        self.settings = {"model": model_fingerprint(model), "seed": 0} | described(settings)
        if self.body is not None:
            self.settings["rig"] = described(self.body)

    def names(self, task: Task) -> list[str]:
        """Name of each sample."""
        if self.samples == 1:
            return [task.name]
        return [f"{task.name}_s{number}" for number in range(1, self.samples + 1)]

    def targets(self, task: Task) -> tuple[Path, ...]:
        """Every file of a task."""
        if task.error is not None:
            return ()
        return tuple(
            self.out / f"{name}.{kind}" for name in self.names(task) for kind in self.output.formats
        )

    def made_with(self, task: Task) -> dict[str, Any]:
        """Everything that the motions of a task depend on, as the record holds it."""
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
        """Controls that a manifest's item gives, where the model knows them."""
        conditions = getattr(self.model, "conditions", None)
        found: dict[str, Any] = {}
        if item.style in getattr(self.model, "styles", ()):
            found["style"] = item.style
        if item.speaker in getattr(self.model, "speakers", ()):
            found["speaker"] = item.speaker
        if getattr(conditions, "path", False) and (item.motion or "path" in item.conditions):
            n_frames = max(1, int(item.duration * self.model.fps + 0.5))
            found["path"] = item.load_path(self.model.fps, n_frames) or item.load_motion()
        known = getattr(conditions, "events", ())
        if events := [event for event in item.load_events() if event.name in known]:
            found["events"] = ",".join(
                f"{event.name}@{event.time:g}" + (f":{event.duration:g}" if event.duration else "")
                for event in events
            )
        return {name: value for name, value in found.items() if name not in self.controls}

    def settle_existing(self, tasks: Sequence[Task]) -> set[Path]:
        """Find the files that are to be left as they are.

        Raises:
            ConfigError: one that is there was made with something else, and is to be refused.
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
        """Fill the files of one task, but for those that are kept."""
        left = tuple(file for file in self.targets(task) if file in kept)
        if task.error is not None or len(left) == len(self.targets(task)):
            return Outcome(task.source, kept=left, error=task.error)
        files: list[Path] = []
        fps = None
        try:
            made_with = self.made_with(task)
            wave, motions = self.generate(task)
            # Players get the file as it is, unless only a part of it was used.
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
        # torch says RuntimeError where memory runs out.
        except (
            GestureKitError,
            af.AudioFeaturesError,
            OSError,
            MemoryError,
            RuntimeError,
        ) as error:
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
        """Tell whether sound is an input of the model, or of an expert beside it."""
        models = [self.model, *(expert[0] for expert in self.controls.get("experts", ()))]
        parts = [part for model in models for part in (model, getattr(model, "conditions", None))]
        return any(getattr(part, "conditioner", None) is not None for part in parts)

    def write(
        self, motion: Motion, file: Path, sound: Path | af.Wave | None, made_with: dict[str, Any]
    ) -> None:
        """Write one file, and record what it was made with."""
        options = dict(self.options[file.suffix[1:]])
        made_with = made_with | options
        if self.body is not None:
            options |= self.body.options.get(file.suffix, {})
        if file.suffix in (".html", ".png") and sound is not None:
            options["audio"] = sound
        self.record.begin(file, made_with)
        motion.save(file, **options)
        self.record.finish(file, made_with)


def _given(model: Any, controls: Mapping[str, Any]) -> dict[str, Any]:
    """Controls that are not the model's defaults.

    Raises:
        ModelError: one that the model does not have.
    """
    parameters = inspect.signature(model.generate).parameters
    defaults = {name: parameter.default for name, parameter in parameters.items()}
    if schema := getattr(model, "controls", None):
        defaults |= {field.name: field.default for field in fields(schema)}
    for name in controls:
        if name not in defaults or name in ("speech", "seconds", "controls"):
            raise ModelError(f"{name}: a {model.kind} model knows no {name}")
    return {
        name: value
        for name, value in controls.items()
        if value is not defaults[name] and value != defaults[name]
    }


def _reason(error: Exception, source: str) -> str:
    """Return the reason of a failure, in one line that names the input."""
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
