"""The search for pieces, against the sum of its costs over all sequences of pieces."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from gesturekit.multires.recall.pieces import ChoiceWeights, PieceSearch
from gesturekit.multires.recall.slow_state import SlowState

LENGTHS, PIECE, OVERLAP = (12, 10), 4, 2
HOP = PIECE - OVERLAP
WEIGHTS = ChoiceWeights(3.0, 2.0, 0.7, 1.5, 2.0, 0.0, 4.0, 1.5, 0.0)
SHRINKAGE = np.array([0.4, 0.8, 0.8])


class Recordings:
    """Two recordings of noise, in which every third frame or so has a defect."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.vectors, self.profiles, self.states = (
            [rng.standard_normal((n, width)) for n in LENGTHS] for width in (5, 3, 2)
        )
        self.states = [own * [1.0, 7.0] + [3.0, -20.0] for own in self.states]
        self.flags = [rng.random(n) < 0.15 for n in LENGTHS]
        self.starts = [(k, s) for k, n in enumerate(LENGTHS) for s in range(n - PIECE + 1)]
        self.spread = np.concatenate(self.states).std(axis=0)

    def search(self, weights: ChoiceWeights = WEIGHTS) -> PieceSearch:
        about = PIECE, OVERLAP, SHRINKAGE, weights, self.flags
        return PieceSearch(self.vectors, self.profiles, self.states, *about)

    def frame(self, piece: tuple[int, int]) -> int:
        return sum(LENGTHS[: piece[0]]) + piece[1]

    def cost(self, piece, wanted, states, others=None, weights=WEIGHTS) -> float:
        """What a piece costs, its neighbours apart; `wanted` and `states` are of its frames."""
        recording, start = piece
        own = slice(start, start + PIECE)
        profile = self.profiles[recording][own]
        terms = wanted**2 - 2 * wanted * profile + SHRINKAGE * profile**2
        found = np.nansum(terms * [weights.movement, *[weights.together] * 2]) / PIECE
        apart = (states.mean(axis=0) - self.states[recording][own].mean(axis=0)) / self.spread
        found += weights.slow * apart[0] ** 2 + weights.place * apart[1] ** 2
        found += weights.defective * self.flags[recording][own].any()
        if others is not None:
            shown = self.frame(piece) + np.arange(len(others))[:, None]
            same = (np.abs(others - shown) <= PIECE / 8).all(axis=1)
            found += weights.copied * same.sum() / PIECE
        return found

    def join(self, before: int, piece: tuple[int, int], weights=WEIGHTS) -> float:
        """What it costs that a piece follows where frame `before`, of all, would be shown."""
        every = np.concatenate(self.vectors)
        ahead = every[np.minimum(before + np.arange(OVERLAP), len(every) - 1)]
        first = self.frame(piece)
        return weights.continuity * np.square(ahead - every[first : first + OVERLAP]).mean()


