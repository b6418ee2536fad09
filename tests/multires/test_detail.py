"""Detail: how much of it, joint by joint, and style by style."""

from __future__ import annotations

import pytest
import torch

from gesturekit.multires.training.data import PairedSequence
from gesturekit.multires.training.targets import DetailTarget

LEVELS, LEVEL = 4, 3


def recording(style, seed):
    """Trembling that comes and goes, ten times as much of it in style 1."""
    torch.manual_seed(seed)
    strength = (0.01, 0.1)[style] * torch.exp(torch.sin(torch.arange(200) / 20))
    motion = torch.randn(9, 200) * strength
    return PairedSequence.make(f"{style}-{seed}", motion, torch.zeros(0, 200), LEVELS, 0)


def windows(style):
    """16 windows of 50 frames of a recording that the target has not seen."""
    return recording(style, 9).motion.unfold(-1, 50, 10).transpose(0, 1)


def places(motion):
    """Three joints, whose places are the motion itself."""
    return motion.unflatten(1, (3, 3))


@pytest.fixture
def target():
    sequences = [recording(style, seed) for style in (0, 1) for seed in (1, 2)]
    sequences = [
        PairedSequence(s.name, s.motion, s.speech, s.sigma, s.z_star, s.passive, int(s.name[0]))
        for s in sequences
    ]
    detail = DetailTarget(sequences, LEVEL, LEVELS, places, 50, 2)
    return lambda motion, styles: detail(places(motion), styles)


def test_as_much_as_the_recordings_of_the_style_is_best(target):
    for style in (0, 1):
        own = windows(style)
        told = torch.full((len(own),), style)
        least = float(target(own, told))
        assert least < float(target(0.5 * own, told)) - 0.1
        assert least < float(target(2 * own, told)) - 0.1
        assert least < float(target(own, 1 - told)) - 0.1


def test_neither_posture_nor_slow_movement_counts(target):
    own = windows(1)
    told = torch.ones(len(own), dtype=torch.long)
    leaning = own + 3 + torch.linspace(0, 1, 50)
    torch.testing.assert_close(target(leaning, told), target(own, told), atol=0.02, rtol=0)


def test_generated_windows_should_differ_as_much_as_recorded_ones(target):
    own = windows(1)
    told = torch.ones(len(own), dtype=torch.long)
    strength = own.square().mean(dim=(1, 2)).log()
    alike = own * torch.exp((strength.mean() - strength) / 2)[:, None, None]
    assert float(target(own, told)) < float(target(alike, told)) - 0.02


def test_a_style_with_a_single_motion_has_no_detail_loss(target):
    own = windows(1)[:1].requires_grad_()
    loss = target(own, torch.ones(1, dtype=torch.long))
    assert float(loss.detach()) == 0
    loss.backward()
    assert not own.grad.any()


def test_joints_that_never_move_have_no_detail():
    """The places of a rig of one joint are zeros: no detail, and no logarithm of it."""
    detail = DetailTarget([recording(0, 1)], LEVEL, LEVELS, lambda x: 0 * places(x), 50, 1)
    made = windows(0).requires_grad_()
    loss = detail(0 * places(made), torch.zeros(len(made), dtype=torch.long))
    loss.backward()
    assert abs(float(loss.detach())) < 1e-3 and made.grad.isfinite().all()
