"""The training objective and the samplers' arithmetic, against numbers worked out by hand."""

from __future__ import annotations

import math

import pytest
import torch

from gesturekit.diffusion.config import NoiseConfig
from gesturekit.diffusion.losses import change_error, denoising_error
from gesturekit.diffusion.sampling import sample
from gesturekit.diffusion.schedule import NoiseSchedule
from gesturekit.diffusion.trainer import _Trainer


def of_two_steps(predict="noise"):
    """Betas of 0.2 and 0.5: 0.8 of the motion's variance is left after one step, 0.4 after two."""
    return NoiseSchedule.of(NoiseConfig(steps=2, first_beta=0.2, last_beta=0.5, predict=predict))


def clip(*values):
    """(1, T, 1) of these frames."""
    return torch.tensor(values, dtype=torch.float64).reshape(1, -1, 1)


def test_the_denoising_error_is_the_mean_square_over_frames_and_features():
    predicted = torch.tensor([[[1.0, 2.0], [3.0, 4.0]], [[0.0, 0.0], [0.0, 2.0]]])
    target = torch.tensor([[[1.0, 0.0], [0.0, 4.0]], [[0.0, 0.0], [0.0, 0.0]]])
    # (0 + 4 + 9 + 0) / 4 and (0 + 0 + 0 + 4) / 4.
    assert denoising_error(predicted, target).tolist() == [3.25, 1.0]


def test_the_change_error_is_that_of_steps_in_units_of_the_recordings_own():
    predicted = torch.tensor([[[0.0, 0.0], [1.0, 0.0], [1.0, 6.0]]])
    target = torch.tensor([[[0.0, 0.0], [0.0, 0.0], [0.0, 0.0]]])
    # Changes (1, 0) and (0, 6) in units of (0.5, 3): (4 + 0 + 0 + 4) / 4.
    assert change_error(predicted, target, torch.tensor([0.5, 3.0])).tolist() == [2.0]


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
    assert schedule.clean_of(clip(-1.0), noisy, 1).item() == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("predict", "wanted"),
    [("noise", -1.0), ("clean", 2.0), ("velocity", -math.sqrt(0.4) - 2 * math.sqrt(0.6))],
)
def test_networks_learn_noise_clean_motion_or_velocity(predict, wanted):
    schedule = of_two_steps(predict)
    assert schedule.target(clip(2.0), clip(-1.0), 1).item() == pytest.approx(wanted)


def test_ancestral_steps_are_those_of_ho_et_al():
    # From x = 1 with a network that says 0.3 at the second step and -0.2 at the first.
    second = (1.0 - 0.5 / math.sqrt(1 - 0.4) * 0.3) / math.sqrt(0.5)
    spread = math.sqrt(0.5 * (1 - 0.8) / (1 - 0.4))  # of the posterior, not of the forward step
    first = (second + spread * 0.7 - 0.2 / math.sqrt(1 - 0.8) * -0.2) / math.sqrt(0.8)
    made = sample(
        lambda noisy, step: clip({1: 0.3, 0: -0.2}[step]),
        lambda k: clip([1.0, 0.7][k]),
        of_two_steps(),
    )
    assert made.item() == pytest.approx(first, rel=1e-12)


def test_deterministic_steps_keep_the_noise_and_end_at_the_clean_motion():
    # DDIM (Song et al. 2021, eq. 12 without noise) puts back the noise that the network predicted.
    clean = (1.0 - math.sqrt(0.6) * 0.3) / math.sqrt(0.4)
    second = math.sqrt(0.8) * clean + math.sqrt(0.2) * 0.3
    made = sample(
        lambda noisy, step: clip({1: 0.3, 0: -0.2}[step]),
        lambda k: clip(1.0),
        of_two_steps(),
        solver="ddim",
    )
    assert made.item() == pytest.approx((second + math.sqrt(0.2) * 0.2) / math.sqrt(0.8))


@pytest.fixture
def trainer_of(make_config, tmp_path):
    """A trainer of the small configuration with changes, its network replaced by zeros."""
    from gesturekit.training.session import session

    def make(**changes):
        config = make_config(**changes, out=str(tmp_path / str(changes)))
        with session(config, resume=False) as (run, device, processes):
            trainer = _Trainer(config, run, device, processes, resume=False)
        trainer.network.forward = lambda noisy, condition, step: torch.zeros_like(noisy)
        return trainer

    return make


def test_the_loss_of_a_batch_is_the_mean_over_clips(trainer_of):
    trainer = trainer_of()
    batch = trainer.batches.draw(0, slice(0, 2))
    # A network that predicts nothing errs by the noise itself.
    expected = float(batch.noise.square().mean())
    assert float(trainer._loss(batch)) == pytest.approx(expected, rel=1e-5)
    assert 0.7 < expected < 1.3  # standard normal


def test_the_weight_of_the_change_error_counts(trainer_of):
    changes = {"noise": {"predict": "clean"}}
    plain = trainer_of(**changes)
    weighed = trainer_of(**changes, training={"changes": 0.5})
    batch = plain.batches.draw(0, slice(0, 2))
    apart = float(weighed._loss(batch)) - float(plain._loss(batch))
    error = change_error(torch.zeros_like(batch.clean), batch.clean, weighed.changes)
    assert apart == pytest.approx(0.5 * float(error.mean()), rel=1e-4)


def test_steps_and_noise_are_drawn_anew_for_every_row_and_update(trainer_of):
    trainer = trainer_of()
    one, other = (trainer.batches.draw(update, slice(0, 2)) for update in (0, 1))
    assert not torch.equal(one.noise[0], one.noise[1])
    assert not torch.equal(one.noise[0], other.noise[0])
    steps = torch.cat([trainer.batches.draw(u, slice(0, 2)).step for u in range(200)])
    # Uniform over the schedule: both ends and everything between.
    quarter = trainer.config.noise.steps // 4
    shares = [(steps // quarter == q).float().mean().item() for q in range(4)]
    assert all(0.17 < share < 0.33 for share in shares)
