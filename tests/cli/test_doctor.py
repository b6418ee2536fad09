"""gesturekit doctor and cache, through the command line."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from importlib import util
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from gesturekit import systems
from gesturekit.diagnosis import Finding, diagnose, is_usable
from gesturekit.errors import ConfigError
from gesturekit.jobs.result import Processor
from gesturekit.jobs.run import Batch, Execution


def test_a_machine_that_works_is_usable(gesturekit, write_wavlm, tmp_path):
    write_wavlm(tmp_path / "weights")
    done = gesturekit("doctor", "--weights", tmp_path / "weights").ok()
    for name in ("torch", "GPU", "threads", "torchaudio", "transformers", "ffmpeg", "disk"):
        assert f" {name} " in done.out
    assert "makes motion: 30 frames" in done.out and "3 layers of 32" in done.out
    assert not [line for line in done.out.splitlines() if line.strip() == "→"], "advice is empty"


def test_a_broken_requirement_gives_exit_code_1(gesturekit, tmp_path):
    done = gesturekit("doctor", "--weights", tmp_path / "none").fails(1)
    assert f"BROKEN WavLM         {tmp_path / 'none'}" in done.out
    assert not is_usable([Finding("a", "ok", ""), Finding("b", "broken", "")])
    assert is_usable([Finding("a", "note", "")])


def test_a_named_blender_that_is_not_there_is_noted(monkeypatch, tmp_path):
    for name, state in ((sys.executable, "ok"), (str(tmp_path / "blender"), "note")):
        monkeypatch.setenv("GESTUREKIT_BLENDER", name)
        found = next(finding for finding in diagnose() if finding.name == "Blender")
        assert found.state == state and name in found.text


def finding(name: str) -> Finding:
    return next(found for found in diagnose() if found.name == name)


GIGABYTE = 10**9


@pytest.mark.parametrize(("free", "state"), [(1.9, "note"), (2.1, "ok")])
def test_a_disk_that_is_nearly_full_is_noted(monkeypatch, free, state):
    usage = shutil._ntuple_diskusage(100 * GIGABYTE, 0, round(free * GIGABYTE))
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: usage)
    disk, cache = finding("disk"), finding("cache")
    assert (disk.state, cache.state) == (state, state)
    assert f"{free} GB free" in disk.text
    assert ("nearly full" in cache.text) == (cache.advice == "gesturekit cache clear")


def test_a_cache_that_cannot_be_written_is_noted(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    places = {"a": "ok", "new/below/b": "ok", "file/c": "note"}
    for place, state in places.items():
        monkeypatch.setenv("GESTUREKIT_CACHE", str(tmp_path / place))
        cache = finding("cache")
        assert cache.state == state and f"{tmp_path / place}: 0 entries, 0.000 GB" in cache.text
        assert ("cannot be written to" in cache.text) == (state == "note")


@pytest.mark.parametrize(
    ("threads", "limit", "state", "advice"),
    [
        (4, None, "ok", ""),
        (2, None, "ok", ""),
        (2, "2", "note", "OMP_NUM_THREADS=2 says so"),
        (4, "4", "ok", ""),
        (5, None, "note", "set OMP_NUM_THREADS=4: more is slower"),
    ],
)
def test_threads_are_compared_with_cores(monkeypatch, threads, limit, state, advice):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 1, 2, 3})
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if limit is not None:
        monkeypatch.setenv("OMP_NUM_THREADS", limit)
    text = f"torch uses {threads} of 4 cores"
    assert finding("threads") == Finding("threads", state, text, advice)


def test_wavlm_weights_are_found_in_the_usual_folders(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    for name in ("HF_HUB_CACHE", "HF_HOME", "TORCH_HOME"):
        monkeypatch.delenv(name, raising=False)
    none = finding("WavLM")
    assert none.state == "note" and "--weights" in none.advice
    snapshot = "models--microsoft--wavlm-base-plus/snapshots/abc"
    files = (
        f".cache/huggingface/hub/{snapshot}/model.safetensors",
        ".cache/huggingface/hub/models--wavlm-empty/snapshots/abc/README.md",
        f"other/hub/{snapshot}/pytorch_model.bin",
        f"hub/{snapshot}/pytorch_model.bin",
        ".cache/torch/hub/checkpoints/wavlm_large.pt",
        "WavLM-Base.pt",
    )
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("")
    others = [tmp_path / ".cache/torch/hub/checkpoints/wavlm_large.pt", tmp_path / "WavLM-Base.pt"]
    for variables, hub in (
        ({}, ".cache/huggingface/hub"),
        ({"HF_HOME": str(tmp_path / "other")}, "other/hub"),
        ({"HF_HUB_CACHE": str(tmp_path / "hub"), "HF_HOME": "x"}, "hub"),
    ):
        for name, value in variables.items():
            monkeypatch.setenv(name, value)
        places = ", ".join(map(str, (tmp_path / hub / snapshot, *others)))
        assert finding("WavLM") == Finding("WavLM", "ok", f"weights in {places}")


def test_a_check_that_breaks_is_a_finding_and_the_next_ones_go_on(monkeypatch):
    def breaks() -> bool:
        raise RuntimeError("no   driver\nat all")

    monkeypatch.setattr(torch.cuda, "is_available", breaks)
    found = {one.name: one for one in diagnose()}
    assert found["GPU"] == Finding("GPU", "broken", "no driver", "install it again: make setup")
    assert found["disk"].state != "broken" and not is_usable(list(found.values()))


def test_only_the_beginning_of_a_long_error_is_shown(monkeypatch):
    def breaks(long: str = "x" * 400) -> bool:
        raise RuntimeError(f"{long}")

    monkeypatch.setattr(torch.cuda, "is_available", breaks)
    assert finding("GPU").text == "x" * 300
    monkeypatch.setattr(torch.cuda, "is_available", lambda: {}["driver"])
    assert finding("GPU").text == "'driver'"


def test_gpus_are_listed_and_what_keeps_torch_from_one_is_explained(monkeypatch):
    gpus = [
        SimpleNamespace(name=name, total_memory=n * 10**9) for name, n in (("A", 24), ("B", 80))
    ]
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda number: gpus[number])
    assert finding("GPU") == Finding("GPU", "ok", "A (24 GB), B (80 GB)")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for cuda, driver, state, says in (
        ("13.0", None, "note", "torch is built for CUDA but sees no GPU"),
        (None, "/bin/nvidia-smi", "note", "there may be one, but torch is built for the CPU"),
        (None, None, "ok", "none; everything runs on the CPU"),
    ):
        monkeypatch.setattr(torch.version, "cuda", cuda)
        monkeypatch.setattr(shutil, "which", lambda name: driver)  # noqa: B023
        found = finding("GPU")
        assert (found.state, found.text, bool(found.advice)) == (state, says, state == "note")
        build = f"built for CUDA {cuda}" if cuda else "built for the CPU"
        assert finding("torch").text == f"{torch.__version__}, {build}"


def test_packages_that_are_missing_are_noted_or_broken(monkeypatch):
    for name in ("imageio_ffmpeg", "soxr"):
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setattr(util, "find_spec", lambda name: None)
    found = {one.name: one for one in diagnose()}
    assert found["ffmpeg"].state == "note" and "gesturekit[video]" in found["ffmpeg"].advice
    assert found["transformers"] == Finding(
        "transformers", "note", "not installed", "pip install 'gesturekit[encoders]'"
    )
    assert found["libraries"].state == "broken" and found["libraries"].text.startswith("soxr (")


@pytest.mark.parametrize(
    ("name", "file", "state"),
    [("HTML player", "player.bundle.js", "broken"), ("human body", "human/human.npz", "note")],
)
def test_what_the_set_up_makes_is_there_or_named(monkeypatch, tmp_path, name, file, state):
    monkeypatch.setattr("gesturekit.diagnosis.__file__", str(tmp_path / "diagnosis.py"))
    missing = finding(name)
    assert (missing.state, missing.advice) == (state, "make setup")
    (tmp_path / "viewer" / file).parent.mkdir(parents=True)
    (tmp_path / "viewer" / file).write_bytes(bytes(2_340_000))
    assert finding(name).state == "ok" and finding(name).text.endswith(", 2.3 MB")


def test_a_folder_of_another_user_is_no_place_for_a_cache(monkeypatch, tmp_path):
    """The superuser, as who tests may run, can write everywhere."""
    monkeypatch.setenv("GESTUREKIT_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(systems, "load", None)  # the demo model is not what is looked at
    for right in (os.W_OK, os.X_OK):
        monkeypatch.setattr(os, "access", lambda place, mode: not mode & right)  # noqa: B023
        assert finding("cache").state == "note" and "cannot be written to" in finding("cache").text
        with pytest.raises(ConfigError, match="out: cannot be written to; give another folder"):
            list(Batch(Nothing(tmp_path / "out"), list, "r", Execution()).run())


class Nothing(Processor):
    """Work on nothing."""

    existing, settings, written = "refuse", {}, {}

    def __init__(self, out: Path) -> None:
        self.out = out

    def make(self, result) -> None: ...


UP_TO_TORCHAUDIO = """
from gesturekit.diagnosis import diagnose
for finding in diagnose():
    print(finding)
    if finding.name == "torchaudio":
        break
