"""What the header of a sound file promises, read before libsndfile sees the file.

libsndfile silently shortens a file that ends before what its header declares (a copy or download
that broke off), and believes a damaged header. So each container's promises are read here and
held against each other, against the file's size, and later against what was decoded.
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from audio_features.errors import AudioError


@dataclass(frozen=True)
class Promise:
    """What must come out of a file.

    Attributes:
        frames: samples a channel; None where only decoding tells.
        least: fewer samples a channel than this are a truncation; for lossy sound, whose length
            is known to a frame or two.
        md5: (16 bytes) of the decoded samples as FLAC defines it, and their bits; None where the
            file holds none.
        unsized_at: where a wav holds a length of 0 that stands for unknown; libsndfile reads it
            as "no sound".
    """

    frames: int | None = None
    least: int = 0
    md5: tuple[bytes, int] | None = None
    unsized_at: int | None = None


def read_promise(name: str) -> Promise:
    """Look into a file and say what must come out of it.

    Raises AudioError where the header contradicts itself or the file, and for sound that
    libsndfile does not decode (AAC in m4a and the like), with the ffmpeg line to run.
    """
    from audio_features.containers import flac, ogg, plain, wav

    readers = {
        b"RIFF": wav.read_promise,
        b"RIFX": wav.read_promise,
        b"RF64": wav.read_promise,
        b"fLaC": flac.read_promise,
        b"OggS": ogg.read_promise,
        b"FORM": plain.read_aiff,
        b".snd": plain.read_au,
        b"NIST": plain.read_nist,
    }
    with Path(name).open("rb") as file:
        head = file.read(16)
        kind = _foreign(head)
        if kind is not None:
            raise AudioError(f"{name}: {kind}, which is not read here: run {ffmpeg_line(name)}")
        size = Path(name).stat().st_size
        if head[:4] in readers:
            file.seek(0)
            return readers[head[:4]](file, name, size)
        if head[:3] == b"ID3" or (len(head) > 1 and head[0] == 0xFF and head[1] & 0xE0 == 0xE0):
            from audio_features.containers import mpeg

            file.seek(0)
            return mpeg.read_promise(file, name, size)
    is_text = all(byte in b"\t\r\n" or 32 <= byte < 127 for byte in head)
    raise AudioError(
        f"{name}: cannot be read as sound (it begins with {head[:8]!r}): give a wav, flac, ogg, "
        "mp3 or aiff file" + ("" if is_text else f", or run {ffmpeg_line(name)}")
    )


def ffmpeg_line(name: str) -> str:
    """The command that makes a wav of a file."""
    path = Path(name)
    stem = f"{path.stem}_new" if path.suffix.lower() == ".wav" else path.stem
    return f"`ffmpeg -i {shlex.quote(name)} {shlex.quote(str(path.with_name(stem + '.wav')))}`"


def exactly(file: BinaryIO, count: int, name: str) -> bytes:
    """The next `count` bytes. Raises AudioError where the file ends before."""
    found = file.read(count)
    if len(found) < count:
        raise AudioError(
            f"{name}: truncated: the header itself ends after {file.tell()} bytes: "
            "copy or export the file again"
        )
    return found


def _foreign(head: bytes) -> str | None:
    """What kind of sound libsndfile will not decode; None where it may."""
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
