"""The training objective, against numbers worked out by hand: signs, weights, units, noise."""

import math
from dataclasses import replace

import pytest
import torch

from gesturekit.multires import losses, resample
from gesturekit.multires.kinematics import log_movement
from gesturekit.multires.training.trainer import Stage, Trainer
from gesturekit.multires.training.windows import random_windows
from gesturekit.training.seeds import rng_for
from gesturekit.training.session import session


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


WEIGHTS = {
    **{"adversarial": 0.5, "contact": 2.0, "smoothness": 3.0, "arm_speed": 4.0},
    **{"arm_acceleration": 5.0, "detail": 6.0, "coarse": 7.0, "reconstruction": 8.0},
}
NONE = dict.fromkeys(WEIGHTS, 0.0)
STEPS = {"discriminator_steps": 0, "generator_steps": 0, "reconstruction_steps": 0}


@pytest.fixture
def stage_of(make_config, tmp_path):
    """The first training stage, or another, of the small configuration with changes.

    Its cache holds one window, which is both of each batch.
    """

    def make(first: int = 0, steps: dict | None = None, **changes) -> Stage:
        training = {**STEPS, "window": 2.0, "window_cache": 1, **(steps or {})}
        out = str(tmp_path / f"{first} {steps} {changes}".replace("/", ""))
        config = make_config(**changes, training=training, out=out)
        with session(config, resume=False) as (run, device, processes):
            trainer = Trainer(config, run, device, processes, resume=False)
        for number, level in enumerate(trainer.network.levels):
            # As it is made, modulation is the identity: give every part a say.
            for name, weight in level.named_parameters():
                rng = rng_for("shaken", number, name)
                weight.data += 0.05 * torch.randn(weight.shape, generator=rng)
        return trainer.stage(first, iterations=10)

    return make


def generated(stage: Stage, kind: str, iteration: int = 0):
    """Return the windows (2) of a batch, and the levels that the network makes of them."""
    stage.batches.renew(iteration)
    windows, _ = stage.batches.windows(kind, 50, rng_for("any"))
    assert len(windows) == 1
    windows = windows.take(torch.tensor([0, 0]))
    lengths = [level.shape[-1] for level in windows.conditions]
    about = {"first": stage.first, "coarser": windows.coarser, "lengths": lengths}
    with torch.no_grad():
        return windows, stage.network(windows.noise, windows.conditions, **about)


def movement_of(stage: Stage, motion: torch.Tensor, stride: float) -> torch.Tensor:
    """Return the log arm movement (B, 2, T) of normalised motion, as `log_movement` has it."""
    values = stage.normaliser.inverse(motion)
    speed = stage.kinematics.arm_speed(values, stride)
    acceleration = stage.kinematics.arm_acceleration(values, stride)
    return log_movement(speed, acceleration, stride / 25.0)


@pytest.mark.parametrize("first", [0, 2])
def test_losses_of_a_random_step_are_those_of_the_middle_of_each_level(stage_of, first):
    """Windows of 50 frames have margins of 5 at both ends; levels have 25, 34, 45 and 60 frames
    with them, and 21, 28, 38 and 50 without. Smoothness counts from half the full rate on.
    """
    steps = {"generator_steps": 1, "margins": True, "silence": 0.0}
    stage = stage_of(first, steps, losses=WEIGHTS)
    windows, made = generated(stage, "random")
    expected, measure = dict.fromkeys(WEIGHTS, 0.0), stage.kinematics
    sizes = zip(made, [21, 28, 38, 50][first:], [2, 3, 3, 5][first:], strict=False)
    for i, (level, n, margin) in enumerate(sizes):
        assert level.shape[-1] == [25, 34, 45, 60][first + i]
        motion, stride = level[..., margin : margin + n], 50 / n
        values = stage.normaliser.inverse(motion)
        places = measure.places(values)
        own = {
            "adversarial": -stage.discriminators[i](motion).mean(),
            "contact": losses.contact(
                measure.foot_velocity(values, stride), measure.contact_labels(values)
            ),
        }
        if stride < 2.05:
            own["smoothness"] = losses.smoothness(measure.bend(values, places, stride))
        aim = stage.arms[i](windows.speech[i])[..., margin : margin + n]
        apart = (movement_of(stage, motion, stride) - aim).abs().mean(dim=(0, 2))
        own["arm_speed"], own["arm_acceleration"] = apart
        if first + i:
            below = windows.coarser if i == 0 else made[0]
            own["coarse"] = (resample(level, below.shape[-1]) - below).abs().mean()
            styles = torch.zeros(len(motion), dtype=torch.long)
            own["detail"] = stage.details[first + i](places, styles)
        for name, value in own.items():
            expected[name] += WEIGHTS[name] * float(value.detach())
    report = stage.iterate(0)
    del expected["reconstruction"]
    assert report == pytest.approx(expected, rel=1e-3, abs=1e-5)


