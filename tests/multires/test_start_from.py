"""Runs that start from another model: what they take over, what is their own, what is refused."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from rigs import prefixed
from small_runs import small_config

import gesturekit as gk
from gesturekit.corpus import prepare
from gesturekit.errors import ConfigError, ModelError
from gesturekit.multires import MultiresConfig, load_training_data, train

STILL = {"learning_rate": 1e-9}
TINY = {
    "features": {"extractors": [{"kind": "prosody"}, {"kind": "effort"}]},
    "network": {"levels": 2, "channels": [2], "embedding": 4},
    "state": True,
    "losses": {"state": 1.0, "arm_speed": 0.0},
    "training": {"first_stage": 1, "window": 2.0, "window_cache": 2},
}


def tiny(corpus: Path | str, out: Path, **changes) -> MultiresConfig:
    """Settings of a run of one iteration."""
    return small_config(corpus, out, TINY, changes)


@pytest.fixture(scope="module")
def first(corpus, tmp_path_factory) -> Path:
    """The model of another speaker."""
    return train(tiny(corpus, tmp_path_factory.mktemp("first") / "run"))


def test_recordings_of_a_taller_speaker_on_top_of_another_model(
    first, gesture, write_speech, tmp_path
):
    """She is a tenth taller and moves more."""
    write_speech(tmp_path / "in" / "hers.wav", 4.0, level=0.4)
    motion = gesture(4.0, seed=5)
    rig = replace(motion.skeleton, offsets=1.1 * motion.skeleton.offsets)
    motion = replace(motion, skeleton=rig, translation=1.1 * motion.translation)
    motion.save(tmp_path / "in" / "hers.bvh")
    taller, gone = tmp_path / "c.jsonl", tmp_path / "gone"
    prepare([tmp_path / "in"], taller, holdout=0.0)
    shutil.copytree(first, gone)
    config = tiny(taller, tmp_path / "run", start_from=str(gone), training=STILL)
    folder = train(config)
    shutil.rmtree(gone)
    model, start = gk.load(folder), gk.load(first)
    # The other model's: units, and what the network gets.
    assert torch.equal(model.normaliser.scale, start.normaliser.scale)
    centres = (m.conditions.conditioner.centre for m in (model, start))
    assert np.array_equal(*centres)
    assert model.representation.joints == start.representation.joints
    for name, value in start.network.state_dict().items():
        assert torch.allclose(model.network.state_dict()[name], value, atol=1e-6), name
    # Her own: bones, state of movement and noise.
    assert np.allclose(model.skeleton.offsets, 1.1 * start.skeleton.offsets, atol=1e-4)
    assert not np.allclose(model.state_process.mean, start.state_process.mean)
    assert not torch.allclose(model.noise.sigma.mean(dim=0), start.noise.sigma.mean(dim=0))
    assert model.noise.sigma.shape == (1, 2)
    # Both in metres of the reference body.
    data = load_training_data(replace(config, start_from=first))
    values = data.normaliser.inverse(data.paired[0].motion[None])[0]
    column = data.representation.layout.root_height
    height, usual = float(values[column].mean()), float(start.normaliser.mean[column])
    assert height == pytest.approx(usual, abs=1e-3)
    assert str(gone) in (folder / "README.md").read_text("utf-8")
    assert "random" in (first / "README.md").read_text("utf-8")
    assert model.generate(seconds=1.0).n_frames == 30


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"fps": 20.0}, r"(?=.*fps)(?=.*\b25\b)(?=.*\b20\b)"),
        ({"network": {"embedding": 8}}, r"(?=.*network.embedding)(?=.*\b4\b)(?=.*\b8\b)"),
        ({"features": {"extractors": [{"kind": "prosody"}]}}, "(?=.*features)(?=.*effort)"),
        ({"features": None}, "(?=.*features)(?=.*effort)"),
        ({"state": False, "losses": {"state": 0.0}}, "state"),
    ],
)
def test_other_settings_are_refused(first, corpus, tmp_path, wrong, told):
    config = tiny(corpus, tmp_path / "run", start_from=str(first), **wrong)
    with pytest.raises(ConfigError, match=f"(?=.*start_from)(?=.*{first})(?=.*{told})"):
        train(config)
    assert not config.out.exists()


def test_another_rig_and_another_system_are_refused(first, gesture, write_speech, tmp_path):
    write_speech(tmp_path / "in" / "x.wav", 3.0)
    prefixed(gesture(3.0)).save(tmp_path / "in" / "x.bvh")
    prepare([tmp_path / "in"], tmp_path / "c.jsonl", holdout=0.0)
    config = tiny(tmp_path / "c.jsonl", tmp_path / "run", start_from=str(first))
    with pytest.raises(ConfigError, match="(?=.*'mixamorig:Hips')(?=.*'Hips')"):
        train(config)
    with pytest.raises(ModelError, match=str(tmp_path / "in")):
        train(replace(config, start_from=tmp_path / "in"))


def test_recordings_in_some_of_the_styles(motions, tmp_path):
    """The other styles stay known, and noise of them is made of any recording."""
    mode = {"features": None, "styles": {}, "network": {"levels": 2, "modulate": "all"}}
    mode |= {"z_star_shuffle": 3, "state": False, "losses": {"detail": 1, "state": 0}}
    start = train(tiny(motions(angry=[3.0], old=[3.0]), tmp_path / "start", **mode))
    mode["start_from"] = str(start)
    model = gk.load(train(tiny(motions(old=[4.0]), tmp_path / "run", **mode)))
    assert model.styles == ("angry", "old")
    assert model.noise.sequences["old_0"].style == "old"
    assert model.generate(seconds=2.0, style="angry").n_frames == 60
    for wrong, own in (({}, "'sad'"), ({"styles": None}, "")):
        config = tiny(motions(sad=[3.0]), tmp_path / "no", **{**mode, **wrong})
        with pytest.raises(ConfigError, match=f"(?=.*angry)(?=.*old)(?=.*{own})"):
            train(config)
