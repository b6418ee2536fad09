"""The arm speed that speech asks for."""

from __future__ import annotations

import pytest
import torch

from gesturekit.multires.training.targets import ArmTarget, log_movement

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
    target = ArmTarget(FRAME).fit(
        [torch.randn(width, 300, generator=rng) for _ in movements], movements
    )
    asked = target(torch.randn(1, width, 300, generator=rng))[0]
    assert (asked.std(dim=1) < 0.25 * movements[0].std(dim=1)).all()
