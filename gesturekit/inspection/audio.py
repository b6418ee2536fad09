"""Summary of a sound file: format, level, amount of speech, problems."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import soundfile

import audio_features as af
from audio_features.sound_file import soundfile_name
from gesturekit.inspection.summary import Summary, size, span
from gesturekit.wording import counted

_BLOCK = 1 << 20
_FULL_SCALE = 0.999
"""Fraction of full scale from which a sample counts as clipped."""
_UNLIMITED_DBFS = 6.0
"""Peak above which a floating-point file was not clipped at full scale."""
_CLIPPED_SHARE = 1e-5
"""Fraction of clipped samples above which clipping is reported as a problem."""
_QUIET_DBFS = -45.0
_OFFSET = 0.01


@dataclass(frozen=True)
class _Levels:
    """Levels of the C channels of a sound file.

    Attributes:
        frames: number of frames read.
        peak, rms, mean: (C,) fractions of full scale.
        clipped: (C,) numbers of clipped samples.
        differ: True if the channels are not all equal.
    """

    frames: int
    peak: np.ndarray
    rms: np.ndarray
    mean: np.ndarray
    clipped: np.ndarray
    differ: bool


def inspect_audio(path: Path) -> Summary:
    """Summarise a sound file.

    Raises:
        AudioError: it cannot be read as sound at all.
    """
    try:
        wave, refused = af.Wave.load(path), None
    except af.AudioError as error:
        wave, refused = None, str(error)
    try:
        with soundfile.SoundFile(soundfile_name(path)) as file:
            header = (file.samplerate, file.channels, file.format, file.subtype, file.frames)
            levels = _levels(file)
    except (soundfile.LibsndfileError, OSError, TypeError, UnicodeError, MemoryError):
        raise af.AudioError(refused or f"{path}: cannot be read as sound") from None
    rate, channels, form, subtype, declared = header
    facts: dict[str, Any] = {
        "path": str(path),
        "format": form,
        "subtype": subtype,
        "bytes": path.stat().st_size,
        "sample_rate": rate,
        "channels": channels,
        "frames_declared": declared,
        "frames": levels.frames,
        "seconds": levels.frames / rate,
        "peak_dbfs": [_db(value) for value in levels.peak],
        "rms_dbfs": [_db(value) for value in levels.rms],
        "mean": levels.mean.tolist(),
        "clipped": levels.clipped.tolist(),
    }
    if wave is not None:
        facts |= _speech(wave)
        facts["repairs"] = list(wave.repairs)
    return Summary(
        kind="audio",
        title=f"{path}: sound, {form} {subtype}, {size(facts['bytes'])}",
        facts=facts,
        rows=tuple(_rows(facts, levels)),
        problems=tuple(_problems(facts, refused)),
    )


def _levels(file: soundfile.SoundFile) -> _Levels:
    n = file.channels
    frames, differ = 0, False
    peak, total, square = np.zeros(n), np.zeros(n), np.zeros(n)
    clipped = np.zeros(n, dtype=np.int64)
    while len(block := file.read(_BLOCK // n, always_2d=True)):
        values = np.where(np.isfinite(block), block, 0.0)
        frames += len(block)
        peak = np.maximum(peak, np.abs(values).max(axis=0))
        total += values.sum(axis=0)
        square += np.square(values).sum(axis=0)
        clipped += (np.abs(values) >= _FULL_SCALE).sum(axis=0)
        differ |= bool((values != values[:, :1]).any())
    count = max(frames, 1)
    mean = total / count
    rms = np.sqrt(np.maximum(square / count - mean**2, 0.0))
    return _Levels(frames, peak, rms, mean, clipped, differ)


def _speech(wave: af.Wave) -> dict[str, Any]:
    hop = 0.01
    speech = af.speech_only(wave)
    active = speech.active(hop)
    # The longest run without speech: its edges are where speech begins or ends.
    edges = np.flatnonzero(np.diff(np.concatenate([[1], active.astype(np.int8), [1]])))
    pauses = edges[1::2] - edges[::2]
    return {
        "active_level_dbfs": speech.active_level(),
        "is_silent": wave.is_silent,
        "has_voice": not speech.is_silent,
        "active_share": float(active.mean()),
        "longest_pause": float(pauses.max(initial=0) * hop),
    }


def _rows(facts: dict[str, Any], levels: _Levels) -> list[tuple[str, str]]:
    decoded = "all of them decoded"
    if facts["frames"] != facts["frames_declared"]:
        decoded = f"the header declares {facts['frames_declared']}"
    channels = {1: "mono", 2: "stereo"}.get(facts["channels"], f"{facts['channels']} channels")
    if facts["channels"] > 1:
        channels += ", channels differ" if levels.differ else ", all channels equal"
        channels += "" if facts.get("repairs") else "; models use their mean"
    rows = [
        (
            "time",
            f"{span(facts['seconds'])}: {counted(facts['frames'], 'sample')} at "
            f"{facts['sample_rate']} Hz, {decoded}",
        ),
        ("channels", channels),
        (
            "level",
            f"peak {_each(facts['peak_dbfs'])} dBFS, RMS {_each(facts['rms_dbfs'])} dBFS"
            + (
                f", speech {facts['active_level_dbfs']:.1f} dBFS"
                if facts.get("active_share")
                else ""
            ),
        ),
    ]
    if facts.get("active_share"):
        share = 100 * facts["active_share"]
        rows.append(
            (
                "speech",
                f"{share:.0f} % of the time, silence {100 - share:.0f} %; the longest pause "
                f"takes {facts['longest_pause']:.2f} s",
            )
        )
    return rows


def _problems(facts: dict[str, Any], refused: str | None) -> list[str]:
    found = [refused] if refused else list(facts["repairs"])
    if refused is None and facts["is_silent"]:
        found.append("silence: no speech above -75 dBFS")
    elif refused is None and not facts["has_voice"]:
        found.append("no voice (noise, hum or whispering): models of speech generate idle motion")
    elif refused is None and facts["active_level_dbfs"] < _QUIET_DBFS:
        found.append(f"quiet: speech is at {facts['active_level_dbfs']:.0f} dBFS")
    clipped = sum(facts["clipped"])
    loudest = max(facts["peak_dbfs"])
    if clipped > _CLIPPED_SHARE * facts["frames"] and loudest <= _UNLIMITED_DBFS:
        found.append(f"clipped: {counted(clipped, 'sample')} at full scale")
    offset = max(map(abs, facts["mean"]))
    if loudest > _UNLIMITED_DBFS:  # floats whose full scale is not 1, for example 32768
        offset /= 10 ** (loudest / 20)
    if offset > _OFFSET:
        found.append(f"DC offset of {offset:.3f} of full scale")
    silent = [k + 1 for k, peak in enumerate(facts["peak_dbfs"]) if peak < -75]
    if silent and len(silent) < facts["channels"]:
        found.append(
            f"channel {', '.join(map(str, silent))} is silent: the mean loses 6 dB or more"
        )
    return found


def _each(values: list[float]) -> str:
    """Format the values of all channels; one value if they agree."""
    texts = [f"{value:.1f}" for value in values]
    return texts[0] if len(set(texts)) == 1 else " / ".join(texts)


def _db(value: float) -> float:
    return 20 * math.log10(value) if value > 0 else -math.inf
