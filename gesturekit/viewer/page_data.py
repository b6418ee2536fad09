"""Data of a page of the player beside the figures: skins, sound, tracks under the time line.

The tracks are spectrogram and onsets of speech, contacts and beats of motion. The numbers are
unpacked by player/data.js.
"""

from __future__ import annotations

import base64
import io
import os
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import soundfile
from scipy.signal import find_peaks

from audio_features import AudioError, LogMel, Onset, Wave
from audio_features.wave import soundfile_name
from gesturekit.motion.body_model import Skin, steady_turns
from gesturekit.motion.contacts import contact_labels, foot_points
from gesturekit.motion.face import values_of
from gesturekit.viewer.drawn_body import DrawnBody
from gesturekit.viewer.human import palette_of

if TYPE_CHECKING:
    from gesturekit.motion import Motion

_LEVELS = 2
"""Skins of the human body on a page: the finest one, and one for playing on slow machines."""
_FULL = 32_767


def add_skins(page: dict[str, Any], shown: Sequence[DrawnBody]) -> None:
    """Add the skins of all figures to a page that has its figures already.

    The human body is there once, whatever the number of figures; the skins of a body model share
    everything but the vertices.
    """
    skins = next((drawn.skins for drawn in shown if drawn.skins), None)
    if skins is None:
        return
    skin = skins[0]
    if skin.regions is None:
        mesh = {"faces": skin.faces.astype("<u4"), "joints": skin.joints, "weights": skin.weights}
        page["skin"] = {name: base64_text(values.tobytes()) for name, values in mesh.items()}
    else:
        page["skin"] = {"levels": [_level(each) for each in skins[:_LEVELS]]}
        faces = [drawn.face.names for drawn in shown if drawn.face]
        channels = [name for name in skin.morphs if any(name in names for names in faces)]
        if channels:
            page["skin"]["levels"][0]["morphs"] = [_morph(skin, name) for name in channels]
    for k, (figure, drawn) in enumerate(zip(page["figures"], shown)):
        if not drawn.skins:
            continue
        skin = drawn.skins[0]
        figure["skin"] = {
            "joints": base64_text((drawn.scale * skin.rest).astype("<f4").tobytes()),
            "turns": base64_text(packed(np.rint(steady_turns(drawn.motion) * _FULL))),
        }
        if skin.regions is None:
            figure["skin"]["vertices"] = base64_text(skin.vertices.astype("<f4").tobytes())
        else:
            palette = ["#{:02x}{:02x}{:02x}".format(*colour) for colour in palette_of(skin, k)]
            figure["skin"] |= {"scale": drawn.scale, "palette": palette}
            if drawn.face:
                values = np.rint(255 * values_of(drawn.face, channels)).astype(np.uint8)
                figure["skin"]["face"] = base64_text(zlib.compress(values.tobytes(), 9))


def _level(skin: Skin) -> dict[str, Any]:
    """Return a mesh at rest as steps from its middle."""
    assert skin.regions is not None
    low, high = skin.vertices.min(axis=0), skin.vertices.max(axis=0)
    middle, step = (low + high) / 2, float((high - low).max()) / 2 / _FULL
    return {
        "n_vertices": len(skin.vertices),
        "n_faces": len(skin.faces),
        "middle": middle.tolist(),
        "step": step,
        "vertices": base64_text(packed(np.rint((skin.vertices - middle) / step))),
        "faces": base64_text(packed(skin.faces)),
        "joints": base64_text(zlib.compress(skin.joints.tobytes(), 9)),
        "weights": base64_text(zlib.compress(skin.weights.tobytes(), 9)),
        "regions": base64_text(zlib.compress(skin.regions.tobytes(), 9)),
    }


def _morph(skin: Skin, channel: str) -> dict[str, Any]:
    """Return the displacements of vertices by a face channel, in steps."""
    morph = skin.morphs[channel]
    step = float(np.abs(morph.offsets).max()) / _FULL
    return {
        "channel": channel,
        "n_vertices": len(morph.vertices),
        "step": step,
        "vertices": base64_text(packed(morph.vertices)),
        "offsets": base64_text(packed(np.rint(morph.offsets / step))),
    }


def packed(steps: np.ndarray) -> bytes:
    """Deflate whole numbers (T, ...) of 16 bits: see `unpack` in player/data.js."""
    channels = steps.astype(np.int64).reshape(len(steps), -1).T
    difference = np.diff(channels, prepend=0) & 0xFFFF
    planes = np.stack([difference & 0xFF, difference >> 8]).astype(np.uint8)
    return zlib.compress(planes.tobytes())


def base64_text(data: bytes) -> str:
    """Return bytes as text in base64."""
    return base64.b64encode(data).decode("ascii")


BANDS = 32
"""Mel bands of the spectrogram."""
_MOST_COLUMNS = 3_000
_FEWEST = 2
"""Least number of the extractor's frames, of 10 ms, in a column of the spectrogram."""
_BEAT_PROMINENCE = 0.1
"""Least depth of a motion beat, as a share of the curve's 98th percentile."""


