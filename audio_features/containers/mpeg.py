"""MP3 header: the length that most encoders store in the first frame."""

from __future__ import annotations

import struct
from typing import BinaryIO

from audio_features.containers.header import Header, exactly

_HEAD = 4096
_HAS_FRAMES = 1
# Samples that encoder and decoder may drop at the ends (codec delays and the last frame).
_SLACK = 4 * 1152


def read_header(file: BinaryIO, name: str, size: int) -> Header:
    """Read the number of frames from the Xing or Info header, which most encoders write.

    Without that header the length of an MP3 is unknown and is not checked.
    """
    head = exactly(file, 10, name)
    start = 0
    if head[:3] == b"ID3":
        start = 10 + sum((byte & 0x7F) << shift for byte, shift in zip(head[6:], (21, 14, 7, 0)))
    file.seek(start)
    first = file.read(_HEAD)
    at = max(first.find(b"Xing", 4, 64), first.find(b"Info", 4, 64))
    if at < 0 or len(first) < at + 12 or first[0] != 0xFF:
        return Header()
    flags, frames = struct.unpack(">II", first[at + 4 : at + 12])
    if not flags & _HAS_FRAMES:
        return Header()
    # MPEG-1 has 1152 samples per frame in layer III, MPEG-2 and 2.5 have 576.
    return Header(least=max(0, frames * (1152 if first[1] & 0x08 else 576) - _SLACK))
