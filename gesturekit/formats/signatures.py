"""What a file is by its first bytes, whatever its suffix says."""

from __future__ import annotations

_SIGNATURES = {
    b"HIERARCHY": "a BVH file",
    b"RIFF": "a wav file",
    b"fLaC": "a flac file",
    b"OggS": "an ogg file",
    b"PK\x03\x04": "a zip or npz file",
    b"Kaydara FBX": "an FBX file",
    b"\x93NUMPY": "an npy file",
    b"glTF": "a glTF file",
    b"; FBX": "an FBX file",
    b"<": "an XML or HTML file",
    b"{": "a JSON file",
}


def kind_by_content(start: bytes) -> str | None:
    """What a file that begins with these 16 bytes or more is; None where it is nothing known."""
    kinds = (kind for mark, kind in _SIGNATURES.items() if start.startswith(mark))
    return next(kinds, None)
