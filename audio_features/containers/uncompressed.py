"""Headers of uncompressed sound: wav (RIFF, RIFX, RF64), AIFF, Sun au and NIST SPHERE."""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass
from typing import BinaryIO

from audio_features.containers.header import Header, copy_again, exactly, ffmpeg_line
from audio_features.errors import AudioError

# Placeholder sizes of writers that stream to a pipe (ffmpeg, sox).
_UNKNOWN_SIZES = {0, 0xFFFFFFFF, 0x7FFFFFFF, 0x7FFFF000, 0x7FFFFFFE, 0xFFFFFFFE}
_LARGEST_PIPE_SIZE = 0x7FFF0000  # larger declared file sizes are placeholders too
_MAX_CHUNKS = 10_000
_MAX_FORMAT_BYTES = 4096
# Formats whose sample is a fixed number of bytes: linear PCM, float, A-law, mu-law.
_PLAIN_FORMATS = {1, 3, 6, 7}
_EXTENSIBLE = 0xFFFE


@dataclass(frozen=True)
class _Format:
    """Fields of a `fmt ` chunk."""

    tag: int
    channels: int
    rate: int
    bytes_per_second: int
    block: int
    bits: int


def read_wav(file: BinaryIO, name: str, size: int) -> Header:
    """Read a wav header and check it against the file's size.

    A length of 0 or 0xFFFFFFFF (and sox's 0x7FFFF000) means unknown: the sound lasts to the end
    of the file. Programs that write to a pipe produce it, for example `ffmpeg -i … -f wav -`.
    """
    head = exactly(file, 12, name)
    order = ">" if head[:4] == b"RIFX" else "<"
    riff_size = struct.unpack(f"{order}I", head[4:8])[0]
    if head[8:] != b"WAVE":
        raise AudioError(f"{name}: a RIFF file that is not a wav ({head[8:]!r}): give a sound file")
    settings, long_sizes = None, None
    for _ in range(_MAX_CHUNKS):
        kind, length = struct.unpack(f"{order}4sI", _chunk_head(file, name))
        if kind == b"data":
            break
        start = file.tell()
        if kind == b"ds64" and length >= 16:
            long_sizes = struct.unpack("<QQ", exactly(file, 16, name))
        elif kind == b"fmt " and 16 <= length <= _MAX_FORMAT_BYTES:
            settings = _format(exactly(file, length, name), order)
        file.seek(start + length + length % 2)
    else:
        raise AudioError(f"{name}: more than {_MAX_CHUNKS} chunks before the sound: export again")
    if settings is None:
        raise AudioError(f"{name}: no `fmt ` chunk before the sound: export the file again")
    _check_format(settings, name)

    start, unsized_at = file.tell(), file.tell() - 4
    if head[:4] == b"RF64" and long_sizes is not None:
        riff_size = long_sizes[0] if riff_size == 0xFFFFFFFF else riff_size
        length = long_sizes[1] if length == 0xFFFFFFFF else length
    there = size - start
    # A 0 means unknown as well, unless the declared file size is known and correct.
    sized = riff_size not in _UNKNOWN_SIZES and riff_size + 8 == size
    unknown = length in _UNKNOWN_SIZES and not (length == 0 and (sized or there == 0))
    if unknown:
        length = there
        if _LARGEST_PIPE_SIZE > riff_size > size - 8:
            length = riff_size + 8 - start
    if length > there:
        raise AudioError(
            f"{name}: truncated: the header declares {length} bytes of sound, "
            f"{there} are there: {copy_again(name)}"
        )
    if not unknown and not _only_chunks_follow(
        file, start + length, _end(riff_size, start + length, size), order
    ):
        raise AudioError(
            f"{name}: damaged: the header declares {length} bytes of sound, but what follows in "
            f"the file ({there - length} bytes) is not valid in a wav: copy or export it again"
        )
    plain = settings.tag in _PLAIN_FORMATS
    return Header(
        frames=length // settings.block if plain else None,
        unsized_at=unsized_at if unknown else None,
    )


def _chunk_head(file: BinaryIO, name: str) -> bytes:
    head = file.read(8)
    if len(head) < 8:
        raise AudioError(f"{name}: truncated: no sound (`data`) in the file: copy or export again")
    return head


