"""gesturekit inspect: what files and folders are, a screen each."""

from __future__ import annotations

import click

from gesturekit.cli.options import part_option, read_from, reading_options

_NARROWEST, _WIDEST = 72, 110


@click.command(
    "inspect",
    epilog="Example: gesturekit inspect take.bvh speech.wav corpus.jsonl demo runs/mine",
)
@click.argument("paths", nargs=-1, required=True, metavar="PATH...")
@reading_options
@part_option
@click.option("--json", "as_json", is_flag=True, help="For programs: one JSON object a line.")
@click.pass_context
def command(
    ctx: click.Context,
    paths: tuple[str, ...],
    parts: tuple[str, ...],
    as_json: bool,
    **reading: object,
) -> None:
    """Tell what PATH is: motion, sound, features, a model (folder or bundled name), a corpus
    (manifest or folder of recordings), or a training run.

    For a motion: its unit, axes and rate, its rig as a tree with the parts of the body in
    brackets, how it moves, and what looks wrong. Exit code 1 where a PATH cannot be told.
    """
    import json
    import shutil

    from tqdm import tqdm

    from audio_features.errors import AudioFeaturesError
    from gesturekit.errors import GestureKitError
    from gesturekit.inspection import inspect
    from gesturekit.motion.parts import parse_parts

    width = min(max(shutil.get_terminal_size((100, 24)).columns, _NARROWEST), _WIDEST)
    named = parse_parts(parts)
    failed = 0
    for number, path in enumerate(paths):
        try:
            summary = inspect(
                path,
                parts=named,
                read=read_from(reading),
                # On a terminal only: a bar in a log file is noise.
                progress=lambda tasks: tqdm(
                    tasks, unit="file", desc="reading", disable=None, leave=False
                ),
            )
        except (GestureKitError, AudioFeaturesError, MemoryError) as error:
            failed += 1
            reason = str(error) or "not enough memory"
            click.echo(f"Failed: {reason if path in reason else f'{path}: {reason}'}", err=True)
            continue
        except OSError as error:
            failed += 1
            click.echo(f"Failed: {error.filename or path}: {error.strerror or error}", err=True)
            continue
        if as_json:
            click.echo(json.dumps(summary.to_json(), ensure_ascii=False))
        else:
            click.echo("\n".join([*([""] if number else []), *summary.lines(width)]))
    ctx.exit(1 if failed else 0)
