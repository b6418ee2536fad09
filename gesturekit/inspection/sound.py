"""Summaries of sound files, and of files of speech features."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import soundfile

import audio_features as af
from audio_features.files import open_npy
from audio_features.wave import soundfile_name
from gesturekit.formats.sources import is_feature_file, visible_folders
from gesturekit.inspection.summary import Summary, size, span
from gesturekit.wording import counted, listed

_BLOCK = 1 << 20
"""Values that are read or checked at a time."""
_FULL_SCALE = 0.999
"""Fraction of full scale from which a sample counts as clipped."""
_UNLIMITED_DBFS = 6.0
"""Peak above which a floating-point file was not clipped at full scale."""
_CLIPPED_SHARE = 1e-5
"""Fraction of clipped samples above which clipping is reported as a problem."""
_QUIET_DBFS, _SILENT_DBFS = -45.0, -75.0
_NOTHING = 1e-10
"""Added to levels, so that those of silence are -200 dBFS."""
_SHOWN = 12


def inspect_audio(path: Path) -> Summary:
    """Summarise a sound file.

    Raises:
        AudioError: it cannot be read as sound at all.
    """
    try:
        wave = af.Wave.load(path)
        voice, problems = _voice(wave), list(wave.repairs)
    except af.AudioError as error:
        voice, problems = {}, [str(error)]
    try:
        with soundfile.SoundFile(soundfile_name(path)) as file:
            form, rate, channels = f"{file.format} {file.subtype}", file.samplerate, file.channels
            levels = _levels(file)
    except (soundfile.LibsndfileError, OSError, TypeError, UnicodeError, MemoryError):
        raise af.AudioError(problems[0] if problems else f"{path}: cannot be read") from None
    n_bytes = path.stat().st_size
    facts = {"path": str(path), "bytes": n_bytes, "format": form, "sample_rate": rate}
    facts |= {"channels": channels, "seconds": levels["frames"] / rate, **levels, **voice}
    time = f"{span(facts['seconds'])}: {counted(facts['frames'], 'sample')} at {rate} Hz"
    level = f"peak {_each(facts['peak_dbfs'])} dBFS, RMS {_each(facts['rms_dbfs'])} dBFS"
    silence = ""
    if share := 100 * voice.get("active_share", 0):
        level += f", speech {voice['active_level_dbfs']:.1f} dBFS"
        silence = f"{share:.0f} % of the time, silence {100 - share:.0f} %"
    mono = "mono" if channels == 1 else f"{channels}; models use their mean"
    rows = {"time": time, "channels": mono, "level": level, "speech": silence}
    title = f"{path}: sound, {form}, {size(n_bytes)}"
    return Summary("audio", title, facts, rows, [*problems, *_doubts(facts)])


def _levels(file: soundfile.SoundFile) -> dict[str, Any]:
    """Return the number of frames, and levels of each channel."""
    n, frames = file.channels, 0
    peak, square, clipped = np.zeros(n), np.zeros(n), 0
    while len(block := file.read(_BLOCK // n, always_2d=True)):
        sizes = np.abs(np.where(np.isfinite(block), block, 0.0))
        frames += len(block)
        peak = np.maximum(peak, sizes.max(axis=0))
        square += np.square(sizes).sum(axis=0)
        clipped += int((sizes >= _FULL_SCALE).sum())
    levels = {"peak_dbfs": peak, "rms_dbfs": np.sqrt(square / max(frames, 1))}
    decibels = {name: (20 * np.log10(x + _NOTHING)).tolist() for name, x in levels.items()}
    return {"frames": frames, "clipped": clipped} | decibels


def _voice(wave: af.Wave) -> dict[str, Any]:
    speech = af.speech_only(wave)
    return {
        "active_level_dbfs": speech.active_level(),
        "is_silent": wave.is_silent,
        "has_voice": not speech.is_silent,
        "active_share": float(speech.active().mean()),
    }


def _doubts(facts: dict[str, Any]) -> Iterator[str]:
    if facts.get("is_silent"):
        yield f"silence: no speech above {_SILENT_DBFS:.0f} dBFS"
    elif not facts.get("has_voice", True):
        yield "no voice (noise, hum or whispering): models of speech generate idle motion"
    elif facts.get("active_level_dbfs", 0.0) < _QUIET_DBFS:
        yield f"quiet: speech is at {facts['active_level_dbfs']:.0f} dBFS"
    is_limited = max(facts["peak_dbfs"]) <= _UNLIMITED_DBFS
    if is_limited and facts["clipped"] > _CLIPPED_SHARE * facts["frames"]:
        yield f"clipped: {counted(facts['clipped'], 'sample')} at full scale"
    silent = [str(k) for k, peak in enumerate(facts["peak_dbfs"], 1) if peak < _SILENT_DBFS]
    if silent and len(silent) < facts["channels"]:
        yield f"channel {', '.join(silent)} is silent: the mean loses 6 dB or more"


def _each(values: list[float]) -> str:
    """Format the values of all channels; one value if they agree."""
    return " / ".join(dict.fromkeys(f"{value:.1f}" for value in values))


def feature_files(folder: Path) -> Iterator[Path]:
    """Yield the npz files of speech features below a folder."""
    every = (path for _, _, files in visible_folders(folder) for path in files)
    yield from (path for path in every if path.suffix.lower() == ".npz" and is_feature_file(path))


def inspect_features(path: Path) -> Summary:
    """Summarise a feature file, or a folder of them, of which the first is read.

    Raises:
        FeatureError: it cannot be read.
    """
    if path.suffix.lower() == ".npy":
        return _inspect_array(path)
    files = list(feature_files(path)) if path.is_dir() else [path]
    track = af.FeatureTrack.load(files[0])
    (n_frames, n_columns), times, values = track.values.shape, track.times, track.values
    rate = 1 / float(np.median(np.diff(times))) if n_frames > 1 else None
    names, spread = list(track.names), values.std(axis=0)
    facts = {"path": str(path), "files": list(map(str, files)), "frames": n_frames, "rate": rate}
    facts |= {"names": names, "spec": track.spec, "sd": spread.tolist()}
    time = f"{span(times[-1] - times[0])}: {counted(n_frames, 'frame')}"
    time += f" at {rate:.6g} a second" if rate else ""
    rows = {
        "files": listed(list(map(str, files)), _SHOWN) if path.is_dir() else "",
        "time": time,
        "columns": f"{n_columns}: {listed(names, _SHOWN)}",
        "values": f"{values.min():.4g} to {values.max():.4g}",
        "made by": json.dumps(track.spec, ensure_ascii=False) if track.spec else "unknown",
    }
    still = [name for name, sd in zip(names, spread) if sd == 0] if n_frames > 1 else []
    problems = [f"never change: {listed(still, _SHOWN)}"] if still else []
    title = f"{path}: features of {counted(len(files), 'sound')}"
    return Summary("features", title, facts, rows, problems)


def _inspect_array(path: Path) -> Summary:
    """Summarise an npy file of own features, which stays on disk."""
    try:
        values = open_npy(path)
    except af.FeatureError as error:
        raise af.FeatureError(f"{path}: {error}") from None
    facts: dict[str, Any] = {"path": str(path), "dtype": str(values.dtype)}
    facts["shape"] = list(values.shape)
    rows = {"shape": f"{values.shape}, {values.dtype}"}
    if values.ndim == 2:
        dim = values.shape[1]
        rows["train with"] = f"{{kind: files, dim: {dim}, suffix: .npy, rate: ROWS PER SECOND}}"
    problems = [] if values.size else ["no values"]
    if values.dtype.kind in "fiub":
        flat = values.ravel(order="K")
        blocks = [flat[start : start + _BLOCK] for start in range(0, flat.size, _BLOCK)]
        counts = {"NaN": sum(int(np.isnan(block).sum()) for block in blocks)}
        counts["infinite"] = sum(int(np.isinf(block).sum()) for block in blocks)
        facts |= {name.lower(): n for name, n in counts.items()}
        problems += [f"{n} of {flat.size} values are {name}" for name, n in counts.items() if n]
    else:
        problems.append(f"{values.dtype} is no number: save plain numbers")
    title = f"{path}: an array without times, {size(path.stat().st_size)}"
    return Summary("features", title, facts, rows, problems)
