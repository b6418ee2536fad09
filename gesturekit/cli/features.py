"""gesturekit features: turn sound files into feature files."""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from gesturekit.cli.options import (
    channel_option,
    existing_option,
    is_left,
    resumable,
    weights_option,
)
from gesturekit.wording import counted

if TYPE_CHECKING:
    from audio_features import Extractor, FeatureTrack, Wave

# Extractors, and the setting that may follow each after a colon, as in mfcc:16.
KINDS = {
    "logmel": "n_mels",
    "mfcc": "n",
    "prosody": "f0",
    "onset": None,
    "liveliness": "seconds",
    "effort": "seconds",
    "music": "n_chroma",
    "words": "encoder",
    "wavlm": None,
    "hf": "path",
}
_NETWORKS = {
    **dict.fromkeys(("weights", "layer", "full_context"), ("wavlm", "hf")),
    **dict.fromkeys(("preset", "dtype", "implementation"), ("wavlm",)),
}
"""Extractors that each option of networks applies to."""


@click.command(
    epilog="Example: gesturekit features speech/*.wav --extractor mfcc:20,prosody --out features"
)
@click.argument("wavs", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="WAV...")
@click.option(
    "--extractor",
    default="logmel,prosody",
    show_default=True,
    metavar="LIST",
    help=f"One or more of {', '.join(KINDS)}, separated by commas and concatenated. A "
    "colon gives a size, method or folder: logmel:64, mfcc:16, prosody:pyin, music:1, "
    "hf:hubert-base/, words:bert-base/.",
)
@click.option(
    "--out", required=True, type=click.Path(path_type=Path, file_okay=False), help="Output folder."
)
@click.option(
    "--fps",
    type=click.FloatRange(min=0, min_open=True, max=1000),
    help="Resample the features to motion frames at this rate.  [default: the features' own rate]",
)
@click.option(
    "--align",
    type=click.Choice(["linear", "mean", "gaussian", "length_ratio"]),
    help="Method of resampling: linear interpolation, mean over the motion frame, a wider gaussian "
    "mean, or by the ratio of lengths, as in systems that ignore frame times.  [default: linear]",
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
    help="WavLM features exactly as in DiffuseStyleGesture; leave --layer out.",
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
    help="Longest sound that WavLM or hf processes whole; longer ones are split.  [default: 300, "
    "of hf 30]",
)
@click.option(
    "--implementation",
    type=click.Choice(["fast", "transformers"]),
    help="Implementation of WavLM: ours, or transformers' own.  [default: fast]",
)
@click.option("--device", default="cpu", show_default=True, help="Device of WavLM and hf.")
@click.option(
    "--cache",
    type=click.Choice(["fp32", "fp16", "off"]),
    default="fp32",
    show_default=True,
    help="Precision of cached features; see gesturekit cache.",
)
@click.option("--picture", is_flag=True, help="Draw STEM.png as well.")
@existing_option("refuse", alias=True)
def command(
    wavs: tuple[Path, ...],
    extractor: str,
    out: Path,
    channel: int | None,
    cache: str,
    existing: str,
    **options: Any,
) -> int:
    """Turn sound files into feature files.

    Writes STEM.npz (values, times, spec) to the output folder for every WAV; flac, ogg, mp3,
    aiff, au and SPHERE are read too. A broken file never stops the others: it is listed with its
    reason.
    """
    import logging

    from audio_features import AudioFeaturesError, Wave, cache_from_environment
    from gesturekit.progress import Progress

    logging.basicConfig(level=logging.WARNING, format="Warning: %(message)s")
    output = _Output(*(options.pop(name) for name in ("fps", "align", "picture")))
    _check(wavs, output)
    chosen = _extractor(extractor, options)
    extract = chosen.extract
    if cache != "off":
        extract = partial(cache_from_environment(cache).extract, chosen)
    files = {wav: [out / f"{wav.stem}.{kind}" for kind in output.formats] for wav in wavs}
    if existing == "refuse":
        is_left([file for targets in files.values() for file in targets], existing)
    failed = 0
    progress = Progress(files, desc="Features", unit="file")
    with resumable(lambda: f"{progress.n} done; with --existing skip the same command continues."):
        for wav in progress:
            target = files[wav][0]
            if existing == "skip" and all(file.exists() for file in files[wav]):
                Progress.write(f"{wav}: left as it is, the outputs exist")
                continue
            try:
                wave = Wave.load(wav, channel=channel)
                for fault in wave.faults():
                    Progress.write(f"Warning: {wav}: {fault}", file=sys.stderr)
                n_frames, width = output.save(extract(wave), wave, target)
            except (AudioFeaturesError, OSError) as error:
                failed += 1
                reason = f"{target}: {error.strerror}" if isinstance(error, OSError) else error
                Progress.write(f"Error: {reason}", file=sys.stderr)
            else:
                Progress.write(f"{target}: {counted(n_frames, 'frame')} × {width}")
    if failed:
        click.echo(f"{failed} of {len(wavs)} files failed.", err=True)
    return 1 if failed else 0


@dataclass(frozen=True)
class _Output:
    """Settings of the written files.

    Attributes:
        fps: frames per second to resample to; None for the features' own rate.
        align: method of resampling; None for linear.
        picture: whether to draw a PNG as well.
    """

    fps: float | None
    align: str | None
    picture: bool

    @property
    def formats(self) -> tuple[str, ...]:
        return ("npz", "png") if self.picture else ("npz",)

    def save(self, track: FeatureTrack, wave: Wave, target: Path) -> tuple[int, int]:
        """Write one feature file and its picture, and return the shape of its values."""
        if self.fps is not None:
            n_frames = wave.n_frames(self.fps)
            track = track.to_rate(self.fps, n_frames, method=self.align or "linear")
        track.save(target)
        if self.picture:
            from gesturekit.viewer.feature_picture import draw_features

            draw_features(track, target.with_suffix(".png"), wave)
        return track.values.shape


def _check(wavs: tuple[Path, ...], output: _Output) -> None:
    """Check the inputs and options.

    Raises:
        click.UsageError: two inputs with the same output file, or --align without --fps.
    """
    stems = Counter(wav.stem for wav in wavs)
    doubles = [str(wav) for wav in wavs if stems[wav.stem] > 1]
    if doubles:
        raise click.UsageError(f"{', '.join(doubles)} would be written to the same file: rename")
    if output.align is not None and output.fps is None:
        raise click.UsageError("--align resamples features to motion frames: give --fps as well")


def _extractor(kinds: str, options: dict[str, Any]) -> Extractor:
    """Return the extractor of --extractor and its options; print the weights that it uses."""
    from audio_features import extractor_from_spec

    weights, device = options.pop("weights"), options.pop("device")
    given = {name: value for name, value in options.items() if value is not None}
    if "layer" in given:
        given["layer"] = _layer(given["layer"])

    specs = []
    for item in filter(None, map(str.strip, kinds.split(","))):
        kind, _, value = item.partition(":")
        if kind not in KINDS or (value and KINDS[kind] is None):
            raise click.UsageError(f"--extractor {item!r}: one or more of {', '.join(KINDS)}")
        specs.append({"kind": kind} | ({KINDS[kind]: _number(value)} if value else {}))
        specs[-1] |= {name: given[name] for name in given if kind in _NETWORKS.get(name, ())}
    kinds = {spec["kind"] for spec in specs}
    for name in [*(["weights"] if weights is not None else []), *given]:
        if kinds.isdisjoint(_NETWORKS[name]):
            option, network = name.replace("_", "-"), " or ".join(_NETWORKS[name])
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
