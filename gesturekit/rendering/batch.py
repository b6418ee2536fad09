"""Render many sounds in one call, for the API and the command line; preview what would be done."""

from __future__ import annotations

import dataclasses
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import soundfile

import audio_features as af
from gesturekit.errors import gesturekit_errors
from gesturekit.jobs.journal import last_run
from gesturekit.jobs.result import Result
from gesturekit.jobs.run import Batch, Execution
from gesturekit.jobs.state import STATE
from gesturekit.jobs.task import Task
from gesturekit.rendering.inputs import SoundSource, sound_batch
from gesturekit.rendering.renderer import Output, Renderer

if TYPE_CHECKING:
    from gesturekit.model import Model


_SHORT, _LONG = 0.5, 5.0  # seconds of sound whose cost is measured


@gesturekit_errors()
def render(
    model: Model | str | Path,
    sources: SoundSource | Sequence[SoundSource] = (),
    out: str | Path = "rendered",
    *,
    seconds: float | None = None,
    channel: int | None = None,
    progress: Callable[[list[Task]], Iterable[Task]] = iter,
    **options: Any,
) -> list[Result]:
    """Render sounds to motion files, and return one result for each input.

    A broken sound never stops the others: its result has an `error`. Files that an earlier call
    made with the same model, settings and input are kept. `iter_render` does the same as an
    iterator.

    Args:
        model: a loaded model, the name of a bundled one, or a model folder.
        sources: a sound file, a folder of them, a glob, a list (`gesturekit.rendering.inputs`), an
            item of a manifest, or a sequence of these; without any, one motion of length `seconds`
            is generated.
        out: folder for the results.
        seconds: length of the motion without sources.
        channel: channel of each file to use, counted from 1; None for the mean of all.
        progress: wraps the list of tasks, as tqdm does.
        options: fields of `gesturekit.rendering.renderer.Output` (formats, existing, rig, unit, up)
            and of `gesturekit.jobs.run.Execution` (workers, shard, deadline ...), and
            arguments of the model's `generate` (seed, samples, style, foot_lock, smooth ...).
            `formats` are of bvh, npz, glb, html, mp4 and png: `("bvh", "html")` or `"bvh,html"`.

    Raises:
        ModelError: no such model, or a control, style or level that it does not have.
        ConfigError: an unknown format, a folder without audio, two sources that would write the
            same file, an existing result with `existing="refuse"`, an output folder that cannot
            be written to, or in which another run works.
        OutputError: the disk became full; what is done is kept.
        FormatError, MotionError: a rig cannot be read, or its body parts cannot be found.

    Examples:
        Without sounds, one motion of a given length is made:

        >>> results = gk.render("demo", [], folder / "out", seconds=2, formats="npz")
        >>> [file.name for result in results for file in result.files]
        ['motion.npz']
    """
    if isinstance(model, str | os.PathLike):
        from gesturekit.systems import load

        model = load(model)
    output = Output(**_fields(Output, options))
    execution = Execution(**_fields(Execution, options))
    options |= {"seconds": seconds, "channel": channel, "progress": progress}
    return list(iter_render(model, sources, out, output=output, execution=execution, **options))


def iter_render(
    model: Model,
    sources: SoundSource | Sequence[SoundSource],
    out: str | Path,
    *,
    progress: Callable[[list[Task]], Iterable[Task]] = iter,
    **settings: Any,
) -> Iterator[Result]:
    """Render sounds as `render` does, and yield the result of each input as soon as it is done.

    Args:
        model, sources, out: see `render_batch`.
        progress: wraps the list of tasks, as tqdm does.
        settings: the other arguments of `render_batch`.

    Raises the errors of `render`.
    """
    batch = render_batch(model, sources, out, **settings)
    steps = iter(progress(batch.tasks))
    next(steps, None)
    for result in batch.run():
        yield result
        next(steps, None)