def padded(rows: np.ndarray, n: int) -> np.ndarray:
    return np.pad(rows, ((0, n - len(rows)), (0, 0)), mode="edge")


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("limited", [False, True])
def test_the_cheapest_of_all_sequences_is_found(seed, limited):
    """Nine frames take four pieces of 4 that overlap by 2; there are 16 pieces."""
    own, rng = Recordings(seed), np.random.default_rng(100 + seed)
    wanted, states = rng.standard_normal((9, 3)), rng.standard_normal((9, 2)) * [1, 7] + [3, -20]
    wanted[rng.random((9, 3)) < 0.1] = np.nan
    others = allowed = None
    if limited:
        # Two other parts show what one of the recordings does, a little apart at times.
        line = own.frame((seed % 2, 1)) + np.arange(9.0)[:, None]
        others = line + rng.choice([0.0, 0.4, 0.6], (9, 2)) * rng.choice([-1, 1], (9, 2))
        allowed = np.ones((9, 2), bool)
        allowed[rng.integers(2, 9), rng.integers(2)] = False
    costs = np.zeros((4, len(own.starts)))
    for n, (k, piece) in itertools.product(range(4), enumerate(own.starts)):
        part = slice(n * HOP, n * HOP + PIECE)
        some = None if others is None else others[part]
        costs[n, k] = own.cost(piece, padded(wanted, 10)[part], padded(states, 10)[part], some)
        middle = min(n * HOP + PIECE // 2, 8)
        if allowed is not None and not allowed[middle, piece[0]]:
            costs[n, k] = np.inf
    joins = np.array([[own.join(own.frame(a) + HOP, b) for b in own.starts] for a in own.starts])
    total = costs[0][:, None, None, None] + costs[1][:, None, None] + costs[2][:, None] + costs[3]
    total = total + joins[:, :, None, None] + joins[None, :, :, None] + joins[None, None]
    best = np.unravel_index(total.argmin(), total.shape)
    found = own.search().choose(torch.Generator(), wanted, states, allowed, others)
    placed = zip(found.recordings.tolist(), found.starts.tolist(), strict=True)
    assert list(placed) == [own.starts[k] for k in best]
    assert (found.hop, found.overlap, found.n_frames) == (HOP, OVERLAP, 9)


@pytest.mark.parametrize("seed", range(8))
def test_the_cheapest_next_piece_is_found_and_its_use_remembered(seed):
    own, rng = Recordings(seed), np.random.default_rng(100 + seed)
    weights = ChoiceWeights(3.0, 2.0, 0.7, 1.5, 2.0, 1.0, 4.0, 1.5, 0.0)
    search = own.search(weights)
    wanted, states = rng.standard_normal((4, 3)), rng.standard_normal(2) * [1, 7] + [3, -20]
    wanted[rng.random((4, 3)) < 0.1] = np.nan
    others = own.frame((1, 3)) + np.arange(4.0)[:, None]
    used, shown = rng.random(search.n_bins), int(rng.integers(22))
    assert search.n_bins == 6, "of 22 frames, by four"
    costs = []
    for piece in own.starts:
        first = own.frame(piece)
        bins = [first // 4, (first + 3) // 4]
        costs.append(
            own.cost(piece, wanted, np.tile(states, (4, 1)), others, weights)
            + used[bins].mean()
            + own.join(shown, piece, weights)
        )
    before = used.copy()
    best = search.following(torch.Generator(), wanted, states, used, others=others, shown=shown)
    assert best == int(np.argmin(costs))
    after = before * 0.95 ** (HOP / PIECE)
    for where in (own.frame(own.starts[best]) // 4, (own.frame(own.starts[best]) + 3) // 4):
        after[where] += 0.5
    np.testing.assert_allclose(used, after)
    only = np.array([seed % 2 == 0, seed % 2 == 1])
    best = search.following(torch.Generator(), wanted, states, before, allowed=only)
    assert own.starts[best][0] == seed % 2


def test_uses_of_a_sequence_are_counted_along_it():
    """All else equal, each piece costs as often as its part of the recordings was used before.

    Pieces of 4 frames without overlap in 12 frames: the first three are different thirds, and the
    fourth is the first again, which has been forgotten most.
    """
    still = [np.zeros((12, 1))]
    weights = ChoiceWeights(used=1.0, chance=0.0)
    search = PieceSearch(still, still, still, 4, 0, [1.0], weights, [np.zeros(12, bool)])
    found = search.choose(torch.Generator(), np.zeros((24, 1)), np.zeros((24, 1)))
    thirds = found.starts // 4
    assert (found.starts % 4 == 0).all(), "a piece across two of them uses both"
    assert sorted(thirds[:3]) == [0, 1, 2] and (thirds[3:] == thirds[:3]).all()


@pytest.mark.parametrize("chance", [0.5, 2.0])
def test_chance_is_gumbel_noise_of_its_scale(chance):
    """The dearer of two pieces that cost 0 and 1 is chosen in 1 / (1 + exp(1 / scale))."""
    profiles = [np.zeros((4, 1)), np.ones((4, 1))]
    still, flags = [np.zeros((4, 1))] * 2, [np.zeros(4, bool)] * 2
    weights = ChoiceWeights(movement=1.0, chance=chance)
    search = PieceSearch(still, profiles, still, 4, 0, [1.0], weights, flags)
    rng = torch.Generator().manual_seed(0)
    asked = np.zeros((4, 1)), np.zeros((4, 1))
    dearer = np.mean([search.choose(rng, *asked).recordings[0] for _ in range(1500)])
    assert dearer == pytest.approx(1 / (1 + np.exp(1 / chance)), abs=0.045)


def test_the_first_piece_begins_before_the_motion():
    """The motion's first frames are then those after as many frames as asked for."""
    own = Recordings(0)
    search = own.search()
    wanted, states = np.random.default_rng(0).standard_normal((9, 3)), np.zeros((9, 2))
    found = search.choose_from_any_frame(torch.Generator(), wanted, states, first=1)
    wider = search.choose(torch.Generator(), padded(wanted[::-1], 10)[::-1], np.zeros((10, 2)))
    np.testing.assert_array_equal(found.starts, wider.starts)
    assert (found.first, found.n_frames) == (1, 9) and (wider.first, wider.n_frames) == (0, 10)


# Slow noise without end.


@pytest.mark.parametrize("between", [0.0, 1.0])
def test_slow_noise_has_no_seam_between_its_blocks(between):
    """It is drawn in blocks of 64 s within takes, and of 256 eighths of a take between them."""
    state = SlowState(np.zeros(1), 1.0, np.eye(1), np.full(1, between), np.array([2.0]), 16.0)
    border = 64.0 if between == 0 else 512.0
    times = border + np.arange(-20, 20, 0.05)
    found = np.array([state.at(7, t, None)[0, 0] for t in times])
    steps = np.abs(np.diff(found))
    assert steps.max() < 4 * np.median(steps) + 0.02 and np.ptp(found) > 0.1
    # Between its points, a quarter of a second or an eighth of a take apart, it is linear.
    bends = np.abs(np.diff(found, 2))
    inner = np.abs((times[1:-1] + 1e-9) % (0.25 if between == 0 else 2.0)) > 0.06
    assert bends[inner].max() < 1e-9 < bends.max()
