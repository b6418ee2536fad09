"""gesturekit render: wavs in, motion files out."""

from __future__ import annotations

from pathlib import Path

import click

from gesturekit.cli.options import comma_separated, rig_part_option


@click.command(
    "render",
    epilog="Example: gesturekit render speech.wav --model demo --out rendered --format bvh,html",
)
@click.argument("sources", nargs=-1, type=click.Path(path_type=Path), metavar="[WAV]...")
@click.option("--model", required=True, help="A bundled name (demo) or a model folder.")
@click.option(
    "--out", required=True, type=click.Path(path_type=Path, file_okay=False), help="Folder to fill."
)
@click.option("--format", "formats", default="bvh", help="Of bvh,npz,html,png.  [default: bvh]")
@click.option("--seed", default=0, show_default=True, help="Another seed, another gesture.")
@click.option(
    "--samples",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    help="Motions for each wav.",
)
@click.option(
    "--seconds",
    type=click.FloatRange(min=0, min_open=True, max=4 * 3600),
    help="Length of an idle motion, without any wav.",
)
@click.option("--speaker", help="Whose body to move, of those that the corpus named.")
@click.option(
    "--weights", type=click.Path(path_type=Path), help="WavLM weights the model was trained with."
)
@click.option(
    "--rig",
    metavar="RIG",
    help="Another body to move: a motion file, of any names, size and rest pose; or smpl, smplh "
    "or smplx.",
)
@rig_part_option
@click.pass_context
def command(
    ctx: click.Context,
    sources: tuple[Path, ...],
    model: str,
    out: Path,
    formats: str,
    seed: int,
    samples: int,
    seconds: float | None,
    speaker: str | None,
    weights: Path | None,
    rig: str | None,
    rig_parts: tuple[str, ...],
) -> None:
    """Turn each WAV (or folder of audio) into motion, as long as the sound.

    One broken file never stops the others: it is listed with its reason, and the exit code is 1.
    """
    import logging

    from gesturekit.motion.parts import parse_parts
    from gesturekit.rendering.render import render
    from gesturekit.systems import load

    logging.basicConfig(level=logging.WARNING, format="Warning: %(message)s")
    if not sources and seconds is None:
        raise click.UsageError("Give audio files, or --seconds for an idle motion.")
    if sources and seconds is not None:
        raise click.UsageError("--seconds goes without audio: a motion is as long as its speech.")
    if rig_parts and rig is None:
        raise click.UsageError("--rig-part names parts of the body that --rig gives.")
    loaded = load(model, weights=weights)
    failed = 0
    for outcome in render(
        loaded,
        sources,
        out,
        formats=comma_separated(formats),
        seed=seed,
        samples=samples,
        seconds=seconds,
        speaker=speaker,
        rig=rig,
        rig_parts=parse_parts(rig_parts),
    ):
        for path in outcome.files:
            click.echo(click.format_filename(path))
        if outcome.error is not None:
            failed += 1
            click.echo(f"Failed: {outcome.error}", err=True)
    ctx.exit(1 if failed else 0)