"""


def test_a_broken_torchaudio_is_explained_and_not_needed(tmp_path):
    (tmp_path / "torchaudio").mkdir()
    (tmp_path / "torchaudio" / "__init__.py").write_text("raise OSError('libcudart.so.13: no')")
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    command, about = [sys.executable, "-c", UP_TO_TORCHAUDIO], {**os.environ, "PYTHONPATH": path}
    done = subprocess.run(command, capture_output=True, text=True, env=about, check=False)
    assert done.returncode == 0, done.stderr
    last = done.stdout.splitlines()[-1]
    for word in ("name='torchaudio', state='note'", "libcudart.so.13", "pip uninstall torchaudio"):
        assert word in last


def test_the_cache_is_shown_and_cleared(
    gesturekit, write_wavlm, write_speech, tmp_path, monkeypatch
):
    write_wavlm(tmp_path / "weights")
    wav = write_speech(tmp_path / "a.wav", 1.0)
    monkeypatch.setenv("GESTUREKIT_CACHE", str(tmp_path / "cache"))
    assert "entries  0" in gesturekit("cache", "info").out
    options = ("--extractor", "wavlm,prosody", "--weights", tmp_path / "weights")
    for out, cache in (("one", "fp32"), ("two", "fp32"), ("three", "off"), ("four", "fp16")):
        done = gesturekit("features", wav, *options, "--out", tmp_path / out, "--cache", cache)
        assert done.status == 0 and "3 layers of 32" in done.out, done.err
    written = [(tmp_path / out / "a.npz").read_bytes() for out in ("one", "two", "three", "four")]
    assert written[0] == written[1] == written[2] != written[3]
    info = gesturekit("cache", "info").out
    assert "entries  2" in info and str(tmp_path / "cache") in info
    assert gesturekit("cache", "clear").out.startswith("2 entries removed")
    assert "entries  0" in gesturekit("cache", "info").out
    assert gesturekit("cache", "forget").status == 2
