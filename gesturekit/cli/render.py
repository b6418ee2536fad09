"""gesturekit render: generate motion files from sounds, styles or nothing."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from gesturekit.cli.batch import GROUPS as BATCH_GROUPS
from gesturekit.cli.batch import batch_options, pop_execution, print_preview, show
from gesturekit.cli.options import (
    FILE,
    PATH,
    GroupedCommand,
    body_option,
    channel_option,
    device_option,
    existing_option,
    framing_option,
    given,
    model_option,
    output_folder_option,
    parse_expert,
    parse_level_files,
    parse_placed_files,
    rig_options,
    seed_option,
    size_option,
    unit_options,
    weights_option,
)
from gesturekit.model import Control, Controls, control_entries
from gesturekit.systems import SYSTEMS, control_docs, controls_type

if TYPE_CHECKING:
    from gesturekit.corpus.manifest import Item
    from gesturekit.jobs.batch import Batch
    from gesturekit.jobs.result import Result, Task
    from gesturekit.model import Model
    from gesturekit.rendering.renderer import Output

EXAMPLES = """\
gesturekit render speech.wav --model demo --out rendered --format bvh,html
gesturekit render speech/ --model runs/mine/model --out rendered    # all sounds below it
gesturekit render --corpus corpus.jsonl --split test --model runs/mine/model --out rendered
gesturekit render night.jsonl --model demo --out rendered --workers 4 --dry-run
gesturekit render --seconds 20 --samples 5 --model runs/clip/model --out rendered
gesturekit render new.wav --model demo --out rendered --rig avatar.bvh --fps 30 --unit m
gesturekit render new.wav --model demo --out rendered --start-pose idle.bvh@2.5 --end-pose idle.bvh
"""

_PARSERS = {"keep": parse_placed_files, "level_speech": parse_level_files}
"""Parsers of the controls that hold several files."""
_MANY = 20  # a run of as many items writes a summary page

CONTROLS = {kind: control_entries(controls_type(kind)) for kind in SYSTEMS}
_COMMON = control_entries(Controls)

GROUPS = {
    "What to render": (
        *("model", "corpus", "split", "seconds", "samples", "seed", "channel", "weights"),
    ),
    "Output": (
        *("out", "formats", "fps", "unit", "up", "body", "framing", "size", "rig", "rig_parts"),
        "existing",
    ),
    **BATCH_GROUPS,
    "Controls of all models": [name for name in _COMMON if name != "fps"],
    **{
        f"Controls of {kind} models": [name for name in controls if name not in _COMMON]
        for kind, controls in CONTROLS.items()
    },
    "Computing": ("device", "dtype"),
}
USUAL = (
    *("model", "corpus", "seconds", "samples", "seed", "out", "formats", "fps", "body", "rig"),
    *("existing", "workers", "dry_run", "speaker", "style", "start_pose", "in_place", "face"),
    "device",
)
"""Options that `--help` shows."""


class ControlOption(click.Option):
    """The option of a control: its name, type and range are those of the control's entry."""

    def __init__(self, name: str, entry: Control) -> None:
        flag = entry.option or f"--{name.replace('_', '-')}"
        if entry.kind is bool:
            flag += f"/--no-{flag[2:]}"
        super().__init__(
            [flag, name],
            type=_click_type(name, entry),
            default=None,
            multiple=entry.option is not None,
            metavar=entry.metavar,
        )
        self._note = entry.note

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        """Return the option and its help: the docstring of the control, read when it is shown."""
        docs = control_docs()

        def plain(name: re.Match[str]) -> str:
            return f"--{name[1].replace('_', '-')}" if name[1] in docs else name[1]

        self.help = re.sub(r"`(\w+)`", plain, f"{docs[self.name]} {self._note}".strip())
        return super().get_help_record(ctx)


def _click_type(name: str, entry: Control) -> Any:
    """Return the type of the option of a control."""
    if name in _PARSERS:
        return _PARSERS[name]
    if entry.choices:
        return click.Choice(entry.choices)
    if entry.kind in (int, float):
        kind: Any = click.IntRange if entry.kind is int else click.FloatRange
        low = entry.least if entry.above is None else entry.above
        if low is None and entry.most is None:
            return entry.kind
        return kind(low, entry.most, min_open=entry.above is not None)
    kinds: dict[Any, Any] = {Path: click.Path(path_type=Path), bool: bool}
    return kinds.get(entry.kind, str)


