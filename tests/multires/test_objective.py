"""The training objective, against numbers worked out by hand: signs, weights, units, noise."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from gesturekit.multires import losses
from gesturekit.multires.config import RecallConfig
from gesturekit.multires.kinematics import CAPTURE_SECONDS, VectorKinematics
from gesturekit.multires.network.resampling import resample
from gesturekit.multires.training.stage import Stage
from gesturekit.multires.training.targets import log_movement
from gesturekit.multires.training.trainer import Trainer, train
from gesturekit.multires.training.window_cache import random_windows
from gesturekit.training.run.session import session
from gesturekit.training.seeds import rng_for


def test_generators_want_high_scores_and_discriminators_a_gap():
    scores = torch.tensor([1.0, 3.0])
    assert float(losses.adversarial(scores)) == -2.0
    assert float(losses.discriminator_gap(scores, torch.tensor([4.0, 6.0]))) == -3.0


def test_the_gradient_penalty_wants_a_norm_of_one():
    # Two channels, two frames: frame norms 5 and 0, the window's norm is 5.
    gradient = torch.tensor([[[3.0, 0.0], [4.0, 0.0]]])

    def penalty(penalty_on):
        motions = torch.zeros(1, 2, 2)
        score = lambda x: (x * gradient).sum(dim=(1, 2))  # noqa: E731
        return float(losses.gradient_penalty(score, motions, motions, motions, penalty_on))

    assert penalty("printed") == 16.0
    # GANimator: of the sum over two frames' scores, norms 10 and 0.
    assert penalty("frame") == (81.0 + 1.0) / 2
    # The gradient of the sum over two frames' scores is sqrt(2) larger in units of the mean's.
    expected = (5 * math.sqrt(2) - 1) ** 2
    assert penalty("window") == pytest.approx(expected)


def test_the_contact_loss_is_squared_speed_where_the_label_says_standing():
    velocity = torch.tensor([[[[0.3, 0.0, 0.4]], [[0.0, 2.0, 0.0]]]])  # 0.5 and 2 m/s
    labels = torch.tensor([[[1.0], [0.0]]])
    stands, lifted = 1 / (1 + math.exp(-5)), 1 / (1 + math.exp(5))
    expected = (0.25 * stands + 4.0 * lifted) / 2
    assert float(losses.contact(velocity, labels)) == pytest.approx(expected, rel=1e-5)
    # GANimator: the speed itself, and a slope of 12.
    stands, lifted = 1 / (1 + math.exp(-6)), 1 / (1 + math.exp(6))
    expected = (0.5 * stands + 2.0 * lifted) / 2
    loss = losses.contact(velocity, labels, slope=12.0, squared=False)
    assert float(loss) == pytest.approx(expected, rel=1e-5)


def test_errors_are_means_of_absolute_differences_of_speeds_accelerations_and_places():
    one, other = torch.tensor([[[1.0, -2.0, 0.0]]]), torch.tensor([[[0.0, 2.0, 1.0]]])
    for loss in (losses.reconstruction, losses.coarse):
        assert float(loss(one, other)) == 2.0
    made = torch.tensor([[[1.0, 1.0], [0.0, 8.0]], [[3.0, 1.0], [0.0, 0.0]]])
    # Speeds 1, 1, 3, 1 and accelerations 0, 8, 0, 0 of two motions of two frames.
    assert losses.movement(made, torch.zeros_like(made)).tolist() == [1.5, 2.0]
    # One joint at 0, 0 and 3 m along x: it is 1 m from the mean of the three.
    bend = torch.tensor([0.0 - 2 * 0.0 + 3.0, 0.0, 0.0]).reshape(1, 1, 3, 1)
    assert float(losses.smoothness(bend)) == pytest.approx(1.0)


def test_detail_is_the_energy_distance():
    made, recorded = torch.tensor([[0.0], [2.0]]), torch.tensor([[1.0], [4.0]])
    # Mean of |0-1|, |0-4|, |2-1|, |2-4| less half the mean distance of the generated ones.
    assert float(losses.detail(made, recorded)) == pytest.approx(2.0 - 0.5 * 2.0, abs=2e-3)


ALONE = dict.fromkeys(("adversarial", "contact", "smoothness", "arm_speed", "reconstruction"), 0)
ALONE |= {"gradient_penalty": 1, "arm_acceleration": 0, "detail": 0, "coarse": 0}


@pytest.fixture
def stage_of(make_config, tmp_path):
    """The first training stage, or another, of the small configuration with changes."""

    def make(first: int = 0, **changes) -> Stage:
        config = make_config(**changes, out=str(tmp_path / f"{first} {changes}"))
        with session(config, resume=False) as (run, device, processes):
            trainer = Trainer(config, run, device, processes, resume=False)
        for number, level in enumerate(trainer.network.levels):
            # As it is made, modulation is the identity: give every part a say.
            for name, weight in level.named_parameters():
                rng = rng_for("shaken", number, name)
                weight.data += 0.05 * torch.randn(weight.shape, generator=rng)
        stage = trainer.stage(first, iterations=10)
        stage.batches.renew(0)
        return stage

    return make


def steps_of(stage: Stage, kind: str):
    """One step's gradients by the generators' parameters, and what it reports."""
    stage._update = lambda name: None
    n_frames = max(stage.batches.sequences)
    step = {"random": stage._random_step, "paired": stage._reconstruction_step}[kind]
    report = step(n_frames, rng_for("step"))
    gradients = [p.grad.clone() for p in stage.generators.parameters() if p.grad is not None]
    return torch.cat([gradient.flatten() for gradient in gradients]), report


@pytest.mark.parametrize(
    ("name", "kind", "first"),
    [
        ("adversarial", "random", 0),
        ("contact", "random", 0),
        ("smoothness", "random", 2),
        ("arm_speed", "random", 0),
        ("arm_acceleration", "random", 0),
        ("detail", "random", 2),
        ("coarse", "random", 2),
        ("reconstruction", "paired", 0),
    ],
)
def test_every_weight_scales_its_gradient(stage_of, name, kind, first):
    once, _ = steps_of(stage_of(first, losses={**ALONE, name: 1.0}), kind)
    thrice, _ = steps_of(stage_of(first, losses={**ALONE, name: 3.0}), kind)
    assert float(once.norm()) > 0
    torch.testing.assert_close(thrice, 3 * once, rtol=1e-3, atol=1e-6 * float(once.norm()))


def test_smoothness_counts_from_half_the_full_rate_on(stage_of):
    # Levels of 32, 42, 56 and 75 frames: the second has 0.56 of the full rate, the first 0.43.
    stage = stage_of(0, losses={**ALONE, "smoothness": 1.0})
    steps_of(stage, "random")
    coarse, finer = stage.generators
    assert all(p.grad is None or not p.grad.any() for p in coarse.parameters())
    assert any(p.grad is not None and p.grad.any() for p in finer.parameters())


def test_recorded_arms_are_read_raw_for_speed_and_smoothed_for_jerks(stage_of, monkeypatch):
    read = {"arm_speed": [], "arm_acceleration": []}
    for name, seen in read.items():
        measure = getattr(VectorKinematics, name)

        def record(self, values, stride, smoothing, seen=seen, measure=measure):
            seen.append(smoothing)
            return measure(self, values, stride, smoothing)

        monkeypatch.setattr(VectorKinematics, name, record)
    stage_of(losses={**ALONE, "arm_speed": 1.0})
    assert set(read["arm_speed"]) == {0.0}
    assert set(read["arm_acceleration"]) == {CAPTURE_SECONDS}


def test_gradient_penalty_and_discriminator_scale_take_effect(stage_of):
    def gradient(**changes):
        stage = stage_of(losses={**ALONE, **changes})
        n_frames = max(stage.batches.sequences)
        stage._update = lambda name: None
        stage._discriminator_steps([n_frames], rng_for("step"))
        return torch.cat([p.grad.flatten() for p in stage.discriminators.parameters()])

    gap = gradient(gradient_penalty=0.0)
    both = gradient(gradient_penalty=1.0)
    more = gradient(gradient_penalty=3.0)
    torch.testing.assert_close(more - gap, 3 * (both - gap), rtol=1e-3, atol=1e-5)
    torch.testing.assert_close(gradient(gradient_penalty=0.0, discriminator_scale=0.5), 0.5 * gap)


def movement_of(stage: Stage, motion: torch.Tensor, stride: float) -> torch.Tensor:
    """Return the log arm movement (B, 2, T) of normalised motion, with the default floors."""
    values, floors = stage.normaliser.inverse(motion), stage.config.losses.arm_floors
    speed = stage.kinematics.arm_speed(values, stride)
    acceleration = stage.kinematics.arm_acceleration(values, stride)
    return log_movement(speed, acceleration, stride / 25.0, floors)


@pytest.mark.parametrize("first", [0, 2])
def test_losses_of_a_random_step_are_those_of_the_middle_of_each_level(
    stage_of, monkeypatch, first
):
    """Windows of 50 frames have margins of 5 at both ends; levels have 25, 34, 45 and 60 frames
    with them, and 21, 28, 38 and 50 without. A quarter of the arms' aim is the recalled motion's.
    """
    alone = {**ALONE, **dict.fromkeys(("adversarial", "contact", "smoothness", "coarse"), 1.0)}
    alone |= dict.fromkeys(("arm_speed", "arm_acceleration", "detail"), 1.0)
    stage = stage_of(first, losses=alone, training={"margins": True, "window": 2.0})
    stage.config = replace(stage.config, recall=RecallConfig(level=2, own_movement=0.25))
    drawn, made, asked = [], [], []
    draw, generate, total = stage._draw, stage._generate, losses.losses

    def drawing(*arguments):
        windows = draw(*arguments)
        rng = rng_for("recalled")
        recalled = tuple(torch.randn(own.shape, generator=rng) for own in recalled_like(windows))
        drawn.append(replace(windows, recalled=recalled))
        return drawn[-1]

    def recalled_like(windows):
        width = stage.discriminators[0].layers[0].shape[1]
        return [own.new_empty(len(own), width, own.shape[-1]) for own in windows.conditions]

    def generating(windows):
        made.extend(generate(windows))
        return made

    def counting(inputs, config):
        asked.append(inputs)
        return total(inputs, config)

    monkeypatch.setattr(stage, "_draw", drawing)
    monkeypatch.setattr(stage, "_generate", generating)
    monkeypatch.setattr("gesturekit.multires.training.stage.losses", counting)
    report = stage._random_step(50, rng_for("step"))
    (windows,), measure = drawn, stage.kinematics
    for i, (inputs, n, margin) in enumerate(
        zip(asked, [21, 28, 38, 50][first:], [2, 3, 3, 5][first:], strict=False)
    ):
        motion, stride = made[i][..., margin : margin + n], 50 / n
        assert made[i].shape[-1] == [25, 34, 45, 60][first + i]
        values = stage.normaliser.inverse(motion)
        places = measure.places(values)
        expected = {
            "scores": stage.discriminators[i](motion),
            "foot_velocity": measure.foot_velocity(values, stride),
            "contact_labels": measure.contact_labels(values),
            "bend": measure.bend(values, places, stride) if stride < 2.05 else None,
            "coarser": windows.coarser if i == 0 else made[0].detach(),
            "arms": movement_of(stage, motion, stride),
        }
        own = movement_of(stage, windows.recalled[i][..., margin : margin + n], stride)
        aim = stage.targets[i](windows.speech[i])[..., margin : margin + n]
        expected["arm_target"] = 0.25 * own + 0.75 * aim
        if first + i:
            size = windows.coarser.shape[-1] if i == 0 else made[0].shape[-1]
            expected["downsampled"] = resample(made[i], size)
            styles = torch.zeros(len(motion), dtype=torch.long)
            expected["detail"] = stage.details[first + i](places, styles)
        else:
            expected["coarser"] = None
        found = {name: getattr(inputs, name) for name in expected}
        torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-4)
    assert len(asked) == 2
    sums = [total(inputs, stage.config.losses) for inputs in asked]
    for name, value in report.items():
        parts = [float(own[name].detach()) for own in sums if name in own]
        assert value == pytest.approx(sum(parts)), "of both levels"


def test_an_iteration_has_as_many_steps_of_each_kind_as_are_set(stage_of, monkeypatch):
    counts = {"discriminator_steps": 3, "generator_steps": 2, "reconstruction_steps": 4}
    stage, made = stage_of(training=counts), []
    for name in ("_discriminator_step", "_random_step", "_reconstruction_step"):
        step = getattr(stage, name)

        def counted(*arguments, name=name, step=step):
            made.append(name)
            return step(*arguments)

        monkeypatch.setattr(stage, name, counted)
    report = stage.iterate(0)
    steps = ["_discriminator_step"] * 3 + ["_random_step"] * 2 + ["_reconstruction_step"] * 4
    assert made == steps
    assert {"discriminator", "adversarial", "reconstruction"} <= set(report)


def scores_of(stage: Stage) -> tuple[float, float]:
    """Mean scores of generated and of recorded windows, by the finer level's discriminator."""
    n_frames = max(stage.batches.sequences)
    with torch.no_grad():
        made = stage._generate(stage._draw("random", n_frames, rng_for("judged")))
        reals = stage.batches.reals(n_frames, rng_for("judged"))
        discriminator = stage.discriminators[-1]
        return float(discriminator(made[-1]).mean()), float(discriminator(reals[-1]).mean())


