"""Files that are broken or hostile: our error or a result, in bounded time and memory."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from fuzz import CASES
from mutators import mutate
from targets import TARGETS

FUZZ = Path(__file__).with_name("fuzz.py")
EXECUTIONS = 20
"""Number for each target, and a tenth of it for those that load a model."""

pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="memory is bounded by Linux' limits"
)


def fuzz(*arguments: str) -> dict[str, dict]:
    root = str(FUZZ.parents[2])
    done = subprocess.run(
        [sys.executable, str(FUZZ), "--inside", "--engine", "own", *arguments],
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, "PYTHONPATH": root, "OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr
    return {(found := json.loads(line))["target"]: found for line in done.stdout.splitlines()}


def test_mutated_files_are_read_or_refused():
    found = fuzz("--executions", str(EXECUTIONS))
    assert {name: one["broken"] for name, one in found.items() if one["broken"]} == {}
    assert found.keys() == TARGETS.keys()
    assert all(one["executions"] >= EXECUTIONS // 10 for one in found.values())


def test_every_found_case_has_a_target():
    assert {path.name.split("-")[0] for path in CASES.iterdir()} <= TARGETS.keys()


def test_a_number_always_gives_the_same_case():
    target = TARGETS["words_ctm"]
    (seed,) = target.seeds(FUZZ.parent)
    cases = [mutate(seed, target.mutators, number) for number in range(20)]
    assert cases == [mutate(seed, target.mutators, number) for number in range(20)]
    assert len(set(cases)) > 15


@pytest.mark.stress
def test_many_mutated_files():
    """Run for minutes: the mutators alone, which every machine has."""
    found = fuzz("--executions", "3000", "--seconds", "60")
    assert {name: one["broken"] for name, one in found.items() if one["broken"]} == {}
