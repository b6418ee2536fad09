"""Each file is a draw of its own, keyed by its name and by nothing else of the batch."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import soundfile
from outputs import render, results

import audio_features as af
import gesturekit as gk
from gesturekit import Motion
from gesturekit.corpus import Item
from gesturekit.jobs.batch import Execution
from gesturekit.rendering.renderer import Output
from gesturekit.systems import bundled_speech

KINDS = ("bvh", "npz")


@pytest.fixture
def sounds(tmp_path, write_speech) -> list[Path]:
    """Three files of the same sound."""
    first = write_speech(tmp_path / "in" / "a.wav", 1.0)
    return [first, *(Path(shutil.copy(first, first.with_stem(name))) for name in "bc")]


def run(model, sources, out: Path, workers: int = 1, **controls) -> dict:
    """Render, and return the bytes of each file by its name."""
    given = {"output": Output(KINDS), "execution": Execution(workers=workers)}
    made = render(model, sources, out, **given, **controls)
    assert all(result.error is None for result in made)
    return results(out)


def of(name: str, files: dict[str, bytes]) -> dict[str, bytes]:
    return {file: data for file, data in files.items() if file.startswith(name)}


def test_files_of_the_same_sound_get_different_motions(model, sounds, tmp_path):
    made = run(model, sounds, tmp_path / "out")
    for kind in KINDS:
        assert len({made[f"{name}.{kind}"] for name in "abc"}) == 3, kind


def test_a_file_does_not_depend_on_the_others_or_their_order(model, sounds, tmp_path):
    whole = run(model, sounds, tmp_path / "whole")
    assert run(model, sounds[::-1], tmp_path / "reversed") == whole
    assert run(model, sounds[0].parent, tmp_path / "folder") == whole
    for sound in sounds:
        assert run(model, [sound], tmp_path / sound.stem) == of(sound.stem, whole)
    sampled = run(model, sounds[1:], tmp_path / "sampled", samples=2)
    for name in "bc":
        assert sampled[f"{name}_s1.bvh"] == whole[f"{name}.bvh"] != sampled[f"{name}_s2.bvh"]


@pytest.mark.stress
def test_processes_give_the_same_bytes(model, sounds, tmp_path):
    whole = run(model, sounds, tmp_path / "whole")
    assert run(model, sounds, tmp_path / "workers", workers=2) == whole


def test_the_name_is_the_item_of_generate(model, sounds, tmp_path):
    folder = tmp_path / "day"
    shutil.copytree(sounds[0].parent, folder / "one")
    items = [Item(id="some id", audio=sounds[0], motion=None, duration=1.0)]
    (tmp_path / "list.jsonl").write_text(f'{{"audio": "{sounds[0]}", "id": "listed/1"}}\n')
    made = {
        "a": run(model, sounds[:1], tmp_path / "file"),
        "one/a": run(model, folder, tmp_path / "below"),
        "some id": run(model, items, tmp_path / "manifest"),
        "listed/1": run(model, [tmp_path / "list.jsonl"], tmp_path / "list"),
    }
    run(model, [], tmp_path / "idle", seconds=1.0)
    for name, folder in zip(made, ("file", "below", "manifest", "list"), strict=True):
        motion = Motion.load(tmp_path / folder / f"{name}.npz")
        wanted = model.generate(sounds[0], item=name)
        assert np.array_equal(motion.rotations, wanted.rotations), name
    idle = Motion.load(tmp_path / "idle" / "motion.npz")
    assert np.array_equal(idle.rotations, model.generate(seconds=1.0, item="motion").rotations)


def test_a_quieter_file_of_the_same_name_keeps_its_motion(tmp_path):
    demo, speech = gk.load("demo"), af.Wave.load(bundled_speech(), duration=4.0)
    for name, gain in {"loud": 1.0, "quiet": 0.1}.items():
        (tmp_path / name).mkdir()
        file = tmp_path / name / "a.wav"
        soundfile.write(file, np.float32(gain) * speech.samples, speech.sample_rate, "FLOAT")
        run(demo, tmp_path / name, tmp_path / f"of {name}")
    loud, quiet = (Motion.load(tmp_path / f"of {name}" / "a.npz") for name in ("loud", "quiet"))
    np.testing.assert_allclose(quiet.rotations, loud.rotations, atol=1e-4)
