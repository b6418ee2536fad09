"""gesturekit cache: show or clear the cache of features and measurements."""

from __future__ import annotations

import click


@click.command(epilog="Example: gesturekit cache info")
@click.argument("action", type=click.Choice(["info", "clear"]))
def command(action: str) -> None:
    """Show the size of the cache (info), or delete its contents (clear).

    The cache holds features that are slow to extract (those of networks) and measurements of
    gesturekit evaluate. Its folder is $GESTUREKIT_CACHE, by default in the user's cache folder, and
    its size is limited to $GESTUREKIT_CACHE_GB gigabytes (20); the least recently used entries are
    removed first. What is cleared is made again when needed.
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
            for used in (contents.oldest or 0.0, contents.newest or 0.0)
        )
        click.echo(f"{'used':<8} {oldest} to {newest}")
