"""AIFF, Sun au and NIST SPHERE: a header with a length, then uncompressed samples."""

from __future__ import annotations

import struct
from typing import BinaryIO

from audio_features.containers.header import Header, copy_again, exactly
from audio_features.errors import AudioError

_MAX_CHUNKS = 10_000
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
