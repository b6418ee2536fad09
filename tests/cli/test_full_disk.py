"""A disk that becomes full: one clear line, nothing lost, and a rerun with room completes."""

import re
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from outputs import finished, results

from audio_features import FeatureTrack
from gesturekit import Motion

ROOM = 200
"""Size of the disk, in kB."""


def resize(disk: Path, kilobytes: int) -> None:
    """Give a disk of `small_disk` another size."""
    options = f"remount,size={kilobytes}k"
    subprocess.run(["mount", "-o", options, str(disk)], check=True)


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


COMMANDS: dict[str, Callable[[Path, Path], list]] = {
    "features": lambda folder, out: ["features", folder, "--out", out],
    "convert": lambda folder, out: ["convert", folder, out, "--format", "npz"],
    "render": lambda folder, out: ["render", folder, "--model", "demo", "--out", out],
}
READ = {"features": FeatureTrack.load, "convert": Motion.load, "render": Motion.load}


@pytest.mark.parametrize(
    "verb",
    ["features", *(pytest.param(verb, marks=pytest.mark.stress) for verb in ("convert", "render"))],
)
def test_a_disk_that_becomes_full(gesturekit, write_pair, small_disk, tmp_path, verb):
    recordings, out, command = tmp_path / "in", small_disk / "out", COMMANDS[verb]
    for number in range(12):
        write_pair(recordings, f"{number:02d}", 2.0, fps=25.0, seed=number)
    assert gesturekit(*command(recordings, tmp_path / "whole")).status == 0
    whole = results(tmp_path / "whole")
    assert sum(map(len, whole.values())) > 1000 * ROOM, "the disk has room for all"
    stopped = gesturekit(*command(recordings, out)).fails(1)
    assert stopped.err.count("Error: ") == stopped.err.count("No space left") == 1
    made = results(out)
    complete = [file for result in finished(out) for file in result.made]
    assert 1 <= len(complete) < 12 and set(complete) <= set(made)
    for name in made:
        READ[verb](out / name)
    assert all(whole[name] == data for name, data in made.items())
    # The same command on the full disk says the same, and loses nothing either.
    again = gesturekit(*command(recordings, out))
    assert again.status in (1, 2) and "No space left" in again.err
    assert results(out).items() >= made.items()
    resize(small_disk, 100 * ROOM)
    assert gesturekit(*command(recordings, out)).status == 0
    assert results(out) == whole


def kilobytes(folder: Path) -> int:
    """Space that the files below a folder take, in whole blocks."""
    return sum(4 + path.stat().st_size // 1024 for path in folder.rglob("*") if path.is_file())


@pytest.mark.parametrize(
    "recipe", ["diffusion", pytest.param("multires", marks=pytest.mark.stress)], indirect=True
)
def test_a_disk_that_becomes_full_during_training(gesturekit, corpus, recipe, small_disk, tmp_path):
    settings = (*recipe, f"corpus={corpus}", "checkpoint_every=1", "log_every=1")
    whole, run = tmp_path / "whole", small_disk / "run"
    assert gesturekit("train", *settings, f"out={whole}").status == 0
    new, resumed = ["train", *settings, f"out={run}"], ["train", "--resume", run]
    checkpoint = kilobytes(whole / "checkpoints") // 2
    for room, command, then in (
        (kilobytes(whole / "data") // 2, new, "start"),
        (kilobytes(whole) - checkpoint // 2, new, f"gesturekit train --resume {run}"),
    ):
        resize(small_disk, room)
        stopped = gesturekit(*command).fails(2)
        (line,) = [line for line in re.split(r"[\r\n]", stopped.err) if "No space left" in line]
        assert f"{run}: " in line and then in line
    assert list((run / "checkpoints").glob("*.pt"))
    resize(small_disk, 100 * ROOM)
    assert gesturekit(*resumed).status == 0
    for name in ("model.safetensors", "config.yaml"):
        assert (run / "model" / name).read_bytes() == (whole / "model" / name).read_bytes()
