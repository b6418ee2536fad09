"""The training monitor logs metrics and does not change the training."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from runs import logged, same_weights

import gesturekit as gk
from gesturekit.multires.network.generator import MultiresGenerator
from gesturekit.multires.training.loading import load_training_data
from gesturekit.multires.training.monitor import Monitor, distance_from_recordings
from gesturekit.multires.training.trainer import train


def test_evaluations_are_logged_and_do_not_change_the_weights(make_config, tmp_path):
    plain = train(make_config(out=str(tmp_path / "plain")))
    watched = train(make_config(out=str(tmp_path / "watched"), eval_every=3))
    assert same_weights(plain, watched)
    assert logged(tmp_path / "plain") == logged(tmp_path / "watched")
    found = logged(tmp_path / "watched", "evaluation")
    # Every third step, and the last of both pairs of levels (of 6 and 4 iterations).
    assert [line["step"] for line in found] == [3, 6, 9, 10]
    for metrics in found:
        assert {"arm_speed_ratio", "jerk_ratio", "foot_skate", "hellinger"} <= metrics.keys()
        assert not {"jerk_genea", "jerk_genea_ratio", "coverage"} & metrics.keys()
    assert found[0]["arm_speed_ratio"] != found[1]["arm_speed_ratio"]
    # The model's README tells losses, not evaluations.
    assert "discriminator" in (watched / "README.md").read_text()
    # Nor does a resumption without them.
    (tmp_path / "watched" / "checkpoints" / "step_00000010.pt").unlink()  # so that some is left
    (watched / "model.safetensors").unlink()
    train(make_config(out=str(tmp_path / "watched")), resume=True)
    assert same_weights(plain, watched)


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
    found = [line for line in logged(config.out, "evaluation") if line["level"] == 3]
    best = min(found, key=distance_from_recordings)["step"]
    assert f"{best}, the best" in (config.out / "best" / "README.md").read_text()
    assert same_weights(folder, config.out / "best") == (best == 12)
    # Resumed from the middle of the last pair, it finds the same.
    whole = (config.out / "best" / "model.safetensors").read_bytes()
    (config.out / "checkpoints" / "step_00000012.pt").unlink()
    train(config, resume=True)
    assert (config.out / "best" / "model.safetensors").read_bytes() == whole


def test_identical_samples_are_reported(make_config, caplog):
    config = make_config(eval_every=5)
    monitor = Monitor(load_training_data(config), config)
    data = monitor.data
    network = MultiresGenerator(data.representation, data.n_speech, config.network).eval()
    for weight in network.parameters():
        torch.nn.init.zeros_(weight)
    metrics = monitor.metrics(network, 4)
    assert metrics["patch_diversity_ratio"] < 0.01
    assert monitor.warn_of_collapse(metrics, 5) and "Step 5: mode collapse" in caplog.text
    recorded = monitor._recorded(0)
    assert monitor._patch_spread([recorded]) > 0.5 and monitor._patch_spread([recorded[:, :2]]) == 0
    assert not monitor.warn_of_collapse({"patch_diversity_ratio": 0.9}, 5)


def test_the_best_model_is_nearest_to_the_recordings():
    near = {"jerk_ratio": 1.1, "arm_speed_ratio": 0.9, "foot_skate": 7.0}
    assert distance_from_recordings(near) < distance_from_recordings({"jerk_ratio": 0.5})
    twice, half = ({"jerk_ratio": ratio} for ratio in (2.0, 0.5))
    assert distance_from_recordings(twice) == pytest.approx(distance_from_recordings(half))
    assert distance_from_recordings({"jerk_ratio": 0.0}) == np.inf
