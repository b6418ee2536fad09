"""Training: the recipe's numbers, exact resume, several processes, models that move alike."""

import re
import shutil

import numpy as np
import pytest
import torch
import yaml
from runs import cut_off, ended, launch, logged, same_weights, weights

import gesturekit as gk
from gesturekit.corpus import prepare
from gesturekit.diffusion import DiffusionModel, train
from gesturekit.diffusion.config import TrainingConfig
from gesturekit.diffusion.training.trainer import learning_rate
from gesturekit.errors import ConfigError, ModelError
from gesturekit.training.config import to_dict
from gesturekit.training.run_folder import Checkpoints


def test_a_run_leaves_metrics_checkpoints_and_a_model_that_moves(make_config):
    notes = {"Licence": "CC BY 4.0", "Year": 2026}
    config = make_config(eval_every=4, fps=15.0, clip_denoised=False, notes=notes)
    folder = train(config)
    card = (folder / "README.md").read_text()
    drawn = r"7\.4 times"  # 6 updates of 4 windows of 2 s, of 6.5 s of recordings
    for facts in ("2 rec", "6 s", drawn, r"steps\W+6\b", "Licence.* CC BY 4.0", "Year.* 2026"):
        assert re.search(facts, card)
    assert [line["step"] for line in logged(config.out)] == [2, 4, 6]
    assert [line["step"] for line in logged(config.out, "evaluation")] == [4, 6]
    assert {"arm_speed_ratio", "jerk_ratio"} <= logged(config.out, "evaluation")[-1].keys()
    assert Checkpoints(config.out / "checkpoints").steps() == [3, 6]
    for name in ("config.yaml", "command.txt", "versions.json", "events"):
        assert (config.out / name).exists(), name
    model = gk.load(folder)
    assert (model.fps, model.recorded_fps, model.clip_denoised) == (15.0, 30.0, False)
    motion = model.generate(seconds=2.0, clip_denoised=True)
    assert motion.n_frames == 60 and motion.skeleton.n_joints == 19


def test_training_learns_to_predict_noise(make_config):
    config = make_config(
        features=None,
        network={"channels": 32},
        training={"updates": 60, "learning_rate": 5e-3, "window": 1.0},
        log_every=10,
    )
    train(config)
    first, *_, last = [line["loss"] for line in logged(config.out)]
    assert last < 0.95 * first


def test_the_seed_decides_the_weights_and_evaluation_does_not(make_config, tmp_path):
    kinds = {"plain": {}, "watched": {"eval_every": 1}, "other": {"seed": 1}}
    short = {"features": None, "training": {"updates": 2}}
    plain, watched, other = (
        train(make_config(out=str(tmp_path / name), **short, **changes))
        for name, changes in kinds.items()
    )
    assert same_weights(plain, watched) and not same_weights(plain, other)


def test_the_model_is_the_moving_average_of_the_weights(make_config, tmp_path):
    """The second of two updates keeps 2 of 11 parts of the average before it."""
    one, two, last = (
        weights(train(make_config(out=str(tmp_path / name), features=None, training=training)))
        for name, training in (
            ("one", {"updates": 1, "ema": 0.6}),
            ("two", {"updates": 2, "ema": 0.6}),
            ("last", {"updates": 2}),
        )
    )
    for name, value in two.items():
        if value.is_floating_point():
            torch.testing.assert_close(value, (2 * one[name] + 9 * last[name]) / 11)


def test_a_resumed_run_is_the_same_to_the_last_bit(make_config, tmp_path):
    options = {"training": {"ema": 0.5, "dropout_condition": 0.3}}
    whole = make_config(out=str(tmp_path / "whole"), **options)
    cut = make_config(**options)
    train(whole)
    shutil.copytree(whole.out, cut.out)
    # As it was when killed after step 5: a checkpoint of step 3, and lines that come again.
    cut_off(cut.out, 6)
    train(cut, resume=True)
    assert same_weights(whole.out / "model", cut.out / "model")
    assert [line["step"] for line in logged(cut.out)] == [2, 4, 6]
    with pytest.raises(ConfigError, match=r"(?=.*seed)(?=.*\b0\b)(?=.*\b5\b)"):
        train(make_config(seed=5, **options), resume=True)
    with pytest.raises(ConfigError, match=f"(?=.*{cut.out})(?=.*out=)"):
        train(cut)


@pytest.mark.stress
def test_two_processes_train_the_model_of_one(make_config, tmp_path, device):
    options = {"network": {"dropout": 0.0}, "training": {"batch": 5}, "device": device}
    one = weights(train(make_config(out=str(tmp_path / "one"), **options)))
    config = make_config(**options)
    file = tmp_path / "config.yaml"
    file.write_text(yaml.safe_dump(to_dict(config)))
    said = ended(launch("-m", "gesturekit", "train", file, processes=2))
    assert len(re.findall("2 rec", said)) == 1
    two = weights(config.out / "model")
    # Adam divides by the size of a gradient: what is next to nothing may go either way.
    apart = torch.cat([(one[name] - two[name]).abs().flatten() for name in one])
    assert apart.quantile(0.99) < 1e-5 and apart.max() < 0.01


