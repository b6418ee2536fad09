"""Ogg pages: each has a checksum and a number, and the last one is marked as such."""

from __future__ import annotations

import struct
import zlib
from typing import BinaryIO

from audio_features.containers.header import Header, copy_again, exactly
from audio_features.errors import AudioError

_FIRST, _LAST = 2, 4
# Ogg's CRC processes the most significant bit first, zlib's the least: mirror input and output.
_MIRROR = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


def read_header(file: BinaryIO, name: str, size: int) -> Header:
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
