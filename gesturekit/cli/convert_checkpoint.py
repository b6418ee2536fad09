"""`gesturekit convert-checkpoint`: a model folder from the weights of the paper's authors."""

from __future__ import annotations

from pathlib import Path

import click

from gesturekit.cli.options import PATH, existing_option, is_left, output_folder_option


@click.command(
    "convert-checkpoint",
    epilog="Example: gesturekit convert-checkpoint dance_LDA.ckpt --rig kthstreet_gLO_001.bvh "
    "--styles dance_styles.txt --features ch0_spec_beatact_features.txt --out lda",
)
@click.argument("checkpoint", type=PATH)
@click.option(
    "--rig", type=PATH, required=True, help="A motion file of the corpus: its joints and bones."
)
@click.option("--styles", type=PATH, help="Names of the styles in the order of training.")
@click.option("--features", type=PATH, help="Names of the features in the order of training.")
@click.option(
    "--columns",
    type=PATH,
    help="Names of the columns of motion (pose_features.expmap.txt).  [default: those of dance]",
)
@output_folder_option
@existing_option("refuse")
def command(
    checkpoint: Path,
    rig: Path,
    styles: Path | None,
    features: Path | None,
    columns: Path | None,
    out: Path,
    existing: str,
) -> int:
    """Make a model folder from a checkpoint of Listen, Denoise, Action! (LDA, LDA-U).

    The .ckpt holds no names and no rig: text files with one name a line give the names, and must
    have as many as the checkpoint has columns. No code of the file is run. The weights are for
    academic use only, and the model card says so.
    """
    from gesturekit.diffusion.released import (
        DANCE_COLUMNS,
        LICENCE,
        convert_checkpoint,
        read_names,
    )

    if is_left([out / "config.yaml"], existing):
        return 0
    names = read_names(features)
    model = convert_checkpoint(
        checkpoint,
        rig,
        read_names(styles),
        names,
        DANCE_COLUMNS if columns is None else read_names(columns),
    )
    rows = {"Columns of features": ", ".join(names)} if names else {}
    model.save(out, notes={**rows, "Licence": LICENCE})
    click.echo(f"{out}: {model!r}; {LICENCE}")
    return 0
