"""The training monitor logs metrics and does not change the training."""

import numpy as np
import pytest
import torch
from runs import logged, same_weights

import gesturekit as gk
from gesturekit.multires import MultiresGenerator, load_training_data, resample, train
from gesturekit.multires.training.monitor import Monitor, distance_from_recordings


def test_evaluations_keep_samples_and_the_best_model_and_change_no_weights(make_config, tmp_path):
    # With this seed, the best evaluation is followed by one that is better than some before it.
    training = {"further_stages": 6, "learning_rate": 0.01}
    changes = {"seed": 4, "training": training}
    plain = train(make_config(**changes, out=str(tmp_path / "plain")))
    config = make_config(**changes, out=str(tmp_path / "run"), eval_every=5)
    folder = train(config)
    assert same_weights(plain, folder) and logged(tmp_path / "plain") == logged(config.out)
    found = logged(config.out, "evaluation")
    # Every fifth step, and the last of both pairs of levels, of 6 iterations each.
    assert [line["step"] for line in found] == [5, 6, 10, 12]
    for metrics in found:
        assert {"arm_speed_ratio", "jerk_ratio", "foot_skate", "hellinger"} <= metrics.keys()
    assert found[0]["arm_speed_ratio"] != found[1]["arm_speed_ratio"]
    samples = sorted(path.name for path in (config.out / "samples").iterdir())
    assert samples == [f"step_{s:08d}.{kind}" for s in (5, 6, 10, 12) for kind in ("bvh", "html")]
    assert gk.Motion.load(config.out / "samples" / samples[0]).n_frames > 25
    # Of levels 3 and 4 of 4, from step 7 on.
    best = min(found[2:], key=distance_from_recordings)["step"]
    assert f"{best}, the best" in (config.out / "best" / "README.md").read_text()
    assert same_weights(folder, config.out / "best") == (best == 12)


class Echo:
    """A network that gives the recordings, as far as its levels can hold them."""

    def __init__(self, data) -> None:
        self.recordings = iter(sequence.motion[None] for sequence in data.paired)

    def parameters(self):
        return iter([torch.zeros(1)])

    def __call__(self, noises, conditions, *, lengths, convolve):
        assert len(noises) == len(conditions) == len(lengths)
        return [None, resample(next(self.recordings), lengths[-1])]


def test_recordings_are_as_they_should_be_and_identical_samples_are_reported(make_config, caplog):
    """The part of a motion that a level cannot hold is missing on both sides."""
    config = make_config(eval_every=5)
    data = load_training_data(config)
    monitor = Monitor(data, config)
    for levels in (2, 4):
        metrics = monitor.metrics(Echo(data), levels)
        assert metrics["patch_diversity_ratio"] == pytest.approx(1.0, abs=1e-6)
        assert [sample.n_frames for sample in monitor.samples] == [100, 63]
    ratios = {name: value for name, value in metrics.items() if name.endswith("_ratio")}
    assert len(ratios) > 3
    assert ratios == pytest.approx(dict.fromkeys(ratios, 1.0), abs=1e-3)
    network = MultiresGenerator(data.representation, data.n_speech, config.network).eval()
    for weight in network.parameters():
        torch.nn.init.zeros_(weight)
    metrics = monitor.metrics(network, 4)
    assert metrics["patch_diversity_ratio"] < 0.01
    assert monitor.warn_of_collapse(metrics, 5) and "Step 5: mode collapse" in caplog.text
    for few in ({"patch_diversity_ratio": 0.4}, {}):
        assert not monitor.warn_of_collapse(few, 5)


def test_the_best_model_is_nearest_to_the_recordings():
    assert distance_from_recordings({"foot_skate": 7.0}) == np.inf
    assert distance_from_recordings({"jerk_ratio": 0.0}) == np.inf
    ratios = {"jerk_ratio": 1.5, "arm_speed_ratio": 0.25, "foot_skate": 7.0}
    expected = (np.log(1.5) + np.log(4.0)) / 2
    assert distance_from_recordings(ratios) == pytest.approx(expected)
