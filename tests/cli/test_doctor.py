"""gesturekit doctor and cache, through the command line."""

from __future__ import annotations

import os
import subprocess
import sys

from gesturekit.diagnosis import Finding, diagnose, is_usable


def test_a_machine_that_works_is_usable(gesturekit, write_wavlm, tmp_path):
    write_wavlm(tmp_path / "weights")
    done = gesturekit("doctor", "--weights", tmp_path / "weights").ok()
    for name in ("torch", "GPU", "threads", "torchaudio", "transformers", "ffmpeg", "disk"):
        assert f" {name} " in done.out
    assert "makes motion: 30 frames" in done.out and "3 layers of 32" in done.out


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
