"""Header: the content that a sound file declares, read before libsndfile opens the file.

libsndfile silently shortens a file that ends early (an interrupted copy or download) and trusts a
damaged header. Each container's declared sizes are therefore checked against each other, against
the size of the file, and later against the decoded samples.
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from audio_features.errors import AudioError


@dataclass(frozen=True)
class Header:
    """Declared content of a sound file.

    Attributes:
        frames: samples per channel; None if only decoding shows it.
        least: minimum number of samples per channel, below which the file is truncated; for
            lossy formats, whose exact length the header does not hold.
        md5: (16-byte MD5 of the decoded samples as FLAC defines it, bits per sample); None if
            the file has no MD5.
        unsized_at: byte offset of a wav's length field that is 0 for "unknown", which libsndfile
            would read as "no sound"; None otherwise.
    """

    frames: int | None = None
    least: int = 0
    md5: tuple[bytes, int] | None = None
    unsized_at: int | None = None


def ffmpeg_line(name: str) -> str:
    """Return the ffmpeg command that converts a file to wav."""
    path = Path(name)
    stem = f"{path.stem}_new" if path.suffix.lower() == ".wav" else path.stem
    return f"`ffmpeg -i {shlex.quote(name)} {shlex.quote(str(path.with_name(stem + '.wav')))}`"


def raw_line(name: str) -> str:
    """Return the ffmpeg command that converts a file of samples without a header to wav."""
    return ffmpeg_line(name).replace("ffmpeg ", "ffmpeg -f s16le -ar 16000 -ac 1 ", 1)


def copy_again(name: str) -> str:
    """Return what to do about a truncated file."""
    return (
        f"copy or export the file again, or keep what is there by {ffmpeg_line(name)}, and put the "
        "result in the place of the file"
    )


def exactly(file: BinaryIO, count: int, name: str) -> bytes:
    """Read the next `count` bytes. Raises AudioError if the file ends before."""
    found = file.read(count)
    if len(found) < count:
        raise AudioError(
            f"{name}: truncated: the header itself ends after {file.tell()} bytes: "
            "copy or export the file again"
        )
    return found
