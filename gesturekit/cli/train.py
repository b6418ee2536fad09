"""gesturekit train: a configuration in, a run folder with a model out."""

from __future__ import annotations

from pathlib import Path

import click


@click.command(
    "train",
    epilog="Example: gesturekit train recipes/multires_speech/light.yaml corpus=corpus.jsonl "
    "out=runs/mine",
)
@click.argument("config", type=click.Path(path_type=Path))
@click.argument("overrides", nargs=-1, metavar="[KEY=VALUE]...")
@click.option("--resume", is_flag=True, help="Go on from the last checkpoint of the run folder.")
def command(config: Path, overrides: tuple[str, ...], resume: bool) -> None:
    """Train a model as CONFIG says; KEY=VALUE changes single settings (schedule.batch=8).

    The run folder (out=...) gets the resolved config, metrics, TensorBoard events, checkpoints,
    and at the end the model.
    """
    import logging

    from gesturekit.systems import train

    logging.basicConfig(level=logging.INFO, format="%(message)s")
    try:
        model = train(config, overrides, resume=resume)
    except KeyboardInterrupt:
        click.echo("\nStopped; the same command with --resume goes on.", err=True)
        raise
    click.echo(f"Model: {model}")
    click.echo(f"Render with: gesturekit render speech.wav --model {model} --out rendered")
