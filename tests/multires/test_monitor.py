"""The training monitor logs metrics and does not change the training."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

import gesturekit as gk
from gesturekit.multires.network.generator import MultiresGenerator
from gesturekit.multires.training.loading import load_training_data
from gesturekit.multires.training.monitor import Monitor, distance_from_recordings
from gesturekit.multires.training.trainer import train


def lines(folder) -> list[dict]:
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def test_evaluations_are_logged_and_the_weights_are_those_without_them(make_config, tmp_path):
    plain = train(make_config(out=str(tmp_path / "plain")))
    watched = train(make_config(out=str(tmp_path / "watched"), eval_every=3))
    one, other = (load_file(model / "model.safetensors") for model in (plain, watched))
    assert all(torch.equal(one[name], other[name]) for name in one)

    found = [line for line in lines(tmp_path / "watched") if line.get("kind") == "evaluation"]
    # Every third step, and the last of both pairs of levels (of 6 and 4 iterations).
    assert [line["step"] for line in found] == [3, 6, 9, 10]
    for metrics in found:
        assert {"arm_speed_ratio", "jerk_ratio", "foot_skate", "hellinger"} <= metrics.keys()
        assert not {"jerk_genea", "jerk_genea_ratio", "coverage"} & metrics.keys()
    assert found[0]["arm_speed_ratio"] != found[1]["arm_speed_ratio"]

    losses, without = (
        [{k: v for k, v in x.items() if "seconds" not in k} for x in lines(run) if "kind" not in x]
        for run in (tmp_path / "watched", tmp_path / "plain")
    )
    assert losses == without
    # The model's README tells losses, not evaluations.
    assert "discriminator" in (watched / "README.md").read_text()


def test_a_run_resumed_without_evaluations_ends_with_the_same_weights(make_config, tmp_path):
    run = tmp_path / "run"
    model = train(make_config(out=str(run), eval_every=5)) / "model.safetensors"
    whole = model.read_bytes()
    (run / "checkpoints" / "step_00000010.pt").unlink()  # so that there is something left to do
    model.unlink()
    train(make_config(out=str(run), eval_every=0), resume=True)
    assert model.read_bytes() == whole


def test_samples_and_the_best_model_of_the_last_pair_are_kept(make_config, tmp_path):
    # With this seed, the best evaluation is followed by one that is better than some before it.
    training = {"further_stages": 6, "learning_rate": 0.01}
    config = make_config(out=str(tmp_path / "run"), eval_every=1, seed=4, training=training)
    folder = train(config)
    samples = sorted(path.name for path in (config.out / "samples").iterdir())
    steps = range(1, 13)
    assert samples == [f"step_{s:08d}.{kind}" for s in steps for kind in ("bvh", "html")]
    assert gk.Motion.load(config.out / "samples" / samples[0]).n_frames > 25
    # Levels 3 and 4 of 4, from step 7 on.
    found = [x for x in lines(config.out) if x.get("kind") == "evaluation" and x["level"] == 3]
    best = min(found, key=distance_from_recordings)["step"]
    assert f"{best}, the best" in (config.out / "best" / "README.md").read_text()
    last = load_file(folder / "model.safetensors")
    kept = load_file(config.out / "best" / "model.safetensors")
    assert all(torch.equal(last[name], kept[name]) for name in last) == (best == 12)
    # Resumed from the middle of the last pair, it finds the same.
    whole = (config.out / "best" / "model.safetensors").read_bytes()
    (config.out / "checkpoints" / "step_00000012.pt").unlink()
    train(config, resume=True)
    assert (config.out / "best" / "model.safetensors").read_bytes() == whole


def test_identical_samples_are_reported(make_config, caplog):
    config = make_config(eval_every=5)
    monitor = Monitor(load_training_data(config), config)
    network = MultiresGenerator(
        monitor.data.representation, monitor.data.n_speech, config.network
    ).eval()
    for weight in network.parameters():
        torch.nn.init.zeros_(weight)
    metrics = monitor.metrics(network, 4)
    assert metrics["patch_diversity_ratio"] < 0.01
    assert monitor.warn_of_collapse(metrics, 5) and "Step 5: mode collapse" in caplog.text
    recorded = monitor._recorded(0)
    assert monitor._patch_spread([recorded]) > 0.5
    assert not monitor.warn_of_collapse({"patch_diversity_ratio": 0.9}, 5)


def test_the_best_model_is_nearest_to_the_recordings():
    near = {"jerk_ratio": 1.1, "arm_speed_ratio": 0.9, "foot_skate": 7.0}
    assert distance_from_recordings(near) < distance_from_recordings({"jerk_ratio": 0.5})
    twice, half = ({"jerk_ratio": ratio} for ratio in (2.0, 0.5))
    assert distance_from_recordings(twice) == pytest.approx(distance_from_recordings(half))
    assert distance_from_recordings({"jerk_ratio": 0.0}) == np.inf
