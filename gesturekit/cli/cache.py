"""gesturekit cache: what the feature cache holds, and emptying it."""

from __future__ import annotations

import click


@click.command(epilog="Example: gesturekit cache info")
@click.argument("action", type=click.Choice(["info", "clear"]))
def command(action: str) -> None:
    """Say what the feature cache holds (info), or remove it all (clear).

    The cache keeps what is slow to extract: WavLM, and pitch by pyin. It lies in
    $GESTUREKIT_CACHE, else in the user's cache folder, and holds $GESTUREKIT_CACHE_GB gigabytes
    at most (20); what was not used for longest goes first. Clearing costs time, nothing else.
    """
    from datetime import datetime

    from audio_features import cache_from_environment

    cache = cache_from_environment()
    if action == "clear":
        removed = cache.clear()
        click.echo(f"{removed.entries} entries removed, {removed.size / 1e9:.3f} GB")
        return
    contents = cache.contents()
    click.echo(f"{'folder':<8} {cache.folder}")
    click.echo(f"{'entries':<8} {contents.entries}")
    click.echo(f"{'size':<8} {contents.size / 1e9:.3f} GB of {cache.max_bytes / 1e9:g} GB")
    if contents.entries:
        oldest, newest = (
            datetime.fromtimestamp(used).strftime("%Y-%m-%d %H:%M")
            for used in (contents.oldest, contents.newest)
        )
        click.echo(f"{'used':<8} {oldest} to {newest}")
