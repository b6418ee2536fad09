"""Schedules and solvers on data whose noise is known: a Gaussian with mean and covariance."""

import math

import pytest
import torch

from gesturekit.diffusion import NoiseConfig
from gesturekit.diffusion.noise_schedule import NoiseSchedule, sample
from gesturekit.training.seeds import rng_for

GESTURE = NoiseSchedule.of(NoiseConfig())
DANCE = NoiseSchedule.of(NoiseConfig(steps=150, first_beta=0.01, last_beta=0.7))
SCHEDULES = pytest.mark.parametrize("schedule", [GESTURE, DANCE], ids=["gesture", "dance"])
D = 6


class Gaussian:
    """Poses with a mean and variances of 0.01 to 2 along directions beside the axes."""

    def __init__(self, schedule: NoiseSchedule) -> None:
        rng = rng_for("gaussian")
        basis = torch.linalg.qr(torch.randn(D, D, generator=rng, dtype=torch.float64)).Q
        self.mean = torch.randn(D, generator=rng, dtype=torch.float64)
        self.covariance = basis * torch.logspace(-2, 0.3, D, dtype=torch.float64) @ basis.T
        self.schedule = schedule
        self.asked: list[int] = []

    def predict(self, noisy: torch.Tensor, step: int) -> torch.Tensor:
        """E[noise | noisy], exactly."""
        self.asked.append(step)
        kept = float(self.schedule.alphas_bar[step])
        whole = kept * self.covariance + (1 - kept) * torch.eye(D, dtype=torch.float64)
        off = noisy - math.sqrt(kept) * self.mean
        return math.sqrt(1 - kept) * torch.linalg.solve(whole, off.mT).mT

    def reached(self, solver: str, steps: int | None) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and covariance of what a solver makes, without drawing any number.

        Solvers are linear here: one row begins with zeros, one for each direction of each noise.
        """
        n_noises = (self.schedule.steps if steps is None else steps) if solver == "ancestral" else 1
        rows = 1 + n_noises * D

        def noise_at(k: int) -> torch.Tensor:
            noise = torch.zeros(rows, D, dtype=torch.float64)
            noise[1 + k * D : 1 + (k + 1) * D] = torch.eye(D, dtype=torch.float64)
            return noise

        made = sample(self.predict, noise_at, self.schedule, solver=solver, steps=steps)
        away = made[1:] - made[0]
        return made[0], away.mT @ away

    def error(self, solver: str, steps: int | None) -> float:
        """Wasserstein distance to the data, beside the data's own spread."""
        mean, covariance = self.reached(solver, steps)

        def root(matrix: torch.Tensor) -> torch.Tensor:
            values, vectors = torch.linalg.eigh(matrix)
            return vectors * values.clamp(min=0).sqrt() @ vectors.mT

        between = root(root(self.covariance) @ covariance @ root(self.covariance))
        square = torch.trace(self.covariance + covariance - 2 * between)
        square += (mean - self.mean).square().sum()
        return math.sqrt(max(float(square), 0) / float(torch.trace(self.covariance)))


@SCHEDULES
@pytest.mark.parametrize("solver", ["ancestral", "ddim", "dpm"])
def test_all_steps_reach_the_mean_and_the_spread(schedule, solver):
    data = Gaussian(schedule)
    mean, _ = data.reached(solver, None)
    torch.testing.assert_close(mean, data.mean, atol=0.02, rtol=0)
    assert data.asked == list(range(schedule.steps - 1, -1, -1))
    assert data.error(solver, None) < 0.2


@SCHEDULES
@pytest.mark.parametrize("steps", [10, 20])
def test_few_steps_of_second_order_are_nearer_than_ddim(schedule, steps):
    data = Gaussian(schedule)
    second, first = data.error("dpm", steps), data.error("ddim", steps)
    assert len(data.asked) == 2 * steps
    assert second < min(0.9 * first, 0.2)


@pytest.mark.parametrize("predict", ["velocity", "clean"])
def test_conversions_agree(predict):
    schedule = NoiseSchedule.of(NoiseConfig(predict=predict))
    rng = rng_for("conversions")
    clean, noise = torch.randn(2, 4, 9, 3, generator=rng, dtype=torch.float64)
    step = torch.tensor([0, 7, 30, 60])
    noisy = schedule.add_noise(clean, noise, step)
    target = schedule.target(clean, noise, step)
    assert (target - noise).abs().max() > 0.1
    torch.testing.assert_close(schedule.noise_of(target, noisy, step), noise)
    alone = schedule.add_noise(clean[1], noise[1], 7)
    torch.testing.assert_close(alone, noisy[1])
    assert torch.equal(GESTURE.target(clean, noise, step), noise)


@pytest.mark.parametrize("predict", ["noise", "velocity", "clean"])
def test_min_snr_weighs_the_error_of_the_clean_motion_by_the_clipped_ratio(predict):
    schedule = NoiseSchedule.of(NoiseConfig(predict=predict))
    rng = rng_for("weights")
    clean, noise, wrong = torch.randn(3, 3, 5, 2, generator=rng, dtype=torch.float64)
    step = torch.tensor([0, 4, 25])
    noisy = schedule.add_noise(clean, noise, step)
    told = schedule.target(clean, noise, step) + wrong
    signal, spread = schedule.scales(step, noisy)
    guess = (noisy - spread * schedule.noise_of(told, noisy, step)) / signal
    ratio = schedule.log_snr().exp()[step].clamp(max=5)
    weighed = schedule.loss_weight(step, 5.0) * wrong.square().mean((1, 2))
    torch.testing.assert_close(weighed, ratio * (guess - clean).square().mean((1, 2)))
    assert schedule.loss_weight(step, None).tolist() == [1, 1, 1]
