"""gesturekit features: turn sound files into feature files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from audio_features.kinds import KINDS
from gesturekit.cli.batch import GROUPS as BATCH_GROUPS
from gesturekit.cli.batch import batch_options, pop_execution, print_preview, show_and_count
from gesturekit.cli.options import (
    GroupedCommand,
    channel_option,
    existing_option,
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
    "Output": ("out", "picture", "existing", "skip_existing"),
    **BATCH_GROUPS,
    "Networks": (*("weights", "layer", "preset", "dtype", "full_context", "device"),),
}

_APPLY_TO = {
    "weights": ("wavlm", "hf", "files"),
    "rate": ("files",),
    **dict.fromkeys(("layer", "full_context"), ("wavlm", "hf")),
    **dict.fromkeys(("preset", "dtype"), ("wavlm",)),
}
"""Extractors that each option applies to, of options that are not for all."""


@click.command("features", cls=GroupedCommand, groups=GROUPS, epilog=EXAMPLES)
@click.argument("wavs", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="WAV...")
@click.option(
    "--extractor",
    default="logmel,prosody",
    show_default=True,
    metavar="LIST",
    help=f"One or more of {', '.join(KINDS)}, separated by commas and concatenated. A size, "
    "method or folder may follow a colon: logmel:64, mfcc:16, prosody:pyin, music:1, "
    "hf:hubert-base/, words:bert-base/; for files, the number of columns: files:64. Or the kind of "
    "an installed extractor.",
)
@click.option(
    "--rate",
    type=float,
    help="Rows per second of the npy files of own features (files); without it they are npz files.",
)
@output_folder_option
@click.option(
    "--fps",
    type=click.FloatRange(min=0, min_open=True, max=1000),
    help="Resample the features to motion frames at this rate.  [default: the features' own rate]",
)
@click.option(
    "--align",
    type=click.Choice(["linear", "mean", "gaussian", "length_ratio"]),
    help="Method of resampling: linear interpolation, mean over the motion frame, a wider "
    "Gaussian mean, or by the ratio of the lengths, as in systems that ignore frame times.  "
    "[default: linear]",
)
@channel_option
@weights_option
@click.option(
    "--layer",
    help="Layer of WavLM or hf: a number from 0, last, mean, several concatenated (6,9,12) or "
    "their weighted mean (6:1,9:3).  [default: last]",
)
@click.option(
    "--preset",
    type=click.Choice(["dsg", "dsg+"]),
    help="Extract WavLM features exactly as in DiffuseStyleGesture; cannot be combined with "
    "--layer.",
)
@click.option(
    "--dtype",
    type=click.Choice(["fp32", "bf16"]),
    help="Precision of WavLM; bf16 is faster on processors that support it, and less exact.  "
    "[default: fp32]",
)
@click.option(
    "--full-context",
    type=click.FloatRange(min=0),
    metavar="SECONDS",
    help="Longest sound that WavLM or hf processes without splitting it.  [default: 300; 30 for "
    "hf]",
)
@click.option("--device", default="cpu", show_default=True, help="Device of WavLM and hf.")
@click.option(
    "--cache",
    type=click.Choice(["fp32", "fp16", "off"]),
    default="fp32",
    show_default=True,
    help="Precision of cached features; see gesturekit cache.",
)
@click.option("--picture", is_flag=True, help="Also draw the features to NAME.png.")
@batch_options
@existing_option("refuse", alias=True)
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
    cache = options.pop("cache")
    names = ("fps", "align", "picture", "channel", "existing")
    settings = {name: options.pop(name) for name in names}
    extraction = FeatureExtraction(
        _extractor(extractor, options), out, cache=None if cache == "off" else cache, **settings
    )
    batch = Batch(extraction, find_tasks(wavs, out), execution)
    if is_dry:
        print_preview(batch)
        return
    ctx.exit(show_and_count(batch, "Features", _print))


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
    given = {name: value for name, value in options.items() if value is not None}
    if "layer" in given:
        given["layer"] = _layer(given["layer"])

    specs = []
    for item in filter(None, map(str.strip, kinds.split(","))):
        kind, _, value = item.partition(":")
        kinds_here = [*KINDS, *installed_kinds()]
        if kind not in kinds_here or (value and (kind not in KINDS or not KINDS[kind].argument)):
            raise click.UsageError(f"--extractor {item!r}: one or more of {', '.join(kinds_here)}")
        argument = {KINDS[kind].argument or "": _number(value)} if value else {}
        own = {name: given[name] for name in given if kind in _APPLY_TO.get(name, ())}
        specs.append({"kind": kind, **argument, **own})
    named = {spec["kind"] for spec in specs}
    for name in [*(["weights"] if weights is not None else []), *given]:
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