def spectrogram(wave: Wave) -> tuple[np.ndarray, float]:
    """Return a log-mel spectrogram (M, BANDS) from 0 to 1, and its columns a second."""
    values = LogMel(n_mels=BANDS).extract(wave).values
    width = max(_FEWEST, -(-len(values) // _MOST_COLUMNS))
    starts = np.arange(0, len(values), width)
    counts = np.diff(np.append(starts, len(values)))  # the last column may be narrower
    means = np.add.reduceat(values, starts) / counts[:, None]
    low, high = np.quantile(values, [0.1, 0.995])
    shares = np.clip((means - low) / max(float(high - low), 1e-3), 0, 1)
    return shares, len(values) / max(wave.duration, 1e-3) / width


def onsets(wave: Wave) -> np.ndarray:
    """Return the times of speech onsets, seconds."""
    track = Onset().extract(wave)
    return track.times[track.values[:, track.names.index("onset_peak")] > 0]


def speed_minima(speed: np.ndarray, fps: float) -> np.ndarray:
    """Return the times of motion beats, seconds: minima of a speed curve (T,)."""
    depth = _BEAT_PROMINENCE * float(np.quantile(speed, 0.98))
    beats, _ = find_peaks(-speed, prominence=max(depth, 1e-6))
    return beats / fps


def contact_track(motion: Motion) -> np.ndarray | None:
    """Return foot contacts (T,) uint8: 1 for the left foot, 2 for the right, 3 for both.

    None for a body without two identified legs. A foot is in contact if any of its points is.
    """
    n_points = len(foot_points(motion.skeleton))
    if not n_points:
        return None
    labels = contact_labels(motion) > 0.5
    left, right = labels[:, : n_points // 2], labels[:, n_points // 2 :]
    return np.asarray(left.any(axis=1) + 2 * right.any(axis=1)).astype(np.uint8)


EMBED_LIMIT = 2_000_000
"""Recordings of at most this many bytes are embedded as they are; bigger ones become MP3."""
OUTLINE_RATE = 100
"""Values a second of a wave's outline."""

# What every current browser plays, by libsndfile's names.
_BROWSER_TYPES = {
    ("FLAC", "PCM_16"): "audio/flac",
    ("FLAC", "PCM_24"): "audio/flac",
    ("MP3", "MPEG_LAYER_III"): "audio/mpeg",
    ("WAV", "FLOAT"): "audio/wav",
    ("WAV", "PCM_16"): "audio/wav",
    ("WAV", "PCM_24"): "audio/wav",
    ("WAV", "PCM_U8"): "audio/wav",
}
_MP3_RATES = (16_000, 22_050, 24_000, 32_000, 44_100, 48_000)
_BLOCK = 1 << 16


Playable = str | os.PathLike[str] | Wave | tuple[np.ndarray, int]
"""A file, a `Wave`, or an array of samples with its rate in Hz."""


def as_wave(audio: Playable | None) -> Wave | None:
    """Return sound as a `Wave`, and None for none.

    Raises:
        AudioError: it is not sound, or an array has no rate.
    """
    if audio is None or isinstance(audio, Wave):
        return audio
    if isinstance(audio, tuple) and len(audio) == 2:
        return Wave.from_array(*audio, "audio")
    if not isinstance(audio, str | os.PathLike):
        raise AudioError(f"audio is {type(audio).__name__}: give a file, a Wave, (samples, rate)")
    return Wave.load(audio)


def encoded(audio: Playable, wave: Wave, compress: bool = False) -> tuple[bytes, str]:
    """Return sound as a browser plays it, and its media type.

    A WAV, FLAC or MP3 file of up to EMBED_LIMIT bytes is taken byte for byte, any other sound is
    encoded: without loss (FLAC) while that stays under the limit, else as mono MP3, which every
    browser plays (Safari plays no Ogg Opus before 18.4). MP3 from here starts on the sample:
    its header tells players what to skip.

    Args:
        audio: the sound as given.
        wave: the same, decoded.
        compress: True for MP3 at any size.
    """
    limit = 0 if compress else EMBED_LIMIT
    if isinstance(audio, str | os.PathLike):
        path = Path(audio)
        info = soundfile.info(soundfile_name(path))
        media_type = _BROWSER_TYPES.get((info.format, info.subtype))
        is_small = path.stat().st_size <= limit or (compress and info.format == "MP3")
        if media_type and is_small:
            return path.read_bytes(), media_type
    # FLAC takes about one byte a sample of speech.
    if len(wave.samples) <= limit:
        flac = _encode(wave, format="FLAC", subtype="PCM_16")
        if len(flac) <= limit:
            return flac, "audio/flac"
    rate = next((rate for rate in _MP3_RATES if rate >= wave.sample_rate), _MP3_RATES[-1])
    return _encode(wave.resample(rate), format="MP3", subtype="MPEG_LAYER_III"), "audio/mpeg"


def _encode(wave: Wave, **kind: str) -> bytes:
    buffer = io.BytesIO()
    with soundfile.SoundFile(
        buffer, "w", samplerate=wave.sample_rate, channels=1, **kind
    ) as encoder:
        for start in range(0, len(wave.samples), _BLOCK):
            encoder.write(wave.samples[start : start + _BLOCK])
    return buffer.getvalue()


def outline(wave: Wave) -> np.ndarray:
    """Return the largest |sample| of each 1/OUTLINE_RATE s as (M,) floats, 1 the clip's peak."""
    n = int(np.ceil(wave.duration * OUTLINE_RATE))
    edges = np.arange(n) * len(wave.samples) // n
    peaks = np.maximum.reduceat(np.abs(wave.samples), edges)
    return peaks / max(float(peaks.max()), 1e-9)
