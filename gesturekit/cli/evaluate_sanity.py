"""gesturekit evaluate --sanity: metrics of known-bad motion."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

_USED = ("sanity", "audio", "out", "json_out", "variant", "threshold", "bas", "seed", "workers")
"""Options of `gesturekit evaluate` that --sanity takes."""


def sanity(
    names: Sequence[object], out: Path | None, json_out: Path | None, options: Mapping[str, Any]
) -> int:
    """Evaluate known-bad motion made from recordings, print the table and return the exit code.

    Args:
        names: the positional arguments; the first one is the recordings.
        out: HTML report to write, or None.
        json_out: JSON to write, or None.
        options: the other options of `gesturekit evaluate`.

    Raises:
        UsageError: more is named than the recordings, or an option that has no use here.
    """
    recordings, *surplus = filter(None, names)
    if surplus:
        raise click.UsageError("--sanity takes only a folder of recordings, and --audio")
    _refuse_unused(click.get_current_context())
    from gesturekit.evaluation import Variants, write_report
    from gesturekit.evaluation.report.bad_motion import run_sanity
    from gesturekit.evaluation.report.headline import headline_lines
    from gesturekit.evaluation.report.sanity_table import conclusion, table_lines
    from gesturekit.progress import Progress

    found = run_sanity(
        Path(str(recordings)),
        options["audio"],
        variants=Variants(options["variant"], options["threshold"], options["bas"]),
        seed=options["seed"],
        workers=options["workers"] or os.cpu_count() or 1,
        progress=lambda tasks, total, label: Progress(tasks, total=total, desc=label, unit="task"),
    )
    # First: the reader of a pipe may leave before everything is printed.
    if json_out is not None:
        found.evaluation.write_json(json_out)
    if out is not None:
        write_report(found.evaluation, out, title=f"Known-bad motion made from {recordings}")
    for line in (*headline_lines(found.evaluation), "", *table_lines(found), conclusion(found)):
        click.echo(line)
    for name, reason in found.left_out.items():
        click.echo(f"Left out: {name}: {reason}", err=True)
    for path in filter(None, (json_out, out)):
        click.echo(f"written  {path}")
    return 1 if found.left_out else 0


def _refuse_unused(context: click.Context) -> None:
    """Refuse options of `gesturekit evaluate` that would be ignored.

    Raises:
        UsageError: there is one.
    """
    for option in context.command.params:
        given = context.get_parameter_source(option.name) is ParameterSource.COMMANDLINE
        if given and isinstance(option, click.Option) and option.name not in _USED:
            raise click.UsageError(
                f"--sanity does not use {option.opts[-1]}; leave it out (--out and --json write "
                "all results)"
            )
