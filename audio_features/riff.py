"""Looking for truncation in a wav file.

libsndfile silently shortens a wav whose header promises more than the file holds (a copy or
download that broke off), so the promise is checked here, before it reads.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path

from audio_features.errors import AudioError

# What writers that stream to a pipe put in place of a size they cannot know (ffmpeg, sox).
_UNKNOWN_SIZES = {0, 0xFFFFFFFF, 0x7FFFFFFF, 0x7FFFF000, 0x7FFFFFFE, 0xFFFFFFFE}
_MAX_CHUNKS = 1000


def check_not_truncated(path: str) -> None:
    """Raise AudioError where a RIFF/RF64 wav declares more sound than the file holds.

    Other formats pass: what is missing in them shows when they are read.
    """
    size = Path(path).stat().st_size
    with Path(path).open("rb") as file:
        header = file.read(12)
        if len(header) < 12 or header[:4] not in (b"RIFF", b"RF64") or header[8:] != b"WAVE":
            return
        long_size = None
        for _ in range(_MAX_CHUNKS):
            chunk = file.read(8)
            if len(chunk) < 8:
                return
            kind, length = struct.unpack("<4sI", chunk)
            if kind == b"ds64" and length >= 16:
                body = file.read(length)
                long_size = struct.unpack("<Q", body[8:16])[0] if len(body) >= 16 else None
                file.seek(length % 2, os.SEEK_CUR)
                continue
            if kind == b"data":
                break
            file.seek(length + length % 2, os.SEEK_CUR)
        else:
            return
        if header[:4] == b"RF64" and length == 0xFFFFFFFF and long_size is not None:
            length = long_size
        there = size - file.tell()
    if length not in _UNKNOWN_SIZES and length > there:
        raise AudioError(
            f"{path}: truncated: the header declares {length} bytes of sound, "
            f"{there} are there: copy or export the file again"
        )
