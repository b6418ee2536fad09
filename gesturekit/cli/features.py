"""gesturekit features: turn sound files into feature files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from audio_features.kinds import KINDS
from gesturekit.cli.batch import GROUPS as BATCH_GROUPS
from gesturekit.cli.batch import batch_options, pop_execution, print_preview, show
from gesturekit.cli.options import (
    PATH,
    RATE,
    GroupedCommand,
    channel_option,
    comma_separated,
    device_option,
    existing_option,
    given,
    output_folder_option,
    weights_option,
)
from gesturekit.wording import counted

if TYPE_CHECKING:
    from audio_features import Extractor
    from gesturekit.jobs.result import Result

EXAMPLES = """\
gesturekit features speech/*.wav --extractor mfcc:20,prosody --out features
gesturekit features speech/ --out features --workers 4    # all sounds below it
"""
GROUPS = {
    "What to extract": ("extractor", "rate", "fps", "align", "channel"),
    "Output": ("out", "picture", "existing"),
    **BATCH_GROUPS,
    "Networks": (*("weights", "layer", "dtype", "full_context", "device"),),
}

_APPLY_TO = {
    "weights": ("wavlm", "hf", "files"),
    "rate": ("files",),
    **dict.fromkeys(("layer", "full_context"), ("wavlm", "hf")),
    "dtype": ("wavlm",),
}
"""Extractors that each option applies to, of options that are not for all."""


@click.command("features", cls=GroupedCommand, groups=GROUPS, epilog=EXAMPLES)
@click.argument("wavs", nargs=-1, required=True, type=PATH, metavar="WAV...")
@click.option(
    "--extractor",
    default="logmel,prosody",
    metavar="LIST",
    help=f"One or more of {', '.join(KINDS)}, or installed ones, which are concatenated. A size "
    "or folder may follow: mfcc:16, music:1, hf:hubert-base/, files:64.",
)
@click.option("--rate", type=float, help="Rows per second of npy files of own features (files).")
@output_folder_option
@click.option("--fps", type=RATE, help="Resample to motion frames.  [default: the features' rate]")
@click.option(
    "--align",
    type=click.Choice(["linear", "mean", "gaussian"]),
    help="Resampling: interpolated, mean over a motion frame, or a wider mean.  [default: linear]",
)
@channel_option
@weights_option
@click.option(
    "--layer", help="Layer of wavlm or hf: 6, last, mean, 6,9,12 or 6:1,9:3.  [default: last]"
)
@click.option(
    "--dtype", type=click.Choice(["fp32", "bf16"]), help="Precision of wavlm.  [default: fp32]"
)
@click.option(
    "--full-context",
    type=click.FloatRange(min=0),
    metavar="SECONDS",
    help="Longest sound that is not split.  [default: 300; 30 for hf]",
)
@device_option
@click.option("--cache/--no-cache", default=True, help="Keep slow features: gesturekit cache.")
@click.option("--picture", is_flag=True, help="Also draw the features to NAME.png.")
@batch_options
@existing_option("refuse")
@click.pass_context
def command(
    ctx: click.Context, wavs: tuple[Path, ...], extractor: str, out: Path, **options: Any
) -> None:
    """Extract speech features from sound files.

    Writes NAME.npz (values, times, spec) to the output folder for every WAV; flac, ogg, mp3, aiff,
    au and SPHERE are read too. WAV may also be a folder, a glob in quotes, or a list, as in
    gesturekit render. A broken file is listed with its
    reason, and the others are still processed. To continue an interrupted run, repeat the command:
    finished files are kept.
    """
    import logging

    from gesturekit.jobs.batch import Batch
    from gesturekit.rendering.features import FeatureExtraction
    from gesturekit.rendering.inputs import find_tasks

    logging.basicConfig(format="Warning: %(message)s")
    if options["align"] is not None and options["fps"] is None:
        raise click.UsageError("--align requires --fps")
    execution, is_dry = pop_execution(ctx, out, options)
    names = ("fps", "align", "picture", "channel", "cache", "existing")
    settings = {name: options.pop(name) for name in names}
    extraction = FeatureExtraction(_extractor(extractor, options), out, **settings)
    batch = Batch(extraction, find_tasks(wavs, out), execution)
    if is_dry:
        print_preview(batch)
        return
    ctx.exit(1 if show(batch, "Features", _print) else 0)


def _print(result: Result) -> None:
    """Print the files of one sound, or why there are none."""
    if result.error is not None:
        click.echo(f"Error: {result.error}", err=True)
    elif result.files:
        n_frames, width = result.facts["shape"]
        name = click.format_filename(result.files[0])
        click.echo(f"{name}: {counted(n_frames, 'frame')} × {width}")
    else:
        source = click.format_filename(result.source)
        click.echo(f"{source}: skipped, its outputs exist")


def _extractor(kinds: str, options: dict[str, Any]) -> Extractor:
    """Return the extractor of --extractor and its options; print the weights that it uses."""
    from audio_features import extractor_from_spec
    from audio_features.kinds import installed_kinds

    weights, device = options.pop("weights"), options.pop("device")
    chosen = given(**options)
    if "layer" in chosen:
        chosen["layer"] = _layer(chosen["layer"])

    specs = []
    for item in comma_separated(kinds):
        kind, _, value = item.partition(":")
        kinds_here = [*KINDS, *installed_kinds()]
        if kind not in kinds_here or (value and (kind not in KINDS or not KINDS[kind].argument)):
            raise click.UsageError(f"--extractor {item!r}: one or more of {', '.join(kinds_here)}")
        argument = {KINDS[kind].argument or "": _number(value)} if value else {}
        own = {name: chosen[name] for name in chosen if kind in _APPLY_TO.get(name, ())}
        specs.append({"kind": kind, **argument, **own})
    named = {spec["kind"] for spec in specs}
    for name in [*(["weights"] if weights is not None else []), *chosen]:
        if named.isdisjoint(_APPLY_TO[name]):
            option, network = name.replace("_", "-"), " or ".join(_APPLY_TO[name])
            raise click.UsageError(f"--{option} requires --extractor {network}")
    spec = specs[0] if len(specs) == 1 else {"kind": "stack", "parts": specs}
    extractor = extractor_from_spec(spec, weights=weights, device=device)
    for part in getattr(extractor, "parts", (extractor,)):
        if hasattr(part, "weights"):
            click.echo(part.weights.describe())
    return extractor


def _layer(text: str) -> Any:
    """Parse a layer: 6 to 6; 6,9 to [6, 9]; 6:1,9:3 to {6: 1, 9: 3}; last to last."""
    items = text.split(",")
    try:
        if ":" in text:
            pairs = [item.split(":") for item in items]
            return {int(layer): float(weight) for layer, weight in pairs}
        layers = [_number(item) for item in items]
    except ValueError as error:
        raise click.UsageError(f"--layer {text!r}: 6, 6,9, last, mean or 6:1,9:3") from error
    return layers[0] if len(layers) == 1 else layers


def _number(text: str) -> Any:
    """Return the text as a number if it is one."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
