"""Windows that a stage trains on, against what the recordings and the networks give there."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from audio_features import level_lengths, residual_pyramid
from gesturekit.multires import resample
from gesturekit.training.seeds import rng_for

FIRST = 2
"""A stage's first level, above two that are finished."""


@pytest.fixture
def cache(make_config, batches_of):
    """Windows of a stage of networks in which each part has a say."""

    def make(**changes):
        config = make_config(**{"training": {"silence": 0.0}, **changes})
        cache = batches_of(config, first=FIRST)
        for name, weight in cache.network.named_parameters():
            weight.data += 0.05 * torch.randn(weight.shape, generator=rng_for("shaken", name))
        return cache

    return make


def starts_of(windows: torch.Tensor, curve: torch.Tensor) -> list[int]:
    """Return the first frames of windows (N, D, T) of a recording (D, T')."""
    every = curve.unfold(-1, windows.shape[-1], 1).movedim(1, 0)
    found = [(every - own).abs().amax(dim=(1, 2)) for own in windows]
    assert all(apart.min() < 1e-6 for apart in found)
    return [int(apart.argmin()) for apart in found]


def conditions_of(speech: torch.Tensor, lengths) -> list[torch.Tensor]:
    """Return the residual features (1, S, T_i) of each level from speech (S, T)."""
    levels = residual_pyramid(np.ascontiguousarray(speech.T.numpy()), lengths)
    return [torch.from_numpy(level.T.astype(np.float32))[None] for level in levels]


@pytest.mark.parametrize("source", ["generated", "real"])
def test_paired_windows_are_parts_of_a_recording(cache, source):
    losses = {"rec_input": "real"} if source == "real" else {}
    cache = cache(losses=losses)
    sequence, lengths = cache.data.paired[0], level_lengths(75, 4)
    windows = cache.paired([sequence], 75, 5, rng_for("paired"))
    assert windows.styles.tolist() == [[0] * 4] * 5 and windows.noise == (None, None)
    assert windows.speech == ()
    starts = starts_of(windows.targets[1], sequence.motion)
    assert len(set(starts)) > 2
    for k, start in enumerate(starts):
        part = slice(start, start + 75)
        motion = sequence.motion[None, :, part]
        torch.testing.assert_close(windows.targets[0][k], resample(motion, lengths[2])[0])
        given = conditions_of(sequence.speech[:, part], lengths)
        for own, expected in zip(windows.conditions, given[2:], strict=True):
            torch.testing.assert_close(own[k], expected[0], atol=1e-5, rtol=1e-5)
        star = sequence.z_star_window(start, lengths[0])[None]
        below = cache.network([star, None], given[:2], lengths=lengths[:2])[-1]
        below = resample(motion, lengths[1]) if source == "real" else below
        torch.testing.assert_close(windows.coarser[k], below[0], atol=1e-4, rtol=1e-4)


def test_as_many_windows_as_there_are_are_all_of_them(cache):
    """A recording of 66 frames has four windows of 63, one of 63 has one."""
    cache = cache()
    long, short = cache.data.paired
    both = [long.cut(10, 76), short]
    windows = cache.paired(both, 63, 5, rng_for("paired"))
    assert starts_of(windows.targets[1][:4], long.motion) == [10, 11, 12, 13]
    assert torch.equal(windows.targets[1][4], short.motion)
    assert len(cache.paired(both, 63, 9, rng_for("paired"))) == 5
    drawn = [cache.paired(both, 63, 4, rng_for("paired", k)) for k in range(6)]
    parts = [[bool((own == short.motion).all()) for own in each.targets[1]] for each in drawn]
    assert {len(each) for each in drawn} == {4} and 0 < sum(map(sum, parts)) < 15


