"""gesturekit genea: render a submission to the GENEA leaderboard, and check it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from gesturekit.cli.options import (
    PATH,
    ModelName,
    existing_option,
    seed_option,
    weights_option,
    workers_option,
)


@click.command(
    epilog="Example: gesturekit genea export beat_english_v2.0.0/ --model runs/mine/model "
    "--out submission\n\nExample: gesturekit genea check beat_english_v2.0.0/ --out submission"
)
@click.argument("action", type=click.Choice(["export", "check"]))
@click.argument("folder", type=PATH)
@click.option("--model", help="For export: a bundled name (demo) or a model folder.")
@click.option("-o", "--out", required=True, type=PATH, help="Folder of the submission.")
@click.option(
    "--layout",
    type=click.Choice(["beat2", "seamless"]),
    default="beat2",
    help="Corpus in FOLDER, as published; written as SMPL-X for beat2, SMPL-H for seamless.",
)
@click.option("--samples", type=click.IntRange(1), default=5, help="Motions for each sound.")
@seed_option
@weights_option
@workers_option
@existing_option("refuse")
def command(
    action: str,
    folder: Path,
    model: str | None,
    out: Path,
    layout: str,
    samples: int,
    **options: Any,
) -> int:
    """Render the test split in FOLDER for the GENEA leaderboard (export), or check a submission.

    Each sound of the published test split becomes NAME_s1.npz to NAME_s5.npz: SMPL-X at 30 fps,
    exactly as long as the sound. A repeated export renders what is missing. `export` also checks
    its results; `check` checks any folder of files with these names.

    Exit codes: 0 complete; 1 files are missing or wrong, as listed; 2 nothing could be started.
    """
    from gesturekit.cli.batch import show
    from gesturekit.rendering.genea import RIGS, check, export, published_sounds
    from gesturekit.systems import load
    from gesturekit.wording import counted

    sounds = published_sounds(folder, layout)
    if action == "export":
        if model is None:
            raise click.UsageError(f"export: {ModelName().get_missing_message()}")
        loaded = load(model, weights=options.pop("weights"))
        batch = export(loaded, folder, out, layout=layout, samples=samples, **options)
        show(batch, "Rendering", lambda result: None)
    faults = check(out, sounds, RIGS[layout], samples)
    for fault in faults:
        click.echo(f"Failed: {fault}", err=True)
    total = counted(samples * len(sounds), "file")
    right = f"all {total} are right" if not faults else f"{len(faults)} of {total} are wrong"
    click.echo(f"{counted(len(sounds), 'sound')}, {right}: {out}")
    return 1 if faults else 0
