"""gesturekit prepare: make a manifest of folders of recordings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from gesturekit.cli.options import (
    FILE,
    PATH,
    RECORDING_OPTIONS,
    GroupedCommand,
    channel_option,
    existing_option,
    is_left,
    part_option,
    read_from,
    recording_options,
    seed_option,
    take_option,
    workers_option,
)
from gesturekit.corpus.layouts import LAYOUTS


def _seconds(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise click.BadParameter(f"{text!r} is not a number of seconds, nor auto") from None


@click.command(
    cls=GroupedCommand,
    groups={},
    epilog="gesturekit prepare recordings/ --unpaired speech/ --out corpus.jsonl",
)
@click.argument("folders", nargs=-1, type=PATH, metavar="FOLDER...")
@click.option("-o", "--out", required=True, type=FILE, help="The manifest.")
@click.option(
    "--layout",
    metavar="NAME",
    help=f"FOLDER is a public corpus in its published form: {', '.join(LAYOUTS)}.",
)
@click.option(
    "--unpaired",
    multiple=True,
    type=PATH,
    metavar="DIR",
    help="Folder of speech without motion. May be repeated.",
)
@click.option(
    "--unpaired-motion",
    multiple=True,
    type=PATH,
    metavar="DIR",
    help="Folder of motion without speech. May be repeated.",
)
@click.option(
    "--holdout",
    type=click.FloatRange(0, 1, max_open=True),
    default=0.1,
    help="Fraction of the takes to hold out from training, as test and valid; 0 for none.",
)
@click.option(
    "--hold-out-seconds",
    metavar="START-END,...",
    help="Hold out these seconds of each pair instead, as test; without END, up to its end.",
)
@click.option(
    "--hold-out-pattern", metavar="REGEX", help="Hold out recordings whose path matches instead."
)
@click.option(
    "--hold-out-list",
    type=PATH,
    metavar="FILE",
    help="Hold out the recordings named in this text file instead, one per line.",
)
@click.option(
    "--hold-out-speakers", metavar="NAME,...", help="Hold out these speakers' recordings instead."
)
@seed_option
@click.option("--speaker", metavar="NAME", help="The speaker of all recordings in FOLDER.")
@click.option("--style", metavar="NAME", help="The style of all recordings in FOLDER.")
@click.option(
    "--style-pattern",
    metavar="REGEX",
    help="Style (and speaker) from each recording's path: '(?P<style>calm|lively)_.*'.",
)
@take_option("Takes are held out as a whole.")
@click.option(
    "--tolerance",
    type=click.FloatRange(0),
    default=1.0,
    help="Seconds by which sound and motion may differ in length; the longer one is trimmed.",
)
@click.option(
    "--trim",
    default="",
    show_default=False,
    metavar="ID,...",
    help="Pairs that may differ in length by more; the longer one is trimmed.",
)
@click.option(
    "--shift",
    default="0",
    metavar="SECONDS|auto",
    callback=lambda ctx, parameter, text: text if text == "auto" else _seconds(text),
    help="Seconds by which the motion comes after the sound, taken back; auto estimates them.",
)
@workers_option
@channel_option
@recording_options
@part_option
@existing_option("replace")
def command(
    folders: tuple[Path, ...],
    out: Path,
    existing: str,
    hold_out_seconds: str | None,
    hold_out_speakers: str | None,
    parts: tuple[str, ...],
    **options: Any,
) -> int:
    """Pair speech (wav, flac, mp3, ogg, opus, aiff) with motion (bvh, npz) and write a manifest.

    Files are paired by path within FOLDER without extension, then by unique name; case, separators
    and a last word such as "audio" or "mocap" need not agree. Tables beside a recording are used
    with it: STEM.events.csv (time,name[,duration]: events), STEM.path.csv (time,x,z[,heading]: path
    of the root) and word lists (STEM.TextGrid, .ctm, .srt and others). Every recording is checked;
    a problem is reported with its file, and the other files are still processed.

    Exit codes: 0 everything is used; 1 some files are left out; 2 nothing is usable.
    """
    from gesturekit.corpus import prepare
    from gesturekit.motion.parts import parse_parts
    from gesturekit.progress import Progress

    if not (folders or options["unpaired"] or options["unpaired_motion"]):
        raise click.UsageError("give at least one FOLDER of recordings")
    if is_left([out], existing):
        return 0
    report = prepare(
        folders,
        out,
        hold_out_seconds=hold_out_seconds or (),
        hold_out_speakers=hold_out_speakers or (),
        parts=parse_parts(parts),
        read=read_from({name: options.pop(name) for name in RECORDING_OPTIONS}),
        progress=lambda tasks: Progress(tasks, unit="file", desc="checking"),
        **options,
    )
    for line in report.problem_lines():
        click.echo(line, err=True)
    if len(report.manifest) == 0:
        where = ", ".join(map(str, [*folders, *options["unpaired"], *options["unpaired_motion"]]))
        click.echo(f"Error: no usable recording found in {where}; no manifest written", err=True)
        return 2
    for line in report.table():
        click.echo(line)
    click.echo(f"{'written':<13} {out}")
    return 0 if report.is_complete else 1
