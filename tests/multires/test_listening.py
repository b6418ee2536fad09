"""The arm speed that speech asks for."""

from __future__ import annotations

import pytest
import torch

from gesturekit.multires.listening import FLOOR, ArmSpeedTarget, log_speed

FRAME = 0.04


def talk(n_frames: int, loudness: float, seed: int):
    """(S, T) speech in phrases, of zero mean, and the (T,) arm speed that goes with it."""
    rng = torch.Generator().manual_seed(seed)
    phrases = torch.rand(n_frames // 20 + 1, generator=rng).repeat_interleave(20)[:n_frames] - 0.5
    noise = 0.1 * torch.randn(3, n_frames, generator=rng)
    speech = noise + loudness * torch.stack([phrases, -phrases, torch.zeros(n_frames)])
    return speech, loudness * (1.0 + 1.6 * phrases)


@pytest.fixture(scope="module")
def target():
    pairs = [talk(700, loudness, seed) for seed, loudness in enumerate([1.0, 3.0, 1.5, 4.0])]
    return ArmSpeedTarget(FRAME).fit(*zip(*pairs, strict=True))


def predicted(target, loudness):
    speech, speed = talk(700, loudness, seed=9)
    return target(speech[None])[0].exp() - FLOOR, log_speed(speed[None], FRAME)[0].exp() - FLOOR


def test_unheard_speech_is_told_when_to_move(target):
    ours, real = predicted(target, 2.0)
    assert torch.corrcoef(torch.stack([ours, real]))[0, 1] > 0.8


def test_calm_and_lively_speech_of_one_mean_ask_for_different_speeds(target):
    calm, lively = (predicted(target, loudness) for loudness in (1.2, 3.5))
    for ours, real in (calm, lively):
        assert 0.7 < ours.mean() / real.mean() < 1.4
    assert lively[0].mean() > 2 * calm[0].mean()


def test_no_speech_asks_for_more_than_was_recorded(target):
    ours, _ = predicted(target, 40.0)
    fastest = max(predicted(target, 4.0)[1].max(), talk(700, 4.0, 3)[1].max())
    assert ours.max() < 1.1 * fastest


def test_a_clip_shorter_than_what_is_read_around_a_frame(target):
    speech, _ = talk(6, 1.0, seed=0)
    assert torch.isfinite(target(speech[None])).all()
