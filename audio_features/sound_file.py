"""Samples of sound files, which libsndfile decodes, and of arrays; checks and repairs of both.

libsndfile silently shortens a file that ends early (an interrupted copy or download). It knows most
of what such a file's header declares, and writes it to a log, which is compared here.
"""

from __future__ import annotations

import io
import os
import re
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
import soundfile
from numpy.typing import ArrayLike

from audio_features.errors import AudioError

CANCELLING = "the channels cancel each other, one is inverted: channel {} is used"
"""Description of the repair by `ChannelLevels.instead_of_mean`."""

_CANCELLED = 0.1
"""Channels cancel if their mean has less than this share of the power that one of them alone,
beside silent ones, would give it."""
_FEW_FAULTY = 0.01
"""Share of samples that may be NaN or infinite; they are interpolated."""
_BLOCK = 1 << 20  # values (samples times channels) processed at a time, which bounds the memory

_CHECKED = ("WAV", "WAVEX", "RF64", "FLAC", "OGG", "MP3", "MPEG", "AIFF", "AU", "NIST")
"""Formats of libsndfile in which a truncated file is recognised."""
_UNCHECKED_BYTES = 256 << 20
"""Bytes of samples that a file of any size may hold."""
_EXPANSION = {"OGG": 256, "MP3": 64, "MPEG": 64}
"""Largest ratio of the bytes of more samples to the size of the file: what Opus at 6 kbit/s and MP3
at 24 kbit/s have at 48 kHz. Other formats keep every sample, for which 20 is plenty."""
_UNKNOWN_SIZES = {0xFFFFFFFF, 0x7FFFFFFF, 0x7FFFF000, 0x7FFFFFFE, 0xFFFFFFFE}
"""Placeholder sizes of programs that write to a pipe (ffmpeg, sox)."""
_LONGEST_PAGE = 65_307  # bytes of an Ogg page
_IS_LAST = 4  # flag of the last Ogg page
# Samples that encoder and decoder of an MP3 may drop at the ends (codec delays, the last frame).
_SLACK = 4 * 1152

_CONTRADICTION = re.compile(r"^ *(.*?) *: (\d+) \(should be (\d+)\)", re.MULTILINE)
_RF64_FRAMES = re.compile(r"frame count (\d+) does not match value from 'ds64' chunk of (\d+)")


@contextmanager
def open_sound(name: str) -> Iterator[soundfile.SoundFile]:
    """Open a sound file whose header agrees with what is there.

    Raises AudioError if the file is missing, is not a sound file, is damaged or ends too soon; also
    for errors of reading it in the context.
    """
    path = Path(name)
    if not path.is_file():
        what = "not a regular file" if path.exists() else "no such file"
        raise AudioError(f"{name}: {what}: give the path of a sound file")
    if path.stat().st_size == 0:
        raise AudioError(f"{name}: the file is empty (0 bytes): export it again")
    try:
        with soundfile.SoundFile(_with_length(name)) as file:
            _check_header(file, name)
            yield file
    except (soundfile.LibsndfileError, OSError, TypeError, UnicodeError, MemoryError) as error:
        # soundfile raises TypeError for files named .raw, and UnicodeError for undecodable names.
        with path.open("rb") as content:
            head = content.read(8)
        if head[:1] == b"\x80" and head[1:2] <= b"\x05":
            message = f"{name}: a Python pickle, not sound; it could run code and is not read"
            raise AudioError(message) from error
        reason = str(error).rpartition(f"{name!r}: ")[2].rstrip(".")
        raw_line = _ffmpeg_line(name, "-f s16le -ar 16000 -ac 1 ")
        ways = f"give a wav, or run {_ffmpeg_line(name)} (raw samples: {raw_line})"
        what = f"cannot be read as sound ({reason}; it begins with {head!r})"
        raise AudioError(f"{name}: {what}: {ways}") from error


def soundfile_name(path: str | os.PathLike[str]) -> str | bytes:
    """Return a path as soundfile takes it: as bytes if the name is not valid Unicode."""
    name = os.fspath(path)
    try:
        name.encode()
    except UnicodeEncodeError:
        return os.fsencode(name)
    return name


