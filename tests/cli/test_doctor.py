"""gesturekit doctor and cache, through the command line."""

import re
import shutil
from pathlib import Path
from types import SimpleNamespace

import torch

from gesturekit.diagnosis import Finding, diagnose, is_usable


def test_a_machine_that_works_is_usable(gesturekit, write_wavlm, tmp_path):
    write_wavlm(tmp_path / "weights")
    done = gesturekit("doctor", "--weights", tmp_path / "weights").ok()
    for name in ("torch", "GPU", "threads", "torchaudio", "transformers", "ffmpeg", "disk"):
        assert name in done.out
    assert "3 layers" in done.out and "32" in done.out


def test_a_broken_requirement_gives_exit_code_1(gesturekit, tmp_path):
    done = gesturekit("doctor", "--weights", tmp_path / "none").fails(1)
    assert re.search(rf"(?i)(?=.*broken)(?=.*WavLM)(?=.*{tmp_path / 'none'})", done.out)
    assert not is_usable([Finding("a", "ok", ""), Finding("b", "broken", "")])
    assert is_usable([Finding("a", "note", "")])


def finding(name: str) -> Finding:
    return next(found for found in diagnose() if found.name == name)


def test_a_disk_that_is_nearly_full_is_noted(monkeypatch):
    for free, state in ((0.5, "note"), (20.0, "ok")):
        usage = SimpleNamespace(total=10**11, used=0, free=round(free * 10**9))
        monkeypatch.setattr(shutil, "disk_usage", lambda folder: usage)  # noqa: B023
        found = {one.name: one for one in diagnose()}
        assert (found["disk"].state, found["cache"].state) == (state, state)
        assert re.search(rf"\b{free:g}(\.0)? GB", found["disk"].text)


def test_a_cache_that_cannot_be_written_is_noted(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    places = {"a": "ok", "new/below/b": "ok", "file/c": "note"}
    for place, state in places.items():
        monkeypatch.setenv("GESTUREKIT_CACHE", str(tmp_path / place))
        cache = finding("cache")
        assert cache.state == state
        assert str(tmp_path / place) in cache.text and "0 entries" in cache.text


def test_wavlm_weights_are_found_in_the_usual_folders(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    for name in ("HF_HUB_CACHE", "HF_HOME", "TORCH_HOME"):
        monkeypatch.delenv(name, raising=False)
    none = finding("WavLM")
    assert none.state == "note" and "--weights" in none.advice
    snapshot = "models--microsoft--wavlm-base-plus/snapshots/abc"
    for name in (
        f".cache/huggingface/hub/{snapshot}/model.safetensors",
        f"other/hub/{snapshot}/pytorch_model.bin",
        ".cache/torch/hub/checkpoints/wavlm_large.pt",
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("")
    for home, hub in ((None, ".cache/huggingface/hub"), (tmp_path / "other", "other/hub")):
        if home is not None:
            monkeypatch.setenv("HF_HOME", str(home))
        found = finding("WavLM")
        assert found.state == "ok" and str(tmp_path / hub / snapshot) in found.text
        assert "wavlm_large.pt" in found.text


def test_a_check_that_breaks_is_a_finding_and_the_next_ones_go_on(monkeypatch):
    def breaks() -> bool:
        raise RuntimeError("no   driver\nat all")

    monkeypatch.setattr(torch.cuda, "is_available", breaks)
    found = {one.name: one for one in diagnose()}
    gpu = found["GPU"]
    assert gpu.state == "broken" and "no driver" in gpu.text
    assert found["disk"].state != "broken" and not is_usable(list(found.values()))


def test_the_cache_is_shown_and_cleared(
    gesturekit, write_wavlm, write_speech, tmp_path, monkeypatch
):
    write_wavlm(tmp_path / "weights")
    wav = write_speech(tmp_path / "a.wav", 1.0)
    monkeypatch.setenv("GESTUREKIT_CACHE", str(tmp_path / "cache"))
    assert re.search(r"(?=.*entries)(?=.*\b0\b)", gesturekit("cache", "info").out)
    options = ("--extractor", "wavlm,prosody", "--weights", tmp_path / "weights")
    for out, cache in (("one", "--cache"), ("two", "--cache"), ("three", "--no-cache")):
        gesturekit("features", wav, *options, "--out", tmp_path / out, cache).ok()
    written = [(tmp_path / out / "a.npz").read_bytes() for out in ("one", "two", "three")]
    assert written[0] == written[1] == written[2]
    info = gesturekit("cache", "info").out
    assert re.search(r"(?=.*entries)(?=.*\b1\b)", info) and str(tmp_path / "cache") in info
    assert "1 entries" in gesturekit("cache", "clear").out
    assert re.search(r"(?=.*entries)(?=.*\b0\b)", gesturekit("cache", "info").out)
    assert gesturekit("cache", "forget").status == 2
