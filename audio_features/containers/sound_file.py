"""Reading of sound files block by block, checked against their headers."""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import soundfile
from numpy.typing import ArrayLike

from audio_features.containers.compressed import read_flac, read_mpeg, read_ogg
from audio_features.containers.header import Header, copy_again, ffmpeg_line, raw_line
from audio_features.containers.uncompressed import read_aiff, read_au, read_nist, read_wav
from audio_features.errors import AudioError

CANCELLING = "the channels cancel each other, one is inverted: channel {} is used"
"""Description of the repair by `ChannelLevels.instead_of_mean`."""

_CANCELLED = 0.1
"""Channels cancel if their mean has less than this share of the power that one of them alone,
beside silent ones, would give it."""
_FEW_FAULTY = 0.01
"""Share of samples that may be NaN or infinite; they are interpolated."""


class ChannelLevels:
    """Power of the channels of a sound and of their mean, about their offsets.

    Args:
        channels: number of channels C.
    """

    def __init__(self, channels: int) -> None:
        self._count = 0
        self._total = np.zeros(channels + 1)
        self._square = np.zeros(channels + 1)

    def add(self, block: np.ndarray, mean: np.ndarray) -> None:
        """Include a block (N, C) of samples, with the mean (N,) of its channels."""
        values = np.column_stack([block, mean]).astype(np.float64)
        values[~np.isfinite(values)] = 0.0
        self._count += len(values)
        self._total += values.sum(axis=0)
        self._square += np.square(values, out=values).sum(axis=0)

    def instead_of_mean(self) -> int | None:
        """Return the loudest channel, from 1, if the channels cancel in the mean, else None."""
        count = max(self._count, 1)
        *powers, of_mean = self._square / count - np.square(self._total / count)
        loudest = int(np.argmax(powers))
        if len(powers) > 1 and of_mean < _CANCELLED * powers[loudest] / len(powers) ** 2:
            return loudest + 1
        return None


def numbers(samples: ArrayLike, name: str) -> np.ndarray:
    """Convert to (N,) or two-dimensional float32 with full scale ±1."""
    if hasattr(samples, "detach") and hasattr(samples, "cpu"):
        # A torch tensor: numpy knows neither bfloat16 nor GPUs.
        tensor = samples.detach().cpu()
        samples = tensor.float() if tensor.is_floating_point() else tensor
    try:
        values: np.ndarray = np.asarray(samples)
    except (TypeError, ValueError) as error:
        raise AudioError(f"{name}: not an array of samples ({error})") from None
    if values.ndim == 0:
        kind = type(samples).__name__
        raise AudioError(f"{name}: {kind}, expected an array of samples, or the path of a file")
    # A batch of one sound.
    values = values.reshape([n for n in values.shape if n != 1] or [1])
    if not values.size:
        raise AudioError(f"{name}: no samples, an array of shape {np.shape(samples)}")
    if values.ndim not in (1, 2):
        raise AudioError(
            f"{name}: shape {values.shape}, expected samples (N,), or channels (C, N) or (N, C)"
        )
    if values.dtype.kind == "f":
        return values.astype(np.float32)
    if values.dtype == np.int64:  # a list of whole numbers: of the fewest bits that hold them
        for narrower in (np.int16, np.int32):
            if (values == values.astype(narrower)).all():
                values = values.astype(narrower)
                break
    if values.dtype.kind not in "iu" or values.dtype.itemsize > 4:
        raise AudioError(
            f"{name}: dtype {values.dtype}, expected floats with full scale ±1, or integers of 8, "
            "16 or 32 bits"
        )
    half = 2.0 ** (8 * values.dtype.itemsize - 1)
    middle = half if values.dtype.kind == "u" else 0.0
    return ((values - middle) / half).astype(np.float32)


def one_channel(values: np.ndarray) -> tuple[np.ndarray, int | None]:
    """Return the mean (N,) of the channels of (C, N) or (N, C); C is the shorter axis.

    If the channels cancel each other, the loudest one is returned, with its number from 1.
    """
    channels = values.T if values.shape[0] <= values.shape[1] else values
    mean = channels.mean(axis=1)
    levels = ChannelLevels(channels.shape[1])
    levels.add(channels, mean)
    used = levels.instead_of_mean()
    return (mean, None) if used is None else (channels[:, used - 1], used)