def read_channel(
    file: soundfile.SoundFile, name: str, first: int, count: int, channel: int | None
) -> tuple[np.ndarray, int | None]:
    """Read one channel, or the mean of all: (N,) float32, and the channel.

    Where the channels cancel each other in their mean, the loudest one is read instead.

    Args:
        file: a file of `open_sound`.
        name: its path, for messages.
        first, count: range of samples.
        channel: counted from 1; None for the mean of all channels.

    Raises AudioError if there is no such channel, or the samples are damaged, or too few or too
    many for the file.
    """
    if channel is not None and not 1 <= channel <= file.channels:
        raise AudioError(f"{name}: channel {channel}: the file has {file.channels}, counted from 1")
    size, times = Path(name).stat().st_size, _EXPANSION.get(file.format, 20)
    if 4 * count > max(_UNCHECKED_BYTES, times * size):
        held = f"{count} samples from a file of {size} bytes, over {times} times the file"
        raise AudioError(f"{name}: {held}: give start and duration, or {_ffmpeg_line(name)}")
    samples, levels = np.empty(count, dtype=np.float32), ChannelLevels()
    file.seek(first)
    done = 0
    while done < count:
        block = file.read(min(count - done, _BLOCK // file.channels), "float32", always_2d=True)
        if len(block) == 0:
            break
        here = samples[done : done + len(block)]
        if channel is None:
            np.mean(block, axis=1, out=here)
            if file.channels > 1:
                levels.add(block, here)
        else:
            here[:] = block[:, channel - 1]
        done += len(block)
    if file.format in ("MP3", "MPEG"):
        is_short = done < count - _SLACK and _declares_length(name)
    else:
        is_short = done < count
    if is_short:
        raise _truncated(name, f"{first + count} samples a channel", f"{first + done} can be read")
    if "reports a hole" in file.extra_info:
        raise AudioError(f"{name}: an Ogg page is missing or has a wrong checksum: export it again")
    if channel is None and (used := levels.instead_of_mean()) is not None:
        return read_channel(file, name, first, count, used)
    return samples[:done], channel


def _check_header(file: soundfile.SoundFile, name: str) -> None:
    if file.format not in _CHECKED:
        raise AudioError(f"{name}: {file.format} files are not read: run {_ffmpeg_line(name)}")
    log = file.extra_info
    for field, declared, actual in _CONTRADICTION.findall(log):
        if field in ("data", "SSND", "Data Size"):
            if int(declared) not in _UNKNOWN_SIZES:
                raise _truncated(name, f"{declared} bytes of sound", f"{actual} are there")
        elif field not in ("RIFF", "FORM", "Riff size"):  # other tags may follow
            why = f"the header contradicts itself: {field} is {declared}, expected {actual}"
            raise AudioError(f"{name}: {why}: run {_ffmpeg_line(name)}")
    frames = re.search(_RF64_FRAMES, log)
    if frames is not None and int(frames[1]) < int(frames[2]):
        raise _truncated(name, f"{frames[2]} samples a channel", f"{frames[1]} are there")
    if file.format == "NIST":
        declared = re.search(rb"sample_count -i (\d+)", _bytes_of(name, 0, 1024))
        if declared is not None and int(declared[1]) > file.frames:
            raise _truncated(name, f"{int(declared[1])} samples", f"{file.frames} are there")
    elif file.format == "OGG":
        # libsndfile takes the last page that is there for the end of the sound.
        last = _bytes_of(name, -_LONGEST_PAGE).rpartition(b"OggS\0")[2]
        if not last[:1] or not last[0] & _IS_LAST:
            raise _truncated(name, "more Ogg pages", "the last one does not end the sound")
    elif file.format == "FLAC" and file.frames > 1 << 36:
        raise AudioError(f"{name}: a FLAC file of undeclared length: run {_ffmpeg_line(name)}")


def _declares_length(name: str) -> bool:
    """Return true if an MP3 has a header with its length, as most encoders write it."""
    head, start = _bytes_of(name, 0, 10), 0
    if head[:3] == b"ID3":
        start = 10 + sum((byte & 0x7F) << shift for byte, shift in zip(head[6:], (21, 14, 7, 0)))
    first = _bytes_of(name, start, 64)
    return b"Xing" in first or b"Info" in first


def _bytes_of(name: str, at: int, count: int = -1) -> bytes:
    """Read bytes from a position in a file; one below 0 counts from its end."""
    with Path(name).open("rb") as file:
        file.seek(max(0, at + Path(name).stat().st_size if at < 0 else at))
        return file.read(count)


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


def _with_length(name: str) -> str | bytes | io.BufferedReader:
    """Return what soundfile opens: a wav written to a pipe may say that it has no sound."""
    head = _bytes_of(name, 0, 4096)
    order: Literal["big", "little"] = "big" if head[:4] == b"RIFX" else "little"
    at = head.find(b"data\0\0\0\0")
    is_whole = int.from_bytes(head[4:8], order) + 8 == Path(name).stat().st_size
    if head[:3] == b"RIF" and at >= 0 and not is_whole:
        return io.BufferedReader(_Unsized(name, at + 4))
    return soundfile_name(name)


def _truncated(name: str, declared: str, there: str) -> AudioError:
    how = f"copy or export it again, or keep what is there by {_ffmpeg_line(name)}"
    return AudioError(f"{name}: truncated: the header declares {declared}, {there}: {how}")


def _ffmpeg_line(name: str, options: str = "") -> str:
    """Return the ffmpeg command that converts a file to wav."""
    path = Path(name)
    stem = f"{path.stem}_new" if path.suffix.lower() == ".wav" else path.stem
    made = shlex.quote(str(path.with_name(f"{stem}.wav")))
    return f"`ffmpeg {options}-i {shlex.quote(name)} {made}`"


class ChannelLevels:
    """Power of the channels of a sound and of their mean, about their offsets."""

    def __init__(self) -> None:
        self._count = 0
        self._sums: Any = 0.0  # of values and squares: (2, channels + 1)

    def add(self, block: np.ndarray, mean: np.ndarray) -> None:
        """Include a block (N, C) of samples, with the mean (N,) of its channels."""
        values = np.column_stack([block, mean]).astype(np.float64)
        values[~np.isfinite(values)] = 0.0
        self._count += len(values)
        self._sums = self._sums + np.stack([values.sum(axis=0), np.square(values).sum(axis=0)])

    def instead_of_mean(self) -> int | None:
        """Return the loudest channel, from 1, if the channels cancel in the mean, else None."""
        if not self._count:
            return None
        total, squares = self._sums / self._count
        *powers, of_mean = squares - np.square(total)
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
    if not values.size or values.ndim not in (1, 2):
        raise AudioError(f"{name}: shape {np.shape(samples)}, expected (N,), (C, N) or (N, C)")
    if values.dtype.kind == "f":
        return values.astype(np.float32)
    if values.dtype == np.int64:  # a list of whole numbers: of the fewest bits that hold them
        for narrower in (np.int16, np.int32):
            if (values == values.astype(narrower)).all():
                values = values.astype(narrower)
                break
    if values.dtype.kind not in "iu" or values.dtype.itemsize > 4:
        raise AudioError(f"{name}: dtype {values.dtype}, expected floats, or 8 to 32 bit integers")
    half = 2.0 ** (8 * values.dtype.itemsize - 1)
    middle = half if values.dtype.kind == "u" else 0.0
    return ((values - middle) / half).astype(np.float32)


def one_channel(values: np.ndarray) -> tuple[np.ndarray, int | None]:
    """Return the mean (N,) of the channels of (C, N) or (N, C); C is the shorter axis.

    If the channels cancel each other, the loudest one is returned, with its number from 1.
    """
    channels = values.T if values.shape[0] <= values.shape[1] else values
    mean = channels.mean(axis=1)
    levels = ChannelLevels()
    levels.add(channels, mean)
    used = levels.instead_of_mean()
    return (mean, None) if used is None else (channels[:, used - 1], used)


def interpolated(samples: np.ndarray, rate: int, repairs: list[str]) -> np.ndarray:
    """Interpolate samples that are not finite if they are few, and describe it in `repairs`."""
    finite = np.isfinite(samples)
    count = len(samples) - np.count_nonzero(finite)
    if not 0 < count <= _FEW_FAULTY * len(samples):
        return samples
    faulty, good = np.flatnonzero(~finite), np.flatnonzero(finite)
    where = f"{count} of {len(samples)} samples, the first at {faulty[0] / rate:.3f} s"
    repairs.append(f"NaN or infinite: {where}: they are interpolated")
    samples = samples.copy()
    samples[faulty] = np.interp(faulty, good, samples[good])
    return samples
