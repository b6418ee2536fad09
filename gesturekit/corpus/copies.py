"""Copies: files with the same content, whose recordings stay in one split."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from gesturekit.corpus.checks import Problem
from gesturekit.corpus.recording import Recording
from gesturekit.wording import counted, listed


def file_fingerprint(path: Path) -> str:
    """Return the first 16 hexadecimal digits of the SHA-256 of a file's content.

    That of a folder, an EasyMocap sequence, is made from those of its files.
    """
    if path.is_dir():
        files = sorted(file for file in path.rglob("*") if file.is_file())
        return hashlib.sha256("".join(map(file_fingerprint, files)).encode()).hexdigest()[:16]
    found = path.stat()
    # A file that is written again has another time of change, whatever its other times are set to.
    return _fingerprint(path, found.st_size, found.st_mtime_ns, found.st_ctime_ns)


@lru_cache(maxsize=2**16)
def _fingerprint(path: Path, *state: int) -> str:
    """Return the fingerprint of a file in this state."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:16]


def join_copies(recordings: Sequence[Recording]) -> tuple[list[Recording], list[Problem]]:
    """Give recordings with the same sound or motion, byte for byte, one take and one `original`.

    Returns:
        the recordings, and a warning that names the copies.
    """
    files = {path for one in recordings for path in (one.audio, one.motion) if path}
    original = _originals(sorted(files))
    contents = [[original[p] for p in (r.audio, r.motion) if p in original] for r in recordings]
    takes = _joined([one.take or one.id for one in recordings], contents)
    firsts = _joined([one.id for one in recordings], contents)
    joined = [
        replace(one, take=take, original=first)
        for one, take, first in zip(recordings, takes, firsts, strict=True)
    ]
    copies = [f"{path} (of {first})" for path, first in original.items() if path != first]
    if not copies:
        return joined, []
    text = (
        f"{counted(len(copies), 'file')} with the content of another: {listed(copies, 4)}. They "
        "count as one take, so that no copy of a held-out recording is trained on; delete those "
        "that are not meant to be there"
    )
    return joined, [Problem("warning", None, text)]


def _originals(files: Sequence[Path]) -> dict[Path, Path]:
    """Return the first file with the same content, for each of several with one content."""
    by_size: dict[int, list[Path]] = defaultdict(list)
    for path in files:
        by_size[path.stat().st_size].append(path)
    by_content: dict[str, list[Path]] = defaultdict(list)
    for path in (path for alike in by_size.values() if len(alike) > 1 for path in alike):
        by_content[file_fingerprint(path)].append(path)
    return {path: same[0] for same in by_content.values() if len(same) > 1 for path in same}


def _joined(names: Sequence[str], contents: Sequence[Sequence[Path]]) -> list[str]:
    """Return the first name that each name is connected with by contents that they share."""
    labels, holders = list(names), {}
    for k, shared in enumerate(contents):
        for content in shared:
            first, own = labels[holders.setdefault(content, k)], labels[k]
            if first != own:
                labels = [first if label == own else label for label in labels]
    return labels