@pytest.mark.parametrize("warm_up", [0, 1, 95, 100, 300])
def test_the_learning_rate_is_that_of_the_released_scheduler(warm_up):
    """There, `StepLR` of ten steps runs from the start; warm-up overwrites its rates."""
    config = TrainingConfig(warm_up=warm_up)
    optimiser = torch.optim.Adam([torch.nn.Parameter(torch.zeros(1))], lr=6e-4)
    scheduler = torch.optim.lr_scheduler.StepLR(optimiser, step_size=10, gamma=config.decay)
    for update in range(warm_up + 45):
        (group,) = optimiser.param_groups
        if update < warm_up:
            group["lr"] = 6e-4 * (update + 1) / warm_up
        assert learning_rate(config, update) == pytest.approx(group["lr"], rel=1e-9), update
        optimiser.step()
        scheduler.step()


def test_nan_stops_the_run_and_the_last_good_checkpoint_stays(make_config, monkeypatch):
    steps, own = [], torch.optim.Adam.step

    def step(self, *args, **kwargs):
        steps.append(own(self, *args, **kwargs))
        if len(steps) > 4:
            self.param_groups[0]["params"][0].data.fill_(float("nan"))

    monkeypatch.setattr(torch.optim.Adam, "step", step)
    config = make_config()
    with pytest.raises(ModelError, match="(?=.*NaN)(?=.*step 3)"):
        train(config)
    last, state = Checkpoints(config.out / "checkpoints").latest()
    assert last == 3 and all(torch.isfinite(value).all() for value in state["network"].values())


@pytest.mark.parametrize(
    "changes",
    [
        {"features": None, "path": True},
        {"training": {"precision": "bfloat16", "min_snr": 5.0}, "noise": {"predict": "velocity"}},
        {"training": {"changes": 0.3, "foot_sliding": 0.3}, "noise": {"predict": "clean"}},
        {
            "network": {"architecture": "diffwave", "dilations": [1, 2]},
            "joints": "all",
            "training": {"dropout_condition": 0.1, "dropout_style": 0.1},
        },
    ],
    ids=str,
)
def test_variants_train(make_config, changes):
    training = {**changes.get("training", {}), "updates": 2}
    config = make_config(**{**changes, "training": training})
    made = DiffusionModel.load(train(config))
    # What guidance may leave out is what windows were trained without.
    assert made.droppable == (("all", "styles") if config.training.dropout_style else ())
    assert all(0 < line["loss"] < 3 for line in logged(config.out))


def test_losses_on_motion_need_a_network_that_predicts_it(make_config):
    for name in ("changes", "foot_sliding"):
        with pytest.raises(ConfigError, match=f"(?=.*training.{name})(?=.*0.3)(?=.*noise.predict)"):
            make_config(training={name: 0.3})


def test_experts_with_speech_and_events_can_be_combined(make_config, gesture, tmp_path):
    """Kicks happen in motion alone, whose mean and spread are not those of the corpus."""
    (tmp_path / "in").mkdir()
    gesture(4.0, seed=9).save(tmp_path / "in" / "f.bvh")
    (tmp_path / "in" / "f.events.csv").write_text("time,name\n1,kick\n2.5,kick\n")
    prepare([], tmp_path / "f.jsonl", unpaired_motion=[tmp_path / "in"], holdout=0.0)
    short = {"training": {"updates": 1}}
    heard = train(make_config(**short))
    told = {"corpus": str(tmp_path / "f.jsonl"), "features": None, "events": True, **short}
    apart = DiffusionModel.load(train(make_config(out=str(tmp_path / "apart"), **told)))
    config = make_config(out=str(tmp_path / "like"), moves_like=str(heard), **told)
    like, leader = DiffusionModel.load(train(config)), DiffusionModel.load(heard)
    with pytest.raises(ModelError, match="moves_like"):
        leader.generate(seconds=1.0, events="kick@0.5", experts=[(apart, 0.5)])
    assert like.conditions.events == ("kick",) and like.conditions.conditioner is None
    assert torch.equal(like.normaliser.scale, leader.normaliser.scale)
    motion = leader.generate(seconds=1.0, events="kick@0.5", experts=[(like, 0.5)], steps=3)
    alone = leader.generate(seconds=1.0, steps=3)
    assert motion.n_frames == 30 and np.abs(motion.rotations - alone.rotations).max() > 1e-4
