"""File signatures: the kind of a file from its first bytes, independent of its suffix."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from gesturekit.wording import listed

A_JSON_FILE = "a JSON file"
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
    b"\x89PNG": "a PNG picture",
    b"\xff\xd8\xff": "a JPEG picture",
    b"%PDF": "a PDF document",
    b"{": A_JSON_FILE,
}
REPORT_IN_WORDS = "figures that gesturekit evaluate wrote (--json); --out FILE.html shows them"
_REPORT = {"reference", "models", "definitions"}  # keys
_SHOWN = 6


def kind_by_content(start: bytes) -> str | None:
    """Return the kind of a file from its first 16 bytes or more; None if unknown."""
    kinds = (kind for mark, kind in _SIGNATURES.items() if start.startswith(mark))
    return next(kinds, None)


def is_report(path: Path) -> bool:
    """Return whether a JSON file holds the metrics of an evaluation."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(content, dict) and content.keys() >= _REPORT


def json_in_words(content: Any) -> str:
    """Return a description of the content of a JSON file."""
    if not isinstance(content, dict):
        return f"a JSON {type(content).__name__}"
    if content.keys() >= _REPORT:
        return REPORT_IN_WORDS
    keys = [ascii(key)[1:-1][:40] for key in content]
    return f"a JSON object with {'the keys ' + listed(keys, _SHOWN) if keys else 'no keys'}"
