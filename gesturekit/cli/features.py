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
    "--weights", type=click.Path(path_type=Path), help="Local folder of the WavLM weights."
)
@click.option(
    "--layer", default="last", show_default=True, help="WavLM layer: a number from 0, or last."
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
    extract = _extractor(extractor, weights, layer).extract

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


def _extractor(kinds: str, weights: Path | None, layer: str) -> Extractor:
    """The extractor that the command line names."""
    from audio_features import extractor_from_spec

    specs = []
    for kind in filter(None, map(str.strip, kinds.split(","))):
        if kind not in KINDS:
            raise click.UsageError(f"--extractor {kind!r}: one or more of {', '.join(KINDS)}")
        specs.append({"kind": kind})
        if kind == "wavlm":
            specs[-1]["layer"] = int(layer) if layer.isdecimal() else layer
    spec = specs[0] if len(specs) == 1 else {"kind": "stack", "parts": specs}
    return extractor_from_spec(spec, weights=weights)
