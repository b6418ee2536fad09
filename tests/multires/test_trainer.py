"""Training: what each step reads, exact resume, and a model that renders."""

import logging
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from rigs import nameless
from runs import logged, same_weights, weights

import audio_features as af
import gesturekit as gk
from audio_features import WeightsError
from gesturekit.corpus import Manifest, prepare
from gesturekit.errors import ConfigError, ModelError
from gesturekit.multires import LossConfig, load_training_data, train
from gesturekit.multires.training.trainer import Trainer
from gesturekit.training.config import dump_yaml, to_dict
from gesturekit.training.run_folder import Checkpoints
from gesturekit.training.session import session

RANDOM = {"discriminator", "adversarial", "contact", "smoothness", "arm_speed"}
ALL = RANDOM | {"reconstruction"}


def test_a_model_keeps_the_rate_of_its_recordings(make_config, corpus, tmp_path):
    config = make_config(fps=20.0)
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(dump_yaml(to_dict(config) | {"corpus": "elsewhere", "fps": 10.0}))
    folder = gk.train(
        recipe, {"fps": 20.0}, corpus=corpus, training={"first_stage": 1, "further_stages": 1}
    )
    model = gk.load(folder)
    assert (model.fps, model.recorded_fps) == (20.0, 30.0)
    motion = model.generate(seconds=2.0)
    assert (motion.fps, motion.n_frames) == (30.0, 60)
    speech = corpus.parent / "paired" / "b.wav"
    made = model.reconstruct("b", speech)
    assert (made.fps, made.n_frames) == (20.0, model.noise.sequences["b"].frames)
    wave = af.Wave.load(speech)
    longer = af.Wave(np.pad(wave.samples, (0, wave.sample_rate)), wave.sample_rate)
    assert model.reconstruct("b", longer).n_frames == made.n_frames, "the rest is left out"
    with pytest.raises(ModelError, match="(?=.*'b')(?=.*speech)"):
        model.reconstruct("b")
    with pytest.raises(ModelError, match=rf"(?=.*'b')(?=.*{made.n_frames} frames)(?=.*\b20\b)"):
        model.reconstruct("b", af.Wave.load(speech, duration=1.0))


@pytest.fixture
def announced(make_config, tmp_path, caplog):
    """announced(**changes): what a run logs before its first step, and its losses."""
    caplog.set_level(logging.INFO)

    def make(**changes) -> tuple[str, LossConfig]:
        config = make_config(**changes, out=str(tmp_path / f"{len(caplog.text)}"))
        caplog.clear()
        with session(config, resume=False) as (run, device, processes):
            made = Trainer(config, run, device, processes, resume=False)
        return caplog.text, made.config.losses

    return make


def test_a_run_says_what_it_trains_and_on_what(announced, motions):
    corpus = str(motions(old=[3.0], angry=[3.0]))
    both = ("2 recordings", "6 s", "30 fps", "25 fps", "19 of 19")
    three = {"styles": {}, "corpus": corpus, "joints": ["Hips", "Head", "Neck"]}
    for changes, facts in (
        ({}, ("speech", "5 s", "28 speech features", *both)),
        ({"features": None}, both),
        ({"features": None, **three}, ("2 styles", "3 of 19", "6 s")),
    ):
        said, _ = announced(**changes)
        for fact in (*facts, "multires", "4 levels", "longer=1"):
            assert fact in said, said


def test_losses_on_parts_that_a_rig_lacks_are_left_out(announced, gesture, write_speech, tmp_path):
    motion, parts = nameless(gesture(3.0))
    write_speech(tmp_path / "in" / "a.wav", 3.0)
    motion.save(tmp_path / "in" / "a.bvh")
    prepare([tmp_path / "in"], tmp_path / "in.jsonl", holdout=0.0)
    corpus, losses = str(tmp_path / "in.jsonl"), {"arm_speed": 2.0, "contact": 3.0}
    said, found = announced(corpus=corpus, losses=losses)
    assert (found.arm_speed, found.arm_acceleration, found.contact) == (0.0, 0.0, 0.0)
    assert all(fact in said for fact in ("arms", "contact", "parts:"))
    said, found = announced(corpus=corpus, losses=losses, parts=parts)
    assert (found.arm_speed, found.contact) == (2.0, 3.0) and "parts:" not in said


