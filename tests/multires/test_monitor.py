"""The training monitor logs metrics and does not change the training."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from runs import logged, same_weights

import gesturekit as gk
from audio_features import residual_pyramid
from gesturekit.multires.network.generator import MultiresGenerator
from gesturekit.multires.network.resampling import resample
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


class Echo:
    """A network that gives the recordings, as far as its levels can hold them."""

    def __init__(self, data) -> None:
        self.recordings, self.asked = [sequence.motion[None] for sequence in data.paired], []

    def parameters(self):
        return iter([torch.zeros(1)])

    def __call__(self, noises, conditions, *, lengths, convolve):
        recorded = self.recordings[len(self.asked)][..., :50]
        self.asked.append((noises, conditions, lengths))
        return [None, resample(recorded, lengths[-1])]


def test_beginnings_of_four_recordings_are_compared(make_config, monkeypatch):
    """Two seconds each, 50 frames; what a level cannot hold is missing on both sides."""
    monkeypatch.setattr("gesturekit.multires.training.monitor.MAX_SECONDS", 2.0)
    config = make_config()
    data = load_training_data(config)
    data = replace(data, paired=data.paired * 3)
    monitor = Monitor(data, config)
    for levels, lengths in ((2, [21, 28]), (4, [21, 28, 38, 50])):
        network = Echo(data)
        metrics = monitor.metrics(network, levels)
        assert metrics["patch_diversity_ratio"] == pytest.approx(1.0, abs=1e-6)
        assert len(network.asked) == len(monitor.samples) == 4
        assert {sample.n_frames for sample in monitor.samples} == {50}
        for (noises, conditions, asked), own in zip(network.asked, data.paired[:4], strict=True):
            speech = np.ascontiguousarray(own.speech[:, :50].T.numpy())
            expected = residual_pyramid(speech, [21, 28, 38, 50])[:levels]
            assert asked == lengths and len(noises) == levels
            for found, given in zip(conditions, expected, strict=True):
                np.testing.assert_allclose(found[0].T, given, atol=1e-5)
    ratios = {name: value for name, value in metrics.items() if name.endswith("_ratio")}
    assert len(ratios) > 3
    assert ratios == pytest.approx(dict.fromkeys(ratios, 1.0), abs=1e-3)
    motions = [own.motion[:, :n] for own, n in zip(data.paired, (40, 63, 24), strict=False)]
    layout = data.representation.layout
    windows = [np.lib.stride_tricks.sliding_window_view(m, 25, axis=1) for m in motions[:2]]
    patches = np.concatenate([own[layout.rotations] for own in windows], axis=1)
    assert patches.shape[1] == 16 + 39, "a patch of a second is longer than the third motion"
    spread = np.sqrt(patches.astype(float).var(axis=1).mean())
    assert monitor._patch_spread(motions) == pytest.approx(spread, rel=1e-5)


def test_a_collapse_is_less_than_two_fifths_of_the_diversity(make_config, caplog):
    config = make_config()
    monitor = Monitor(load_training_data(config), config)
    for metrics in ({"patch_diversity_ratio": 0.4}, {}):
        assert not monitor.warn_of_collapse(metrics, 7) and not caplog.text
    assert monitor.warn_of_collapse({"patch_diversity_ratio": 0.39}, 7)
    assert "0.39 times as much" in caplog.text


def test_the_best_model_is_nearest_to_the_recordings():
    assert distance_from_recordings({"foot_skate": 7.0}) == np.inf
    ratios = {"jerk_ratio": 1.5, "arm_speed_ratio": 0.25, "foot_skate": 7.0}
    expected = (np.log(1.5) + np.log(4.0)) / 2
    assert distance_from_recordings(ratios) == pytest.approx(expected)
    near = {"jerk_ratio": 1.1, "arm_speed_ratio": 0.9, "foot_skate": 7.0}
    assert distance_from_recordings(near) < distance_from_recordings({"jerk_ratio": 0.5})
    twice, half = ({"jerk_ratio": ratio} for ratio in (2.0, 0.5))
    assert distance_from_recordings(twice) == pytest.approx(distance_from_recordings(half))
    assert distance_from_recordings({"jerk_ratio": 0.0}) == np.inf
