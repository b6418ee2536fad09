"""gesturekit render: generate motion files from sounds, styles or nothing."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from gesturekit.cli.options import (
    RATE,
    UNITS,
    ControlOption,
    GroupedCommand,
    channel_option,
    comma_separated,
    existing_option,
    given,
    resumable,
    rig_part_option,
)

if TYPE_CHECKING:
    from gesturekit.model import Model
    from gesturekit.rendering.render import Outcome, Output

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
    help="Render the items of this manifest instead of WAVs; outputs are named by their ids.",
)
@click.option(
    "--split",
    type=click.Choice(["train", "valid", "test"]),
    help="Split of --corpus to render.  [default: test]",
)
@click.option(
    "--out", required=True, type=click.Path(path_type=Path, file_okay=False), help="Output folder."
)
@click.option("--format", "formats", default="bvh", help="Any of bvh,npz,html,png.  [default: bvh]")
@click.option("--fps", cls=ControlOption, type=RATE, metavar="RATE")
@click.option("--unit", type=click.Choice(UNITS), help="Unit of BVH files.  [default: cm]")
@click.option(
    "--up", type=click.Choice(["y", "z"]), help="Up axis of SMPL npz files; z for AMASS readers."
)
@click.option("--seed", default=0, show_default=True, help="Random seed.")
@click.option(
    "--samples",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    help="Number of motions for each WAV.",
)
@click.option(
    "--seconds",
    type=click.FloatRange(min=0, min_open=True, max=4 * 3600),
    help="Length of a motion without a WAV.",
)
@channel_option
@click.option("--speaker", cls=ControlOption)
@click.option(
    "--weights", type=click.Path(path_type=Path), help="Weights the model was trained with."
)
@click.option(
    "--rig",
    metavar="RIG",
    help="Skeleton to retarget to: a motion file with any joint names, size and rest pose; or "
    "smpl, smplh or smplx.",
)
@rig_part_option
@click.option(
    "--device",
    default="cpu",
    show_default=True,
    help="Device of diffusion and WavLM: cpu, cuda, cuda:1, or auto.",
)
@click.option(
    "--dtype",
    type=click.Choice(["fp32", "bf16"]),
    default="fp32",
    show_default=True,
    help="Precision of diffusion; bf16 is 1.5 to 1.9 times as fast on processors that support it, "
    "and its motion differs slightly.",
)
@click.option(
    "--style",
    cls=ControlOption,
    metavar="NAME",
    note="Diffusion models also take mixtures by weights that add up to 1: old:0.25,angry:0.75.",
)
@click.option("--guidance", cls=ControlOption, type=float, metavar="GAMMA")
@click.option("--unconditional", cls=ControlOption, metavar="MODEL")
@click.option("--events", cls=ControlOption, metavar="NAME@SECONDS,...")
@click.option(
    "--expert",
    "experts",
    multiple=True,
    metavar="MODEL[:WEIGHT[:STYLE]]",
    help="Combine with another model (product of experts); --model gets the remaining weight. "
    "Without weights, all count equally. Over time: MODEL:0.2@0-10,0.8@10-20 (seconds). May be "
    "repeated.",
)
@click.option(
    "--steps",
    cls=ControlOption,
    type=click.IntRange(min=1),
    metavar="N",
    note="10 to 20 are fast.",
)
@click.option("--solver", cls=ControlOption, type=click.Choice(["ancestral", "ddim", "dpm"]))
@click.option("--level-style", cls=ControlOption, metavar="LEVELS=NAME,...")
@click.option("--levels", cls=ControlOption, type=click.IntRange(min=1), metavar="N")
@click.option("--keyframes", cls=ControlOption, type=click.Path(path_type=Path), metavar="EDIT.bvh")
@click.option("--keyframe-level", cls=ControlOption, type=click.IntRange(min=1), metavar="N")
@click.option("--like", cls=ControlOption, type=click.Path(path_type=Path), metavar="OTHER.bvh")
@click.option(
    "--change",
    cls=ControlOption,
    type=click.FloatRange(min=0, min_open=True, max=1),
    metavar="SHARE",
)
@click.option("--path", cls=ControlOption, type=click.Path(path_type=Path), metavar="PATH.csv")
@click.option(
    "--keep",
    cls=ControlOption,
    metavar="FILE[@SECONDS],...",
    note="clip.bvh is continued up to --seconds; a.bvh@0,b.bvh@6 is filled in between.",
)
@click.option("--foot-lock/--no-foot-lock", cls=ControlOption, default=True, note="[default: lock]")
@click.option("--smooth", cls=ControlOption, type=click.FloatRange(min=0, max=2), metavar="SECONDS")
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
    """Turn each WAV (or folder of audio) into motion of the same length.

    Folders are searched recursively and keep their structure. Models without speech input take
    --seconds, --keyframes, --like, --path or --keep instead of a WAV.

    A broken file never stops the others: it is listed with its reason, and the exit code is 1.
    To continue an interrupted run, repeat the command: files made with the same model, settings
    and input are kept, and anything else in --out is only overwritten with --existing replace.
    """
    import logging

    from tqdm.contrib.logging import logging_redirect_tqdm

    summary = _Summary(out, options["samples"])
    logging.basicConfig(level=logging.WARNING, format="Warning: %(message)s")
    _check(sources, corpus, split, seconds, options)

    from gesturekit.corpus import Manifest
    from gesturekit.progress import Progress
    from gesturekit.rendering.render import render
    from gesturekit.systems import load

    items = () if corpus is None else Manifest.load(corpus).in_split(split or "test", str(corpus))
    names = ("weights", "device", "dtype")
    open_model = partial(load, **{name: options.pop(name) for name in names})
    loaded = open_model(model)
    inputs = {"output": _output(options), "seconds": seconds, "channel": options.pop("channel")}
    is_whole = options["levels"] is None
    outcomes = render(
        loaded,
        [*sources, *items],
        out,
        progress=lambda tasks: Progress(tasks, desc="Rendering", unit="file"),
        **inputs,
        **_controls(options, open_model),
    )
    with (
        resumable(lambda: f"{summary}; the same command continues"),
        logging_redirect_tqdm(tqdm_class=Progress),
    ):
        for outcome in outcomes:
            with Progress.external_write_mode():
                summary.add(outcome, loaded.fps if is_whole else None)
    click.echo(summary, err=True)
    ctx.exit(1 if summary.counts["failed"] else 0)


class _Summary:
    """Count and print the outcomes of a run with `samples` motions for each input."""

    def __init__(self, out: Path, samples: int) -> None:
        self.counts = {"rendered": 0, "kept": 0, "failed": 0}
        self._out, self._samples, self._begin = out, samples, time.monotonic()
        self._has_named_rate = False

    def add(self, outcome: Outcome, rate: float | None) -> None:
        """Print the files or the failure of an outcome, and once that its frame rate differs.

        Args:
            outcome: one input's.
            rate: frames per second of the model; None if they do not matter.
        """
        for file in outcome.files:
            click.echo(click.format_filename(file))
        differs = None not in (rate, outcome.fps) and abs(outcome.fps - rate) > 0.01 * rate
        if differs and not self._has_named_rate:
            click.echo(
                f"Written at {outcome.fps:g} fps; the model's own rate is {rate:g} fps "
                "(change it with --fps).",
                err=True,
            )
            self._has_named_rate = True
        if outcome.error is not None:
            click.echo(f"Failed: {outcome.error}", err=True)
        done = "rendered" if outcome.files else "kept"
        self.counts["failed" if outcome.error is not None else done] += 1

    def __str__(self) -> str:
        from gesturekit.progress import time_in_words

        parts = [f"{n} {what}" for what, n in self.counts.items() if n or what == "rendered"]
        if self._samples > 1:
            parts[0] += f" ({self._samples * self.counts['rendered']} motions)"
        return f"{', '.join(parts)} in {time_in_words(time.monotonic() - self._begin)}: {self._out}"


def _check(
    sources: Sequence[Path],
    corpus: Path | None,
    split: str | None,
    seconds: float | None,
    options: dict[str, Any],
) -> None:
    """Check which options are combined.

    Raises:
        click.UsageError: options that cannot be combined.
    """
    starts = ("keyframes", "like", "path", "keep")
    named = [f"--{name}" for name in starts if options[name] is not None]
    if len(named) > 1:
        raise click.UsageError(f"{' and '.join(named)} cannot be combined: give one.")
    if options["keyframe_level"] is not None and not {"--keyframes", "--like"} & {*named}:
        raise click.UsageError("--keyframe-level requires --keyframes or --like.")
    if options["change"] is not None and options["like"] is None:
        raise click.UsageError("--change requires --like.")
    if options["rig_parts"] and options["rig"] is None:
        raise click.UsageError("--rig-part names joints of --rig: give it as well.")
    if corpus is None and split is not None:
        raise click.UsageError("--split selects items of --corpus: give it as well.")
    if corpus is not None:
        if sources or seconds is not None or options["channel"] is not None:
            raise click.UsageError(
                "--corpus sets the sounds: leave out WAV, --seconds and --channel."
            )
        return
    if not sources and seconds is None and not named:
        raise click.UsageError("Give audio files, --corpus, or --seconds for an idle motion.")
    if sources and seconds is not None:
        raise click.UsageError(
            "--seconds is for motion without audio; otherwise the audio sets it."
        )


def _output(options: dict[str, Any]) -> Output:
    """Pop the options of the output from all options."""
    from gesturekit.formats.rig import Rig
    from gesturekit.motion.parts import parse_parts
    from gesturekit.rendering.render import Output

    rig, parts = options.pop("rig"), parse_parts(options.pop("rig_parts"))
    return Output(
        formats=options.pop("formats"),
        rig=None if rig is None else Rig.load(rig, parts),
        **{name: options.pop(name) for name in ("existing", "unit", "up")},
    )


def _controls(options: dict[str, Any], open_model: Callable[[str], Model]) -> dict[str, Any]:
    """Return the arguments of `generate` from the options that were given."""
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
    text: str, open_model: Callable[[str], Model]
) -> tuple[Model, float | str | None, str | None]:
    """Parse MODEL[:WEIGHT[:STYLE]]; a weight with times stays a string."""
    model, _, rest = text.partition(":")
    weight, _, style = rest.partition(":")
    try:
        share = weight if "@" in weight else float(weight) if weight else None
    except ValueError:
        raise click.UsageError(
            f"--expert {text}: {weight!r} is not a weight; expected MODEL[:WEIGHT[:STYLE]]."
        ) from None
    return open_model(model), share, style or None


def _placed_files(text: str) -> dict[float, Path]:
    """Parse a.bvh@0,b.bvh@6 to files by the second at which they begin; without @ at 0."""
    placed: dict[float, Path] = {}
    for item in comma_separated(text):
        name, at, second = item.rpartition("@")
        try:
            begin = float(second) if at else 0.0
        except ValueError:
            name, begin = item, 0.0  # an @ in the file's name
        if begin in placed:
            raise click.UsageError(
                f"--keep: {placed[begin]} and {name or item} both begin at {begin:g} s; give a "
                "time, such as b.bvh@6."
            )
        placed[begin] = Path(name or item)
    return placed
