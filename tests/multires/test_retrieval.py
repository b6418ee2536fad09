"""Retrieval of recorded pieces: the search, the times at which pieces are shown, and their parts.

Searches are held against the sum of their costs over all sequences of pieces.
"""

import itertools
import time
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import gesturekit as gk
from gesturekit.motion import quaternion_from_rotation_vector, rotation_angles
from gesturekit.multires import (
    MotionPart,
    MultiresRepresentation,
    PassiveChannels,
    defects_of_parts,
    hand_directions,
    motion_parts,
    movements,
    slow_states,
)
from gesturekit.multires.recall.library import time_offsets
from gesturekit.multires.recall.parts import SPEED_FLOOR
from gesturekit.multires.recall.pieces import ChoiceWeights, Pieces, PieceSearch

LENGTHS, PIECE, OVERLAP = (12, 10), 4, 2
HOP = PIECE - OVERLAP
WEIGHTS = ChoiceWeights(3.0, 2.0, 0.7, 1.5, 2.0, 0.0, 4.0, 1.5, 0.0)
SHRINKAGE = np.array([0.4, 0.8, 0.8])
FPS = 20.0
NONE = np.zeros(0, int)


def noise(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(shape)


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
        """The cost of a piece, its neighbours apart; `wanted` and `states` are of its frames."""
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
        """The cost of a piece that follows where frame `before`, of all, would be."""
        every = np.concatenate(self.vectors)
        ahead = every[np.minimum(before + np.arange(OVERLAP), len(every) - 1)]
        first = self.frame(piece)
        return weights.continuity * np.square(ahead - every[first : first + OVERLAP]).mean()


def padded(rows: np.ndarray, n: int) -> np.ndarray:
    return np.pad(rows, ((0, n - len(rows)), (0, 0)), mode="edge")


@pytest.mark.parametrize("seed", range(4))
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


@pytest.mark.parametrize("seed", range(4))
def test_the_cheapest_next_piece_is_found_and_its_use_remembered(seed):
    own, rng = Recordings(seed), np.random.default_rng(100 + seed)
    weights = ChoiceWeights(3.0, 2.0, 0.7, 1.5, 2.0, 1.0, 4.0, 1.5, 0.0)
    search = own.search(weights)
    wanted, states = rng.standard_normal((4, 3)), rng.standard_normal(2) * [1, 7] + [3, -20]
    wanted[rng.random((4, 3)) < 0.1] = np.nan
    others = own.frame((1, 3)) + np.arange(4.0)[:, None]
    used, shown = rng.random(search.n_bins), int(rng.integers(22))
    costs = []
    for piece in own.starts:
        first = own.frame(piece)
        bins = [first // 4, (first + 3) // 4]
        alone = own.cost(piece, wanted, np.tile(states, (4, 1)), others, weights)
        costs.append(alone + used[bins].mean() + own.join(shown, piece, weights))
    before = used.copy()
    best = search.following(torch.Generator(), wanted, states, used, others=others, shown=shown)
    assert best == int(np.argmin(costs))
    shown = [(own.frame(own.starts[best]) + k) // 4 for k in (0, 3)]
    faded = np.delete(used / before, shown)
    assert (used[shown] > before[shown]).all() and 0.5 < faded.min() < 1, "forgotten in time"
    np.testing.assert_allclose(faded, faded[0])
    only = np.array([seed % 2 == 0, seed % 2 == 1])
    best = search.following(torch.Generator(), wanted, states, before, allowed=only)
    assert own.starts[best][0] == seed % 2


def test_the_first_piece_begins_before_the_motion():
    """The motion's first frames are then those after as many frames as asked for."""
    search = Recordings(0).search()
    wanted, states = noise(9, 3), np.zeros((9, 2))
    found = search.choose_from_any_frame(torch.Generator(), wanted, states, first=1)
    wider = search.choose(torch.Generator(), padded(wanted[::-1], 10)[::-1], np.zeros((10, 2)))
    np.testing.assert_array_equal(found.starts, wider.starts)
    assert (found.first, found.n_frames) == (1, 9) and (wider.first, wider.n_frames) == (0, 10)


@pytest.mark.parametrize("lengths", [[4], [1, 1, 3], [12, 4, 60]])
@pytest.mark.parametrize("n_frames", [1, 9, 40])
def test_short_recordings_and_short_speech(lengths, n_frames):
    rows = [[noise(n, width) for n in lengths] for width in (4, 1, 1)]
    flags = [np.zeros(n, bool) for n in lengths]
    found = PieceSearch(*rows, 10, 2, np.ones(1), ChoiceWeights(), flags)
    others = np.linspace(-3, 99, 2 * n_frames).reshape(n_frames, 2)
    asked = noise(n_frames, 1), np.zeros((n_frames, 1)), None, others
    pieces = found.choose(torch.Generator(), *asked)
    curves = [torch.full((1, n), float(k)) for k, n in enumerate(lengths)]
    made = pieces.blend(curves, lengths, n_frames)
    assert made.shape == (1, n_frames) and torch.isfinite(made).all()
    for k, start in zip(pieces.recordings, pieces.starts, strict=True):
        assert 0 <= start <= lengths[k] - found.piece, "a piece is whole"
    # No cross-fade is cut short by the next: from 0 to 1 all the time.
    order = np.arange(4) % len(lengths)
    joined = Pieces(order, np.zeros(4, int), found.hop, found.overlap, 4 * found.hop)
    ones = [torch.full((1, n), float(k % 2)) for k, n in enumerate(lengths)]
    jumps = joined.blend(ones, lengths, joined.n_frames)[0].diff().abs()
    assert len(jumps) == 0 or jumps.max() <= 1 / max(1, found.overlap) + 1e-6


@pytest.mark.stress
def test_minutes_of_speech_take_seconds_and_little_memory():
    """In twenty minutes of recordings at 4.4 frames per second; so does their timing."""
    rows = [[noise(5300, width)] for width in (4, 1, 1)]
    found = PieceSearch(*rows, 9, 2, np.ones(1), ChoiceWeights(), [np.zeros(5300, bool)])
    own, asked = noise(2, 3, 10_000)
    tracemalloc.start()
    began = time.process_time()
    pieces = found.choose(torch.Generator(), noise(3000, 1), np.zeros((3000, 1)))
    time_offsets(own, asked, 14.0, 0.25)
    seconds, peak = time.process_time() - began, tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(pieces.starts) == 429
    assert seconds < 30 and peak < 60e6


# Times at which pieces are shown.


def test_pieces_are_the_recordings_frames_and_fade_linearly_at_the_border():
    curves = [10.0 * torch.arange(12)[None], 100.0 + torch.arange(12)[None]]
    joined = Pieces(np.array([0, 1]), np.array([2, 4]), hop=3, overlap=2, n_frames=8)
    made = joined.blend(curves, (12, 12), 8)[0]
    fade = [0.75 * 50 + 0.25 * 104, 0.25 * 60 + 0.75 * 105]
    assert made.tolist() == pytest.approx([20, 30, 40, *fade, 106, 107, 108])
    rest = joined.beginning_at(2)
    torch.testing.assert_close(rest.blend(curves, (12, 12), 6)[0], made[2:])
    assert joined.recorded_frames((12, 12)).tolist() == [2, 3, 4, 16, 17, 18, 19, 20]
    later = replace(rest, offsets=np.full(6, 0.5))
    assert later.recorded_frames((12, 12)).tolist() == [4.5, 16.5, 17.5, 18.5, 19.5, 20.5]


@pytest.mark.parametrize("recorded_rate", [1.0, 2.5])
@pytest.mark.parametrize("rate", [1.0, 3.0, 0.5])
@pytest.mark.parametrize("shift", [0.0, 2.0])
def test_times_stay_true_at_any_rate(recorded_rate, rate, shift):
    """A recording of the square of its time, continued in its next piece, gives that square."""

    def times(n: int, of: int) -> np.ndarray:
        return (np.arange(n) + 0.5) * of / n - 0.5

    offsets = shift * np.sin(np.arange(24) / 5)
    about = {"hop": 10, "overlap": 4, "n_frames": 24, "offsets": offsets if shift else None}
    pieces = Pieces(np.array([0, 0]), np.array([5, 15]), **about)
    curve = torch.from_numpy(times(round(48 * recorded_rate), 48))[None] ** 2
    at = times(round(24 * rate), 24)
    made = pieces.blend([curve], (48,), len(at))[0]
    np.testing.assert_allclose(made, (5 + at + np.interp(at, np.arange(24), offsets)) ** 2)
    part = pieces.blend([curve], (48,), len(at), slice(3, 9))[0]
    torch.testing.assert_close(part, made[3:9])


@pytest.mark.parametrize("offset", [-9.0, 9.0])
def test_offsets_beyond_both_ends_hold_the_recording(offset):
    pieces = Pieces(np.array([0]), np.array([0]), 6, 0, 6, offsets=np.full(6, offset))
    made = pieces.blend([torch.arange(6.0)[None]], (6,), 6)
    assert set(made[0].tolist()) == {0.0 if offset < 0 else 5.0}


@pytest.mark.parametrize("seed", range(2))
def test_of_all_paths_the_one_with_the_lowest_cost_is_found(seed):
    """Two curves of 7 frames, offsets of up to 1 frame in halves; every path is tried."""
    own, asked = 2 * noise(2, 2, 7, seed=seed)
    costs = {}
    for path in itertools.product(range(-2, 3), repeat=7):
        tempos = np.diff(path)
        if np.abs(tempos).max() <= 1:
            times = np.arange(7) + np.array(path) / 2
            shown = np.stack([np.interp(times, np.arange(7), curve) for curve in own])
            costs[path] = ((shown - asked) ** 2).sum() + 0.1 * (np.diff(tempos) ** 2).sum()
    best = np.array(min(costs, key=costs.get)) / 2
    np.testing.assert_allclose(time_offsets(own, asked, 2.5, 0.5), best, atol=1e-9)
    assert np.isfinite(time_offsets(own[:, :1], asked[:, :1], 2.5, 0.5)).all()


# The library of the bundled model.


@pytest.fixture(scope="module")
def library():
    return gk.load("demo").library


def test_searches_of_arms_and_trunk(library):
    """Speech that predicts little counts less; the trunk's pieces are twice as long, and its feet
    should not slide."""
    counts = []
    for r in (0.7, 0.3, -0.2):
        wanted = replace(library.wanted, fast=replace(library.wanted.fast, r=r))
        left, right, rest = replace(library, wanted=wanted).searches
        counts.append(left.weights.movement)
        assert left.weights == right.weights
        assert rest.weights.movement == left.weights.movement
    assert counts[0] > counts[1] > counts[2] == 0
    assert left.piece == right.piece and rest.piece == pytest.approx(2 * left.piece, abs=1)
    assert rest.weights.continuity > left.weights.continuity
    for own in replace(library, wanted=None).searches:
        assert own.weights.movement == 0.0


def seeded(seed: int = 0):
    return lambda _: torch.Generator().manual_seed(seed)


def test_the_second_arm_goes_with_the_first_and_is_stretched_alike(library):
    """Directions of both hands agree more where they count; fast parts follow the prediction."""
    speech = noise(len(library.wanted.fast_basis), 300)
    directions = [own.directions for own in library.recordings]
    apart = []
    for together in (0.0, 5.0):
        weights = ChoiceWeights(together=together)
        changed = replace(library, weights=weights, stretch=0.0)
        for seed in range(4):
            made = changed.recall(speech, seeded(seed))
            left, right = (p.blend(directions, made.lengths, 100) for p in made.pieces[:2])
            apart.append(float((left - right[[2, 3, 0, 1]]).square().mean()))
            assert made.pieces[0].first == made.pieces[1].first
    assert np.mean(apart[4:]) < 0.8 * np.mean(apart[:4])
    left, right, rest = replace(library, stretch=0.25).recall(speech, seeded()).pieces
    np.testing.assert_array_equal(left.offsets, right.offsets)
    assert left.offsets.any() and rest.offsets is None
    unheard = replace(library, stretch=0.25, wanted=None)
    assert [p.offsets for p in unheard.recall(speech[:0], seeded()).pieces] == [None] * 3


@pytest.mark.parametrize(
    ("speaker", "styles", "expected"),
    [
        (None, None, None),
        ("Bo", None, [1, 3, 4]),
        ("Cy", None, None),  # nobody's: all
        ("Di", None, None),  # too short: all
        (None, [1], [2, 3]),
        (None, [2], None),  # too short, and only Bo's
        ("Ann", [1], [2]),
        ("Bo", [2], [1, 3, 4]),
        ("Di", [1], [2, 3]),
    ],
)
def test_recordings_of_a_speaker_and_style_that_are_long_enough(library, speaker, styles, expected):
    own = [("Ann", 0, 30), ("Bo", 0, 30), ("Ann", 1, 30), ("Bo", 1, 30), ("Bo", 2, 9), ("Di", 3, 9)]
    recordings = []
    for (name, style, n), recording in zip(own, library.recordings, strict=False):
        part = replace(recording, motion=recording.motion[:, :n], speaker=name, style=style)
        recordings.append(part)
    some = replace(library, recordings=tuple(recordings))
    found = some.allowed(10, 3, speaker, None if styles is None else np.array(styles * 3))
    if expected is None:
        assert found is None
    else:
        assert [np.flatnonzero(row).tolist() for row in found] == [expected] * 3
    both = some.allowed(10, 3, None, np.array([0, 1, 1]))
    assert [np.flatnonzero(row).tolist() for row in both] == [[0, 1], [2, 3], [2, 3]]


@pytest.mark.parametrize("speed, least, most", [(0.05, 0, 0), (0.2, 0.1, 0.9), (1.0, 1, 1)])
def test_finer_levels_add_nothing_to_a_part_that_rests(library, speed, least, most):
    """The share of detail is 0 at rest, 1 from `full_detail`, and goes smoothly from one to one."""
    parts = (
        MotionPart("left", np.array([0, 2]), (), (), np.array([0, 2]), 0.35, 1.0),
        MotionPart("rest", np.array([3, 1]), (), (), np.array([1]), 0.35, 2.0),
    )
    model = replace(library, parts=parts, spread=2.0, mean=-1.0, fps=31.25)
    profiles = np.full((2, 60), (np.log(speed + SPEED_FLOOR) + 1.0) / 2.0)
    profiles[1, 30:] = (np.log(2.0 + SPEED_FLOOR) + 1.0) / 2.0
    detail = model.detail(profiles)
    width = detail.shape[0]
    share = detail[0, 0]
    assert least - 1e-5 <= share <= most + 1e-5
    np.testing.assert_allclose(detail[[0, 2]], share, atol=1e-5)
    assert (detail[np.setdiff1d(np.arange(width), [0, 1, 2])] == 1.0).all(), "legs and the root"
    np.testing.assert_allclose(detail[1, [0, -1]], [share, 1.0], atol=1e-5)
    assert (np.diff(detail[1]) > -1e-6).all() and np.diff(detail[1]).max() < 0.4


# Parts of the body.


def part_of(*moving: str, name: str = "left") -> MotionPart:
    return MotionPart(name, NONE, (), moving, NONE, 0.35, 1.0)


def test_movement_is_the_log_of_the_smoothed_speed():
    """0.5 m/s for three seconds, then rest; the other hand rests."""
    n = 120
    way = 0.5 / FPS * np.minimum(np.arange(n), 60)
    hand = np.outer([0.6, 0.0, -0.8], way)
    places = np.stack([np.zeros((3, n)), hand, np.ones((3, n))])
    parts = [part_of("hand", "other"), part_of("hand"), part_of("other")]
    both, one, rest = movements(parts, ("hips", "hand", "other"), FPS, places)
    np.testing.assert_allclose(rest, np.log(SPEED_FLOOR))
    np.testing.assert_allclose(one[:50], np.log(0.5 + SPEED_FLOOR), atol=1e-3)
    np.testing.assert_allclose(one[70:], np.log(SPEED_FLOOR), atol=1e-3)
    assert (np.diff(one[50:70]) <= 0).all() and one[60] > one[70] + 1
    np.testing.assert_allclose(both, (one + rest) / 2)


def test_directions_of_a_hand_are_compressed_velocities_up_and_away():
    """0.3 m/s down, and 0.2 m/s away from the body: less than one and a half times as much."""
    time = np.arange(60) / FPS
    away = 0.3 + 0.2 * time
    hand = np.stack([away * np.sin(time), 1.0 - 0.3 * time, away * np.cos(time)])
    places = np.stack([np.zeros((3, 60)), hand])
    found = hand_directions(part_of("hand"), ("hips", "hand"), FPS, places)
    np.testing.assert_allclose(found, np.tile(found[:, :1], 60), atol=1e-6)
    assert found[0, 0] < 0 < found[1, 0] and 1.05 < -found[0, 0] / found[1, 0] < 1.45


def test_slow_states_of_an_arm_are_where_its_hand_is_and_how_wide_it_moves():
    """It is held 0.3 m up and 0.4 m away, then moves up and down by 0.1 m once a second there."""
    time = np.arange(1200) / 25.0
    up = 0.3 + 0.1 * np.sin(2 * np.pi * time) * (time > 24)
    away = 0.4 * np.array([np.sin(1.0), np.cos(1.0)])
    hand = np.stack([np.full(1200, away[0]), up, np.full(1200, away[1])])
    places = np.stack([np.zeros_like(hand), hand])
    found = slow_states(part_of("hand"), ("hips", "hand"), 25.0, places, np.full(1200, -1.5))
    for part, least, most in ((found[:, :350], 0.0, 0.03), (found[:, 850:], 0.06, 0.1)):
        np.testing.assert_allclose(part[:3].mean(axis=1), [-1.5, 0.3, 0.4], atol=0.03)
        assert least < np.exp(part[3].mean()) < most, "its logarithm; rms 0.07 m of a sine"
    rest = part_of("hand", name="rest")
    assert len(slow_states(rest, ("hips", "hand"), 25.0, places, np.zeros(1200))) == 1


def test_defects_are_assigned_to_the_part_with_the_defective_joint(gesture):
    motion = gesture(4.0, fps=30.0)
    rotations = motion.rotations.copy()
    elbow = motion.skeleton.index("LeftForeArm")
    off = Rotation.from_euler("x", 80, degrees=True) * Rotation.from_quat(rotations[50, elbow])
    rotations[50, elbow] = off.as_quat()
    representation = MultiresRepresentation.fit([motion])
    parts = motion_parts(representation, separate=True)
    for made, frames in ((motion, []), (replace(motion, rotations=rotations), [50])):
        values = torch.from_numpy(representation.encode(made).T)
        flags = defects_of_parts(parts, representation, 30.0, values)
        found = [np.flatnonzero(own).tolist() for own in flags]
        assert (found[0][:1], found[1], found[2]) == (frames, [], [])


@pytest.mark.parametrize(("size", "moves"), [(0.005, False), (0.05, True)])
def test_joints_that_hardly_move_are_no_passive_channels(gesture, size, moves):
    """Six numbers of a rotation of a radian change by about as much as a sine, rms 0.7."""
    motion = gesture(3.0)
    modelled = [name for name in motion.skeleton.names if "Hand" not in name]
    motion.rotations[:, motion.skeleton.index("RightHand")] = [0, 0, 0, 1]
    turn = size * np.sin(6 * motion.times)[:, None] * [1.0, 0.0, 0.0]
    motion.rotations[:, motion.skeleton.index("LeftHand")] = quaternion_from_rotation_vector(turn)
    found = PassiveChannels.find([motion], modelled)
    assert found.joints == (("LeftHand",) if moves else ()) and found.expressions == 0
    faced = replace(motion, expressions=np.zeros((motion.n_frames, 10)))
    wider = replace(motion, expressions=np.zeros((motion.n_frames, 50)))
    assert PassiveChannels.find([faced, faced], modelled).expressions == 10
    for other in (wider, motion):
        assert PassiveChannels.find([faced, other], modelled).expressions == 0


@pytest.mark.parametrize("n_frames", [5, 1030])
def test_passive_channels_come_back_as_they_were(gesture, n_frames):
    motion = gesture(n_frames / 30)
    motion = replace(motion, expressions=np.random.default_rng(0).random((n_frames, 4)))
    passive = PassiveChannels(("LeftHand", "RightHand"), 4)
    values = passive.encode(motion)
    blank = motion.rotations.copy()
    blank[:, [motion.skeleton.index(name) for name in passive.joints]] = [0, 0, 0, 1]
    made = passive.applied(
        replace(motion, rotations=blank, expressions=None), lambda part: values[:, part]
    )
    assert rotation_angles(made.rotations, motion.rotations).max() < 1e-3
    np.testing.assert_allclose(made.expressions, motion.expressions, atol=1e-6)
    left, right, rest = passive.columns(
        motion_parts(MultiresRepresentation.fit([motion]), separate=True)
    )
    assert (left.tolist(), right.tolist()) == (list(range(6)), list(range(6, 12)))
    assert rest.tolist() == [12, 13, 14, 15], "the face goes with the trunk"
