"""`make mutants` prints the defects that no test notices, here in a project of one module."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

CODE = """
def guarded(n):
    return n * 2


def unguarded(n: int) -> int:
    return -n
"""
TESTS = """from gesturekit.numbers import guarded, unguarded


def test_numbers():
    assert guarded(4) == 8
    assert unguarded(0) == 0
"""


@pytest.mark.stress
def test_it_prints_the_defects_that_no_test_notices(tmp_path):
    files = {"gesturekit/__init__.py": "", "gesturekit/numbers.py": CODE, "tests/test_n.py": TESTS}
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    tool = Path(__file__).with_name("mutants.py")
    command = [sys.executable, tool, "--seed", "3", "--only", "gesturekit", "--jobs", "1"]
    quick = {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "PYTEST_PLUGINS": "pytest_cov,xdist.plugin"}
    done = subprocess.run(
        command, cwd=tmp_path, env=os.environ | quick, capture_output=True, text=True, check=True
    )
    lines = done.stdout.splitlines()
    assert "3 of 3" in lines[0] and re.search(r"(?=.*\b2\b)(?=.*\b1\b)", lines[-1])
    (survived,) = (line for line in lines if "numbers.py" in line)
    assert re.search(r"(?=.*gesturekit/numbers\.py:7)(?=.*-n)(?=.*\(n\))", survived)
    assert (tmp_path / "gesturekit/numbers.py").read_text() == CODE
