"""gesturekit jobs: the state of the work in a folder, from its records."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from gesturekit.cli.options import FILE, FOLDER, existing_option, is_left
from gesturekit.wording import counted, printable

if TYPE_CHECKING:
    from gesturekit.jobs.records import Status

_MOST_REASONS = 12


@click.command("jobs", epilog="Example: gesturekit jobs rendered")
@click.argument("out", type=FOLDER)
@click.option("--failed", is_flag=True, help="List the items that failed, with their reasons.")
@click.option("--left", is_flag=True, help="List the items that are not done yet.")
@click.option("--json", "as_json", is_flag=True, help="Print everything as JSON.")
@click.option("--page", type=FILE, metavar="FILE.html", help="Write an overview with pictures.")
@existing_option("replace", note=" (with --page)")
def command(
    out: Path, failed: bool, left: bool, as_json: bool, page: Path | None, existing: str
) -> None:
    """Show which items are done, failed or left in OUT, the output folder of a batch.

    OUT is that of gesturekit render, features or convert. This works at any time, also while other
    processes write into the folder.
    """
    from gesturekit.jobs.records import status_of

    if page is not None and page.suffix.lower() not in (".html", ".htm"):
        raise click.UsageError(f"--page {page}: the page is HTML: name it .html")
    status = status_of(out)
    if as_json:
        click.echo(_as_json(status))
    else:
        _print(status, out)
    if failed:
        for item in status.failed:
            click.echo(printable(f"failed {item.failures}x  {item.id}: {item.error}"))
    if left:
        for name in status.left:
            click.echo(printable(f"left  {name}"))
    if page is not None and not is_left([page], existing):
        from gesturekit.rendering.summary import write_summary

        write_summary(out, status, page)
        click.echo(page, err=True)


def _print(status: Status, out: Path) -> None:
    from gesturekit.progress import time_in_words

    aside = sum(item.is_aside for item in status.failed)
    put_aside = f" ({aside} put aside after three failures)" if aside else ""
    click.echo(f"{out}: {counted(status.items, 'item')}")
    click.echo(
        f"done {status.done} ({time_in_words(status.sound)} of sound), failed "
        f"{len(status.failed)}{put_aside}, left {len(status.left)}"
    )
    if status.earlier:
        click.echo(f"done earlier, not an input of the latest run: {status.earlier}")
    if len(status.shards) > 1:
        whole = sum(done == count for count, done in status.shards)
        click.echo(f"shards: {whole} of {len(status.shards)} finished")
    for about in status.running:
        where = f"process {about.get('pid')} on {about.get('host')}, {about['name']}"
        click.echo(printable(f"running: {where}"))
    if status.in_hand and not status.running:
        names = ", ".join(status.in_hand[:5])
        click.echo(printable(f"in progress when a run was killed: {names}"))
    if status.items_per_minute:
        until = ""
        if status.left and status.running:
            until = f"; {time_in_words(status.seconds_left or 0.0)} left"
        click.echo(
            f"speed: {status.items_per_minute:.1f} items a minute, "
            f"{status.real_time_factor:.1f}x real time{until}"
        )
    reasons = status.reasons()
    for reason, count, first in reasons[:_MOST_REASONS]:
        click.echo(printable(f"{count:6d}x {reason} (first: {first})"))
    if len(reasons) > _MOST_REASONS:
        click.echo(f"        and {len(reasons) - _MOST_REASONS} more reasons; --failed lists all")


def _as_json(status: Status) -> str:
    import json

    failed = [
        {"id": item.id, "error": str(item.error), "attempts": item.failures}
        for item in status.failed
    ]
    values = vars(status) | {"failed": failed, "seconds_left": status.seconds_left}
    return json.dumps(values, indent=1)