def render_batch(
    model: Model,
    sources: SoundSource | Sequence[SoundSource],
    out: str | Path,
    *,
    output: Output | None = None,
    execution: Execution | None = None,
    seconds: float | None = None,
    channel: int | None = None,
    **controls: Any,
) -> Batch:
    """Return the work of rendering: a motion for each input, as NAME.bvh (NAME_s1.bvh ... if many).

    NAME is the stem of a sound file, the path within its folder for one found in a folder, and
    the id of a manifest's item. Faults of a sound (`Wave.faults`) are logged as warnings, and it is
    rendered nevertheless. A hidden folder beside the results has the plan of the work and a journal
    of what was done with which model, settings and input, so that an interrupted run can be
    continued.

    Args:
        model: model from `gesturekit.load`.
        sources: sound files; folders, for all sounds below them; globs; lists; items of a
            manifest. An item's sound is cut to its interval, and its style, speaker, path and
            events are used where the model has them as inputs and `controls` does not set them.
            Items without sound, or for a model without speech input, are as long as their
            duration. Without any source, one motion of length `seconds` is generated.
        out: folder for the results.
        output: settings of the written files.
        execution: how the work is done.
        seconds: length of the motion without sources.
        channel: channel of each file to use, counted from 1; None for the mean of all.
        controls: arguments of the model's `generate`: seed, samples, style, foot_lock, smooth ...

    Raises the errors of `render`.
    """
    renderer = Renderer(model, Path(out), output or Output(), seconds, channel, controls)
    return sound_batch("render", renderer, sources, execution or Execution(), seconds, channel)


def model_of_results(out: Path) -> Path | None:
    """Return the folder of the model that made the latest results in a folder, if it is known.

    Raises:
        FormatError: a journal cannot be opened, or was written by a newer version.
    """
    folder = (last_run(out / STATE, "model_folder") or {}).get("model_folder")
    return Path(folder) if isinstance(folder, str) else None


@dataclass(frozen=True)
class Cost:
    """Cost of the work in one process, measured on this machine.

    Attributes:
        item: (seconds, bytes) of each item, however short.
        sound: (seconds, bytes) of each second of sound.
    """

    item: tuple[float, float]
    sound: tuple[float, float]

    def of(self, items: int, sound: float) -> tuple[float, float]:
        """Return the (seconds, bytes) of a number of items with so many seconds of sound."""
        seconds, size = (items * a + sound * b for a, b in zip(self.item, self.sound, strict=True))
        return seconds, size


def preview(batch: Batch) -> Iterator[Result]:
    """Yield what would come of each task; nothing is written.

    The status is "left" for a task to be done, "kept" if its files are up to date, and "failed" if
    it cannot be done, or was put aside. Only the first half second of a sound is read, so that
    damage further on is not found.
    """
    for task in batch.tasks:
        result = batch.known(task)
        if result.status == "left" and (reason := _unreadable(task)):
            result = Result(task, "failed", error=reason)
        yield result


def _unreadable(task: Task) -> str | None:
    """Return why the beginning of a task's sound cannot be read; None if it can, or has none."""
    if task.path is None or task.duration is not None:
        return None
    try:
        af.Wave.load(task.path, duration=_SHORT)
    except (af.AudioError, OSError) as error:
        return str(error)
    return None


def measured_cost(batch: Batch) -> Cost:
    """Measure the cost of a short and a longer piece of speech, written to a temporary folder.

    All costs are 0 if nothing can be made of speech with these settings.
    """
    from gesturekit.systems import bundled_speech

    found, speech = [], af.Wave.load(bundled_speech())
    with tempfile.TemporaryDirectory(prefix="gesturekit-") as folder:
        # Samples cost the same each: one is measured.
        n_samples = batch.processor.samples
        one = batch.processor
        one = one.single() if n_samples > 1 and isinstance(one, Renderer) else one
        processor = one.into(Path(folder))
        for seconds in (_LONG, _SHORT, _LONG):  # the first includes compilation
            wav = Path(folder) / f"{seconds:g}.wav"
            part = speech.slice(1.0, seconds)  # it begins with silence
            soundfile.write(wav, part.samples, part.sample_rate)
            result = processor(Result(Task(wav.stem, wav)))
            size = sum(about["size"] for about in result.digests.values())
            found.append((n_samples * result.seconds, n_samples * size))
    if result.status != "done":
        return Cost((0.0, 0.0), (0.0, 0.0))
    _, short, long = found
    sound = tuple(max(0.0, (b - a) / (_LONG - _SHORT)) for a, b in zip(short, long, strict=True))
    item = tuple(max(0.0, a - _SHORT * b) for a, b in zip(short, sound, strict=True))
    return Cost(item, sound)


def _fields(kind: type, options: dict[str, Any]) -> dict[str, Any]:
    """Take the fields of a dataclass out of `options`."""
    names = {field.name for field in dataclasses.fields(kind)} & options.keys()
    return {name: options.pop(name) for name in names}
