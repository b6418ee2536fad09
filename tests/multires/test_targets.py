"""Targets of the losses: detail by joint and style, and the arm speed that speech asks for."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from gesturekit.multires.training.sequences import PairedSequence
from gesturekit.multires.training.targets import ArmTarget, DetailTarget, log_movement

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
def detail():
    """detail(motion, style): the loss of motions that are told to have a style."""
    kinds = [(style, seed) for style in (0, 1) for seed in (1, 2)]
    sequences = [replace(recording(style, seed), style=style) for style, seed in kinds]
    target = DetailTarget(sequences, LEVEL, LEVELS, places, 50, 2)

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


def test_neither_posture_nor_slow_movement_counts(detail):
    own = windows(1)
    leaning = own + 3 + torch.linspace(0, 1, 50)
    torch.testing.assert_close(detail(leaning, 1), detail(own, 1), atol=0.02, rtol=0)


def test_generated_windows_should_differ_as_much_as_recorded_ones(detail):
    own = windows(1)
    strength = own.square().mean(dim=(1, 2)).log()
    alike = own * torch.exp((strength.mean() - strength) / 2)[:, None, None]
    assert float(detail(own, 1)) < float(detail(alike, 1)) - 0.02


def test_a_style_with_a_single_motion_has_no_detail_loss(detail):
    own = windows(1)[:1].requires_grad_()
    loss = detail(own, 1)
    assert float(loss.detach()) == 0
    loss.backward()
    assert not own.grad.any()


@pytest.mark.parametrize("alone", [0, 1])
def test_styles_count_by_their_shares_and_not_with_a_single_motion(detail, alone):
    """The one of 17 motions that is alone in its style counts for nothing, whichever is first."""
    other = windows(1 - alone)
    together = detail.of(torch.cat([other, windows(alone)[:1]]), [1 - alone] * len(other) + [alone])
    torch.testing.assert_close(together, 16 / 17 * detail(other, 1 - alone))


def test_joints_that_never_move_have_no_detail():
    """The places of a rig of one joint are zeros: no detail, and no logarithm of it."""
    of_none = DetailTarget([recording(0, 1)], LEVEL, LEVELS, lambda x: 0 * places(x), 50, 1)
    made = windows(0).requires_grad_()
    loss = of_none(0 * places(made), torch.zeros(len(made), dtype=torch.long))
    loss.backward()
    assert abs(float(loss.detach())) < 1e-3 and made.grad.isfinite().all()


FRAME = 0.04
FLOORS = (1.0, 10.0)


def talk(n_frames: int, loudness: float, seed: int):
    """(S, T) speech in phrases, of zero mean, and the arm movement that goes with it."""
    rng = torch.Generator().manual_seed(seed)
    phrases = torch.rand(n_frames // 20 + 1, generator=rng).repeat_interleave(20)[:n_frames] - 0.5
    noise = 0.1 * torch.randn(3, n_frames, generator=rng)
    speech = noise + loudness * torch.stack([phrases, -phrases, torch.zeros(n_frames)])
    speed = loudness * (1.0 + 1.6 * phrases)
    return speech, log_movement(speed[None], 9.0 * speed[None], FRAME, FLOORS)[0]


@pytest.fixture(scope="module")
def target():
    pairs = [talk(700, loudness, seed) for seed, loudness in enumerate([1.0, 3.0, 1.5, 4.0])]
    return ArmTarget(FRAME).fit(*zip(*pairs, strict=True))


def predicted(target, loudness):
    """(2, T) speeds and accelerations, asked for and real."""
    speech, movement = talk(700, loudness, seed=9)
    floors = torch.tensor(FLOORS)[:, None]
    return target(speech[None])[0].exp() - floors, movement.exp() - floors


def test_arm_speed_of_unpaired_speech_is_predicted(target):
    for ours, real in zip(*predicted(target, 2.0), strict=True):
        assert torch.corrcoef(torch.stack([ours, real]))[0, 1] > 0.8


def test_calm_and_lively_speech_with_equal_means_predict_different_speeds(target):
    calm, lively = (predicted(target, loudness) for loudness in (1.2, 3.5))
    for both in (calm, lively):
        for ours, real in zip(*both, strict=True):
            assert 0.7 < ours.mean() / real.mean() < 1.4
    assert (lively[0].mean(dim=1) > 2 * calm[0].mean(dim=1)).all()


def test_predicted_movement_stays_within_the_recorded_range(target):
    ours, _ = predicted(target, 40.0)
    fastest = predicted(target, 4.0)[1].amax(dim=1)
    assert (ours.amax(dim=1) < 1.1 * fastest).all()


def test_a_clip_shorter_than_what_is_read_around_a_frame(target):
    speech, _ = talk(6, 1.0, seed=0)
    assert torch.isfinite(target(speech[None])).all()


@pytest.mark.parametrize("width", [3, 100])
def test_uninformative_features_are_not_overfitted(width):
    rng = torch.Generator().manual_seed(0)
    movements = [talk(300, 2.0, seed)[1] for seed in range(4)]
    speeches = [torch.randn(width, 300, generator=rng) for _ in movements]
    target = ArmTarget(FRAME).fit(speeches, movements)
    asked = target(torch.randn(1, width, 300, generator=rng))[0]
    assert (asked.std(dim=1) < 0.25 * movements[0].std(dim=1)).all()


def test_features_that_never_change_leave_the_prediction_as_it_is():
    """There are more columns than frames then, and the dual problem is solved."""
    speech, movement = talk(300, 2.0, seed=0)
    silent = torch.zeros(29, 300)
    few = ArmTarget(FRAME).fit([speech], [movement])(speech[None])
    many = ArmTarget(FRAME).fit([torch.cat([speech, silent])], [movement])
    assert torch.allclose(many(torch.cat([speech, silent])[None]), few, atol=1e-3)
    assert few.std() > 0.1
