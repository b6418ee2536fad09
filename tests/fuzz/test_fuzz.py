"""Files that are broken or hostile: our error or a result, in bounded time and memory."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
from fuzz import CASES
from mutators import mutate
from targets import TARGETS

import audio_features as af
from gesturekit.errors import ConfigError
from gesturekit.training.config import read_yaml

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


# Small files that claim to be large are refused before memory is taken.


def test_a_feature_file_of_zeros_is_not_unpacked(tmp_path):
    path = tmp_path / "a.npz"
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("values.npy", "w") as member,
    ):
        np.lib.format.write_array_header_1_0(
            member, {"descr": "<f4", "fortran_order": False, "shape": (30 << 20, 1)}
        )
        for _ in range(30):
            member.write(bytes(4 << 20))
    assert path.stat().st_size < 1 << 20
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(af.FeatureError, match="unpacks to"):
        af.FeatureTrack.load(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 20 << 10


def test_yaml_of_nested_aliases_is_refused_at_once(tmp_path):
    for row in ("[{}]", "{{<<: [{}]}}"):  # lists of lists, and merged mappings
        lines = ["a: &a {x: 1, y: 2}"]
        for one, two in zip("abcdefghi", "bcdefghij"):
            lines.append(f"{two}: &{two} " + row.format(", ".join([f"*{one}"] * 9)))
        path = tmp_path / "a.yaml"
        path.write_text("\n".join(lines))
        begun = time.process_time()
        with pytest.raises(ConfigError, match=r"a\.yaml: .*aliases make it more than"):
            read_yaml(path)
        assert time.process_time() - begun < 1


def test_aliases_of_a_few_values_are_read(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text("base: &b {levels: 4, window: 1e-3}\nother: {<<: *b, levels: 5}\nmore: *b\n")
    assert read_yaml(path)["other"] == {"levels": 5, "window": 1e-3}


def test_a_configuration_of_megabytes_is_refused(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_bytes(b"# " + b"x" * (3 << 20))
    with pytest.raises(ConfigError, match="over 2 MB"):
        read_yaml(path)


def test_a_message_stays_short_whatever_it_quotes(tmp_path):
    error = ConfigError(f"{tmp_path}: key {'x' * 100_000!r} is unknown; did you mean levels?")
    assert len(str(error)) < 1400
    assert str(error).startswith(str(tmp_path)) and str(error).endswith("did you mean levels?")