def interpolated(samples: np.ndarray, rate: int, repairs: list[str]) -> np.ndarray:
    """Interpolate samples that are not finite if they are few, and describe it in `repairs`."""
    count = sum(
        np.count_nonzero(~np.isfinite(samples[at : at + _BLOCK]))
        for at in range(0, len(samples), _BLOCK)
    )
    if not 0 < count <= _FEW_FAULTY * len(samples):
        return samples
    finite = np.isfinite(samples)
    faulty, good = np.flatnonzero(~finite), np.flatnonzero(finite)
    repairs.append(
        f"NaN or infinite: {count} of {len(samples)} samples, the first at "
        f"{faulty[0] / rate:.3f} s: they are interpolated"
    )
    samples = samples.copy()
    samples[faulty] = np.interp(faulty, good, samples[good])
    return samples


_READERS = {
    b"RIFF": read_wav,
    b"RIFX": read_wav,
    b"RF64": read_wav,
    b"fLaC": read_flac,
    b"OggS": read_ogg,
    b"FORM": read_aiff,
    b".snd": read_au,
    b"NIST": read_nist,
}
"""Header reader by the first four bytes of the file."""

_BLOCK = 1 << 20  # values (samples times channels) processed at a time, which bounds the memory

_UNCHECKED = 256 << 20
"""Bytes of samples that a file of any size may hold."""
_EXPANSION = {"OGG": 256, "MP3": 64, "MPEG": 64}
"""Largest ratio of the bytes of more samples to the size of the file: what Opus at 6 kbit/s and MP3
at 24 kbit/s have at 48 kHz. Other formats keep every sample, for which 20 is plenty."""

Segment = Callable[[int, int], tuple[int, int]]
"""Function from (samples per channel, rate) to (first sample, number of samples) to read."""


def read_sound(
    name: str, segment: Segment, channel: int | None
) -> tuple[np.ndarray, int, int | None]:
    """Read one channel, or the mean of all: (N,) float32, the sample rate and the channel.

    Where the channels cancel each other in their mean, the loudest one is read instead.

    Args:
        name: path of the file.
        segment: function that selects the samples to read; raises if there are none.
        channel: counted from 1; None for the mean of all channels.

    Raises AudioError if the file is missing, is not a sound file, is damaged or ends too soon.
    """
    if not Path(name).is_file():
        what = "not a regular file" if Path(name).exists() else "no such file"
        raise AudioError(f"{name}: {what}: give the path of a sound file")
    try:
        if Path(name).stat().st_size == 0:
            raise AudioError(f"{name}: the file is empty (0 bytes): export it again")
        header = read_header(name)
        with _opened(name, header) as file:
            _check_length(file, name, header)
            first, count = segment(file.frames, file.samplerate)
            _check_memory(name, file.format, count)
            samples, levels = _read(file, name, header, first, count, channel)
            if channel is None and (channel := levels.instead_of_mean()) is not None:
                file.seek(0)
                samples, _ = _read(file, name, header, first, count, channel)
            return samples, file.samplerate, channel
    except (soundfile.LibsndfileError, OSError, TypeError, UnicodeError) as error:
        # soundfile raises TypeError for files named .raw, and UnicodeError for undecodable names.
        reason = str(error).removeprefix(f"Error opening {name!r}: ").rstrip(".")
        raise AudioError(
            f"{name}: cannot be read as sound ({reason}): "
            f"give a wav, flac, ogg or mp3 file, or run {ffmpeg_line(name)}"
        ) from error
    except MemoryError as error:
        raise AudioError(f"{name}: too long for this machine's memory: split it") from error


def read_header(name: str) -> Header:
    """Read the header of a sound file.

    Raises AudioError if the header contradicts itself or the file, and for formats that
    libsndfile cannot decode (for example AAC in m4a), with the ffmpeg command to run.
    """
    with Path(name).open("rb") as file:
        head = file.read(16)
        kind = _foreign(head)
        if kind is not None:
            raise AudioError(f"{name}: {kind} is not supported: run {ffmpeg_line(name)}")
        size = Path(name).stat().st_size
        if head[:4] in _READERS:
            file.seek(0)
            return _READERS[head[:4]](file, name, size)
        if head[:3] == b"ID3" or (len(head) > 1 and head[0] == 0xFF and head[1] & 0xE0 == 0xE0):
            file.seek(0)
            return read_mpeg(file, name, size)
    if head[:1] == b"\x80" and head[1:2] <= b"\x05":
        raise AudioError(f"{name}: a Python pickle, not sound; it could run code and is not read")
    is_text = all(byte in b"\t\r\n" or 32 <= byte < 127 for byte in head)
    raise AudioError(
        f"{name}: cannot be read as sound (it begins with {head[:8]!r}): give a wav, flac, ogg, "
        "mp3 or aiff file"
        + ("" if is_text else f", or run {ffmpeg_line(name)} (raw samples: {raw_line(name)})")
    )