def control_options() -> list[click.Parameter]:
    """Return the options of the controls of all systems."""
    entries = {name: entry for controls in CONTROLS.values() for name, entry in controls.items()}
    return [ControlOption(name, entry) for name, entry in entries.items()]


@click.command(
    "render",
    cls=GroupedCommand,
    groups=GROUPS,
    usual=USUAL,
    params=control_options(),
    epilog=EXAMPLES,
)
@click.argument("sources", nargs=-1, type=PATH, metavar="[WAV]...")
@model_option
@click.option(
    "--corpus", type=FILE, metavar="CORPUS.jsonl", help="Render this manifest's items instead."
)
@click.option(
    "--split",
    type=click.Choice(["train", "valid", "test"]),
    help="Split of --corpus to render.  [default: test]",
)
@output_folder_option
@click.option(
    "--format", "formats", default="bvh", help="Output formats: any of bvh,npz,glb,html,mp4,png."
)
@unit_options
@body_option
@framing_option
@size_option
@seed_option
@click.option("--samples", type=click.IntRange(1), default=1, help="Motions for each WAV.")
@click.option(
    "--seconds",
    type=click.FloatRange(min=0, min_open=True, max=4 * 3600),
    help="Length of the motion if there is no WAV.",
)
@channel_option
@weights_option
@rig_options
@device_option
@click.option(
    "--dtype",
    type=click.Choice(["fp32", "bf16"]),
    default="fp32",
    help="Precision of diffusion models; bf16 is faster, and its motion differs slightly.",
)
@batch_options
@existing_option("refuse")
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
    """Generate motion for each WAV (or folder of audio), of the same length.

    Folders are searched recursively and keep their structure. WAV may also be a glob in quotes, or
    a list: NAME.txt with one path per line, Kaldi's wav.scp, or NAME.jsonl with lines such as
    {"audio": "a.wav", "id": "day1/a", "seed": 3, "style": "old"}. Models without speech input take
    --seconds, --keyframes, --like, --path or --keep instead of a WAV.

    A broken file is listed with its reason, the others are still rendered, and the exit code is 1.
    To continue an interrupted run, repeat the command: files rendered with the same model, settings
    and input are kept, and other files in --out are only overwritten with --existing replace.
    `gesturekit jobs OUT` shows the state of a run at any time.
    """
    import logging

    begin = time.monotonic()
    logging.basicConfig(format="Warning: %(message)s")
    _check(sources, corpus, split, seconds, options)

    from gesturekit.rendering.renderer import render_batch
    from gesturekit.systems import load

    items: Sequence[Item] = ()
    if corpus is not None:
        from gesturekit.corpus.manifest import Manifest

        items = Manifest.load(corpus).in_split(split or "test", str(corpus))
    execution, is_dry = pop_execution(ctx, out, options)
    output = _output(options)  # before the model, which takes seconds to load
    names = ("weights", "device", "dtype")
    open_model: Callable[..., Model] = partial(load, **{name: options.pop(name) for name in names})
    loaded = open_model(model)
    is_rate_chosen = options["levels"] is not None or options["fps"] is not None
    batch = render_batch(
        loaded,
        [*sources, *items],
        out,
        output,
        execution,
        seconds=seconds,
        channel=options.pop("channel"),
        **chosen_controls(options, open_model),
    )
    _warn_of_speakers(loaded.speakers, options["speaker"], batch.tasks)
    if is_dry:
        print_preview(batch)
        return
    ctx.exit(_run(batch, begin, None if is_rate_chosen else loaded.fps))


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
    is_coarse = options["keyframe_level"] is not None and not {"--keyframes", "--like"} & {*named}
    has_sound = bool(sources) or corpus is not None
    is_set_twice = bool(sources) or seconds is not None or options["channel"] is not None
    problems = (
        (len(named) > 1, f"{' and '.join(named)} cannot be combined: give one."),
        (is_coarse, "--keyframe-level requires --keyframes or --like."),
        (options["change"] is not None and options["like"] is None, "--change requires --like."),
        (options["rig_parts"] and options["rig"] is None, "--rig-part requires --rig."),
        (corpus is None and split is not None, "--split requires --corpus."),
        (corpus and is_set_twice, "--corpus sets the sounds: no WAV, --seconds, --channel."),
        (
            not (has_sound or named) and seconds is None,
            "Give audio files, --corpus, or --seconds for an idle motion.",
        ),
        (sources and seconds is not None, "--seconds is for motion without audio, which sets it."),
    )
    for is_wrong, text in problems:
        if is_wrong:
            raise click.UsageError(text)


