"""Functions of `import gesturekit as gk`, called as a new user would."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

import audio_features as af
import gesturekit as gk
from gesturekit.systems import bundled_models, model_folder
from gesturekit.training.config import read_yaml


@pytest.fixture(scope="module")
def demo():
    return gk.load("demo")


@pytest.fixture
def sound(tmp_path, write_speech):
    return write_speech(tmp_path / "in" / "x.wav", 1.0)


@pytest.mark.parametrize(
    ("wrong", "named"),
    [({"seed": 1.5}, "seed="), ({"seconds": "two"}, "two"), ({"fps": "two"}, "two")],
)
def test_a_value_of_another_type_is_named(demo, wrong, named):
    with pytest.raises(gk.GestureKitError, match=named):
        demo.generate(**{"seconds": 0.5} | wrong)


def test_render_takes_one_source_as_text_and_renders_at_once(demo, sound, tmp_path):
    outcomes = gk.render(demo, str(sound), str(tmp_path / "out"))
    assert [outcome.files for outcome in outcomes] == [(tmp_path / "out" / "x.bvh",)]
    assert (tmp_path / "out" / "x.bvh").is_file()
    (outcome,) = gk.render(demo, sound.parent, tmp_path / "folder")
    assert outcome.files == (tmp_path / "folder" / "x.bvh",)


@pytest.mark.parametrize("formats", ["bvh,npz", ("BVH", ".npz")])
def test_render_takes_a_model_by_name_and_formats_as_people_write_them(sound, tmp_path, formats):
    (outcome,) = gk.render("demo", [sound], tmp_path, formats=formats, seed=3)
    assert [file.name for file in outcome.files] == ["x.bvh", "x.npz"]


@pytest.mark.parametrize("seconds", ["1-2", [(1, 2)], [(1.0, 2.0)]])
def test_prepare_takes_single_folders_and_intervals(write_pair, write_speech, tmp_path, seconds):
    write_pair(tmp_path / "pairs", "a", 3.0)
    write_speech(tmp_path / "speech" / "b.wav", 2.0)
    write_pair(tmp_path / "moves", "c", 2.0)[0].unlink()
    report = gk.prepare(
        str(tmp_path / "pairs"),
        unpaired=str(tmp_path / "speech"),
        unpaired_motion=str(tmp_path / "moves"),
        hold_out_seconds=seconds,
    )
    assert [item.id for item in report.manifest.unpaired()] == ["b"]
    assert [item.id for item in report.manifest.motion_alone()] == ["c"]
    assert [item.id for item in report.manifest.paired("test")] == ["a@1.00-2.00"]


def test_evaluate_takes_texts_and_a_manifest(write_pair, gesture, tmp_path):
    write_pair(tmp_path / "recordings", "a", 2.5, fps=25.0)
    gesture(2.5, 25.0, seed=5).save(tmp_path / "made" / "a.npz")
    folders = [str(tmp_path / name) for name in ("made", "recordings")]
    found = gk.evaluate(*folders, audio=folders[1], cheap=True)
    assert "sync" in found.models[0].metrics
    assert str(found.reference) == folders[1]
    manifest = tmp_path / "corpus.jsonl"
    gk.prepare(folders[1], manifest, holdout=0.0)
    (model,) = gk.evaluate({"ours": folders[0]}, str(manifest), split="train", cheap=True).models
    assert (model.label, "sync" in model.metrics) == ("ours", True)
    with pytest.raises(gk.GestureKitError, match="test"):
        gk.evaluate(folders[0], manifest)
    with pytest.raises(gk.GestureKitError, match="(?=.*'train')(?=.*manifest)"):
        gk.evaluate(*folders, split="train")


@pytest.mark.parametrize(
    ("option", "hint"),
    [("unpared", "unpaired"), ("xyz", "holdout")],
)
def test_an_option_that_prepare_does_not_have_is_named(tmp_path, option, hint):
    with pytest.raises(TypeError, match=f"(?=.*{option})(?=.*{hint})") as caught:
        gk.prepare(tmp_path, **{option: 1})
    assert isinstance(caught.value, gk.GestureKitError)


def test_one_class_catches_every_expected_error(demo, tmp_path):
    (tmp_path / "x.wav").write_text("no sound")
    motion = demo.generate(seconds=1.0)
    for fails in (
        lambda: demo.generate(tmp_path / "x.wav"),
        lambda: demo.generate(np.zeros(100), 16000),
        lambda: motion.save(tmp_path / "x.html", audio=tmp_path / "x.wav"),
    ):
        with pytest.raises(gk.GestureKitError) as caught:
            fails()
        assert isinstance(caught.value, af.AudioError) and isinstance(caught.value, ValueError)
        assert isinstance(caught.value.__cause__, af.AudioError)


@pytest.mark.parametrize("suffix", ["html", "png"])
def test_a_motion_is_saved_with_an_array_of_sound(demo, tmp_path, suffix):
    motion, samples = demo.generate(seconds=1.0), np.zeros(16000, np.float32)
    motion.save(tmp_path / f"x.{suffix}", audio=(samples, 16000))
    assert (tmp_path / f"x.{suffix}").is_file()
    with pytest.raises(gk.GestureKitError, match="(?=.*samples)(?=.*rate)"):
        motion.save(tmp_path / f"y.{suffix}", audio=samples)


def test_a_run_folder_can_be_loaded_as_a_model(demo, tmp_path):
    demo.save(tmp_path / "run" / "model")
    (tmp_path / "run" / "config.yaml").write_text("system: multires\n")
    assert gk.load(tmp_path / "run").folder == (tmp_path / "run" / "model").resolve()


def test_a_model_is_loaded_with_its_weights_on_a_device_and_in_a_precision(tmp_path):
    folder = tmp_path / "model"
    shutil.copytree(model_folder("demo"), folder)
    config = read_yaml(folder / "config.yaml")
    config["features"]["spec"] = {"kind": "wavlm"}
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    for options, says in (
        ({}, "WavLM"),
        ({"weights": tmp_path / "none"}, str(tmp_path / "none")),
        ({"device": "abacus"}, "abacus"),
        ({"dtype": "bf16"}, "bf16"),
    ):
        with pytest.raises(gk.GestureKitError, match=re.escape(says)):
            gk.load(folder, **options)
    (folder / "config.yaml").write_text("kind: other\n")
    with pytest.raises(gk.GestureKitError, match="(?=.*'other')(?=.*multires)"):
        gk.load(folder)
    (folder / "config.yaml").unlink()
    with pytest.raises(gk.GestureKitError, match=re.escape(str(folder))):
        gk.load(folder)


def test_a_bundled_name_goes_before_a_folder_of_that_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "demo").mkdir()
    assert "demo" in bundled_models()
    assert model_folder("demo").is_absolute() and (model_folder("demo") / "config.yaml").is_file()
    assert model_folder("./demo") == Path("demo")
    assert model_folder("other") == Path("other")
