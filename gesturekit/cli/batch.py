"""Options and output of commands that work on many files."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click

from gesturekit.cli.launchers import LAUNCHER_OPTIONS
from gesturekit.cli.options import resumable, workers_option

if TYPE_CHECKING:
    from gesturekit.conversion.convert import Conversion
    from gesturekit.jobs.batch import Batch, Execution
    from gesturekit.jobs.result import Result

GROUPS = {
    "Many files": ("workers", "shard", "deadline", "retry_failed", "dry_run"),
    "Clusters": ("launcher", "jobs", "launcher_options", "address"),
}
"""Groups of the options of `batch_options` in the help."""


def _shard(ctx: click.Context, _: click.Parameter, text: str | None) -> tuple[int, int] | None:
    """Parse --shard: 1/8 to (1, 8)."""
    match = re.fullmatch(r"(\d{1,5})/(\d{1,5})", text or "1/1", re.ASCII)
    number, count = map(int, match.groups()) if match else (0, 0)
    if not 1 <= number <= count:
        raise click.UsageError(
            f"--shard {text!r}: expected a number of 1 to N and N, such as 1/8 or 8/8"
        )
    return None if text is None else (number, count)


_OPTIONS = (
    workers_option,
    click.option(
        "--shard",
        metavar="K/N",
        callback=_shard,
        help="Process part K of N, such as 1/8. Parts may be processed in any order, or in "
        "parallel on several machines, into one output folder.",
    ),
    *LAUNCHER_OPTIONS,
    click.option(
        "--deadline",
        type=click.FloatRange(min=0, min_open=True),
        metavar="SECONDS",
        help="Abandon an input after this time.",
    ),
    click.option(
        "--retry-failed",
        is_flag=True,
        help="Retry inputs that are skipped because they failed three times.",
    ),
)


def batch_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of `pop_execution` and of launchers."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command


def pop_execution(options: dict[str, Any]) -> Execution:
    """Pop the options of the execution from all options."""
    from gesturekit.jobs.batch import Execution

    shard = options.pop("shard") or (1, 1)
    names = ("workers", "deadline", "retry_failed")
    return Execution(shard=shard, **{name: options.pop(name) for name in names})


def show(
    work: Batch | Conversion,
    description: str,
    add: Callable[[Result], str | None],
    stopped: Callable[[], str],
) -> bool:
    """Do work with a progress bar.

    Args:
        work: what to do.
        description: name of the bar.
        add: called with each result, to print it; it may return a text for the bar.
        stopped: returns the message of Ctrl-C.

    Returns:
        False if the output folder could no longer be written to, which is printed.
    """
    from tqdm.contrib.logging import logging_redirect_tqdm

    from gesturekit.errors import OutputError
    from gesturekit.progress import Progress

    try:
        with (
            resumable(stopped),
            logging_redirect_tqdm(tqdm_class=Progress),
            Progress(total=len(work.tasks), desc=description, unit="file") as bar,
        ):
            for result in work.run():
                with Progress.external_write_mode():
                    text = add(result)
                if text is not None:
                    bar.set_postfix_str(text, refresh=False)
                bar.update()
    except OutputError as error:
        click.echo(f"Error: {error}", err=True)
        return False
    return True


def show_and_count(
    work: Batch | Conversion, description: str, add: Callable[[Result], None]
) -> int:
    """Do work as `show` does, print how many inputs failed, and return the exit code."""
    errors: list[str | None] = []

    def counted(result: Result) -> None:
        errors.append(result.error)
        add(result)

    is_whole = show(
        work, description, counted, lambda: f"{len(errors)} done; the same command continues."
    )
    failed = len(errors) - errors.count(None)
    if failed and len(errors) > 1:
        click.echo(f"{failed} of {len(errors)} failed.", err=True)
    return 1 if failed or not is_whole else 0


def print_preview(batch: Batch) -> None:
    """Print what would be done about each sound of a batch, and the sums."""
    from gesturekit.progress import time_in_words
    from gesturekit.rendering.batch import estimated_cost, preview
    from gesturekit.wording import listed

    words = {"left": "make", "kept": "keep", "failed": "fail"}
    counts, sound = dict.fromkeys(words.values(), 0), 0.0
    for result, length in preview(batch):
        action = words[result.status]
        where = result.error or listed(
            [str(path) for path in batch.processor.targets(result.task)], 4
        )
        shown = "      ? s" if length is None else f"{length:7.1f} s"
        click.echo(f"{action}  {shown}  {click.format_filename(result.source)} -> {where}")
        counts[action] += 1
        sound += (length or 0.0) if action == "make" else 0.0
    seconds, size = estimated_cost(batch, counts["make"], sound)
    took = time_in_words(seconds / batch.execution.workers)
    parts = ", ".join(f"{count} to {action}" for action, count in counts.items())
    click.echo(
        f"{parts}; {time_in_words(sound)} of sound, about {size / 1e6:.1f} MB and "
        f"{took} with {batch.execution.workers} of --workers, besides loading: {batch.out} "
        "(dry run: nothing was written, and only the headers of sounds were read: damage inside "
        "them is not counted)",
        err=True,
    )