def test_finer_levels_learn_to_leave_what_is_coarse(make_config):
    training = {"first_stage": 20, "discriminator_steps": 0, "reconstruction_steps": 0, "window": 1}
    losses = {"adversarial": 0, "arm_speed": 0, "coarse": 20, "detail": 1}
    config = make_config(network={"levels": 2}, training=training, losses=losses, log_every=5)
    train(config)
    lines = logged(config.out)
    pair = [line for line in lines if line["level"] == 1]
    assert pair[-1]["coarse"] < 0.6 * pair[0]["coarse"]
    assert pair[-1]["detail"] < pair[0]["detail"]


@pytest.mark.parametrize(("levels", "window", "warned"), [(10, None, True), (9, None, False)])
def test_clips_shorter_than_a_patch_at_level_1_are_warned_about(
    announced, caplog, levels, window, warned
):
    """The clip has 125 frames: 9.4 of them at level 1 of 10, and 12.5 of 9; a patch has 13, which
    are 12.5 (4/3)^9 / 25 = 6.7 s at level 1 of 10."""
    network = {"levels": levels, "kernel": 5, "channels": [2, 2]}
    announced(network=network, training={"window": window})
    assert all((fact in caplog.text) is warned for fact in ("1 of 1", "13 frames", "6.7 s"))


def test_with_margins_a_whole_clip_continues_in_them_as_in_generation(make_config, batches_of):
    config = make_config(training={"window": None, "margins": True, "silence": 0.0})
    data = load_training_data(config)
    data = replace(data, conditions=replace(data.conditions, residual=False))
    (clip,) = data.unpaired
    batches = batches_of(replace(config, features=None), data, first=2)
    rng = torch.Generator().manual_seed(0)
    windows = batches.random(data.paired, clip.shape[-1], 1, rng)
    margin = config.random_margin
    around = np.pad(clip.numpy(), ((0, 0), (margin, margin)), mode="reflect")
    np.testing.assert_array_equal(windows.conditions[-1][0].numpy(), around)


def test_a_model_keeps_the_speed_of_its_fastest_second_in_metres(make_config, gesture, tmp_path):
    """In-betweening plans gaps by it. Bodies of twice the usual size; walks of 0.4 and 1.8 m/s."""
    (tmp_path / "walks").mkdir()
    for name, speed in {"slow": 0.4, "fast": 1.8}.items():
        walk = gesture(3.0)
        there = np.clip(walk.times - 1.0, 0.0, 1.0) * speed  # one second in the middle
        walk.translation[:] = np.stack([there, np.full_like(there, 1.8), 0 * there], axis=1)
        giant = replace(walk.skeleton, offsets=2.0 * walk.skeleton.offsets)
        replace(walk, skeleton=giant).save(tmp_path / "walks" / f"{name}.bvh")
    prepare([], tmp_path / "w.jsonl", unpaired_motion=[tmp_path / "walks"], holdout=0.0)
    short = {"features": None, "training": {"first_stage": 1}, "network": {"levels": 2}}
    model = gk.load(train(make_config(corpus=str(tmp_path / "w.jsonl"), **short)))
    assert model.representation.scale == pytest.approx(2.0, rel=0.2)
    assert model.fastest == pytest.approx(1.8, rel=0.05)


def test_a_recording_of_one_frame_at_the_coarsest_level_trains(make_config, write_pair, tmp_path):
    for stem, seconds in {"long": 1.0, "short": 0.5}.items():
        write_pair(tmp_path / "pairs", stem, seconds)
    prepare([tmp_path / "pairs"], tmp_path / "short.jsonl", holdout=0.0)
    changes = {"network": {"levels": 10}, "training": {"first_stage": 1, "further_stages": 1}}
    config = make_config(corpus=str(tmp_path / "short.jsonl"), **changes)
    assert (train(config) / "config.yaml").is_file()


