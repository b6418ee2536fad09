"""gesturekit view: play motion with sound in the browser, or write it as a video or picture."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from gesturekit.cli.options import (
    FILE,
    PATH,
    RATE,
    body_option,
    existing_option,
    framing_option,
    given,
    is_left,
    part_option,
    read_from,
    reading_options,
    size_option,
)

if TYPE_CHECKING:
    from gesturekit.motion import Motion

_MOST = 8
"""Largest number of motions of a folder on a page."""
_TOLERANCE = 1.0
"""Largest difference in length of sound and motion without a warning, seconds."""


@click.command(
    "view",
    epilog="Example: gesturekit view take.bvh --audio take.wav\n\n"
    "Example: gesturekit view recorded.bvh rendered.bvh --out compare.html\n\n"
    "Example: gesturekit view recorded.bvh rendered.bvh --audio take.wav -o compare.mp4",
)
@click.argument("clips", nargs=-1, required=True, type=PATH, metavar="MOTION...")
@click.option("--audio", type=PATH, metavar="WAV", help="Sound to play.")
@click.option(
    *("-o", "--out"),
    type=FILE,
    metavar="FILE",
    help="Write a page (.html), video (.mp4) or picture (.png, .svg, .pdf); do not open it.",
)
@body_option
@framing_option
@size_option
@click.option("--fps", type=RATE, metavar="RATE", help="Frames per second of an mp4 video.")
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
    **options: Any,
) -> None:
    """Play MOTION (bvh, npz, EasyMocap, or a folder of them) in the browser; several are shown
    side by side.

    The page is one file that needs no network: send it by mail, put it on a server. With --out
    NAME.mp4 a video is written instead, with --out NAME.png, .svg or .pdf a picture.
    """
    import tempfile

    from gesturekit.errors import ConfigError

    body = options.pop("body")
    names = ("framing", "size", "fps")
    write = _writer(out, given(**{name: options.pop(name) for name in names}))
    if out is not None and is_left([out], existing):
        return
    reading = read_from(options)
    files = _files_of(clips)
    motions, has_failed = _loaded(files, clips, reading, parts)
    if not motions:
        raise ConfigError("no motion to show")
    if out is None:
        page = Path(tempfile.mkdtemp(prefix="gesturekit-")) / f"{files[0].stem or 'motion'}.html"
    else:
        page = out
    if audio is not None:
        _compare_lengths(audio, max(motion.duration for motion in motions.values()))
    shown = motions if len(motions) > 1 else next(iter(motions.values()))
    write(shown, page, audio=audio, **given(body=body, body_model=reading.get("body_model")))
    click.echo(click.format_filename(page))
    if out is None and not _opened(page):
        click.echo("No browser found: open this file in a browser.", err=True)
    ctx.exit(1 if has_failed else 0)


def _writer(out: Path | None, options: Mapping[str, Any]) -> Callable[..., None]:
    """Return the function that writes a file of this name, by default a page, with options.

    Raises:
        ConfigError: an unknown format, or an option of another one.
    """
    from gesturekit.errors import ConfigError
    from gesturekit.formats.sources import writer_options
    from gesturekit.viewer import write_html, write_picture, write_video

    writers = {"html": write_html, "mp4": write_video}
    writers |= dict.fromkeys(("png", "svg", "pdf"), write_picture)
    kind = "html" if out is None else out.suffix.lower()[1:]
    kind = "html" if kind == "htm" else kind
    if kind not in writers:
        raise ConfigError(f"{out}: give a name ending in .html, .mp4, .png, .svg or .pdf")
    return partial(writers[kind], **writer_options([kind], options)[kind])


def _compare_lengths(audio: Path, longest: float) -> None:
    """Warn of sound that is longer or shorter than the motion, which lasts `longest` seconds."""
    from audio_features import Wave

    if abs((sound := Wave.load(audio).duration) - longest) > _TOLERANCE:
        text = f"{audio} lasts {sound:.1f} s, the motion {longest:.1f} s: do they belong together?"
        click.echo(f"Warning: {text}", err=True)


def _files_of(clips: tuple[Path, ...]) -> list[Path]:
    """Return the motions to show, those of folders included."""
    from gesturekit.formats.sources import motions_of

    files = [motion for clip in clips for motion in motions_of(clip)]
    if len(files) > (most := max(len(clips), _MOST)):
        text = f"{len(files)} motions; the page shows the first {most}, or those you name"
        click.echo(f"Warning: {text}", err=True)
    return files[:most]


def _loaded(
    files: list[Path], clips: tuple[Path, ...], options: Mapping[str, Any], parts: tuple[str, ...]
) -> tuple[dict[str, Motion], bool]:
    """Load motions; return {label: motion} and whether a file not named in `clips` failed."""
    from gesturekit.errors import GestureKitError
    from gesturekit.formats.conventions import plausibility_warnings
    from gesturekit.formats.sources import load_with_warnings
    from gesturekit.motion.parts import parse_parts

    named = parse_parts(parts)
    # Files of the same name come from different folders.
    repeated = len({clip.stem for clip in files}) < len(files)
    motions, has_failed = {}, False
    for clip in files:
        try:
            motion, warnings = load_with_warnings(clip, options, named)
        except GestureKitError as error:
            if clip in clips:
                raise
            click.echo(f"Failed: {error}", err=True)
            has_failed = True
            continue
        doubts = plausibility_warnings(motion, options)
        for line in [*warnings, *(f"{clip}: {doubt}" for doubt in doubts)]:
            click.echo(f"Warning: {line}", err=True)
        motions[str(clip) if repeated else clip.stem] = motion
    return motions, has_failed


def _opened(page: Path) -> bool:
    """Open a page in a graphical browser; a text browser would take over the terminal."""
    import os
    import sys
    import webbrowser

    has_windows = sys.platform in ("darwin", "win32") or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")
    )
    return has_windows and webbrowser.open(page.resolve().as_uri())