def test_random_steps_alone_raise_the_score_of_what_is_generated(stage_of):
    stage = stage_of(losses={**ALONE, "adversarial": 1.0})
    n_frames = max(stage.batches.sequences)
    before = scores_of(stage)[0]
    for k in range(8):
        stage._random_step(n_frames, rng_for("random", k))
    assert scores_of(stage)[0] > before + 0.01


def test_discriminator_steps_alone_tell_recorded_from_generated(stage_of):
    stage = stage_of(losses=ALONE)
    n_frames = max(stage.batches.sequences)
    fake, real = scores_of(stage)
    stage._discriminator_steps([n_frames] * 12, rng_for("discriminator"))
    fake_after, real_after = scores_of(stage)
    assert real_after - fake_after > real - fake + 0.01


def test_the_learning_rate_falls_to_a_tenth_at_decay_at(make_config, monkeypatch):
    rates = []
    iterate = Stage._iterate

    def record(self, iteration):
        groups = [o.param_groups for o in self.optimisers.values()]
        rates.append({group["lr"] for members in groups for group in members})
        return iterate(self, iteration)

    monkeypatch.setattr(Stage, "_iterate", record)
    train(make_config(training={"decay_at": 0.7, "first_stage": 10, "further_stages": 10}))
    assert rates == 2 * (7 * [{1e-3}] + 3 * [{1e-4}])