def test_a_run_resumes_only_with_the_weights_it_began_with(make_config, write_wavlm, tmp_path):
    write_wavlm(tmp_path / "weights")
    features = {"extractors": [{"kind": "wavlm"}], "weights": str(tmp_path / "weights")}
    config = make_config(features=features, training={"first_stage": 1}, network={"levels": 2})
    train(config)
    assert train(config, resume=True).is_dir()
    write_wavlm(tmp_path / "weights", seed=1)
    with pytest.raises(WeightsError, match="(?=.*weights)(?=.*fingerprint)"):
        train(config, resume=True)


def test_a_run_leaves_metrics_checkpoints_and_a_model(make_config, tmp_path, caplog):
    """The same model by one thread, and by two of which each trains a level."""
    changes = {"losses": {"arm_acceleration": 3, "coarse": 1.0}, "notes": {"Licence": "CC0"}}
    changes["training"] = {"first_stage": 2, "further_stages": 2, "window": 1.0}
    config = make_config(**changes)
    folder = train(config)
    card = (folder / "README.md").read_text("utf-8")
    facts = ("4 levels", "25 fps", "30 fps", "19 of 19", "2 recordings", "6 s", "5 s", "1 file")
    for fact in (*facts, "discriminator", "CC0"):
        assert fact in card
    # Two iterations of two windows of 1 s, and a cache of four, of 6.5 s of recordings.
    assert card.count(" about 0.62 times (46% ") == 2
    assert re.search(r"steps\W+4\b", card)
    lines = logged(config.out)
    assert [(line["level"], line["step"]) for line in lines] == [(1, 2), (3, 4)]
    assert ALL | {"arm_acceleration"} <= set(lines[-1])
    for name in ("config.yaml", "command.txt", "versions.json", "checkpoints", "events"):
        assert (config.out / name).exists(), name
    motion = gk.load(folder).generate(seconds=2.0, fps=25)
    assert motion.n_frames == 50 and motion.skeleton.n_joints == 19
    assert same_weights(train(make_config(**changes, threads=2, out=str(tmp_path / "two"))), folder)


def test_no_checkpoint_is_written_after_nan(make_config):
    training = {"learning_rate": 1e30, "first_stage": 20}
    config = make_config(training=training, checkpoint_every=1, log_every=100)
    with pytest.raises(ModelError, match="(?=.*step)(?=.*NaN)"):
        train(config)
    latest = Checkpoints(config.out / "checkpoints").latest()
    assert latest is None or all(torch.isfinite(v).all() for v in latest[1]["generators"].values())


@pytest.mark.parametrize(
    ("changes", "losses"),
    [
        (
            {
                "training": {"window": None, "margins": True},
                "losses": {"arm_speed": 0, "rec_input": "real"},
            },
            ALL - {"arm_speed"},
        ),
        ({"training": {"discriminator_steps": 0, "generator_steps": 0}}, {"reconstruction"}),
        ({"training": {"reconstruction_steps": 0}, "precision": "bfloat16"}, RANDOM),
        ({"features": {"residual": False}, "network": {"film": "input"}, "joints": "all"}, ALL),
    ],
    # The order of a set depends on the process.
    ids=lambda value: "losses" if isinstance(value, set) else str(value),
)
def test_variants_train_on_the_losses_that_they_name(make_config, changes, losses, caplog, corpus):
    if "precision" in changes:  # without unpaired speech
        items = [item for item in Manifest.load(corpus) if item.is_paired]
        alone = make_config().out.parent / "alone.jsonl"
        Manifest(items).save(alone)
        changes = changes | {"corpus": str(alone)}
    short = {"first_stage": 1, **changes.get("training", {})}
    network = {"levels": 2, **changes.get("network", {})}
    config = make_config(**{**changes, "training": short, "network": network, "log_every": 1})
    trained = weights(train(config))
    assert ("unpaired" in caplog.text) == ("precision" in changes)
    # The finest level is at the full rate, where every loss applies.
    found = logged(config.out)[-1].keys()
    assert losses <= found and not (ALL - losses) & found
    assert all(torch.isfinite(value).all() for value in trained.values())


def test_wrong_betas_are_refused(make_config):
    for betas in ([0.9], [0.9, 1.0]):
        with pytest.raises(ConfigError, match="betas"):
            make_config(training={"betas": betas})