@pytest.mark.parametrize("source", ["generated", "real"])
def test_a_reconstruction_step_counts_the_errors_of_both_levels(stage_of, source):
    losses_of = {**NONE, "reconstruction": 8.0, "rec_input": source}
    stage = stage_of(2, {"reconstruction_steps": 1}, losses=losses_of)
    windows, made = generated(stage, "paired")
    if source == "real":  # both levels continue recorded motion
        about = {"first": 3, "coarser": windows.targets[0], "lengths": [50]}
        with torch.no_grad():
            made[1] = stage.network(windows.noise[1:], windows.conditions[1:], **about)[0]
    errors = [(a - b).abs().mean() for a, b in zip(made, windows.targets, strict=True)]
    before = [p.detach().clone() for p in stage.generators.parameters()]
    report = stage.iterate(0)
    assert report == pytest.approx({"reconstruction": float(sum(errors) / 2)}, rel=1e-3)
    after = list(stage.generators.parameters())
    assert sum(not torch.equal(*pair) for pair in zip(before, after, strict=True)) > 4
    first = report["reconstruction"]
    for k in range(1, 12):
        report = stage.iterate(k)
    assert report["reconstruction"] < first


def test_an_iteration_has_as_many_steps_of_each_kind_as_are_set(stage_of):
    counts = {"discriminator_steps": 3, "generator_steps": 2, "reconstruction_steps": 4}
    stage = stage_of(steps=counts)
    assert {"discriminator", "adversarial", "reconstruction"} <= set(stage.iterate(0))
    for name, count in (("discriminator", 3), ("generator", 2 + 4)):
        made = {int(own["step"]) for own in stage.optimisers[name].state.values()}
        assert made == {count}


def gap_of(stage: Stage) -> tuple[float, float]:
    """Mean scores of generated and of recorded windows, by the finer level's discriminator."""
    _, made = generated(stage, "random")
    reals = stage.batches.reals(50, rng_for("judged"))
    with torch.no_grad():
        own = stage.discriminators[-1]
        return float(own(made[-1]).mean()), float(own(reals[-1]).mean())


def test_random_steps_alone_raise_the_score_of_what_is_generated(stage_of):
    steps = {"generator_steps": 1, "renew_every": 100}
    stage = stage_of(steps=steps, losses={**NONE, "adversarial": 1.0})
    before = gap_of(stage)[0]
    for k in range(8):
        stage.iterate(k)
    assert gap_of(stage)[0] > before + 0.01


def test_discriminator_steps_alone_tell_recorded_from_generated(stage_of):
    stage = stage_of(
        steps={"discriminator_steps": 12, "generator_steps": 1, "renew_every": 100}, losses=NONE
    )
    fake, real = gap_of(stage)
    stage.iterate(0)
    fake_after, real_after = gap_of(stage)
    assert real_after - fake_after > real - fake + 0.01


def test_the_learning_rate_falls_to_a_tenth_at_decay_at(stage_of):
    steps = {"generator_steps": 1, "decay_at": 0.7, "betas": [0.5, 0.95], "window": 0.5}
    stage, rates = stage_of(steps=steps, losses={**NONE, "adversarial": 1.0}), []
    for k in range(10):
        stage.iterate(k)
        groups = [group for own in stage.optimisers.values() for group in own.param_groups]
        rates.append({group["lr"] for group in groups})
    assert rates == 7 * [{1e-3}] + 3 * [{1e-4}]
    assert {tuple(group["betas"]) for group in groups} == {(0.5, 0.95)}


@pytest.fixture
def cache(make_config, batches_of):
    return batches_of(make_config(training={"silence": 0.0}))


def test_random_steps_have_noise_of_each_levels_own_sigma(cache):
    n_frames = next(iter(cache.data.window_lengths()))
    for first in (0, 2):
        cache.first = first
        windows = cache.random(cache.data.paired, n_frames, 64, rng_for("bank"))
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
    n_frames, cache.first = max(cache.data.window_lengths()), 2
    for share in (0.0, 0.3):
        training = replace(cache.config.training, silence=share)
        cache.config = replace(cache.config, training=training)
        conditions = replace(cache.data.conditions, residual=False)
        cache.data = replace(cache.data, conditions=conditions)
        windows = cache.random(cache.data.paired, n_frames, 100, rng_for("silent"))
        silent = (windows.conditions[-1] == cache.data.silence[:, :n_frames]).all(dim=(1, 2))
        assert float(silent.float().mean()) == pytest.approx(share, abs=0.1)


def test_reconstruction_has_z_star_at_the_first_level_and_no_noise_above(cache):
    n_frames, members = max(cache.data.window_lengths().items())
    sequences = [cache.data.paired[i] for i in members]
    windows = cache.paired(sequences, n_frames, 8, rng_for("paired"))
    first, second = windows.noise
    assert second is None
    n_coarsest = first.shape[-1]
    stars = [s.z_star_window(start, n_coarsest) for s in sequences for start in range(s.n_frames)]
    for noise in first:
        assert any(torch.equal(noise, star) for star in stars)