@pytest.fixture
def cache(make_config, cache_of):
    return cache_of(make_config(training={"silence": 0.0}))


def test_random_steps_have_noise_of_each_levels_own_sigma(cache):
    n_frames = next(iter(cache.data.window_lengths()))
    for first in (0, 2):
        windows = cache.random(cache.data.paired, n_frames, first, 64, rng_for("bank"))
        for i, noise in enumerate(windows.noise):
            sigma = float(cache.noise.sigma[first + i])
            # Shared by all channels, drawn anew for every window and frame.
            assert noise.shape[1] == 1
            assert float(noise.std()) == pytest.approx(sigma, rel=0.15)
            assert not torch.equal(noise[0], noise[1])


def test_random_windows_have_the_mean_sigma_of_the_recordings(cache):
    one, *others = (sequence.sigma.double() for sequence in cache.data.paired)
    expected = sum(others, one) / (1 + len(others))
    assert others and not torch.allclose(one, others[0])
    torch.testing.assert_close(cache.noise.sigma.double(), expected, rtol=1e-5, atol=0)


def test_windows_of_recordings_begin_anywhere(cache):
    longest = max(cache.data.paired, key=lambda sequence: sequence.n_frames)
    starts = {start for _, start in random_windows([longest], 25, 800, rng_for("windows"))}
    last = longest.n_frames - 25
    assert min(starts) == 0 and max(starts) == last and len(starts) > 0.9 * last


