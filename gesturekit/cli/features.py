"""gesturekit features: sound files to feature files."""

from __future__ import annotations

from collections import Counter
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from gesturekit.cli.options import channel_option, existing_option, is_left, resumable

if TYPE_CHECKING:
    from audio_features import Extractor

# Kind to the setting that may follow it after a colon, as in mfcc:16.
KINDS = {
    "logmel": "n_mels",
    "mfcc": "n",
    "prosody": "f0",
    "onset": None,
    "liveliness": "seconds",
    "music": "n_chroma",
    "wavlm": None,
}


@click.command(
    epilog="Example: gesturekit features speech/*.wav --extractor mfcc:20,prosody --out features"
)
@click.argument("wavs", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="WAV...")
@click.option(
    "--extractor",
    default="logmel,prosody",
    show_default=True,
    metavar="LIST",
    help=f"One or more of {', '.join(KINDS)}, separated by commas and stacked side by side. A "
    "colon gives a size or method: logmel:64, mfcc:16, prosody:pyin, music:1.",
)
@click.option(
    "--out", required=True, type=click.Path(path_type=Path, file_okay=False), help="Output folder."
)
@click.option(
    "--fps",
    type=click.FloatRange(min=0, min_open=True, max=1000),
    help="Put the features on motion frames at this rate.  [default: the features' own rate]",
)
@click.option(
    "--align",
    type=click.Choice(["linear", "mean", "gaussian", "length_ratio"]),
    help="How they get there: by true time, interpolated, or averaged over the motion frame; "
    "gaussian averages more; length_ratio only reproduces systems that ignored time.  "
    "[default: linear]",
)
@channel_option
@click.option(
    "--weights",
    type=click.Path(path_type=Path),
    help="WavLM weights: Hugging Face's folder, Microsoft's .pt or a torchaudio state dict.",
)
@click.option(
    "--layer",
    help="WavLM layer: a number from 0, last, mean, several side by side (6,9,12) or their "
    "weighted mean (6:1,9:3).  [default: last]",
)
@click.option(
    "--preset",
    type=click.Choice(["dsg", "dsg+"]),
    help="WavLM as DiffuseStyleGesture makes it, quirks included; leave --layer out.",
)
@click.option(
    "--dtype",
    type=click.Choice(["fp32", "bf16"]),
    help="WavLM's arithmetic; bf16 is faster where the processor has it, and less exact.  "
    "[default: fp32]",
)
@click.option(
    "--full-context",
    type=click.FloatRange(min=0),
    metavar="SECONDS",
    help="Longest sound that WavLM sees whole; longer ones go in chunks.  [default: 300]",
)
@click.option("--device", default="cpu", show_default=True, help="Where WavLM computes.")
@click.option(
    "--cache",
    type=click.Choice(["fp32", "fp16", "off"]),
    default="fp32",
    show_default=True,
    help="How slow features are kept for next time; see gesturekit cache.",
)
@click.option("--picture", is_flag=True, help="Draw STEM.png as well.")
@existing_option("refuse", alias=True)
def command(
    wavs: tuple[Path, ...],
    extractor: str,
    out: Path,
    fps: float | None,
    align: str | None,
    channel: int | None,
    weights: Path | None,
    device: str,
    cache: str,
    picture: bool,
    existing: str,
    **wavlm: Any,
) -> int:
    """Turn sound files into feature files.

    Writes STEM.npz (values, times, spec) to the output folder for every WAV; flac, ogg, mp3,
    aiff, au and SPHERE will do too. A file that fails is reported and the others go on.
    """
    import logging
    import sys

    from audio_features import AudioFeaturesError, Wave, cache_from_environment
    from gesturekit.progress import Progress

    logging.basicConfig(level=logging.WARNING, format="Warning: %(message)s")
    stems = Counter(wav.stem for wav in wavs)
    doubles = [str(wav) for wav in wavs if stems[wav.stem] > 1]
    if doubles:
        raise click.UsageError(f"{', '.join(doubles)} would be written to the same file: rename")
    if align is not None and fps is None:
        raise click.UsageError("--align puts features on motion frames: give --fps as well")
    if wavlm["layer"] is not None:
        wavlm["layer"] = _layer(wavlm["layer"])
    chosen = _extractor(extractor, weights, device, wavlm)
    for part in getattr(chosen, "parts", (chosen,)):
        if hasattr(part, "weights"):
            click.echo(part.weights.describe())
    extract = chosen.extract
    if cache != "off":
        extract = partial(cache_from_environment(cache).extract, chosen)

    def outputs(wav: Path) -> list[Path]:
        return [out / f"{wav.stem}.{kind}" for kind in ("npz", "png")[: 1 + picture]]

    if existing == "refuse":
        is_left([file for wav in wavs for file in outputs(wav)], existing)
    failed = 0
    progress = Progress(wavs, desc="Features", unit="file")
    with resumable(lambda: f"{progress.n} done; with --existing skip the same command goes on."):
        for wav in progress:
            if existing == "skip" and all(file.exists() for file in outputs(wav)):
                Progress.write(f"{wav}: left as it is, the outputs exist")
                continue
            target = out / f"{wav.stem}.npz"
            try:
                wave = Wave.load(wav, channel=channel)
                for fault in wave.faults():
                    Progress.write(f"Warning: {wav}: {fault}", file=sys.stderr)
                track = extract(wave)
                if fps is not None:
                    track = track.to_rate(fps, wave.n_frames(fps), method=align or "linear")
                track.save(target)
                if picture:
                    from gesturekit.viewer.feature_picture import draw_features

                    draw_features(track, target.with_suffix(".png"), wave)
            except (AudioFeaturesError, OSError) as error:
                failed += 1
                reason = f"{target}: {error.strerror}" if isinstance(error, OSError) else error
                Progress.write(f"Error: {reason}", file=sys.stderr)
            else:
                n_frames, width = track.values.shape
                Progress.write(f"{target}: {n_frames} frames × {width}")
    if failed:
        click.echo(f"{failed} of {len(wavs)} files failed.", err=True)
    return 1 if failed else 0


def _extractor(kinds: str, weights: Path | None, device: str, wavlm: dict[str, Any]) -> Extractor:
    """The extractor that the command line names."""
    from audio_features import extractor_from_spec

    specs = []
    for item in filter(None, map(str.strip, kinds.split(","))):
        kind, _, value = item.partition(":")
        if kind not in KINDS or (value and KINDS[kind] is None):
            raise click.UsageError(f"--extractor {item!r}: one or more of {', '.join(KINDS)}")
        specs.append({"kind": kind} | ({KINDS[kind]: _number(value)} if value else {}))
        if kind == "wavlm":
            specs[-1] |= {key: value for key, value in wavlm.items() if value is not None}
    given = [name for name, value in {"weights": weights, **wavlm}.items() if value is not None]
    if given and all(spec["kind"] != "wavlm" for spec in specs):
        option = given[0].replace("_", "-")
        raise click.UsageError(f"--{option} is about WavLM: name it, as in --extractor wavlm")
    spec = specs[0] if len(specs) == 1 else {"kind": "stack", "parts": specs}
    return extractor_from_spec(spec, weights=weights, device=device)


def _layer(text: str) -> Any:
    """6 to 6, 6,9 to [6, 9], 6:1,9:3 to {6: 1, 9: 3}, last to last."""
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
    """A number where the text is one."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
