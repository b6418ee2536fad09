"""gesturekit convert: convert motion files to other formats, rigs and frame rates."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from gesturekit.cli.batch import GROUPS as BATCH_GROUPS
from gesturekit.cli.batch import batch_options, pop_execution, show
from gesturekit.cli.options import (
    PATH,
    RATE,
    RECORDING_OPTIONS,
    GroupedCommand,
    body_option,
    comma_separated,
    existing_option,
    framing_option,
    given,
    part_option,
    read_from,
    reading_options,
    rig_options,
    size_option,
    unit_options,
)

if TYPE_CHECKING:
    from gesturekit.conversion import Changes
    from gesturekit.jobs.result import Result

EXAMPLES = """\
gesturekit convert take.bvh take.npz --rig smplx --fps 30
gesturekit convert takes/ converted/ --format npz,html
"""
GROUPS = {
    "Output": (
        *("formats", "rig", "rig_parts", "fps", "antialias", "trim", "mirror", "joints", "up"),
        *("unit", "body", "framing", "size", "existing"),
    ),
    "Input": (*RECORDING_OPTIONS, "animation", "parts", "face"),
    **BATCH_GROUPS,
}
WIDTH = 100
"""Maximum length of an output line."""


@click.command("convert", cls=GroupedCommand, groups=GROUPS, epilog=EXAMPLES)
@click.argument("sources", nargs=-1, required=True, type=PATH, metavar="IN...")
@click.argument("out", type=PATH)
@click.option(
    *("--format", "formats"),
    metavar="LIST",
    help="Formats to write into a folder: bvh,npz,glb,vrma,fbx,html,mp4,png,svg,pdf,obj,csv.",
)
@rig_options
@click.option("--fps", type=RATE, metavar="RATE", help="Resample to this frame rate.")
@click.option(
    "--antialias", is_flag=True, help="Low-pass filter before --fps reduces the frame rate."
)
@click.option(
    "--trim", metavar="START:END", help="Keep only these seconds; START or END may be omitted."
)
@click.option("--mirror", is_flag=True, help="Swap left and right.")
@click.option(
    "--joints", default="all", metavar="LIST", help="Joints to keep; body leaves out fingers, face."
)
@unit_options
@body_option
@framing_option
@size_option
@batch_options
@existing_option("refuse")
@reading_options
@part_option
@click.option(
    "--face",
    type=PATH,
    metavar="PATH",
    help="Face to add: a CSV of Live Link Face, or a folder with one of the name of each motion.",
)
@click.pass_context
def command(
    ctx: click.Context,
    sources: tuple[Path, ...],
    out: Path,
    formats: str | None,
    existing: str,
    body_model: Path | None,
    face: Path | None,
    **options: Any,
) -> None:
    """Convert motion: one file to another, or files and folders into the folder OUT.

    Folders are searched recursively and keep their structure. Unit, axes and frame rate of each
    file are detected and printed, with a ? where they are a guess. A broken file is listed with its
    reason, the others are still converted, and the exit code is 1. To continue an interrupted run,
    repeat the command: finished files in the folder OUT are kept.
    """
    from gesturekit.conversion import Conversion
    from gesturekit.motion.parts import parse_parts

    execution, dry_run = pop_execution(ctx, out, options)
    changes, parts = _changes(options), parse_parts(options.pop("parts"))
    names = ("up", "unit", "body", "framing", "size")
    write = given(**{name: options.pop(name) for name in names})
    conversion = Conversion(
        sources,
        out,
        formats=comma_separated(formats),
        changes=changes,
        read=read_from(options),
        write=write,
        body_model=body_model,
        parts=parts,
        face=face,
        existing=existing,
        dry_run=dry_run,
        execution=execution,
    )
    failed = show(conversion, "Converting", _print)
    if dry_run:
        click.echo("Dry run: nothing was written.", err=True)
    ctx.exit(1 if failed else 0)


def _changes(options: dict[str, Any]) -> Changes:
    """Pop the options that change a motion from all options.

    Raises:
        click.UsageError: --rig-part without --rig.
    """
    from gesturekit.conversion import Changes, parse_trim
    from gesturekit.formats.smpl import Rig
    from gesturekit.motion.parts import parse_parts

    rig, rig_parts, trim, joints = (
        options.pop(name) for name in ("rig", "rig_parts", "trim", "joints")
    )
    if rig_parts and rig is None:
        raise click.UsageError("--rig-part requires --rig.")
    if options["antialias"] and options["fps"] is None:
        click.echo("Warning: --antialias has no effect without --fps", err=True)
    return Changes(
        trim=parse_trim(trim) if trim is not None else None,
        rig=Rig.load(rig, parse_parts(rig_parts)) if rig is not None else None,
        joints=joints if joints in ("all", "body") else tuple(comma_separated(joints)),
        **{name: options.pop(name) for name in ("mirror", "fps", "antialias")},
    )


def _print(result: Result) -> None:
    """Print one result, with its warnings and its failure."""
    if result.error is None or result.files:
        click.echo(_line(result))
    for warning in result.facts.get("warnings", ()):
        click.echo(f"Warning: {warning}", err=True)
    if result.error is not None:
        click.echo(f"Failed: {result.error}", err=True)


def _line(result: Result) -> str:
    """Return the detected input, the written files and the changes, on one or two lines."""
    source = click.format_filename(result.source)
    if not result.files:
        return f"{source}: skipped, its outputs exist"
    first, *others = result.files
    written = ", ".join([click.format_filename(first), *(path.suffix for path in others)])
    found, done = f"{source} ({result.facts['found']})", result.facts["done"]
    made = f"-> {written}" + (f" ({', '.join(done)})" if done else "")
    return f"{found} {made}" if len(found) + len(made) < WIDTH else f"{found}\n    {made}"