def test_a_share_of_random_windows_is_silent(cache):
    n_frames = max(cache.data.window_lengths())
    for share in (0.0, 0.3):
        training = replace(cache.config.training, silence=share)
        features = replace(cache.config.features, residual=False)
        cache.config = replace(cache.config, training=training, features=features)
        windows = cache.random(cache.data.paired, n_frames, 2, 200, rng_for("silent"))
        silent = (windows.conditions[-1] == cache.data.silence[:, :n_frames]).all(dim=(1, 2))
        assert float(silent.float().mean()) == pytest.approx(share, abs=0.1)


def test_reconstruction_has_z_star_at_the_first_level_and_no_noise_above(cache):
    n_frames, members = max(cache.data.window_lengths().items())
    sequences = [cache.data.paired[i] for i in members]
    windows = cache.paired(sequences, n_frames, 0, 8, rng_for("paired"))
    first, second = windows.noise
    assert second is None
    n_coarsest = first.shape[-1]
    stars = [s.z_star_window(start, n_coarsest) for s in sequences for start in range(s.n_frames)]
    for noise in first:
        assert any(torch.equal(noise, star) for star in stars)


def test_unpaired_speech_is_read_from_anywhere(cache):
    clip = torch.arange(300.0).expand(cache.data.n_speech, -1)
    object.__setattr__(cache.data, "unpaired", (clip,))
    starts = [int(cache.data.speech_window(50, 0, rng_for("start", k))[0, 0]) for k in range(200)]
    assert min(starts) < 15 and max(starts) > 235
    assert len(set(starts)) > 100
