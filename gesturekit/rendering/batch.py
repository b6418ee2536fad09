"""Render many sounds in one call."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gesturekit.errors import gesturekit_errors
from gesturekit.rendering.render import Outcome, Output
from gesturekit.rendering.render import render as outcomes
from gesturekit.rendering.tasks import Source, Task

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
    made with the same model, settings and input are kept. `gesturekit.rendering.render.render`
    does the same as an iterator, which yields each outcome as soon as it is done.

    Args:
        model: a loaded model, the name of a bundled one, or a model folder.
        sources: a sound file, a folder of them, an item of a manifest, or a sequence of these;
            without any, one motion of length `seconds` is generated.
        out: folder for the results.
        seconds: length of the motion without sources.
        channel: channel of each file to use, counted from 1; None for the mean of all.
        progress: wraps the list of tasks, as tqdm does.
        options: fields of `gesturekit.rendering.render.Output` (formats, existing, rig, unit, up)
            and arguments of the model's `generate` (seed, samples, style, foot_lock, smooth ...).
            `formats` are of bvh, npz, html and png: `("bvh", "html")` or `"bvh,html"`.

    Raises:
        ModelError: no such model, or a control, style or level that it does not have.
        ConfigError: an unknown format, a folder without audio, two sources that would write the
            same file, an existing result with `existing="refuse"`, or an output folder that
            cannot be written to.
        FormatError, MotionError: a rig cannot be read, or its body parts cannot be found.
    """
    if isinstance(model, str | os.PathLike):
        from gesturekit.systems import load

        model = load(model)
    names = {field.name for field in dataclasses.fields(Output)} & options.keys()
    output = Output(**{name: options.pop(name) for name in names})
    inputs = {"seconds": seconds, "channel": channel, "progress": progress}
    return list(outcomes(model, sources, out, output=output, **inputs, **options))
