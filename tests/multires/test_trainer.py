"""Training: what each step reads, exact resume, and a model that renders."""

from __future__ import annotations

import json
import logging

import pytest
import torch
from safetensors.torch import load_file

import gesturekit as gk
from gesturekit.errors import ConfigError
from gesturekit.multires.bank import Bank
from gesturekit.multires.data import TrainingData
from gesturekit.multires.trainer import train


def weights(config):
    return load_file(config.out / "model" / "model.safetensors")


def test_a_run_leaves_metrics_checkpoints_and_a_model(make_config):
    config = make_config()
    folder = train(config)
    lines = [json.loads(line) for line in (config.out / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [2, 4, 6, 8, 10]
    assert {"critic", "adversarial", "contact", "smooth", "arm_speed", "rec"} <= set(lines[-1])
    for name in ("config.yaml", "command.txt", "versions.json", "checkpoints", "events"):
        assert (config.out / name).exists(), name
    model = gk.load(folder)
    motion = model.generate(seconds=2.0)
    assert motion.n_frames == 50 and motion.skeleton.n_joints == 19


def test_training_moves_towards_the_recording(make_config):
    config = make_config(
        schedule={
            "first_pair": 60,
            "discriminator_steps": 0,
            "generator_steps": 0,
            "reconstruction_steps": 4,
        },
        log_every=10,
    )
    train(config)
    lines = [json.loads(line) for line in (config.out / "metrics.jsonl").read_text().splitlines()]
    first = [line["rec"] for line in lines if line["level"] == 1]
    assert first[-1] < 0.6 * first[0]


def test_the_same_seed_gives_the_same_weights_and_another_seed_others(make_config, tmp_path):
    one = make_config()
    same = make_config(out=str(tmp_path / "same"))
    other = make_config(out=str(tmp_path / "other"), seed=1)
    for config in (one, same, other):
        train(config)
    assert all(torch.equal(weights(one)[k], v) for k, v in weights(same).items())
    assert any(not torch.equal(weights(one)[k], v) for k, v in weights(other).items())


def test_random_steps_read_no_paired_speech_and_no_target(make_config, monkeypatch):
    speech_read, targets_read = [], []
    window, windows = TrainingData.speech_window, Bank._windows

    def speech_window(self, n_frames, rng):
        speech_read.append({id(clip) for clip in self.unpaired})
        assert not {id(clip) for clip in self.unpaired} & {id(s.speech) for s in self.paired}
        return window(self, n_frames, rng)

    def make_windows(self, n_frames, first, speech, noises, motion):
        made = windows(self, n_frames, first, speech, noises, motion)
        targets_read.append((noises[-1] is None, motion is None, made.targets is None))
        return made

    monkeypatch.setattr(TrainingData, "speech_window", speech_window)
    monkeypatch.setattr(Bank, "_windows", make_windows)
    train(make_config())
    assert speech_read, "random windows come from the unpaired speech"
    random = [(motion, target) for fixed, motion, target in targets_read if not fixed]
    paired = [(motion, target) for fixed, motion, target in targets_read if fixed]
    assert random and all(motion and target for motion, target in random)
    assert paired and not any(motion or target for motion, target in paired)


def test_without_unpaired_speech_the_run_says_what_it_does(make_config, tmp_path, caplog, corpus):
    lines = corpus.read_text().splitlines()
    alone = corpus.parent / "paired_only.jsonl"
    kept = [line for line in lines if json.loads(line).get("motion") or "schema" in line]
    alone.write_text("\n".join(kept) + "\n")
    with caplog.at_level(logging.WARNING):
        train(make_config(corpus=str(alone), schedule={"first_pair": 1, "further_pairs": 1}))
    assert "random steps draw windows of the paired speech" in caplog.text


@pytest.mark.parametrize(
    "changes",
    [
        {"schedule": {"window": None}},
        {"schedule": {"discriminator_steps": 0, "generator_steps": 0}},
        {"schedule": {"reconstruction_steps": 0}},
        {"features": {"residual": False}, "network": {"film": "input"}},
        {"losses": {"arm_speed": 0, "rec_input": "real"}},
        {"network": {"levels": 3}},
        {"joints": "all"},
    ],
    ids=str,
)
def test_variants_train(make_config, changes):
    assert (train(make_config(**changes)) / "config.yaml").is_file()


def test_a_folder_with_a_run_is_not_overwritten(make_config):
    config = make_config()
    with pytest.raises(ConfigError, match="no run to resume"):
        train(config, resume=True)
    train(config)
    before = (config.out / "metrics.jsonl").read_bytes()
    with pytest.raises(ConfigError, match="--resume"):
        train(config)
    with pytest.raises(ConfigError, match="seed: 0"):
        train(make_config(seed=5), resume=True)
    assert (config.out / "metrics.jsonl").read_bytes() == before