def _format(body: bytes, order: str) -> _Format:
    tag, channels, rate, bytes_per_second, block, bits = struct.unpack(f"{order}HHIIHH", body[:16])
    if tag == _EXTENSIBLE and len(body) >= 26:
        tag = struct.unpack(f"{order}H", body[24:26])[0]
    return _Format(tag, channels, rate, bytes_per_second, block, bits)


def _check_format(settings: _Format, name: str) -> None:
    """Raise AudioError if the redundant fields of the header contradict each other."""
    if settings.tag not in _PLAIN_FORMATS:
        return
    block = settings.channels * -(-settings.bits // 8)
    if settings.channels == 0 or settings.bits == 0:
        raise AudioError(
            f"{name}: the header declares {settings.channels} channels of {settings.bits} bits: "
            "export the file again"
        )
    if settings.block != block or settings.bytes_per_second != settings.rate * block:
        raise AudioError(
            f"{name}: the header contradicts itself: {settings.channels} channels of "
            f"{settings.bits} bits at {settings.rate} Hz are {block} bytes per sample and "
            f"{settings.rate * block} per second, it declares {settings.block} and "
            f"{settings.bytes_per_second}: export it again, or run {ffmpeg_line(name)}"
        )


def _end(riff_size: int, sound_end: int, size: int) -> int:
    """Return the byte at which the wav ends; other tags may follow it in the file."""
    end = riff_size + 8
    return end if riff_size not in _UNKNOWN_SIZES and sound_end <= end <= size else size


def _only_chunks_follow(file: BinaryIO, at: int, end: int, order: str) -> bool:
    """Return true if bytes `at` to `end` are chunks; an odd chunk may lack its pad byte."""
    return any(
        _chunks_fill(file, start, end, order) for start in ({at, at + 1} if at % 2 else {at})
    )


def _chunks_fill(file: BinaryIO, at: int, end: int, order: str) -> bool:
    for _ in range(_MAX_CHUNKS):
        if end - at <= 1:
            return True
        file.seek(at, os.SEEK_SET)
        head = file.read(8)
        if len(head) < 8 or not all(0x20 <= byte < 0x7F for byte in head[:4]):
            return False
        length = struct.unpack(f"{order}I", head[4:])[0]
        at += 8 + length
        if at > end:
            return False
        at += length % 2
    return False


_UNKNOWN_AU_SIZE = 0xFFFFFFFF


def read_aiff(file: BinaryIO, name: str, size: int) -> Header:
    """Read an AIFF or AIFF-C header; the SSND chunk must fit into the file."""
    if exactly(file, 12, name)[8:] not in (b"AIFF", b"AIFC"):
        raise AudioError(f"{name}: an IFF file that is not AIFF: give a sound file")
    frames = None
    for _ in range(_MAX_CHUNKS):
        head = file.read(8)
        if len(head) < 8:
            break
        kind, length = struct.unpack(">4sI", head)
        start = file.tell()
        if kind == b"COMM" and length >= 18:
            frames = struct.unpack(">hI", exactly(file, 6, name))[1]
        elif kind == b"SSND":
            _check_fits(name, length, size - start)
        file.seek(start + length + length % 2)
    if frames is None:
        raise AudioError(f"{name}: an AIFF file without COMM: export the file again")
    return Header(frames=frames)


def read_au(file: BinaryIO, name: str, size: int) -> Header:
    """Read a Sun au header; a length of 0xFFFFFFFF means up to the end of the file."""
    offset, length = struct.unpack(">II", exactly(file, 12, name)[4:])
    if length != _UNKNOWN_AU_SIZE:
        _check_fits(name, length, size - offset)
    return Header()


def read_nist(file: BinaryIO, name: str, size: int) -> Header:
    """Read a NIST SPHERE header (TIMIT and other corpora): text fields."""
    try:
        lines = exactly(file, 1024, name).decode("ascii", "replace").splitlines()
        offset = int(lines[1])
        fields = dict(line.split(None, 2)[::2] for line in lines[2:] if line.count(" ") >= 2)
        frames = int(fields["sample_count"])
        block = int(fields["channel_count"]) * int(fields["sample_n_bytes"])
    except (ValueError, KeyError, IndexError) as error:
        raise AudioError(f"{name}: the SPHERE header cannot be read: export it again") from error
    _check_fits(name, frames * block, size - offset)
    return Header(frames=frames)


def _check_fits(name: str, declared: int, there: int) -> None:
    if declared > there:
        raise AudioError(
            f"{name}: truncated: the header declares {declared} bytes of sound, "
            f"{max(there, 0)} are there: {copy_again(name)}"
        )
