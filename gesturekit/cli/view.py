"""gesturekit view: motion in the browser, with its sound."""

from __future__ import annotations

from pathlib import Path

import click

from gesturekit.cli.options import (
    existing_option,
    is_left,
    part_option,
    read_from,
    reading_options,
)

_MOST = 8
"""Motions that a page shows of a folder."""
_TOLERANCE = 1.0
"""Seconds by which sound and motion may differ in length without a word."""


@click.command(
    "view",
    epilog="Example: gesturekit view take.bvh --audio take.wav\n\n"
    "Example: gesturekit view recorded.bvh rendered.bvh --out compare.html",
)
@click.argument(
    "clips", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="MOTION..."
)
@click.option("--audio", type=click.Path(path_type=Path), metavar="WAV", help="Sound to play.")
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="HTML",
    help="Write the page here, and open nothing.",
)
@existing_option("replace")
@reading_options
@part_option
@click.pass_context
def command(
    ctx: click.Context,
    clips: tuple[Path, ...],
    audio: Path | None,
    out: Path | None,
    existing: str,
    parts: tuple[str, ...],
    **reading: object,
) -> None:
    """Play MOTION (bvh, npz, EasyMocap, or a folder of them) in the browser; several stand side
    by side.

    The page is one file that needs no network: send it by mail, put it on a server.
    """
    import tempfile
    import warnings

    from audio_features import Wave
    from gesturekit.errors import ConfigError, GestureKitError
    from gesturekit.formats.conversion import load
    from gesturekit.formats.plausibility import plausibility_warnings
    from gesturekit.formats.sources import motions_of
    from gesturekit.motion.parts import parse_parts
    from gesturekit.viewer import write_html

    if out is not None and is_left([out], existing):
        return
    options, named = read_from(reading), parse_parts(parts)
    found = [motion for clip in clips for motion in motions_of(clip)]
    if len(found) > (most := max(len(clips), _MOST)):
        click.echo(
            f"Warning: {len(found)} motions; the page shows the first {most}, or those you name",
            err=True,
        )
        found = found[:most]
    named_clips, clips = set(clips), tuple(found)
    # Clips of one name come from different folders.
    same = len({clip.stem for clip in clips}) < len(clips)
    motions, failed = {}, 0
    for clip in clips:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("ignore")
            warnings.simplefilter("always", UserWarning)
            try:
                motion = load(clip, options, named)
            except GestureKitError as error:
                if clip in named_clips:
                    raise
                click.echo(f"Failed: {error}", err=True)
                failed += 1
                continue
        lines = [str(warning.message) for warning in said]
        for line in [
            *lines,
            *(f"{clip}: {doubt}" for doubt in plausibility_warnings(motion, options)),
        ]:
            click.echo(f"Warning: {line}", err=True)
        motions[str(clip) if same else clip.stem] = motion
    if not motions:
        raise ConfigError("no motion to show")
    if out is None:
        page = Path(tempfile.mkdtemp(prefix="gesturekit-")) / f"{clips[0].stem or 'motion'}.html"
    elif out.suffix.lower() not in (".html", ".htm"):
        raise ConfigError(f"{out}: the page is HTML; give a name ending in .html")
    else:
        page = out
    longest = max(motion.duration for motion in motions.values())
    if audio is not None and abs((sound := Wave.load(audio).duration) - longest) > _TOLERANCE:
        click.echo(
            f"Warning: {audio} lasts {sound:.1f} s, the motion {longest:.1f} s: the page plays "
            "the longer of the two; check that they belong together",
            err=True,
        )
    shown = motions if len(motions) > 1 else next(iter(motions.values()))
    write_html(shown, page, audio=audio, body_model=options.get("body_model"))
    click.echo(click.format_filename(page))
    if out is None and not _opened(page):
        click.echo("No browser found here: open this file in one.", err=True)
    ctx.exit(1 if failed else 0)


def _opened(page: Path) -> bool:
    """Show a page in a browser with windows; a text browser would take the terminal over."""
    import os
    import sys
    import webbrowser

    has_windows = sys.platform in ("darwin", "win32") or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")
    )
    return has_windows and webbrowser.open(page.resolve().as_uri())
