"""The golden comparison sees what changed, and nothing else."""

import io
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from golden import Ran, command_lines, differences, renamed_flags

TABLE = {
    "left_out": {"keys": ["time"], "patterns": [r"in \d+ s"], "files": ["*.log"]},
    "renamed": {"flags": {"--new": "--old"}, "texts": {"bank": "cache"}},
}


def npz(**arrays) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def found(before: Ran, after: Ran) -> list[str]:
    return list(differences(before, after, TABLE))


def test_times_left_out_files_and_renamed_words_are_no_difference():
    old = {"a.json": b'{"time": 1, "bank": 2}', "x/bank.npz": npz(a=[1]), "b.log": b"1"}
    new = {"a.json": b'{"cache": 2, "time": 5}', "x/cache.npz": npz(a=[1]), "b.log": b"2"}
    assert found(Ran(0, "done in 3 s", old), Ran(0, "done in 9 s", new)) == []


@pytest.mark.parametrize(
    "after, says",
    [
        (Ran(1, "done", {"a.bvh": b"1", "b.npz": npz(a=[1.0])}), r"\b0\b & \b1\b"),
        (Ran(0, "gone", {"a.bvh": b"1", "b.npz": npz(a=[1.0])}), r"printed & \+gone"),
        (Ran(0, "done", {"a.bvh": b"2", "b.npz": npz(a=[1.0])}), "a.bvh"),
        (Ran(0, "done", {"b.npz": npz(a=[1.0])}), "a.bvh & BASE"),
        (Ran(0, "done", {"a.bvh": b"1", "b.npz": npz(a=[1.0 + 1e-15])}), r"b.npz & \+a"),
        (Ran(0, "done", {"a.bvh": b"1", "b.npz": npz(b=[1.0])}), r"b.npz & \+b"),
    ],
)
def test_every_other_difference_is_listed(after, says):
    before = Ran(0, "done", {"a.bvh": b"1", "b.npz": npz(a=[1.0])})
    assert found(before, before) == []
    said = "\n".join(found(before, after))
    assert all(re.search(fact, said) for fact in says.split(" & "))


def test_command_lines_are_read_as_typed_and_spelled_as_base_does():
    lines = command_lines("render 'a b.wav' --new 3 # why\n\n# nothing\ninspect x\n")
    assert lines == [["render", "a b.wav", "--new", "3"], ["inspect", "x"]]
    assert renamed_flags(lines[0], TABLE["renamed"]["flags"]) == ["render", "a b.wav", "--old", "3"]


@pytest.mark.stress
def test_the_last_commit_writes_what_the_files_here_write():
    """Uncommitted changes make it fail where they change what is written."""
    script = Path(__file__).with_name("golden.py")
    run = subprocess.run([sys.executable, str(script), "HEAD"], capture_output=True, text=True)
    assert run.returncode == 0, run.stdout
