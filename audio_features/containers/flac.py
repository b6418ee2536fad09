"""FLAC header; the decoder itself verifies the checksum of every frame."""

from __future__ import annotations

from typing import BinaryIO

from audio_features.containers.header import Header, exactly, ffmpeg_line
from audio_features.errors import AudioError

_BLOCKS = 1000
# Sample rates by their code in a frame header (RFC 9639, section 9.1.2).
_RATE_CODES = dict(
    enumerate(
        (88_200, 176_400, 192_000, 8_000, 16_000, 22_050, 24_000, 32_000, 44_100, 48_000, 96_000),
        start=1,
    )
)
_CHECKED_BITS = (8, 16, 24)
"""Bit depths that float32 represents exactly, so that the MD5 can be computed from it."""


def read_header(file: BinaryIO, name: str, size: int) -> Header:
    """Read length and MD5 from STREAMINFO; its rate must match the first frame's."""
    exactly(file, 4, name)
    info = None
    for _ in range(_BLOCKS):
        head = exactly(file, 4, name)
        length = int.from_bytes(head[1:], "big")
        if head[0] & 0x7F == 0 and length == 34:
            info = exactly(file, 34, name)
        else:
            file.seek(length, 1)
        if head[0] & 0x80:
            break
    if info is None:
        raise AudioError(f"{name}: a FLAC file without STREAMINFO: export the file again")
    numbers = int.from_bytes(info[10:18], "big")
    rate, bits, frames = numbers >> 44, (numbers >> 36 & 0x1F) + 1, numbers & (1 << 36) - 1
    if frames == 0:
        raise AudioError(
            f"{name}: a FLAC file of undeclared length (written to a pipe): run {ffmpeg_line(name)}"
        )
    first = exactly(file, 4, name)
    # If the first frame has another form, only the decoder can judge it.
    code = first[2] & 0x0F if first[0] == 0xFF and first[1] >> 2 == 0x3E else 0
    if _RATE_CODES.get(code, rate) != rate:
        raise AudioError(
            f"{name}: damaged: the header says {rate} Hz, the sound {_RATE_CODES[code]} Hz: "
            "export the file again"
        )
    digest = info[18:]
    checked = any(digest) and bits in _CHECKED_BITS
    return Header(frames=frames, md5=(digest, bits) if checked else None)
