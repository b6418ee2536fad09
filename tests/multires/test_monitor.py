"""The training monitor logs metrics and does not change the training."""

import re

import numpy as np
import pytest
import torch
from runs import logged, same_weights

import gesturekit as gk
from gesturekit.multires import MultiresGenerator, load_training_data, resample, train
from gesturekit.multires.training.monitor import Monitor, distance_from_recordings


def test_evaluations_keep_samples_and_the_best_model_and_change_no_weights(
    make_config, motions, tmp_path
):
    # With this seed, the best evaluation is followed by one that is better than some before it.
    training = {"first_stage": 4, "learning_rate": 0.01, "window": 1.0}
    changes = {"seed": 4, "training": training, "features": None}
    changes["corpus"] = str(motions(none=[2.0]))
    plain = train(make_config(**changes, out=str(tmp_path / "plain")))
    config = make_config(**changes, out=str(tmp_path / "run"), eval_every=3)
    folder = train(config)
    assert same_weights(plain, folder) and logged(tmp_path / "plain") == logged(config.out)
    found = logged(config.out, "evaluation")
    # Every third step, and the last of both pairs of levels, of 4 iterations each.
    assert [line["step"] for line in found] == [3, 4, 6, 8]
    for metrics in found:
        assert {"arm_speed_ratio", "jerk_ratio", "foot_skate", "hellinger"} <= metrics.keys()
    assert found[0]["arm_speed_ratio"] != found[1]["arm_speed_ratio"]
    samples = sorted(path.name for path in (config.out / "samples").iterdir())
    assert len(samples) == 2 * 4, "a motion and a page of each"
    assert gk.Motion.load(config.out / "samples" / samples[0]).n_frames > 25
    # Of levels 3 and 4 of 4, from step 5 on.
    best = min(found[2:], key=distance_from_recordings)["step"]
    assert re.search(rf"steps\W+{best}\b", (config.out / "best" / "README.md").read_text())
    assert same_weights(folder, config.out / "best") == (best == 8)


class Echo:
    """A network that gives the recordings, as far as its levels can hold them."""

    def __init__(self, data) -> None:
        self.recordings = iter(sequence.motion[None] for sequence in data.paired)

    def parameters(self):
        return iter([torch.zeros(1)])

    def __call__(self, noises, conditions, *, lengths, convolve):
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
    assert monitor.warn_of_collapse(metrics, 5) and re.search("(?=.*5)(?=.*collapse)", caplog.text)
    for few in ({"patch_diversity_ratio": 0.9}, {}):
        assert not monitor.warn_of_collapse(few, 5)


def test_the_best_model_is_nearest_to_the_recordings():
    assert distance_from_recordings({"foot_skate": 7.0}) == np.inf
    assert distance_from_recordings({"jerk_ratio": 0.0}) == np.inf
    half, double, both = (
        distance_from_recordings({"jerk_ratio": one, "arm_speed_ratio": other, "foot_skate": 7.0})
        for one, other in ((1.0, 0.5), (2.0, 1.0), (0.5, 2.0))
    )
    assert 0 < half == pytest.approx(double) and both > 1.5 * half
    assert distance_from_recordings({"jerk_ratio": 1.0}) == 0
