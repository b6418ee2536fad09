"""The training objective and the samplers' arithmetic, against numbers worked out by hand."""

import math

import pytest
import torch

from gesturekit.diffusion import NoiseConfig
from gesturekit.diffusion.losses import change_error, denoising_error
from gesturekit.diffusion.noise_schedule import NoiseSchedule, sample


def of_two_steps(predict="noise"):
    """Betas of 0.2 and 0.5: 0.8 of the motion's variance is left after one step, 0.4 after two."""
    return NoiseSchedule.of(NoiseConfig(steps=2, first_beta=0.2, last_beta=0.5, predict=predict))


def clip(*values):
    """(1, T, 1) of these frames."""
    return torch.tensor(values, dtype=torch.float64).reshape(1, -1, 1)


def test_errors_are_mean_squares_over_frames_and_features():
    predicted = torch.tensor([[[1.0, 2.0], [3.0, 4.0]], [[0.0, 0.0], [0.0, 2.0]]])
    target = torch.tensor([[[1.0, 0.0], [0.0, 4.0]], [[0.0, 0.0], [0.0, 0.0]]])
    # (0 + 4 + 9 + 0) / 4 and (0 + 0 + 0 + 4) / 4.
    assert denoising_error(predicted, target).tolist() == [3.25, 1.0]
    moving, still = torch.tensor([[[0.0, 0.0], [1.0, 0.0], [1.0, 6.0]]]), torch.zeros(1, 3, 2)
    # Changes (1, 0) and (0, 6) in units of (0.5, 3): (4 + 0 + 0 + 4) / 4.
    assert change_error(moving, still, torch.tensor([0.5, 3.0])).tolist() == [2.0]


def test_the_schedule_is_linear_in_beta_and_multiplies_what_is_left():
    schedule = NoiseSchedule.of(NoiseConfig())
    # (0.78 - 0.0074) / 99 is 0.00780404...
    assert schedule.betas[:2].tolist() == pytest.approx([0.0074, 0.015204040404])
    assert schedule.betas[-1].item() == 0.78
    assert schedule.alphas_bar[:2].tolist() == pytest.approx([0.9926, 0.977508469495])


def test_noise_is_added_by_the_square_roots_of_both_shares():
    schedule = of_two_steps()
    noisy = schedule.add_noise(clip(2.0), clip(-1.0), 1)
    assert noisy.item() == pytest.approx(2 * math.sqrt(0.4) - math.sqrt(0.6))


@pytest.mark.parametrize(
    ("predict", "wanted"),
    [("noise", -1.0), ("clean", 2.0), ("velocity", -math.sqrt(0.4) - 2 * math.sqrt(0.6))],
)
def test_networks_learn_noise_clean_motion_or_velocity(predict, wanted):
    schedule = of_two_steps(predict)
    assert schedule.target(clip(2.0), clip(-1.0), 1).item() == pytest.approx(wanted)


def says(noisy, step):
    """A network that says 0.3 at the second step and -0.2 at the first."""
    return clip({1: 0.3, 0: -0.2}[step])


def test_ancestral_steps_are_those_of_ho_et_al():
    # From x = 1.
    second = (1.0 - 0.5 / math.sqrt(1 - 0.4) * 0.3) / math.sqrt(0.5)
    spread = math.sqrt(0.5 * (1 - 0.8) / (1 - 0.4))  # of the posterior, not of the forward step
    first = (second + spread * 0.7 - 0.2 / math.sqrt(1 - 0.8) * -0.2) / math.sqrt(0.8)
    made = sample(says, lambda k: clip([1.0, 0.7][k]), of_two_steps())
    assert made.item() == pytest.approx(first)


def test_deterministic_steps_keep_the_noise_and_end_at_the_clean_motion():
    # DDIM (Song et al. 2021, eq. 12 without noise) puts back the noise that the network predicted.
    clean = (1.0 - math.sqrt(0.6) * 0.3) / math.sqrt(0.4)
    second = math.sqrt(0.8) * clean + math.sqrt(0.2) * 0.3
    made = sample(says, lambda k: clip(1.0), of_two_steps(), solver="ddim")
    assert made.item() == pytest.approx((second + math.sqrt(0.2) * 0.2) / math.sqrt(0.8))


def test_second_order_steps_are_those_of_dpm_solver_plus_plus():
    # DPM-Solver++ 2M (Lu et al. 2022, algorithm 2) in its own symbols, over three steps.
    schedule = NoiseSchedule.of(NoiseConfig(steps=3, first_beta=0.1, last_beta=0.5))
    kept = (0.9, 0.9 * 0.7, 0.9 * 0.7 * 0.5)
    alpha, sigma = ([math.sqrt(f(k)) for k in kept] for f in (lambda k: k, lambda k: 1 - k))
    lam = [math.log(a / s) for a, s in zip(alpha, sigma, strict=True)]
    noises = {2: 0.3, 1: -0.4, 0: 0.6}
    x = 1.0
    clean_2 = (x - sigma[2] * noises[2]) / alpha[2]
    h = lam[1] - lam[2]
    x = sigma[1] / sigma[2] * x - alpha[1] * (math.exp(-h) - 1) * clean_2
    clean_1 = (x - sigma[1] * noises[1]) / alpha[1]
    h_before, h = h, lam[0] - lam[1]
    r = h_before / h
    ahead = (1 + 1 / (2 * r)) * clean_1 - 1 / (2 * r) * clean_2
    x = sigma[0] / sigma[1] * x - alpha[0] * (math.exp(-h) - 1) * ahead
    clean_0 = (x - sigma[0] * noises[0]) / alpha[0]
    made = sample(
        lambda noisy, step: clip(noises[step]), lambda k: clip(1.0), schedule, solver="dpm"
    )
    assert made.item() == pytest.approx(clean_0)
