"""Headers of compressed sound: Ogg, FLAC and MP3.

Each Ogg page has a checksum and a number, and the last one is marked as such. FLAC's decoder itself
verifies the checksum of every frame. Most MP3 encoders store the length in the first frame.
"""

from __future__ import annotations

import struct
import zlib
from typing import BinaryIO

from audio_features.containers.header import Header, copy_again, exactly, ffmpeg_line
from audio_features.errors import AudioError

_FIRST, _LAST = 2, 4
# Ogg's CRC processes the most significant bit first, zlib's the least: mirror input and output.
_MIRROR = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


def read_ogg(file: BinaryIO, name: str, size: int) -> Header:
    """Check every page: none damaged, none missing, none after the end.

    libsndfile would skip a damaged page and treat the remaining pages as the whole sound.
    """
    expected: dict[int, int] = {}
    ended: set[int] = set()
    while file.tell() < size:
        at = file.tell()
        head = bytearray(exactly(file, 27, name))
        if head[:4] != b"OggS":
            raise AudioError(f"{name}: damaged: no Ogg page at byte {at}: copy or export it again")
        table = exactly(file, head[26], name)
        body = exactly(file, sum(table), name)
        flags, serial, number, checksum = head[5], *struct.unpack("<III", head[14:26])
        head[22:26] = bytes(4)
        if checksum != _checksum(bytes(head) + table + body):
            raise AudioError(
                f"{name}: damaged: the checksum of the Ogg page at byte {at} is wrong: "
                "copy or export the file again"
            )
        if flags & _FIRST:
            if ended:
                raise AudioError(
                    f"{name}: several sounds one after the other in one Ogg file (byte {at}): "
                    "split it"
                )
            expected[serial] = number
        if expected.get(serial) != number:
            raise AudioError(
                f"{name}: damaged: Ogg page {expected.get(serial, 0)} is missing before byte "
                f"{at}: copy or export the file again"
            )
        expected[serial] = number + 1 & 0xFFFFFFFF
        if flags & _LAST:
            ended.add(serial)
    if set(expected) != ended:
        raise AudioError(
            f"{name}: truncated: the last Ogg page is not marked as the end of the sound: "
            f"{copy_again(name)}"
        )
    return Header()


def _checksum(page: bytes) -> int:
    """Compute CRC-32 with polynomial 0x04C11DB7, no reflection, initial value 0 (RFC 3533)."""
    mirrored = zlib.crc32(page.translate(_MIRROR), 0xFFFFFFFF) ^ 0xFFFFFFFF
    return int(f"{mirrored:032b}"[::-1], 2)


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


def read_flac(file: BinaryIO, name: str, size: int) -> Header:
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


_HEAD = 4096
_HAS_FRAMES = 1
# Samples that encoder and decoder may drop at the ends (codec delays and the last frame).
_SLACK = 4 * 1152


def read_mpeg(file: BinaryIO, name: str, size: int) -> Header:
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