def soundfile_name(path: str | os.PathLike[str]) -> str | bytes:
    """Return a path as soundfile takes it: as bytes if the name is not valid Unicode."""
    name = os.fspath(path)
    try:
        name.encode()
    except UnicodeEncodeError:
        return os.fsencode(name)
    return name


class _Unsized(io.FileIO):
    """A wav file whose length 0 ("unknown") is read as 0xFFFFFFFF, which libsndfile understands."""

    def __init__(self, name: str, at: int) -> None:
        super().__init__(name)
        self._at = at

    def readinto(self, buffer: Any) -> int:
        """Fill the buffer, replacing the four bytes of the length."""
        start = self.tell()
        count = super().readinto(buffer)
        for at in range(max(self._at, start), min(self._at + 4, start + count)):
            memoryview(buffer)[at - start] = 0xFF
        return count


def _opened(name: str, header: Header) -> soundfile.SoundFile:
    if header.unsized_at is None:
        return soundfile.SoundFile(soundfile_name(name))
    return soundfile.SoundFile(io.BufferedReader(_Unsized(name, header.unsized_at)))


def _check_length(file: soundfile.SoundFile, name: str, header: Header) -> None:
    if header.frames is not None and header.frames != file.frames:
        raise AudioError(
            f"{name}: damaged: the header declares {header.frames} samples a channel, "
            f"{file.frames} can be found: copy or export the file again"
        )


def _check_memory(name: str, form: str, count: int) -> None:
    size, times = Path(name).stat().st_size, _EXPANSION.get(form, 20)
    if 4 * count > max(_UNCHECKED, times * size):
        raise AudioError(
            f"{name}: {count} samples from a file of {size} bytes: over {_UNCHECKED >> 20} MB, and "
            f"over {times} times the file: if it is sound, give start and duration, or make a wav "
            f"of it: {ffmpeg_line(name)}"
        )


def _read(
    file: soundfile.SoundFile,
    name: str,
    header: Header,
    first: int,
    count: int,
    channel: int | None,
) -> tuple[np.ndarray, ChannelLevels]:
    if channel is not None and not 1 <= channel <= file.channels:
        raise AudioError(f"{name}: channel {channel}: the file has {file.channels}, counted from 1")
    whole = first == 0 and count == file.frames
    md5, digest = header.md5 if whole else None, hashlib.md5(usedforsecurity=False)
    samples, levels = np.empty(count, dtype=np.float32), ChannelLevels(file.channels)
    if first:
        file.seek(first)
    done = 0
    while done < count:
        n = min(count - done, _BLOCK // file.channels)
        block = file.read(n, dtype="float32", always_2d=True)
        if len(block) == 0:
            break
        here = samples[done : done + len(block)]
        if channel is None:
            np.mean(block, axis=1, out=here)
            if file.channels > 1:
                levels.add(block, here)
        else:
            here[:] = block[:, channel - 1]
        if md5 is not None:
            digest.update(_integers(block, md5[1]))
        done += len(block)
    if file.format in ("MP3", "MPEG"):  # these formats only estimate their length
        least = header.least if whole else 0
    else:
        least = count
    if done < least:
        raise AudioError(
            f"{name}: truncated: the header declares {first + least} samples a channel, "
            f"only {first + done} can be read: {copy_again(name)}"
        )
    if md5 is not None and digest.digest() != md5[0]:
        raise AudioError(
            f"{name}: damaged: the sound does not match the MD5 in its header: "
            "copy or export the file again"
        )
    return samples[:done], levels


def _integers(block: np.ndarray, bits: int) -> bytes:
    """Convert samples (N, C) to FLAC's MD5 input: interleaved signed little-endian integers."""
    integers = np.rint(block * np.float32(1 << (bits - 1))).astype("<i4")
    size = bits // 8
    return integers.view(np.uint8).reshape(*block.shape, 4)[..., :size].tobytes()


def _foreign(head: bytes) -> str | None:
    """Name a format that libsndfile cannot decode; None for any other."""
    if head[4:8] == b"ftyp":
        return "MPEG-4 sound (m4a, mp4, AAC)"
    if head[:2] in (b"\xff\xf1", b"\xff\xf9"):
        return "AAC sound"
    for magic, kind in (
        (b"\x1a\x45\xdf\xa3", "Matroska or WebM sound"),
        (b"\x30\x26\xb2\x75", "Windows Media sound (wma)"),
        (b"#!AMR", "AMR sound"),
        (b"caff", "a Core Audio file (caf)"),
        (b"riff\x2e\x91\xcf\x11", "a Sony Wave64 file (w64)"),
        (b"ADIF", "AAC sound"),
    ):
        if head.startswith(magic):
            return kind
    return None
