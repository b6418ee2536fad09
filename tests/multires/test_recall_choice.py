"""Choice of recorded pieces: what is asked for, what is found, and how pieces are joined."""

from __future__ import annotations

import time
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from gesturekit.multires.motion_vector import MultiresRepresentation
from gesturekit.multires.recall.library import (
    RecalledMotion,
    RecalledRecording,
    RecallLibrary,
    averaged,
)
from gesturekit.multires.recall.parts import (
    MotionPart,
    PassiveChannels,
    defects_of_parts,
    motion_parts,
    slow_channels,
    slow_part,
    slow_states,
)
from gesturekit.multires.recall.pieces import ChoiceWeights, Pieces, PieceSearch
from gesturekit.multires.recall.slow_state import SlowState
from gesturekit.multires.recall.wanted import (
    WantedMovement,
    folds_of,
    usual_voice,
)
from gesturekit.multires.training.recall_library import _any_near, _weights

FPS = 25.0
ONLY_MOVEMENT = ChoiceWeights(continuity=0.0, used=0.0, chance=0.0)
ANYTHING = np.nan


def rng(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def noise(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(shape)


def library_of(motion, profiles, parts, fps, spread, mean) -> RecallLibrary:
    """A library of one recording, without prediction from speech."""
    empty, n_states = motion[:0], sum(len(slow_channels(part)) for part in parts)
    defects = torch.zeros(len(parts), motion.shape[-1], dtype=torch.bool)
    states = torch.zeros(n_states, motion.shape[-1])
    recording = RecalledRecording(motion, empty, profiles, states, empty, None, 0, defects)
    slow = SlowState(np.zeros(n_states), 0.0, *(np.zeros(n_states),) * 3, take=1.0)
    search = {"level": 2, "levels": 4, "fps": fps, "piece": 1.0, "overlap": 0.2, "stretch": 0.0}
    speech = {"spread": spread, "mean": mean, "slow_state": slow, "wanted": None}
    body = {"parts": parts, "passive": PassiveChannels()}
    return RecallLibrary(recordings=(recording,), **search, **speech, **body)


def search(lengths, weights=ONLY_MOVEMENT, *, piece=10, overlap=2, seed=0) -> PieceSearch:
    """A search in recordings of noise with profiles of noise and one slow state."""
    vectors = [noise(n, 4, seed=seed + k) for k, n in enumerate(lengths)]
    profiles = [profile_of(k, seed, n) for k, n in enumerate(lengths)]
    return search_in(vectors, profiles, None, piece, overlap, weights)


def search_in(
    vectors, profiles, states, piece, overlap, weights=ONLY_MOVEMENT, shrinkage=None, flags=None
) -> PieceSearch:
    """A search by squared differences in recordings without defects, with one slow state."""
    every = [np.zeros((len(v), 1)) for v in vectors]
    defective = [np.zeros(len(v), bool) for v in vectors]
    shrinkage = np.ones(profiles[0].shape[1]) if shrinkage is None else shrinkage
    states, flags = states or every, flags or defective
    return PieceSearch(vectors, profiles, states, piece, overlap, shrinkage, weights, flags)


def profile_of(recording: int, seed: int = 0, length: int = 60) -> np.ndarray:
    return noise(length, 1, seed=seed + 100 + recording)


def chosen(found: PieceSearch, wanted: np.ndarray, *rest, seed: int = 0) -> Pieces:
    """Choose pieces for a wanted profile in the one slow state that there is."""
    return found.choose(rng(seed), wanted, np.zeros((len(wanted), 1)), *rest)


def placed(pieces: Pieces) -> list[tuple[int, int]]:
    return list(zip(pieces.recordings.tolist(), pieces.starts.tolist(), strict=True))


@pytest.mark.parametrize("speed, share", [(0.05, 0.0), (0.1, 0.0), (0.225, 0.5), (1.0, 1.0)])
def test_finer_levels_add_nothing_to_a_part_that_rests(speed, share):
    """The share of detail is 0 up to 0.1 m/s, 1 from `full_detail`, and linear between."""
    none = np.zeros(0, int)
    parts = (
        MotionPart("left", np.array([0, 2]), (), (), np.array([0, 2]), 0.35, 1.0),
        MotionPart("right", np.array([1]), (), (), np.array([1]), 0.6, 1.0),
        MotionPart("rest", np.array([3, 4]), (), (), np.array([4]), 0.35, 2.0),
        MotionPart("none", np.array([5]), (), (), none, 0.35, 1.0),
    )
    profiles = torch.zeros(4, 12)
    profiles[0] = profiles[2] = (np.log(speed + 0.05) + 1.0) / 2.0  # log speed: sd 2, mean -1
    library = library_of(torch.zeros(6, 12), profiles, parts, 25.0, 2.0, -1.0)
    pieces = Pieces(np.array([0]), np.array([0]), hop=12, overlap=0, n_frames=12)
    choice = RecalledMotion(parts, (pieces,) * 4, (12,))
    detail = library.detail(choice.profiles(library.recordings, 20))
    assert detail.shape == (6, 20)
    np.testing.assert_allclose(detail[[0, 2, 4]], share, atol=1e-5)
    mean = (np.exp(-1.0) - 0.05 - 0.1) / 0.5  # the right hand moves at the mean log speed
    np.testing.assert_allclose(detail[1], mean, atol=1e-5)
    assert (detail[[3, 5]] == 1.0).all(), "legs and the root keep their detail"


@pytest.mark.parametrize("fps, frames", [(31.25, 3), (93.75, 8)])
def test_detail_returns_within_a_tenth_of_a_second_at_any_frame_rate(fps, frames):
    """A Gaussian of 0.08 s: 0.08 s before a rest ends, detail is that of one sd below the mean."""
    left = MotionPart("left", np.array([0]), (), (), np.array([0]), 0.35, 1.0)
    n_frames, ends = 60, 30
    profiles = torch.full((1, n_frames), float(np.log(0.05 + 0.05)))
    profiles[0, ends:] = float(np.log(2.0 + 0.05))
    library = library_of(torch.zeros(1, n_frames), profiles, (left,), fps, 1.0, 0.0)
    pieces = Pieces(np.array([0]), np.array([0]), hop=n_frames, overlap=0, n_frames=n_frames)
    choice = RecalledMotion((left,), (pieces,), (n_frames,))
    detail = library.detail(choice.profiles(library.recordings, n_frames))[0]
    # The edge lies half a frame before the first fast frame.
    assert (frames - 0.5) / fps == pytest.approx(0.08)
    assert detail[ends - frames] == pytest.approx(norm.cdf(-1.0), abs=0.005)
    assert detail[ends - 1 + frames] == pytest.approx(norm.cdf(1.0), abs=0.005)


@pytest.mark.parametrize("r, variance", [(0.0, 0.0), (0.6, 0.9375), (-0.8, 0.0), (1.0, 20 / 9)])
def test_the_second_arm_follows_as_closely_as_the_recorded_one_did(r, variance):
    """Directions of both hands have the variance r / (1 - r^2), with an r from 0 to 0.8.

    The cross term of two Gaussians' log likelihood ratio is r / (1 - r^2) times their product.
    """
    hand, other = noise(2, 400)
    hand, other = hand - hand.mean(), other - other.mean()
    other -= hand * (hand @ other) / (hand @ hand)
    beside = r * hand / hand.std() + np.sqrt(1 - r**2) * other / other.std()
    directions = 7 * np.stack([hand, hand, beside, beside])
    both = _weights(np.split(directions, [150], axis=1)) * directions
    np.testing.assert_allclose(both.var(axis=1), variance, atol=1e-3)
    assert both.shape == (4, 400)
    for row, own in zip(both, (hand, hand, beside, beside), strict=True):
        assert variance == 0 or np.corrcoef(row, own)[0, 1] > 0.999


def test_pieces_are_the_recordings_frames_and_fade_linearly_at_the_border():
    curves = [10.0 * torch.arange(12)[None], 100.0 + torch.arange(12)[None]]
    joined = Pieces(np.array([0, 1]), np.array([2, 4]), hop=3, overlap=2, n_frames=8)
    made = joined.blend(curves, (12, 12), 8)[0]
    fade = [0.75 * 50 + 0.25 * 104, 0.25 * 60 + 0.75 * 105]
    expected = [20, 30, 40, *fade, 106, 107, 108]
    assert made.tolist() == pytest.approx(expected)


def test_no_cross_fade_is_cut_short_by_the_next():
    """Pieces of short recordings, of 0 and of 1 all the time, are joined without jumps."""
    found = search([6, 6], piece=10, overlap=4)
    order = np.array([0, 1, 0, 1])
    pieces = Pieces(order, np.zeros(4, int), found.hop, found.overlap, 4 * found.hop)
    made = pieces.blend([torch.zeros(1, 6), torch.ones(1, 6)], (6, 6), pieces.n_frames)[0]
    assert made.diff().abs().max() <= 1 / found.overlap + 1e-6


@pytest.mark.parametrize("recorded_rate", [1.0, 2.5, 0.5])
@pytest.mark.parametrize("rate", [1.0, 4 / 3, 3.0, 0.5])
def test_times_stay_true_at_any_rate(recorded_rate, rate):
    """A recording of its own time, continued in its next piece, gives time."""

    def times(n: int, of: int) -> torch.Tensor:
        return ((torch.arange(n) + 0.5) * of / n - 0.5).double()

    pieces = Pieces(np.array([0, 0]), np.array([5, 15]), hop=10, overlap=4, n_frames=24)
    ramp = times(round(48 * recorded_rate), 48)[None]
    n = round(24 * rate)
    made = pieces.blend([ramp], (48,), n)[0]
    np.testing.assert_allclose(made, 5 + times(n, 24), atol=1e-9)


def test_averages_keep_the_mean_of_each_part():
    curves = np.stack([np.arange(12.0), np.ones(12)])
    np.testing.assert_allclose(averaged(curves, 3), [[1.5, 5.5, 9.5], [1, 1, 1]])
    np.testing.assert_allclose(averaged(curves, 5).mean(axis=1), [5.5, 1.0])
    np.testing.assert_allclose(averaged(curves, 12), curves)


def test_the_piece_with_the_wanted_profile_is_found():
    found = search([60, 60, 60])
    for recording, start in ((0, 0), (1, 23), (2, 50)):
        wanted = profile_of(recording)[start : start + 10]
        assert placed(chosen(found, wanted)) == [(recording, start)]
    pieces = chosen(found, profile_of(1)[7 : 7 + 42])
    assert placed(pieces) == [(1, 7 + 8 * n) for n in range(5)]


def test_the_nearer_of_two_movements_is_chosen():
    curves = [np.full((10, 1), level) for level in (0.55, 1.0)]
    found = search_in([np.zeros((10, 1))] * 2, curves, None, 10, 2)
    for wanted, recording in ((0.3, 0), (0.6, 0), (0.9, 1), (3.0, 1)):
        assert placed(chosen(found, np.full((10, 1), wanted))) == [(recording, 0)]


def test_a_weak_prediction_asks_for_pieces_as_varied_as_recorded_ones():
    """Predictions x with r = 0.5 of recorded movement y have the variance r^2 = 1/4.

    The likeliest pieces have y nearest to x / r^2: for x = 0.4 that is 1.6, not 0.4. Without any
    correlation (x = 0), no piece is likelier than another.
    """
    levels = (0.0, 0.4, 1.6, 3.0)
    for shrinkage, wanted, best in ((1.0, 0.4, 1), (0.25, 0.4, 2), (0.25, -0.1, 0), (0.25, 1.0, 3)):
        curves = [np.full((10, 1), level) for level in levels]
        found = search_in([np.zeros((10, 1))] * 4, curves, None, 10, 2, ONLY_MOVEMENT, [shrinkage])
        assert placed(chosen(found, np.full((10, 1), wanted))) == [(best, 0)]
    uninformed = [
        search([60, 60], replace(ONLY_MOVEMENT, chance=1.0)),
        search_in(*_same(), ChoiceWeights(continuity=0.0, used=0.0, chance=1.0), [0.0]),
    ]
    known, unknown = (
        {placed(chosen(found, np.zeros((10, 1)), seed=seed))[0] for seed in range(40)}
        for found in uninformed
    )
    assert len(unknown) > 25 > len(known), "all that differs is chance"


def _same() -> tuple[object, ...]:
    """The recordings of `search([60, 60])`, up to the weights."""
    return [noise(60, 4, seed=k) for k in (0, 1)], [profile_of(k) for k in (0, 1)], None, 10, 2


def test_the_likeliest_piece_wins_as_often_as_its_likelihood_says():
    """Without a preference for the strongest, a choice would still be a mean: r = 0.6 here.

    Given a prediction of 0.6 x, recorded movement y is Gaussian with mean 0.6 x and variance
    0.64; among 4000 pieces that are drawn from the standard normal distribution, those that are
    chosen without any chance are those of the highest likelihood relative to it: y = x / 0.6.
    """
    levels = np.sort(noise(4000))
    curves = [np.full((10, 1), level) for level in levels]
    weights = ChoiceWeights(continuity=0.0, used=0.0, chance=0.0)
    found = search_in([np.zeros((10, 1))] * 4000, curves, None, 10, 2, weights, [0.36])
    for predicted in (-0.6, 0.0, 0.3, 0.9):
        ((best, _),) = placed(chosen(found, np.full((10, 1), predicted)))
        gain = norm.logpdf(levels, predicted, 0.8) - norm.logpdf(levels)
        assert levels[best] == pytest.approx(levels[gain.argmax()], abs=0.02)


def test_the_piece_in_the_wanted_slow_state_is_chosen():
    """Slow movement counts more than a place, in standard deviations of each channel."""
    states = [np.tile([slow, place], (10, 1)) for slow in (-1.0, 1.0) for place in (3.0, 9.0)]
    found = search_in([np.zeros((10, 1))] * 4, [np.zeros((10, 1))] * 4, states, 10, 2)

    def nearest(slow: float, place: float) -> list[tuple[int, int]]:
        wanted = np.tile([slow, place], (10, 1))
        return placed(found.choose(rng(), np.zeros((10, 1)), wanted))

    for recording, state in enumerate(states):
        assert nearest(*state[0]) == [(recording, 0)]
    assert nearest(-0.2, 20.0) == [(1, 0)] and nearest(0.2, -20.0) == [(2, 0)]
    # 2 sd of movement or of place: the piece that has the movement is chosen.
    states = [np.tile(own, (10, 1)) for own in ([-1.0, 9.0], [1.0, 3.0])]
    found = search_in([np.zeros((10, 1))] * 2, [np.zeros((10, 1))] * 2, states, 10, 2)
    assert nearest(1.0, 9.0) == [(1, 0)] and nearest(-1.0, 3.0) == [(0, 0)]


def test_the_nearest_of_three_slow_states_is_chosen():
    states = [np.full((10, 1), level) for level in (0.0, 0.5, 1.0)]
    found = search_in([np.zeros((10, 1))] * 3, [np.zeros((10, 1))] * 3, states, 10, 2)
    for wanted, recording in ((-3.0, 0), (0.2, 0), (0.3, 1), (0.7, 1), (0.8, 2), (3.0, 2)):
        pieces = found.choose(rng(), np.zeros((10, 1)), np.full((10, 1), wanted))
        assert placed(pieces) == [(recording, 0)]


@pytest.mark.parametrize(("apart", "recording"), [(1.1, 1), (1.4, 0)])
def test_movement_and_slow_states_are_weighed_in_standard_deviations(apart, recording):
    """The first recording moves otherwise by 1 all the time and is in a state of 0, the second is
    in a state 2 sd above it. Some x sd below the second, 1 + (2 - x)^2 < x^2 for x > 5/4."""
    weights = ChoiceWeights(movement=2.0, slow=2.0, continuity=0.0, used=0.0, chance=0.0)
    profiles = [np.full((10, 1), 1.0), np.zeros((10, 1))]
    states = [np.zeros((10, 1)), np.full((10, 1), 5.0)]
    found = search_in([np.zeros((10, 1))] * 2, profiles, states, 10, 2, weights)
    pieces = found.choose(rng(), np.zeros((10, 1)), np.full((10, 1), 5.0 - 2.5 * apart))
    assert placed(pieces) == [(recording, 0)]


def test_a_slow_state_is_the_mean_over_a_piece():
    """Whatever happens within it: a ramp from -1 to 1 is as good as 0 all the time."""
    ramp, far = np.linspace(-1, 1, 10)[:, None], np.full((10, 1), 0.3)
    found = search_in([np.zeros((10, 1))] * 2, [np.zeros((10, 1))] * 2, [far, ramp], 10, 2)
    for wanted, recording in ((np.zeros((10, 1)), 1), (ramp, 1), (far, 0), (0.2 + ramp, 0)):
        assert placed(found.choose(rng(), np.zeros((10, 1)), wanted)) == [(recording, 0)]


def test_a_slow_channel_that_never_changes_hides_no_other():
    """An arm that is always held: only rounding differs in its height."""
    states = [
        np.tile([level, 0.9], (30, 1)) + 1e-6 * noise(30, 2, seed=k)
        for k, level in enumerate((-0.5, 0.5))
    ]
    profiles = [profile_of(k, length=30) for k in (0, 1)]
    found = search_in([np.zeros((30, 1))] * 2, profiles, states, 10, 2)
    for recording, start in ((0, 0), (1, 7), (0, 20)):
        rows = slice(start, start + 10)
        pieces = found.choose(rng(), profiles[recording][rows], states[recording][rows])
        assert placed(pieces) == [(recording, start)]


def test_the_piece_with_the_same_movement_of_the_other_hand_is_chosen():
    """Columns: movement, then the other hand upwards and outwards."""
    curves = [np.tile([0.0, up, out], (10, 1)) for up in (-1, 1) for out in (-1, 1)]
    found = search_in([np.zeros((10, 1))] * 4, curves, None, 10, 2)
    for recording, curve in enumerate(curves):
        assert placed(chosen(found, curve)) == [(recording, 0)]
    # Movement counts more: twice the other hand's difference does not outweigh it.
    curves = [np.tile([level, -level, -level], (10, 1)) for level in (-1.0, 1.0)]
    found = search_in([np.zeros((10, 1))] * 2, curves, None, 10, 2)
    assert placed(chosen(found, np.tile([1.0, 1.0, 1.0], (10, 1)))) == [(1, 0)]


def test_unknown_movement_matches_any_piece():
    curves = [noise(10, 3, seed=k) for k in range(5)]
    found = search_in([np.zeros((10, 1))] * 5, curves, None, 10, 2)
    wanted = curves[3].copy()
    wanted[:, 0] = ANYTHING
    assert placed(chosen(found, wanted)) == [(3, 0)]


def test_continuity_prefers_what_came_next_in_the_recording():
    wanted = np.full((26, 1), ANYTHING)
    weights = ChoiceWeights(used=0.0, chance=0.0)
    (k, start), *after = placed(chosen(search([30, 30], weights), wanted))
    assert after == [(k, start + 8), (k, start + 16)]
    apart = placed(chosen(search([30, 30]), wanted))
    assert apart[1] != (apart[0][0], apart[0][1] + 8), "nothing else would have done this"


def test_the_next_recorded_piece_is_a_candidate_among_hours():
    """It is one even where thousands of pieces come nearer to what is wanted."""
    found = search([4000], ChoiceWeights(movement=0.01, continuity=9.0, used=0.0, chance=0.0))
    (_, start), *after = placed(chosen(found, noise(42, 1, seed=1)))
    assert after == [(0, start + 8 * n) for n in range(1, 5)]


def test_only_allowed_recordings_are_used():
    wanted, found = noise(50, 1, seed=5), search([60] * 4, ChoiceWeights())
    allowed = np.zeros((50, 4), bool)
    allowed[:26, 3] = allowed[26:, 1] = True
    used = chosen(found, wanted, allowed).recordings
    # A piece counts where its middle is: pieces of 10 frames begin every 8.
    assert used.tolist() == [3, 3, 3, 1, 1, 1]
    assert len(set(chosen(found, wanted).recordings)) > 1


def test_recordings_that_were_used_are_avoided():
    still = [np.zeros((40, 3))], [np.zeros((40, 1))]
    wanted = np.zeros((34, 1))

    def starts(used: float) -> np.ndarray:
        weights = ChoiceWeights(used=used, chance=0.0)
        return chosen(search_in(*still, None, 10, 2, weights), wanted).starts

    assert len(set(starts(0.0))) < 4
    # 4 pieces of 10 frames in the 40 that there are: each part once.
    assert len(set(starts(0.25) // 10)) == 4


def test_parts_are_not_joined_to_a_copy_of_the_recording():
    weights = ChoiceWeights(movement=3.0, continuity=0.0, used=0.0, chance=0.0)
    found, wanted = search([60, 60], weights), profile_of(1)[20:30]
    shown = np.arange(80.0, 90.0)[:, None]
    best = [(1, 20)]

    def beside(*others: np.ndarray) -> list[tuple[int, int]]:
        return placed(chosen(found, wanted, None, np.concatenate(others, axis=1)))

    for number, start in beside(shown) + beside(shown + 1):
        assert number == 0 or abs(start - 20) > 1
    # A moment is the same if it is at most an eighth of a piece away: 1.25 frames here.
    assert beside(shown + 3) == best and beside(shown - 30) == best
    # The others show different moments: there is no copy.
    assert beside(shown, shown - 30) == best
    assert beside(shown, shown + 1) != best
    # It counts by the share of the piece: one frame of ten does not outweigh what is wanted.
    few = np.where(np.arange(10)[:, None] < 1, shown, 0.0)
    assert beside(few) == best
    # In every piece of a longer motion.
    wanted = profile_of(1)[7:49]
    pieces = chosen(found, wanted, None, np.arange(67.0, 109.0)[:, None])
    assert len(pieces.starts) == 5
    for n, (number, start) in enumerate(placed(pieces)):
        assert number == 0 or abs(start - (7 + 8 * n)) > 1


@pytest.mark.parametrize("lengths", [[4], [1], [1, 1, 3], [12, 4, 60]])
@pytest.mark.parametrize("n_frames", [1, 2, 9, 11, 40])
def test_short_recordings_and_short_speech(lengths, n_frames):
    found = search(lengths, ChoiceWeights())
    others = np.linspace(-3, 99, 2 * n_frames).reshape(n_frames, 2)
    pieces = chosen(found, noise(n_frames, 1), None, others)
    curves = [torch.full((1, n), float(k)) for k, n in enumerate(lengths)]
    made = pieces.blend(curves, lengths, n_frames)
    assert made.shape == (1, n_frames) and torch.isfinite(made).all()
    for k, start in placed(pieces):
        assert 0 <= start <= lengths[k] - found.piece, "a piece is whole"
    assert len(pieces.starts) * found.hop + found.overlap >= n_frames


def test_an_hour_of_speech_takes_seconds_and_little_memory():
    """In twenty minutes of recordings at 4.4 frames per second."""
    found = search([5300], ChoiceWeights(), piece=9, overlap=2)
    wanted = noise(16000, 1)
    tracemalloc.start()
    began = time.process_time()
    pieces = chosen(found, wanted)
    seconds, peak = time.process_time() - began, tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(pieces.starts) == 2286
    assert seconds < 10 and peak < 100e6


EFFORT = (4, 5)  # columns of vocal effort in the synthetic speech


def talk(seed: int, *, seconds: float = 40.0, lively: float | None = None, follows: bool = True):
    """Return synthetic speech (6, T) and movement (T,).

    Movement follows energy, column 0, and effort, whose level changes slowly or is `lively`.
    Without `follows`, it follows those of other speech.
    """
    n = round(seconds * FPS)
    energy = slow_part(noise(n, seed=seed), 0.15 * FPS)
    energy -= slow_part(energy, FPS)
    energy /= energy.std()
    level = slow_part(noise(n, seed=seed + 1000), 4 * FPS)
    level = level / level.std() if lively is None else np.full(n, lively)
    movement = -1.0 + 0.4 * energy + 0.5 * level
    if not follows:
        energy, level = talk(seed + 5000, seconds=seconds)[0][[0, 4]]
    speech = 0.2 * noise(6, n, seed=seed + 2000)
    speech[0] += energy
    speech[list(EFFORT)] += [level, 2 * level]
    return speech, movement


def fitted(
    follows: bool = True, effort=EFFORT, wide: bool = False, count: int = 5
) -> WantedMovement:
    """Fit to talks of which each is a take."""
    speeches, movements = zip(*(talk(seed, follows=follows) for seed in range(count)), strict=True)
    if wide:
        speeches = [np.concatenate([s, 0.01 * noise(80, s.shape[1])]) for s in speeches]
    takes = [f"take {k}" for k in range(count)]
    return WantedMovement.fit(speeches, movements, levels_of(movements), FPS, effort, takes=takes)


def levels_of(movements) -> list[np.ndarray]:
    """Return the slow parts, in standard deviations from the mean."""
    slow = [slow_part(movement, FPS) for movement in movements]
    every = np.concatenate(slow)
    return [(curve - every.mean()) / max(every.std(), 1e-9) for curve in slow]


@pytest.fixture(scope="module")
def wanted() -> WantedMovement:
    return fitted()


def agreement(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.corrcoef(a, b)[0, 1])


def test_movement_is_predicted_for_unseen_speech(wanted):
    speech, movement = talk(77)
    fast, slow = wanted(speech)
    assert fast.shape == slow.shape == movement.shape
    assert agreement(slow, slow_part(movement, FPS)) > 0.7
    assert agreement(fast, movement - slow_part(movement, FPS)) > 0.7
    assert abs(agreement(fast, slow)) < 0.1, "neither has a share in the other"


def test_wanted_movement_stays_within_the_recorded_range(wanted):
    """Noise that is ten times as loud as all speech asks for no more than was recorded."""
    movements = [talk(seed)[1] for seed in range(5)]
    fast, slow = wanted(10 * talk(77)[0])
    recorded = [np.abs(movement - slow_part(movement, FPS)).max() for movement in movements]
    assert np.abs(fast).max() < max(recorded)
    assert np.abs(slow).max() <= 2 * 2.5


def test_an_unusual_voice_predicts_as_much_movement_as_a_usual_one(wanted):
    speech = talk(77)[0]
    usual, *unusual = speech, speech.copy(), speech.copy()
    for other, shift in zip(unusual, (-50.0, 50.0), strict=True):
        other[list(EFFORT)] += shift - other[list(EFFORT)].mean(axis=1, keepdims=True)
        assert wanted(other)[1].mean() == pytest.approx(wanted(usual)[1].mean(), abs=0.5)


def test_long_speech_gives_the_same_prediction_in_parts(wanted, monkeypatch):
    speech = talk(77)[0]
    whole = wanted(speech)
    monkeypatch.setattr("gesturekit.multires.recall.wanted._FRAMES_AT_ONCE", 70)
    np.testing.assert_allclose(wanted(speech), whole, atol=1e-9)


def test_frames_beside_a_left_out_quarter_are_left_out_too():
    """12 frames in quarters of 3, of which the second recording has a single one."""
    quarters = [((0, 2), (0, 3)), ((2, 5), (1, 6)), ((5, 8), (4, 8)), ((8, 12), (8, 12))]
    for takes in (["a", "b"], ["a", "a"]):
        found = folds_of([8, 4], takes, gap=1)
        for (out, kept), (left_out, near) in zip(found, quarters, strict=True):
            assert np.flatnonzero(out).tolist() == list(range(*left_out))
            assert np.flatnonzero(~kept).tolist() == list(range(*near))


def test_three_takes_are_left_out_as_a_whole():
    """Recordings of 3, 2, 4 and 1 frames, of which the first and the last are of one take."""
    found = folds_of([3, 2, 4, 1], ["x", "y", "z", "x"], gap=1)
    assert [np.flatnonzero(out).tolist() for out, _ in found] == [
        [0, 1, 2, 9],
        [3, 4],
        [5, 6, 7, 8],
    ]
    assert all((kept == ~out).all() for out, kept in found)
    many = folds_of([1] * 40, [f"{k}" for k in range(40)], gap=1)
    assert len(many) == 8 and sum(out for out, _ in many).tolist() == [1] * 40


def test_parts_of_a_take_flatter_the_prediction_and_whole_takes_do_not():
    """Each take has a mood and a microphone of its own, which go together by chance."""
    r = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        speeches, movements = [], []
        for _ in range(4):
            mood, *microphone = rng.standard_normal(3)
            for _ in range(3):
                speech = rng.standard_normal((6, 500))
                speech[list(EFFORT)] += 10 * np.array(microphone)[:, None]
                speeches.append(speech)
                movements.append(mood + 0.1 * rng.standard_normal(500))
        takes = [f"take {k // 3}" for k in range(12)]
        pairs = speeches, movements, levels_of(movements), FPS, EFFORT
        within = WantedMovement.fit(*pairs)
        across = WantedMovement.fit(*pairs, takes=takes)
        r.append((within.slow.r, across.slow.r))
    r_within, r_across = np.mean(r, axis=0)
    assert r_within > 0.7 and r_across < 0.5
    assert all(one > other for one, other in r)


def test_speech_without_effort_or_with_many_features_is_enough():
    speech, movement = talk(77)
    many = np.concatenate([speech, 0.01 * noise(80, speech.shape[1], seed=9)])
    wide = fitted(wide=True)
    assert wide.fast_basis.shape == (84 + 2, 64) and wide.slow_basis.shape[0] == 84 + 2
    for fast, slow in (fitted(effort=())(speech), wide(many)):
        assert agreement(slow, slow_part(movement, FPS)) > 0.6
        assert agreement(fast, movement - slow_part(movement, FPS)) > 0.6


def test_calm_voices_predict_less_movement_than_lively_ones(wanted):
    calm, usual, lively = (wanted(talk(50, lively=level)[0])[1].mean() for level in (-1, 0, 1))
    assert calm < usual - 0.3 < lively - 0.6


def test_uninformative_speech_predicts_hardly_anything(wanted):
    unrelated = fitted(follows=False, count=20)
    assert abs(unrelated.slow.r) < 0.25 and wanted.slow.r > 0.5
    assert unrelated.spread < 0.1 * wanted.spread


def test_an_unusual_voice_is_centred_and_a_usual_one_unchanged():
    voices = np.array([[-1.0], [0.0], [1.0]])

    def effort_and_result(level: float) -> tuple[float, float]:
        speech = np.stack([noise(50), level + 0.1 * noise(50) - 0.1 * noise(50).mean()])
        kept = usual_voice(speech, (1,), voices)
        np.testing.assert_array_equal(kept[0], speech[0])
        assert kept[1].std() == pytest.approx(speech[1].std())
        return float(speech[1].mean()), float(kept[1].mean())

    for level in (-1.9, -1.0, 0.0, 0.7, 1.9):
        before, after = effort_and_result(level)
        assert after == pytest.approx(before), "calm and lively voices stay so"
    assert effort_and_result(2.5)[1] == pytest.approx(1.25), "half way at 1.5 half ranges outside"
    for level in (-8.0, 3.0, 40.0):
        assert effort_and_result(level)[1] == pytest.approx(0.0, abs=1e-9)
    same = noise(2, 20)
    np.testing.assert_array_equal(usual_voice(same, (), voices), same)


def test_still_recordings_and_constant_speech_are_finite():
    speeches, movements = [np.zeros((6, 40)), np.zeros((6, 3))], [np.full(40, -2.0), np.full(3, -2)]
    wanted = WantedMovement.fit(speeches, movements, levels_of(movements), FPS, EFFORT)
    assert not wanted.predicts
    for n_frames in (1, 2, 100):
        np.testing.assert_array_equal(wanted(np.zeros((6, n_frames))), np.zeros((2, n_frames)))
    assert np.isfinite(wanted(noise(6, 30))).all()


@pytest.mark.parametrize(
    ("frames", "is_avoided"),
    [
        *(([], False), ([20], True), ([25], True), ([29], True)),
        *(([19], False), ([30], False)),  # beside the piece
        ([*range(0, 40, 5)], False),  # every piece has one
    ],
)
def test_a_piece_with_a_defect_is_not_chosen_where_there_are_others(frames, is_avoided):
    """Frames 20 to 29 of a recording of 40 frames hold the wanted movement."""
    flags, profile = np.zeros(40, bool), noise(40, 1)
    flags[frames] = True
    found = search_in([np.zeros((40, 3))], [profile], None, 10, 0, flags=[flags])
    (start,) = chosen(found, profile[20:30]).starts
    assert (start != 20) == is_avoided
    assert not is_avoided or not flags[start : start + 10].any()


@pytest.mark.parametrize("heading", [0.0, 1.0])
def test_slow_states_of_an_arm_are_where_its_hand_is_and_how_wide_it_moves(heading):
    """It is held 0.3 m up and 0.4 m away, then moves up and down by 0.1 m once a second there."""
    time = np.arange(1200) / FPS
    up = 0.3 + 0.1 * np.sin(2 * np.pi * time) * (time > 24)
    away = 0.4 * np.array([np.sin(heading), np.cos(heading)])
    hand = np.stack([np.full(1200, away[0]), up, np.full(1200, away[1])])
    places = np.stack([np.zeros_like(hand), hand])
    none = np.zeros(0, int)
    arm = MotionPart("left", none, (), ("hand",), none, 0.35, 1.0)
    found = slow_states(arm, ("hips", "hand"), FPS, places, np.full(1200, -1.5))
    assert slow_channels(arm) == ("movement", "height", "distance", "width")
    held, moved = found[:, :350], found[:, 850:]
    for part, width in ((held, 0.0), (moved, 0.1 / np.sqrt(2))):
        expected = [-1.5, 0.3, 0.4, np.log(width + 0.01)]
        np.testing.assert_allclose(part.mean(axis=1), expected, atol=0.03)
    rest = MotionPart("rest", none, (), ("hand",), none, 0.35, 1.0)
    assert len(slow_states(rest, ("hips", "hand"), FPS, places, np.zeros(1200))) == 1


def test_defects_are_assigned_to_the_part_with_the_defective_joint(gesture):
    motion = gesture(4.0, fps=30.0)
    rotations = motion.rotations.copy()
    elbow = motion.skeleton.index("LeftForeArm")
    off = Rotation.from_euler("x", 80, degrees=True) * Rotation.from_quat(rotations[50, elbow])
    rotations[50, elbow] = off.as_quat()
    spoilt = replace(motion, rotations=rotations)
    representation = MultiresRepresentation.fit([motion])
    parts = motion_parts(representation, separate=True)
    for made, frames in ((motion, []), (spoilt, [50])):
        values = torch.from_numpy(representation.encode(made).T)
        flags = defects_of_parts(parts, representation, 30.0, values)
        assert flags.shape == (3, 120)
        found = [np.flatnonzero(own).tolist() for own in flags]
        # The hand moves there and back at some 10 m/s, which may count as jumps around the pop.
        assert [[f for f in own if not 50 <= f <= 51] for own in found] == [[], [], []]
        assert (found[0][:1], found[1], found[2]) == (frames, [], [])


def test_flags_at_a_coarser_level_are_those_of_both_frames_around():
    flags = np.zeros((3, 12), bool)
    flags[0, 4] = flags[1, 5] = flags[2, 0] = flags[2, 11] = True
    # Frames 4 and 5 of 12 lie at (4.5 / 12) 4 - 0.5 = 1 and at 1.33 of 4, the ends outside.
    expected = [[0, 1, 0, 0], [0, 1, 1, 0], [1, 0, 0, 1]]
    assert _any_near(flags, 4).astype(int).tolist() == expected
