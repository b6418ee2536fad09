"""Render many sounds in one call."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gesturekit.errors import gesturekit_errors
from gesturekit.jobs.batch import Batch, Execution
from gesturekit.jobs.work import Outcome
from gesturekit.rendering.render import Output, Renderer
from gesturekit.rendering.tasks import Source, Task, sound_inputs

if TYPE_CHECKING:
    from gesturekit.model import Model


@gesturekit_errors()
def render(
    model: Model | str | Path,
    sources: Source | Sequence[Source] = (),
    out: str | Path = "rendered",
    *,
    seconds: float | None = None,
    channel: int | None = None,
    progress: Callable[[list[Task]], Iterable[Task]] = iter,
    **options: Any,
) -> list[Outcome]:
    """Render sounds to motion files, and return one outcome for each input.

    Example::

        import gesturekit as gk

        outcomes = gk.render("demo", "speech/", "rendered", formats="bvh,html", seed=3)
        files = [file for outcome in outcomes for file in outcome.files]
        failed = [outcome.error for outcome in outcomes if outcome.error]

    A broken sound never stops the others: its outcome has an `error`. Files that an earlier call
    made with the same model, settings and input are kept. `iter_render` does the same as an
    iterator.

    Args:
        model: a loaded model, the name of a bundled one, or a model folder.
        sources: a sound file, a folder of them, a glob, a list (`gesturekit.rendering.lists`), an
            item of a manifest, or a sequence of these; without any, one motion of length `seconds`
            is generated.
        out: folder for the results.
        seconds: length of the motion without sources.
        channel: channel of each file to use, counted from 1; None for the mean of all.
        progress: wraps the list of tasks, as tqdm does.
        options: fields of `gesturekit.rendering.render.Output` (formats, existing, rig, unit, up)
            and of `gesturekit.jobs.batch.Execution` (workers, shard, deadline ...), and
            arguments of the model's `generate` (seed, samples, style, foot_lock, smooth ...).
            `formats` are of bvh, npz, html, mp4 and png: `("bvh", "html")` or `"bvh,html"`.

    Raises:
        ModelError: no such model, or a control, style or level that it does not have.
        ConfigError: an unknown format, a folder without audio, two sources that would write the
            same file, an existing result with `existing="refuse"`, an output folder that cannot
            be written to, or in which another run works.
        OutputError: the disk became full; what is done is kept.
        FormatError, MotionError: a rig cannot be read, or its body parts cannot be found.
    """
    if isinstance(model, str | os.PathLike):
        from gesturekit.systems import load

        model = load(model)
    output = Output(**_fields(Output, options))
    execution = Execution(**_fields(Execution, options))
    inputs = {"seconds": seconds, "channel": channel, "progress": progress}
    return list(
        iter_render(model, sources, out, output=output, execution=execution, **inputs, **options)
    )


def iter_render(
    model: Model,
    sources: Source | Sequence[Source],
    out: str | Path,
    *,
    output: Output | None = None,
    execution: Execution | None = None,
    seconds: float | None = None,
    channel: int | None = None,
    progress: Callable[[list[Task]], Iterable[Task]] = iter,
    **controls: Any,
) -> Iterator[Outcome]:
    """Generate motion for each input and write it as NAME.bvh (NAME_s1.bvh ... for samples).

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
        progress: wraps the list of tasks, as tqdm does.
        controls: arguments of the model's `generate`: seed, samples, style, foot_lock, smooth ...

    Yields:
        an outcome for each input as soon as it is done.

    Raises the errors of `render`.
    """
    renderer = Renderer(model, Path(out), output or Output(), seconds, channel, controls)
    inputs = sound_inputs("render", sources, renderer.out, seconds, channel)
    batch = Batch(renderer, inputs, execution or Execution())
    steps = iter(progress(batch.tasks))
    next(steps, None)
    for outcome in batch.run():
        yield outcome
        next(steps, None)


def _fields(kind: type, options: dict[str, Any]) -> dict[str, Any]:
    """Take the fields of a dataclass out of `options`."""
    names = {field.name for field in dataclasses.fields(kind)} & options.keys()
    return {name: options.pop(name) for name in names}
