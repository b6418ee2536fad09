"""Targets of the losses: detail by joint and style, and the arm speed that speech asks for."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter1d

from gesturekit.multires.config import NetworkConfig
from gesturekit.multires.kinematics import log_movement
from gesturekit.multires.training.data import PairedSequence
from gesturekit.multires.training.targets import ArmTarget, DetailTarget

NETWORK, LEVEL = NetworkConfig(levels=4), 3


def recording(style, seed):
    """Trembling that comes and goes, ten times as much of it in style 1."""
    torch.manual_seed(seed)
    strength = (0.01, 0.1)[style] * torch.exp(torch.sin(torch.arange(200) / 20))
    motion = torch.randn(9, 200) * strength
    return PairedSequence.make(f"{style}-{seed}", motion, torch.zeros(0, 200), NETWORK, 0)


def windows(style):
    """16 windows of 50 frames of a recording that the target has not seen."""
    return recording(style, 9).motion.unfold(-1, 50, 10).transpose(0, 1)


def places(motion):
    """Three joints, whose places are the motion itself."""
    return motion.unflatten(1, (3, 3))


@pytest.fixture
def detail():
    """detail(motion, style): the loss of motions that are told to have a style."""
    kinds = [(style, seed) for style in (0, 1) for seed in (1, 2)]
    sequences = [replace(recording(style, seed), style=style) for style, seed in kinds]
    target = DetailTarget(sequences, LEVEL, places, 50, 2)

    def loss(motion, style):
        return target(places(motion), torch.full((len(motion),), style))

    loss.of = lambda motion, styles: target(places(motion), torch.tensor(styles))
    return loss


def test_as_much_as_the_recordings_of_the_style_is_best(detail):
    for style in (0, 1):
        own = windows(style)
        least = float(detail(own, style))
        for worse, told in ((0.5 * own, style), (2 * own, style), (own, 1 - style)):
            assert least < float(detail(worse, told)) - 0.1


def test_generated_windows_should_differ_as_much_as_recorded_ones(detail):
    own = windows(1)
    strength = own.square().mean(dim=(1, 2)).log()
    alike = own * torch.exp((strength.mean() - strength) / 2)[:, None, None]
    assert float(detail(own, 1)) < float(detail(alike, 1)) - 0.02


@pytest.mark.parametrize("alone", [0, 1])
def test_styles_count_by_their_shares_and_not_with_a_single_motion(detail, alone):
    """The one of 17 motions that is alone in its style counts for nothing, whichever is first."""
    other = windows(1 - alone)
    together = detail.of(torch.cat([other, windows(alone)[:1]]), [1 - alone] * len(other) + [alone])
    torch.testing.assert_close(together, 16 / 17 * detail(other, 1 - alone))


FRAME = 0.04


def talk(n_frames: int, loudness: float, seed: int):
    """(S, T) speech in phrases, of zero mean, and the arm movement that goes with it."""
    rng = torch.Generator().manual_seed(seed)
    phrases = torch.rand(n_frames // 20 + 1, generator=rng).repeat_interleave(20)[:n_frames] - 0.5
    noise = 0.1 * torch.randn(3, n_frames, generator=rng)
    speech = noise + loudness * torch.stack([phrases, -phrases, torch.zeros(n_frames)])
    speed = loudness * (1.0 + 1.6 * phrases)
    return speech, log_movement(speed[None], 9.0 * speed[None], FRAME)[0]


@pytest.mark.parametrize("width", [3, 100])
def test_uninformative_features_are_not_overfitted(width):
    rng = torch.Generator().manual_seed(0)
    movements = [talk(300, 2.0, seed)[1] for seed in range(4)]
    speeches = [torch.randn(width, 300, generator=rng) for _ in movements]
    target = ArmTarget(FRAME).fit(speeches, movements)
    asked = target(torch.randn(1, width, 300, generator=rng))[0]
    assert (asked.std(dim=1) < 0.25 * movements[0].std(dim=1)).all()


def test_movement_goes_with_speech_as_it_did_in_training_and_no_further():
    speeches, movements = zip(*(talk(300, 2.0, seed) for seed in range(4)), strict=True)
    target = ArmTarget(FRAME).fit(list(speeches), list(movements))
    speech, movement = talk(300, 2.0, 9)
    asked, loud = (target(factor * speech[None])[0] for factor in (1, 100))
    every = torch.cat(movements, dim=1)
    for own, far, true, known in zip(asked, loud, movement, every, strict=True):
        assert np.corrcoef(own, true)[0, 1] > 0.8
        assert float(own.mean()) == pytest.approx(float(true.mean()), abs=0.15)
        assert known.min() <= far.min() and far.max() <= known.max()
    mean = torch.cat([target(own[None])[0] for own in speeches], dim=1).mean(dim=1)
    torch.testing.assert_close(mean, every.mean(dim=1), atol=0.05, rtol=0)


def test_log_movement_is_smoothed_over_a_tenth_of_a_second():
    rng = np.random.default_rng(0)
    speed, acceleration = 1 + rng.random((2, 1, 40))
    made = log_movement(torch.from_numpy(speed), torch.from_numpy(acceleration), 0.05)
    for own, found, floor in zip((speed, acceleration), made[0], (1.0, 10.0), strict=True):
        smooth = gaussian_filter1d(own[0], 2.0, truncate=3.0, mode="mirror")
        np.testing.assert_allclose(found, np.log(smooth + floor))
