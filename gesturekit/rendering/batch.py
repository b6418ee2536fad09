"""Render many sounds in one call, for the API and the command line; preview what would be done."""

from __future__ import annotations

import dataclasses
import os
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import soundfile

import audio_features as af
from gesturekit.errors import gesturekit_errors
from gesturekit.jobs.batch import Batch, Execution
from gesturekit.jobs.records import STATE, read_items
from gesturekit.jobs.result import Result, Task
from gesturekit.rendering.inputs import SoundSource, find_tasks, length_of
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
    **options: Any,
) -> list[Result]:
    """Render sounds to motion files, and return one result for each input.

    A broken sound never stops the others: its result has an `error`. Files that an earlier call
    made with the same model, settings and input are kept.

    Args:
        model: a loaded model, the name of a bundled one, or a model folder.
        sources: a sound file, a folder of them, a glob, a list (`gesturekit.rendering.inputs`), an
            item of a manifest, or a sequence of these; without any, one motion of length `seconds`
            is generated.
        out: folder for the results.
        seconds: length of the motion without sources.
        channel: channel of each file to use, counted from 1; None for the mean of all.
        options: fields of `gesturekit.rendering.renderer.Output` (formats, existing, rig, unit, up)
            and of `gesturekit.jobs.batch.Execution` (workers, shard, deadline ...), and
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
    options |= {"seconds": seconds, "channel": channel}
    return list(render_batch(model, sources, out, output, execution, **options).run())


def render_batch(
    model: Model,
    sources: SoundSource | Sequence[SoundSource],
    out: str | Path,
    output: Output | None = None,
    execution: Execution | None = None,
    *,
    seconds: float | None = None,
    channel: int | None = None,
    **controls: Any,
) -> Batch:
    """Return the work of rendering: a motion for each input, as NAME.bvh (NAME_s1.bvh ... if many).

    NAME is the stem of a sound file, the path within its folder for one found in a folder, and
    the id of a manifest's item. Faults of a sound (`Wave.faults`) are logged as warnings, and it is
    rendered nevertheless. A hidden folder beside the results records what was done with which
    model, settings and input, so that an interrupted run can be continued.

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
    renderer = Renderer(model, Path(out), output or Output(), channel, controls)
    if sources:
        tasks = find_tasks(sources, renderer.out)
    else:
        tasks = [Task("motion", more={} if seconds is None else {"seconds": seconds})]
    return Batch(renderer, tasks, execution or Execution())


def model_of_results(out: Path) -> Path | None:
    """Return the folder of the model that made the latest results in a folder, if it is known.

    Raises:
        FormatError: what is known of the run is damaged, or was written by a newer version.
    """
    folder = (read_items(out / STATE) or {}).get("model_folder")
    return Path(folder) if isinstance(folder, str) else None


def preview(batch: Batch) -> Iterator[tuple[Result, float | None]]:
    """Yield what would come of each task, and its seconds of sound; nothing is written.

    The status is "left" for a task to be done, "kept" if its files are up to date, and "failed" if
    it cannot be done, or was put aside. Only the first half second of a sound is read, so that
    damage further on is not found.
    """
    for task in batch.tasks:
        result, seconds = batch.known(task), length_of(task)
        if result.status == "left" and task.path is not None and seconds is None:
            try:
                af.Wave.load(task.path, duration=_SHORT)
            except (af.AudioError, OSError) as error:
                result = Result(task, "failed", error=str(error))
        yield result, seconds


def estimated_cost(batch: Batch, items: int, sound: float) -> tuple[float, float]:
    """Return seconds and bytes of items with so many seconds of sound, for one process.

    The cost of a short and a longer piece of speech is measured in a temporary folder; it is 0 if
    nothing can be made of speech with these settings.
    """
    from gesturekit.systems import bundled_speech

    costs, speech = [], af.Wave.load(bundled_speech())
    with tempfile.TemporaryDirectory(prefix="gesturekit-") as folder:
        processor = batch.processor.trial(Path(folder))
        for seconds in (_LONG, _SHORT, _LONG):  # the first includes compilation
            wav = Path(folder) / f"{seconds:g}.wav"
            piece = speech.slice(1.0, seconds)  # it begins with silence
            soundfile.write(wav, piece.samples, piece.sample_rate)
            result = processor(Result(Task(wav.stem, wav)))
            costs.append([result.seconds, sum(made["size"] for made in result.made.values())])
    if result.status != "done":
        return 0.0, 0.0
    # Samples cost the same each: one was measured.
    _, short, long = batch.processor.samples * np.array(costs)
    of_second = np.maximum(0.0, (long - short) / (_LONG - _SHORT))
    of_item = np.maximum(0.0, short - _SHORT * of_second)
    time, size = items * of_item + sound * of_second
    return float(time), float(size)


def _fields(kind: type, options: dict[str, Any]) -> dict[str, Any]:
    """Take the fields of a dataclass out of `options`."""
    names = {field.name for field in dataclasses.fields(kind)} & options.keys()
    return {name: options.pop(name) for name in names}
