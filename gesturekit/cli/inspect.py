"""gesturekit inspect: describe files and folders."""

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
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object per line.")
@click.pass_context
def command(
    ctx: click.Context,
    paths: tuple[str, ...],
    parts: tuple[str, ...],
    as_json: bool,
    **reading: object,
) -> None:
    """Describe PATH: motion, an avatar, sound, features (npz, npy), a model (folder or bundled
    name), a corpus (manifest or folder of recordings), or a training run.

    A motion is shown with its unit, axes and frame rate, its rig as a tree with body parts in
    brackets, statistics of its movement, and probable defects. The exit code is 1 if a PATH
    cannot be identified or read.
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
    failed = False
    for number, path in enumerate(paths):
        try:
            summary = inspect(
                path,
                parts=named,
                read=read_from(reading),
                # Only on a terminal, not in log files.
                progress=lambda tasks: tqdm(
                    tasks, unit="file", desc="reading", disable=None, leave=False
                ),
            )
        except (GestureKitError, AudioFeaturesError, MemoryError) as error:
            failed = True
            reason = str(error) or "not enough memory"
            click.echo(f"Failed: {reason if path in reason else f'{path}: {reason}'}", err=True)
            continue
        except OSError as error:
            failed = True
            click.echo(f"Failed: {error.filename or path}: {error.strerror or error}", err=True)
            continue
        if as_json:
            click.echo(json.dumps(summary.to_json(), ensure_ascii=False))
        else:
            click.echo("\n".join([*([""] if number else []), *summary.lines(width)]))
    ctx.exit(1 if failed else 0)