def test_random_windows_continue_what_the_finished_levels_make_of_their_noise(cache):
    cache, lengths = cache(), level_lengths(75, 4)
    stage = cache.random(cache.data.paired, 75, 5, rng_for("random"))
    cache.first = 0
    first = cache.random(cache.data.paired, 75, 5, rng_for("random"))
    speech = stage.speech[1]
    torch.testing.assert_close(first.speech[0], resample(speech, lengths[0]))
    torch.testing.assert_close(stage.speech[0], resample(speech, lengths[2]))
    assert first.coarser is None and stage.targets == ()
    assert [noise.shape for noise in first.noise + stage.noise] == [(5, 1, n) for n in lengths]
    for k in range(5):
        assert starts_of(speech[k : k + 1], cache.data.unpaired[0])
        given = conditions_of(speech[k], lengths)
        for own, expected in zip(stage.conditions, given[2:], strict=True):
            torch.testing.assert_close(own[k], expected[0], atol=1e-5, rtol=1e-5)
        noise = [own[k : k + 1] for own in first.noise]
        below = cache.network(noise, given[:2], lengths=lengths[:2])[-1]
        torch.testing.assert_close(stage.coarser[k], below[0], atol=1e-4, rtol=1e-4)
    # Those that are taken, in the order in which they are.
    taken, chosen = stage.take(torch.tensor([3, 1])), [3, 1]
    for name in ("noise", "conditions", "speech"):
        for own, every in zip(getattr(taken, name), getattr(stage, name), strict=True):
            assert torch.equal(own, every[chosen])
    assert torch.equal(taken.coarser, stage.coarser[chosen])
    assert len(taken) == 2 and taken.targets == ()
    quiet = replace(cache.config.losses, arm_speed=0.0, arm_acceleration=0.0)
    cache.config = replace(cache.config, losses=quiet)
    assert cache.random(cache.data.paired, 75, 2, rng_for("random")).speech == ()


def test_real_motions_are_windows_of_the_recordings_at_both_levels(cache):
    cache, lengths = cache(), level_lengths(63, 4)
    coarse, fine = cache.recorded(cache.data.paired, 63, 12, rng_for("reals"))
    torch.testing.assert_close(coarse, resample(fine, lengths[2]))
    long, short = (sequence.motion for sequence in cache.data.paired)
    of_short = [bool((own - short).abs().max() < 1e-6) for own in fine]
    others = fine[[not own for own in of_short]]
    # Of 38 windows of 63 frames in a recording of 100, and of a single one in the other.
    assert sum(of_short) <= 2 and len(set(starts_of(others, long))) > 6
    cache.first = 0
    assert cache.recorded(cache.data.paired, 63, 1, rng_for("reals"))[0].shape[-1] == lengths[0]


def test_styles_of_windows_are_conditions_of_their_level(make_config, batches_of, motions):
    corpus = str(motions(old=[4.0], angry=[4.0], sad=[4.0]))
    styles, about = {"mixing": 0.5}, {"features": None, "training": {"window": 2.0}}
    cache = batches_of(make_config(corpus=corpus, styles=styles, **about), first=FIRST)
    windows = cache.random(cache.data.paired, 50, 40, rng_for("styles"))
    mixed = (windows.styles != windows.styles[:, :1]).any(dim=1).float().mean()
    assert 0.1 < mixed < 0.6, "of half of them, a third has the same style above"
    for i, own in enumerate(windows.conditions):
        expected = torch.nn.functional.one_hot(windows.styles[:, FIRST + i], 3)
        assert own.shape[1] == 3 and (own == expected[:, :, None]).all()
    angry = [sequence for sequence in cache.data.paired if sequence.style == 0]
    windows = cache.random(angry, 50, 40, rng_for("styles"))
    assert (windows.styles[:, 0] == 0).all() and windows.styles[:, 3].unique().tolist() == [0, 1, 2]
    own = cache.paired(cache.data.paired, 50, 30, rng_for("paired"))
    motion_of = {sequence.style: sequence.motion for sequence in cache.data.paired}
    assert own.styles.shape == (30, 4) and (own.styles == own.styles[:, :1]).all()
    for style, target in zip(own.styles[:, 0].tolist(), own.targets[1], strict=True):
        assert starts_of(target[None], motion_of[style])
    for asked in ([1, 2, 0], [0, 0, 1]):
        _, fine = cache.recorded(cache.data.paired, 50, 3, rng_for("reals"), asked)
        for style, motion in zip(asked, fine, strict=True):
            assert starts_of(motion[None], motion_of[style])
