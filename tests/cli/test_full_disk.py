"""A disk that becomes full: one clear line, nothing lost, and a rerun with room completes."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from audio_features import FeatureTrack
from gesturekit import Motion
from gesturekit.jobs.state import STATE

ROOM = 200
"""Size of the disk, in kB."""


@pytest.fixture
def small_disk(tmp_path) -> Iterator[Path]:
    """A file system of `ROOM` kB in memory."""
    path = tmp_path / "disk"
    path.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={ROOM}k", "tmpfs", str(path)]
    try:
        subprocess.run(mount, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("this user may not mount a file system")
    yield path
    subprocess.run(["umount", str(path)], check=True)


@pytest.fixture
def recordings(tmp_path, write_pair) -> Path:
    for number in range(12):
        write_pair(tmp_path / "in", f"{number:02d}", 2.0, fps=25.0, seed=number)
    return tmp_path / "in"


def content(out: Path) -> dict[str, bytes]:
    """Bytes of each file but those of state; nothing temporary may be left."""
    files = [path for path in out.rglob("*") if path.is_file() and STATE not in path.parts]
    assert not [path for path in files if path.name.startswith(".")]
    return {path.relative_to(out).as_posix(): path.read_bytes() for path in files}


def done(out: Path) -> list[str]:
    """Files that are complete by the journal."""
    (journal,) = (out / STATE / "journal").iterdir()
    values = [json.loads(line) for line in journal.read_text().splitlines() if line[-1:] == "}"]
    return [file for one in values if one.get("status") == "done" for file in one["files"]]


COMMANDS: dict[str, Callable[[Path, Path], list]] = {
    "features": lambda folder, out: ["features", folder, "--out", out],
    "convert": lambda folder, out: ["convert", folder, out, "--format", "npz"],
    "render": lambda folder, out: ["render", folder, "--model", "demo", "--out", out],
}
READ = {"features": FeatureTrack.load, "convert": Motion.load, "render": Motion.load}


@pytest.mark.parametrize(
    "verb", ["features", "convert", pytest.param("render", marks=pytest.mark.stress)]
)
def test_a_disk_that_becomes_full(gesturekit, recordings, small_disk, tmp_path, verb):
    out, command = small_disk / "out", COMMANDS[verb]
    assert gesturekit(*command(recordings, tmp_path / "whole")).status == 0
    whole = content(tmp_path / "whole")
    assert sum(map(len, whole.values())) > 1000 * ROOM, "the disk has room for all"
    stopped = gesturekit(*command(recordings, out))
    assert stopped.status == 1
    (line,) = [line for line in stopped.err.splitlines() if line.startswith("Error: ")]
    assert "No space left on device; stopped: finished results are kept" in line
    assert "Traceback" not in stopped.err and stopped.err.count("No space left") == 1
    made = content(out)
    assert 1 <= len(done(out)) < 12 and set(done(out)) <= set(made)
    for name in made:
        READ[verb](out / name)
    assert all(whole[name] == data for name, data in made.items())
    # The same command on the full disk says the same, and loses nothing either.
    again = gesturekit(*command(recordings, out))
    assert again.status in (1, 2) and "No space left" in again.err
    assert content(out).items() >= made.items()
    options = f"remount,size={100 * ROOM}k"
    subprocess.run(["mount", "-o", options, str(small_disk)], check=True)
    assert gesturekit(*command(recordings, out)).status == 0
    assert content(out) == whole