def _run(batch: Batch, begin: float, rate: float | None) -> int:
    """Do the work, print what comes of it, and return the exit code.

    Args:
        batch: the work.
        begin: time of the monotonic clock from which the speed is counted.
        rate: frames per second of the model; None if they do not matter.
    """
    from gesturekit.progress import time_in_words

    counts, samples = {"rendered": 0, "kept": 0, "failed": 0}, batch.processor.samples
    sound = 0.0

    def add(result: Result) -> str:
        """Print the files or the failure of a result, and return the speed so far."""
        nonlocal rate, sound
        for file in result.files:
            click.echo(click.format_filename(file))
        fps = result.facts.get("fps")
        if rate is not None and fps is not None and abs(fps - rate) > 0.01 * rate:
            text = f"Written at {fps:g} fps; the model's own rate is {rate:g} fps (--fps sets it)."
            click.echo(text, err=True)
            rate = None  # it is said once
        if result.error is not None:
            click.echo(f"Failed: {result.error}", err=True)
        done = "rendered" if result.files else "kept"
        counts["failed" if result.error is not None else done] += 1
        sound += result.sound
        factor = sound / max(time.monotonic() - begin, 1e-3)
        return f"{sound / 3600:.2f} h of sound, {factor:.1f}x real time"

    def summary() -> str:
        parts = [f"{n} {what}" for what, n in counts.items() if n or what == "rendered"]
        parts[0] += f" ({samples * counts['rendered']} motions)" if samples > 1 else ""
        return f"{', '.join(parts)} in {time_in_words(time.monotonic() - begin)}: {batch.out}"

    counts["failed"] = show(batch, "Rendering", add, summary)
    if len(batch.tasks) >= _MANY and counts["rendered"]:
        _write_page(batch)
    if "face" in batch.processor.settings:
        from gesturekit.jobs.records import all_records
        from gesturekit.rendering.summary import faces_in_words

        if faces := faces_in_words(all_records(batch.state)):
            click.echo(faces, err=True)
    click.echo(summary(), err=True)
    return 1 if counts["failed"] else 0


def _warn_of_speakers(speakers: Collection[str], given: str | None, tasks: Sequence[Task]) -> None:
    """Print whose gestures a model of several speakers makes if none of them is chosen."""
    from gesturekit.wording import listed

    items = (task.more.get("item") for task in tasks)
    own = (task.more.get("speaker", item and item.speaker) for task, item in zip(tasks, items))
    if len(speakers) < 2 or given in speakers or all(name in speakers for name in own):
        return
    text = f"the model has {len(speakers)} speakers, and gestures are those of all of them"
    click.echo(f"Warning: {text}: --speaker ({listed(sorted(speakers))})", err=True)


def _write_page(batch: Batch) -> None:
    """Write the summary page of the folder, and print where it is."""
    from gesturekit.jobs.records import status_of
    from gesturekit.rendering.summary import PAGE, write_summary

    page = batch.state / PAGE
    try:
        write_summary(batch.out, status_of(batch.out), page)
    except OSError as error:  # a full disk, which the page is not worth failing for
        click.echo(f"Warning: {page}: not written ({error.strerror})", err=True)
        return
    click.echo(f"Summary page: {page}", err=True)


_WRITTEN = ("existing", "unit", "up", "body", "framing", "size")


def _output(options: dict[str, Any]) -> Output:
    """Pop the options of the output from all options."""
    from gesturekit.formats.smpl import Rig
    from gesturekit.motion.parts import parse_parts
    from gesturekit.rendering.renderer import Output

    rig, parts = options.pop("rig"), options.pop("rig_parts")
    return Output(
        formats=options.pop("formats"),
        rig=None if rig is None else Rig.load(rig, parse_parts(parts)),
        **{name: options.pop(name) for name in _WRITTEN},
    )


def chosen_controls(options: dict[str, Any], open_model: Callable[[str], Model]) -> dict[str, Any]:
    """Return the arguments of `generate` from the options that were given."""
    experts, unconditional = options.pop("experts"), options.pop("unconditional")
    return given(
        **options,
        experts=[parse_expert(text, open_model) for text in experts] or None,
        unconditional=None if unconditional is None else open_model(unconditional),
    )
