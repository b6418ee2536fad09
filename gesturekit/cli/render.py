"""gesturekit render: wavs in (or a style, or nothing), motion files out."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import click

from gesturekit.cli.options import channel_option, comma_separated, given, rig_part_option


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
@channel_option
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
@click.option(
    "--device",
    default="cpu",
    show_default=True,
    help="Where diffusion and WavLM compute: cpu, cuda, cuda:1, or auto.",
)
@click.option(
    "--dtype",
    type=click.Choice(["fp32", "bf16"]),
    default="fp32",
    show_default=True,
    help="Arithmetic of diffusion; bf16 takes half the time where the processor has it, and its "
    "motion differs in small things.",
)
@click.option(
    "--style",
    metavar="NAME",
    help="A style that the model knows, or several over time: old@0-10,angry@10-20 (seconds). "
    "Diffusion models mix them by weights that add up to 1: old:0.25,angry:0.75.",
)
@click.option(
    "--guidance",
    type=float,
    metavar="GAMMA",
    help="Above 1 a style is exaggerated, below 1 subdued; 0 leaves it out.",
)
@click.option(
    "--unconditional",
    metavar="MODEL",
    help="The model without styles that guidance leads away from.  [default: the same one]",
)
@click.option(
    "--events",
    metavar="NAME@SECONDS,...",
    help="What happens when: kick@1.0,punch@2.5:0.5 (lasting half a second), kick@beats (of the "
    "WAV), or a table time,name[,duration] (.csv).",
)
@click.option(
    "--expert",
    "experts",
    multiple=True,
    metavar="MODEL[:WEIGHT[:STYLE]]",
    help="A further model that must agree to each movement; --model has what is left of 1. Without "
    "weights, all count alike. Over time: MODEL:0.2@0-10,0.8@10-20 (seconds). May be repeated.",
)
@click.option(
    "--steps",
    type=click.IntRange(min=1),
    metavar="N",
    help="Denoising steps; 10 to 20 are quick.  [default: all, as in training]",
)
@click.option(
    "--solver",
    type=click.Choice(["ancestral", "ddim", "dpm"]),
    help="How they are taken.  [default: dpm with --steps, else ancestral]",
)
@click.option(
    "--level-style",
    metavar="LEVELS=NAME,...",
    help="Styles of single levels, 1 the coarsest: 1-4=describe,5-8=angry.",
)
@click.option(
    "--levels",
    type=click.IntRange(min=1),
    metavar="N",
    help="Stop after N levels: a coarse motion to edit and give back by --keyframes.",
)
@click.option(
    "--keyframes",
    type=click.Path(path_type=Path),
    metavar="EDIT.bvh",
    help="A motion that takes the place of a coarse level; finer levels add their detail.",
)
@click.option(
    "--keyframe-level",
    type=click.IntRange(min=1),
    metavar="N",
    help="Which level that is, 1 the coarsest.  [default: 1]",
)
@click.option(
    "--like",
    type=click.Path(path_type=Path),
    metavar="OTHER.bvh",
    help="A motion, of any rig of a person, to be done in the manner of the model.",
)
@click.option(
    "--change",
    type=click.FloatRange(min=0, min_open=True, max=1),
    metavar="SHARE",
    help="How much of --like a diffusion model may change, up to 1 for all.  [default: 0.5]",
)
@click.option(
    "--path",
    type=click.Path(path_type=Path),
    metavar="PATH.csv",
    help="Where to go: a table time,x,z[,heading] (s, m, degrees), or a motion whose way to take.",
)
@click.option(
    "--keep",
    metavar="FILE[@SECONDS],...",
    help="Motions that stay as they are, and when each begins: clip.bvh is continued up to "
    "--seconds; a.bvh@0,b.bvh@6 is filled in between.",
)
@click.option(
    "--foot-lock/--no-foot-lock",
    default=True,
    help="Keep feet where they stand, or leave them as the model moves them.  [default: keep]",
)
@click.option(
    "--smooth",
    type=click.FloatRange(min=0, max=2),
    metavar="SECONDS",
    help="Smooth movements of the upper body that are shorter, as 0.2; beats keep their time and "
    "height. 0 for none.  [default: what the model was trained for]",
)
@click.option(
    "--skip-existing",
    is_flag=True,
    help="Leave out what is in --out already, to go on after a stop.",
)
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
    channel: int | None,
    speaker: str | None,
    weights: Path | None,
    rig: str | None,
    rig_parts: tuple[str, ...],
    device: str,
    dtype: str,
    style: str | None,
    guidance: float | None,
    unconditional: str | None,
    events: str | None,
    experts: tuple[str, ...],
    steps: int | None,
    solver: str | None,
    level_style: str | None,
    levels: int | None,
    keyframes: Path | None,
    keyframe_level: int | None,
    like: Path | None,
    change: float | None,
    path: Path | None,
    keep: str | None,
    foot_lock: bool,
    smooth: float | None,
    skip_existing: bool,
) -> None:
    """Turn each WAV (or folder of audio) into motion, as long as the sound.

    Models that do not hear take --seconds, --keyframes, --like, --path or --keep instead of any
    WAV.

    One broken file never stops the others: it is listed with its reason, and the exit code is 1.
    """
    import logging

    from gesturekit.motion.parts import parse_parts
    from gesturekit.rendering.render import render
    from gesturekit.systems import load

    logging.basicConfig(level=logging.WARNING, format="Warning: %(message)s")
    start_from = {"--keyframes": keyframes, "--like": like, "--path": path, "--keep": keep}
    named = [name for name, value in start_from.items() if value is not None]
    if len(named) > 1:
        raise click.UsageError(
            f"{' and '.join(named)} are all that a motion starts from: give one."
        )
    if keyframe_level is not None and keyframes is None and like is None:
        raise click.UsageError("--keyframe-level goes with --keyframes or --like.")
    if change is not None and like is None:
        raise click.UsageError("--change goes with --like.")
    if not sources and seconds is None and not named:
        raise click.UsageError("Give audio files, or --seconds for an idle motion.")
    if sources and seconds is not None:
        raise click.UsageError("--seconds goes without audio: a motion is as long as its speech.")
    if rig_parts and rig is None:
        raise click.UsageError("--rig-part names parts of the body that --rig gives.")
    open_model = partial(load, weights=weights, device=device, dtype=dtype)
    loaded = open_model(model)
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
        channel=channel,
        rig=rig,
        rig_parts=parse_parts(rig_parts),
        controls=given(
            style=style,
            guidance=guidance,
            unconditional=None if unconditional is None else open_model(unconditional),
            events=events,
            experts=[_expert(text, open_model) for text in experts] or None,
            steps=steps,
            solver=solver,
            level_style=level_style,
            levels=levels,
            keyframes=keyframes,
            keyframe_level=keyframe_level,
            like=like,
            change=change,
            path=path,
            keep=None if keep is None else _placed_files(keep),
        ),
        foot_lock=foot_lock,
        smooth=smooth,
        skip_existing=skip_existing,
    ):
        for file in outcome.files:
            click.echo(click.format_filename(file))
        if outcome.error is not None:
            failed += 1
            click.echo(f"Failed: {outcome.error}", err=True)
    ctx.exit(1 if failed else 0)


def _expert(
    text: str, open_model: Callable[[str], Any]
) -> tuple[Any, float | str | None, str | None]:
    """MODEL[:WEIGHT[:STYLE]]: the model, its weight (a text where it has times), its style."""
    model, _, rest = text.partition(":")
    weight, _, style = rest.partition(":")
    try:
        share = weight if "@" in weight else float(weight) if weight else None
    except ValueError:
        raise click.UsageError(
            f"--expert {text}: {weight!r} is no weight; expected MODEL[:WEIGHT[:STYLE]]."
        ) from None
    return open_model(model), share, style or None


def _placed_files(text: str) -> dict[float, str]:
    """a.bvh@0,b.bvh@6: files by the second at which they begin; without @ at 0."""
    placed: dict[float, str] = {}
    for item in comma_separated(text):
        name, at, second = item.rpartition("@")
        try:
            begin = float(second) if at else 0.0
        except ValueError:
            name, begin = item, 0.0  # an @ in the file's name
        if begin in placed:
            raise click.UsageError(
                f"--keep: {placed[begin]} and {name or item} both begin at {begin:g} s; say when, "
                "as b.bvh@6."
            )
        placed[begin] = name or item
    return placed
