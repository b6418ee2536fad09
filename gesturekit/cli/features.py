"""gesturekit features: sound files to feature files."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from audio_features import Extractor

KINDS = ("logmel", "mfcc", "prosody", "liveliness", "wavlm")


@click.command(
    epilog="Example: gesturekit features speech/*.wav --extractor logmel,prosody --out features"
)
@click.argument("wavs", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="WAV...")
@click.option(
    "--extractor",
    default="logmel,prosody",
    show_default=True,
    metavar="LIST",
    help=f"One or more of {', '.join(KINDS)}, separated by commas; stacked side by side.",
)
@click.option(
    "--out", required=True, type=click.Path(path_type=Path, file_okay=False), help="Output folder."
)
@click.option(
    "--weights",
    type=click.Path(path_type=Path),
    help="WavLM weights: Hugging Face's folder, Microsoft's .pt or a torchaudio state dict.",
)
@click.option(
    "--layer",
    default="last",
    show_default=True,
    help="WavLM layer: a number from 0, last, mean, several side by side (6,9,12) or their "
    "weighted mean (6:1,9:3).",
)
@click.option(
    "--preset",
    type=click.Choice(["dsg", "dsg+"]),
    help="WavLM as DiffuseStyleGesture makes it, quirks included; leave --layer out.",
)
@click.option(
    "--dtype",
    type=click.Choice(["fp32", "bf16"]),
    default="fp32",
    show_default=True,
    help="WavLM's arithmetic; bf16 is faster where the processor has it, and less exact.",
)
@click.option(
    "--full-context",
    type=click.FloatRange(min=0),
    metavar="SECONDS",
    help="Longest sound that WavLM sees whole; longer ones go in chunks.  [default: 300]",
)
@click.option(
    "--fps",
    type=click.FloatRange(min=0, min_open=True, max=1000),
    help="Put the features on motion frames at this rate.  [default: the features' own rate]",
)
def command(
    wavs: tuple[Path, ...],
    extractor: str,
    out: Path,
    weights: Path | None,
    layer: str,
    preset: str | None,
    dtype: str,
    full_context: float | None,
    fps: float | None,
) -> int:
    """Turn sound files into feature files.

    Writes STEM.npz (values, times, spec) to the output folder for every WAV; any format that
    libsndfile reads will do. A file that fails is reported and the others go on.
    """
    from audio_features import AudioFeaturesError, Wave

    stems = Counter(wav.stem for wav in wavs)
    doubles = [str(wav) for wav in wavs if stems[wav.stem] > 1]
    if doubles:
        raise click.UsageError(f"{', '.join(doubles)} would be written to the same file: rename")
    wavlm = {"layer": _layer(layer), "preset": preset, "dtype": dtype, "full_context": full_context}
    made = _extractor(extractor, weights, wavlm)
    for part in getattr(made, "parts", (made,)):
        if hasattr(part, "weights"):
            click.echo(part.weights.describe())
    extract = made.extract

    failed = 0
    for wav in wavs:
        target = out / f"{wav.stem}.npz"
        try:
            wave = Wave.load(wav)
            if wave.is_silent:
                click.echo(f"Warning: {wav}: no speech above -75 dBFS", err=True)
            track = extract(wave)
            if fps is not None:
                track = track.to_rate(fps, n_frames=wave.n_frames(fps))
            track.save(target)
        except (AudioFeaturesError, OSError) as error:
            failed += 1
            reason = f"{target}: {error.strerror}" if isinstance(error, OSError) else error
            click.echo(f"Error: {reason}", err=True)
        else:
            click.echo(f"{target}: {track.values.shape[0]} frames × {track.values.shape[1]}")
    if failed:
        click.echo(f"{failed} of {len(wavs)} files failed.", err=True)
    return 1 if failed else 0


def _layer(text: str) -> int | str | list | dict:
    """6, last, mean, 6,9,12 or 6:1,9:3; what is none of these is left to the extractor."""
    parts = [part.strip() for part in text.split(",")]
    if all(part.isdecimal() for part in parts):
        numbers = [int(part) for part in parts]
        return numbers if len(numbers) > 1 else numbers[0]
    if ":" in text:
        return {layer: weight for layer, _, weight in (part.partition(":") for part in parts)}
    return text


def _extractor(kinds: str, weights: Path | None, wavlm: dict) -> Extractor:
    """The extractor that the command line names."""
    from audio_features import extractor_from_spec

    specs = []
    for kind in filter(None, map(str.strip, kinds.split(","))):
        if kind not in KINDS:
            raise click.UsageError(f"--extractor {kind!r}: one or more of {', '.join(KINDS)}")
        specs.append({"kind": kind})
        if kind == "wavlm":
            specs[-1] |= {key: value for key, value in wavlm.items() if value is not None}
    spec = specs[0] if len(specs) == 1 else {"kind": "stack", "parts": specs}
    return extractor_from_spec(spec, weights=weights)
