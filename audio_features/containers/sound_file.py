"""Reading of sound files block by block, checked against their headers."""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import soundfile

from audio_features.containers.compressed import read_flac, read_mpeg, read_ogg
from audio_features.containers.header import Header, copy_again, ffmpeg_line, raw_line
from audio_features.containers.samples import ChannelLevels
from audio_features.containers.uncompressed import read_aiff, read_au, read_nist, read_wav
from audio_features.errors import AudioError

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

_BLOCK = 1 << 20  # values (samples times channels) decoded at a time, which bounds the memory

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

    def readinto(self, buffer: bytearray | memoryview) -> int:
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
    digest = hashlib.md5(usedforsecurity=False) if whole and header.md5 else None
    samples, levels = np.empty(count, dtype=np.float32), ChannelLevels(file.channels)
    if first:
        file.seek(first)
    done = 0
    while done < count:
        block = file.read(
            min(count - done, max(1, _BLOCK // file.channels)), dtype="float32", always_2d=True
        )
        if len(block) == 0:
            break
        here = samples[done : done + len(block)]
        if channel is None:
            np.mean(block, axis=1, out=here)
            if file.channels > 1:
                levels.add(block, here)
        else:
            here[:] = block[:, channel - 1]
        if digest is not None:
            digest.update(_integers(block, header.md5[1]))
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
    if digest is not None and digest.digest() != header.md5[0]:
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
