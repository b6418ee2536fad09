"""Render many sounds in one call."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gesturekit.errors import gesturekit_errors
from gesturekit.formats.rig import Rig
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
    formats: str | Sequence[str] = ("bvh",),
    existing: str = "refuse",
    rig: str | os.PathLike[str] | Rig | None = None,
    unit: str | None = None,
    up: str | None = None,
    seconds: float | None = None,
    channel: int | None = None,
    progress: Callable[[list[Task]], Iterable[Task]] = iter,
    **controls: Any,
) -> list[Outcome]:
    """Render sounds to motion files, and return one outcome for each input.

    Example::

        import gesturekit as gk

        outcomes = gk.render("demo", "speech/", "rendered", formats="bvh,html", seed=3)
        files = [file for outcome in outcomes for file in outcome.files]
        failed = [outcome.error for outcome in outcomes if outcome.error]

    A broken sound never stops the others: its outcome has an `error`. Files that an earlier call
    made with the same model, settings and input are kept. `gesturekit.rendering.render.render` is
    the same as an iterator, which yields each outcome as soon as it is there.

    Args:
        model: a loaded model, the name of a bundled one, or a model folder.
        sources: a sound file, a folder of them, an item of a manifest, or a sequence of these;
            without any, one motion of so many `seconds` is made.
        out: folder for the results.
        formats: of bvh, npz, html and png: `("bvh", "html")` or `"bvh,html"`.
        existing, rig, unit, up: see `gesturekit.rendering.render.Output`.
        seconds: length of a motion without sound.
        channel: which channel of each file to take, counted from 1; None for the mean of all.
        progress: wraps the list of tasks while they are done, as tqdm does.
        controls: arguments of the model's `generate`: seed, samples, style, foot_lock, smooth ...

    Raises:
        ModelError: no such model, or a control, style or level that it does not have.
        ConfigError: an unknown format, a folder without audio, two sources that would write the
            same file, a result that exists and is to be refused, or a folder for the results that
            cannot be written to.
        FormatError, MotionError: a rig that cannot be read, or whose parts cannot be found.
    """
    if isinstance(model, str | os.PathLike):
        from gesturekit.systems import load

        model = load(model)
    output = Output(formats, existing, rig, unit, up)
    return list(
        outcomes(
            model,
            sources,
            out,
            output=output,
            seconds=seconds,
            channel=channel,
            progress=progress,
            **controls,
        )
    )
