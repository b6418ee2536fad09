"""gesturekit render: sounds in (or a style, or nothing), motion files out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import click

from gesturekit.cli.options import (
    RATE,
    UNITS,
    GroupedCommand,
    channel_option,
    comma_separated,
    existing_option,
    given,
    resumable,
    rig_part_option,
)

EXAMPLES = """\
gesturekit render speech.wav --model demo --out rendered --format bvh,html
gesturekit render speech/ --model runs/mine/model --out rendered    # all sounds below it
gesturekit render --corpus corpus.jsonl --split test --model runs/mine/model --out rendered
gesturekit render --seconds 20 --samples 5 --model runs/clip/model --out rendered
gesturekit render new.wav --model demo --out rendered --rig avatar.bvh --fps 30 --unit m
"""

GROUPS = {
    "What to render": (
        *("model", "corpus", "split", "seconds", "samples", "seed", "channel", "weights"),
    ),
    "Output": ("out", "formats", "fps", "unit", "up", "rig", "rig_parts", "existing")
    + ("skip_existing",),
    "Controls of all models": ("speaker", "style", "path", "like", "foot_lock", "smooth"),
    "Controls of multires models": (
        *("level_style", "levels", "keyframes", "keyframe_level", "keep"),
    ),
    "Controls of diffusion models": (
        *("guidance", "unconditional", "events", "experts", "steps", "solver", "change"),
    ),
    "Computing": ("device", "dtype"),
}


@click.command("render", cls=GroupedCommand, groups=GROUPS, epilog=EXAMPLES)
@click.argument("sources", nargs=-1, type=click.Path(path_type=Path), metavar="[WAV]...")
@click.option("--model", required=True, help="A bundled name (demo) or a model folder.")
@click.option(
    "--corpus",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="CORPUS.jsonl",
    help="Render the items of this manifest in place of WAVs, cut as it says, named by their ids.",
)
@click.option(
    "--split",
    type=click.Choice(["train", "valid", "test"]),
    help="Which items of --corpus.  [default: test]",
)
@click.option(
    "--out", required=True, type=click.Path(path_type=Path, file_okay=False), help="Folder to fill."
)
@click.option("--format", "formats", default="bvh", help="Of bvh,npz,html,png.  [default: bvh]")
@click.option(
    "--fps",
    type=RATE,
    metavar="RATE",
    help="Frames per second to write.  [default: the recordings' rate, as the model keeps it]",
)
@click.option("--unit", type=click.Choice(UNITS), help="Unit of BVH to write.  [default: cm]")
@click.option("--up", type=click.Choice(["y", "z"]), help="Up in SMPL npz; z for AMASS readers.")
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
    help="Arithmetic of diffusion; bf16 is 1.5 to 1.9 times as fast where the processor has it, "
    "and its motion differs slightly.",
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
@existing_option("refuse", alias=True)
@click.pass_context
def command(
    ctx: click.Context,
    sources: tuple[Path, ...],
    corpus: Path | None,
    split: str | None,
    model: str,
    out: Path,
    seconds: float | None,
    **options: Any,
) -> None:
    """Turn each WAV (or folder of audio) into motion, as long as the sound.

    Folders are searched to the bottom and keep their shape. Models without speech input take
    --seconds, --keyframes, --like, --path or --keep instead of any WAV.

    One broken file never stops the others: it is listed with its reason, and the exit code is 1.
    A run that was stopped goes on with the same command: what was made with the same model,
    settings and input is kept, and anything else in --out is only overwritten with --existing
    replace.
    """
    import logging
    import time

    from tqdm.contrib.logging import logging_redirect_tqdm

    begin = time.monotonic()
    logging.basicConfig(level=logging.WARNING, format="Warning: %(message)s")
    _check(sources, corpus, split, seconds, options)

    from gesturekit.corpus import Manifest
    from gesturekit.progress import Progress, time_in_words
    from gesturekit.rendering.render import render
    from gesturekit.systems import load

    items = ()
    if corpus is not None:
        items = Manifest.load(corpus).in_split(split or "test", str(corpus))
    names = ("weights", "device", "dtype")
    open_model = partial(load, **{name: options.pop(name) for name in names})
    loaded = open_model(model)
    output, channel = _output(options), options.pop("channel")
    counts = {"rendered": 0, "kept": 0, "failed": 0}

    def summary() -> str:
        said = [f"{n} {what}" for what, n in counts.items() if n or what == "rendered"]
        if options["samples"] > 1:
            said[0] += f" ({options['samples'] * counts['rendered']} motions)"
        return f"{', '.join(said)} in {time_in_words(time.monotonic() - begin)}: {out}"

    with (
        resumable(lambda: f"{summary()}; the same command goes on"),
        logging_redirect_tqdm(tqdm_class=Progress),
    ):
        rate = loaded.fps if options["levels"] is None else None
        for outcome in render(
            loaded,
            [*sources, *items],
            out,
            output=output,
            seconds=seconds,
            channel=channel,
            progress=lambda tasks: Progress(tasks, desc="Rendering", unit="file"),
            **_controls(options, open_model),
        ):
            with Progress.external_write_mode():
                for file in outcome.files:
                    click.echo(click.format_filename(file))
                if None not in (rate, outcome.fps) and abs(outcome.fps - rate) > 0.01 * rate:
                    click.echo(
                        f"Written at {outcome.fps:g} fps; the model's own rate is {rate:g} fps "
                        "(--fps chooses).",
                        err=True,
                    )
                    rate = None  # once is enough
                if outcome.error is not None:
                    click.echo(f"Failed: {outcome.error}", err=True)
            done = "rendered" if outcome.files else "kept"
            counts["failed" if outcome.error is not None else done] += 1
    click.echo(summary(), err=True)
    ctx.exit(1 if counts["failed"] else 0)


def _check(
    sources: Sequence[Path],
    corpus: Path | None,
    split: str | None,
    seconds: float | None,
    options: dict[str, Any],
) -> None:
    """Refuse options that do not go together.

    Raises:
        click.UsageError: names them.
    """
    starts = ("keyframes", "like", "path", "keep")
    named = [f"--{name}" for name in starts if options[name] is not None]
    if len(named) > 1:
        raise click.UsageError(
            f"{' and '.join(named)} are all that a motion starts from: give one."
        )
    if options["keyframe_level"] is not None and not {"--keyframes", "--like"} & {*named}:
        raise click.UsageError("--keyframe-level goes with --keyframes or --like.")
    if options["change"] is not None and options["like"] is None:
        raise click.UsageError("--change goes with --like.")
    if options["rig_parts"] and options["rig"] is None:
        raise click.UsageError("--rig-part names parts of the body that --rig gives.")
    if corpus is None and split is not None:
        raise click.UsageError("--split chooses items of --corpus: give it as well.")
    if corpus is not None:
        if sources or seconds is not None or options["channel"] is not None:
            raise click.UsageError(
                "--corpus says which sound is rendered: leave WAV, --seconds and --channel out."
            )
        return
    if not sources and seconds is None and not named:
        raise click.UsageError("Give audio files, --corpus, or --seconds for an idle motion.")
    if sources and seconds is not None:
        raise click.UsageError("--seconds goes without audio: a motion is as long as its speech.")


def _output(options: dict[str, Any]) -> Any:
    """Take the options of the output out of all options."""
    from gesturekit.formats.rig import Rig
    from gesturekit.motion.parts import parse_parts
    from gesturekit.rendering.render import Output

    rig, parts = options.pop("rig"), parse_parts(options.pop("rig_parts"))
    return Output(
        formats=options.pop("formats"),
        rig=None if rig is None else Rig.load(rig, parts),
        **{name: options.pop(name) for name in ("existing", "unit", "up")},
    )


def _controls(options: dict[str, Any], open_model: Callable[[str], Any]) -> dict[str, Any]:
    """Arguments of `generate`, from the options that were given."""
    experts, unconditional, keep = (
        options.pop(name) for name in ("experts", "unconditional", "keep")
    )
    return given(
        **options,
        experts=[_expert(text, open_model) for text in experts] or None,
        unconditional=None if unconditional is None else open_model(unconditional),
        keep=None if keep is None else _placed_files(keep),
    )


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


def _placed_files(text: str) -> dict[float, Path]:
    """a.bvh@0,b.bvh@6: files by the second at which they begin; without @ at 0."""
    placed: dict[float, Path] = {}
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
        placed[begin] = Path(name or item)
    return placed
