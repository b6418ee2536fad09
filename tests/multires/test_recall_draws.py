"""Recalled motion is drawn: moods, places and both hands as the recordings have them.

Libraries are made of simulated recordings whose properties are known. Every frame of a recording
shows its own measured values, so that the motion's are those of its pieces.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter1d

from gesturekit.multires.recall.library import RecalledRecording, RecallLibrary
from gesturekit.multires.recall.parts import MotionPart, PassiveChannels, slow_part
from gesturekit.multires.recall.pieces import ChoiceWeights
from gesturekit.multires.recall.slow_state import SlowState
from gesturekit.multires.recall.wanted import WantedMovement
from gesturekit.multires.training.recall_library import _weights

FPS = 10.0
SECONDS = 120.0
MEAN, SPREAD = -1.2, 0.8
SLOW_ROWS, REST = (0, 4), 8  # rows of slow movement of both hands and of the rest, among 9
NONE = np.zeros(0, int)
PARTS = (
    MotionPart("left", np.array([0, 1]), (), (), NONE, 0.35, 1.0),
    MotionPart("right", np.array([2, 3]), (), (), NONE, 0.35, 1.0),
    MotionPart("rest", np.array([4]), (), (), NONE, 1.0, 2.0),
)


def curves(rng: np.random.Generator, count: int, n: int, width: float) -> np.ndarray:
    """Return smooth noise (count, n) with standard deviation 1; `width` in seconds."""
    smooth = gaussian_filter1d(rng.standard_normal((count, n + 200)), width * FPS, axis=1)
    return smooth[:, 100:-100] * np.sqrt(2 * np.sqrt(np.pi) * width * FPS)


def correlated(r: float, own: np.ndarray, other: np.ndarray) -> np.ndarray:
    return r * own + np.sqrt(1 - r**2) * other


@dataclass
class Talk:
    """A simulated recording: energy (T,) of its speech, slow states (9, T), fast movement (3, T),
    velocities (2 hands, 2, T)."""

    energy: np.ndarray
    states: np.ndarray
    fast: np.ndarray
    velocities: np.ndarray

    @property
    def speech(self) -> np.ndarray:
        """Speech features (2, T): nothing, and energy."""
        return np.stack([np.zeros(len(self.energy)), self.energy])


def talk(seed: int, *, together: float, r_energy: float, level: float = 0.0) -> Talk:
    """Simulate a recording.

    Args:
        seed: of the recording.
        together: correlation of both hands' velocities.
        r_energy: correlation of fast movement and energy.
        level: of all slow movement, standard deviations.
    """
    rng, n = np.random.default_rng(seed), round(SECONDS * FPS)
    energy = curves(rng, 1, n, 0.2)[0]
    energy -= slow_part(energy, FPS)
    energy /= energy.std()
    fast = curves(rng, 3, n, 0.2)
    fast -= slow_part(fast, FPS)
    fast = correlated(r_energy, energy, fast / fast.std(axis=1, keepdims=True))
    states = curves(rng, 9, n, 4.0)
    states[[4, 8]] = correlated(0.8, states[0], states[[4, 8]])
    states[[0, 4, 8]] += level
    first, second = curves(rng, 4, n, 0.3).reshape(2, 2, n)
    return Talk(energy, states, fast, np.stack([first, correlated(together, first, second)]))


def library_of(
    talks, *, speakers=(), styles=(), slow_state=None, stretch=0.0, from_speech=False
) -> RecallLibrary:
    """Return the library of talks, which are takes of their own."""
    n = len(talks)
    directions = [own.velocities.reshape(4, -1) for own in talks]
    directions = [_weights(directions) * own for own in directions]
    names = [f"take {k}" for k in range(n)]
    movements = [MEAN + SPREAD * (0.7 * o.states[[0, 4, 8]] + 0.7 * o.fast) for o in talks]
    slow = [MEAN + SPREAD * 0.7 * own.states[[0, 4, 8]] for own in talks]
    recordings = []
    for k, (own, movement, slowly) in enumerate(zip(talks, movements, slow, strict=True)):
        states = own.states.copy()
        states[[0, 4, 8]] = slowly
        motion = np.concatenate([own.velocities.reshape(4, -1), own.fast[2:]])
        rows = (motion, motion[:0], (movement - MEAN) / SPREAD, states, directions[k])
        recordings.append(
            RecalledRecording(
                *(torch.from_numpy(row).float() for row in rows),
                speakers[k] if speakers else None,
                styles[k] if styles else 0,
                torch.zeros(3, motion.shape[1], dtype=torch.bool),
            )
        )
    wanted = None
    if from_speech:
        hands = [movement[:2].mean(axis=0) for movement in movements]
        levels = [own.states[[0, 4]].mean(axis=0) for own in talks]
        speeches = [own.speech for own in talks]
        wanted = WantedMovement.fit(speeches, hands, levels, FPS, (), takes=names)
    scores = [own.states for own in talks]
    fitted = slow_state or SlowState.fit(scores, wanted, names, FPS)
    about = {"level": 2, "levels": 2, "fps": FPS, "piece": 1.0, "overlap": 0.3}
    about |= {"parts": PARTS, "recordings": tuple(recordings), "spread": SPREAD, "mean": MEAN}
    about |= {"passive": PassiveChannels(), "stretch": stretch}
    return RecallLibrary(slow_state=fitted, wanted=wanted, **about)


def made_of(count=4, *, together=0.0, r_energy=0.0, **changes) -> RecallLibrary:
    talks = [talk(seed, together=together, r_energy=r_energy) for seed in range(count)]
    return library_of(talks, **changes)


def rng_of(mood: int = 0, pieces: int = 0):
    """Return the random generators of the mood and of each part."""
    parts = {"mood": mood, "left": 1000 + pieces, "right": 2000 + pieces, "rest": 3000 + pieces}
    return lambda name: torch.Generator().manual_seed(parts[name])


def silence(seconds: float) -> np.ndarray:
    """Return the speech of a model without speech input."""
    return np.zeros((0, round(seconds * FPS)))


def achieved(library: RecallLibrary, motion) -> np.ndarray:
    """Return the slow states (9, T) that the chosen pieces have."""
    curves = [recording.states for recording in library.recordings]
    rows = [np.arange(9)[own] for own in library.rows]
    return motion.channels(curves, rows, motion.pieces[0].n_frames).numpy()


def drawing(scores) -> SimpleNamespace:
    """Return a slow state that always draws these scores (9, T)."""
    return SimpleNamespace(draw=lambda *_: np.array(scores))


def placed(motion) -> list[list[tuple[int, int]]]:
    return [[*zip(p.recordings.tolist(), p.starts.tolist(), strict=True)] for p in motion.pieces]


# Moods.


@pytest.fixture(scope="module")
def library() -> RecallLibrary:
    return made_of()


def test_the_same_generators_give_the_same_pieces(library):
    one, again, mood, pieces = (
        placed(library.recall(silence(20), rng_of(*numbers)))
        for numbers in ((1, 1), (1, 1), (2, 1), (1, 2))
    )
    assert one == again
    assert one != mood and one != pieces


def test_moods_are_calm_and_lively_as_the_recordings_are(library):
    """Levels of many motions of 10 s spread as those of clips of 10 s of the recordings."""
    recorded = np.concatenate(
        [own.states[list(SLOW_ROWS)].mean(dim=0).split(100) for own in library.recordings]
    ).reshape(-1, 100)
    clips = recorded.mean(axis=1)
    made = [
        achieved(library, library.recall(silence(10), rng_of(k, k)))[list(SLOW_ROWS)].mean()
        for k in range(60)
    ]
    assert np.std(made) == pytest.approx(clips.std(), rel=0.3)
    assert abs(np.mean(made) - clips.mean()) < 0.4 * clips.std()


def test_a_mood_is_of_all_pieces_and_pieces_of_one_mood_differ_little(library):
    levels = np.array(
        [
            [
                achieved(library, library.recall(silence(10), rng_of(mood, seed)))[0].mean()
                for seed in range(4)
            ]
            for mood in range(12)
        ]
    )
    assert levels.mean(axis=1).std() > 3 * levels.std(axis=1).mean()


def test_a_calm_stretch_is_made_of_calm_pieces():
    """Pieces have the drawn state: movement of each part most closely, places too."""
    library = made_of(6)
    time = np.arange(600) / FPS
    phases = np.linspace(0, 2 * np.pi, 9, endpoint=False)[:, None]
    scores = 1.2 * np.sin(2 * np.pi * time / 25 + phases)
    drawn = replace(library, slow_state=drawing(scores))
    found = np.mean(
        [achieved(drawn, drawn.recall(silence(60), rng_of(0, k))) for k in range(4)], axis=0
    )
    r = [np.corrcoef(own, score)[0, 1] for own, score in zip(found, scores, strict=True)]
    assert min(r[0], r[4]) > 0.95 and r[8] > 0.85
    assert min(r[1:4] + r[5:8]) > 0.4


def test_a_shift_of_liveliness_is_a_factor_on_the_speed(library):
    """Within what was recorded: the slow log speed rises by the factor's logarithm."""
    still = replace(library, slow_state=drawing(np.zeros((9, 400))))
    levels = [
        achieved(still, still.recall(silence(40), rng_of(), liveliness=x))[[0, 4, 8]].mean(axis=1)
        for x in (0.7, 1.0, 1.5)
    ]
    np.testing.assert_allclose(levels[0] - levels[1], np.log(0.7), atol=0.12)
    np.testing.assert_allclose(levels[2] - levels[1], np.log(1.5), atol=0.12)


def test_extreme_liveliness_is_the_calmest_or_liveliest_that_was_recorded(library):
    every = np.concatenate([own.states[0].numpy() for own in library.recordings])
    for amount, share in ((1e-3, 0.1), (1e3, 0.9)):
        made = library.recall(silence(20), rng_of(), liveliness=amount)
        level = achieved(library, made)[0].mean()
        extreme = np.quantile(every, share)
        assert level < extreme if share < 0.5 else level > extreme


# Whose moods.


def test_drawn_values_come_from_the_recordings_that_are_allowed():
    """Ann is calm, Bo lively: one score is one level of hers and another of his."""
    talks = [talk(k, together=0.0, r_energy=0.0, level=4.0 * (k % 2)) for k in range(4)]
    library = library_of(talks, speakers=("Ann", "Bo") * 2, styles=(0, 1) * 2)
    library = replace(library, slow_state=drawing(np.zeros((9, 200))))
    own = [
        np.median(np.concatenate([r.states[0] for r in library.recordings if r.speaker == name]))
        for name in ("Ann", "Bo")
    ]
    assert own[1] - own[0] > 1.5
    for level, speaker in zip(own, ("Ann", "Bo"), strict=True):
        made = library.recall(silence(20), rng_of(), speaker=speaker)
        assert achieved(library, made)[0].mean() == pytest.approx(level, abs=0.2)
    # Styles: Ann's in the first half, Bo's in the second.
    styles = np.repeat([0, 1], 100)
    found = achieved(library, library.recall(silence(20), rng_of(), styles=styles))[0]
    assert found[:85].mean() == pytest.approx(own[0], abs=0.2)
    assert found[115:].mean() == pytest.approx(own[1], abs=0.2)


# Speech.


def fast_of(library: RecallLibrary, motion) -> np.ndarray:
    """Return the fast movement (3, T) that the chosen pieces have."""
    rows = [np.array([i]) for i in range(3)]
    curves = [recording.profiles for recording in library.recordings]
    moved = motion.channels(curves, rows, motion.pieces[0].n_frames).numpy()
    return moved - slow_part(moved, FPS)


def followed(library: RecallLibrary, r_energy: float) -> tuple[float, float]:
    """Return the correlation of the hands' fast movement with the energy of new talks, and its
    standard deviation relative to the recordings'."""
    r, spreads = [], []
    for seed in range(3):
        own = talk(100 + seed, together=0.0, r_energy=r_energy)
        fast = fast_of(library, library.recall(own.speech, rng_of(seed, seed)))
        r += [np.corrcoef(row, own.energy)[0, 1] for row in fast[:2]]
        spreads.append(fast[:2].std())
    recorded = [own.profiles.numpy() for own in library.recordings]
    usual = np.mean([(row - slow_part(row, FPS))[:2].std() for row in recorded])
    return float(np.mean(r)), float(np.mean(spreads) / usual)


def test_hands_move_when_speech_says_so_and_as_much_as_recorded():
    """The weaker the prediction, the less it is followed; a mean would also be calmer."""
    found = [
        followed(made_of(8, r_energy=r_energy, from_speech=True), r_energy)
        for r_energy in (0.15, 0.4, 0.8)
    ]
    weak, some, strong = (r for r, _ in found)
    assert 0.1 < weak < some < strong
    assert all(0.8 < spread < 1.25 for _, spread in found)


def test_a_prediction_that_was_wrong_on_left_out_talks_is_not_followed():
    library = made_of(8, r_energy=0.8, from_speech=True)
    wanted = library.wanted
    wrong = replace(wanted, spread=0.0, fast=replace(wanted.fast, r=-0.5))
    r, spread = followed(replace(library, wanted=wrong), 0.8)
    assert abs(r) < 0.1 and 0.8 < spread < 1.25


# Both hands.


@pytest.mark.parametrize(("together", "least", "most"), [(0.0, -0.2, 0.2), (0.7, 0.7, 0.95)])
def test_hands_rise_together_where_the_speaker_raises_them_together(together, least, most):
    library = made_of(6, together=together)
    raised = []
    for seed in range(4):
        motion = library.recall(silence(60), rng_of(seed, seed))
        own = motion.vectors([own.motion for own in library.recordings], 600).numpy()
        raised.append(np.corrcoef(own[0], own[2])[0, 1])
    recorded = [np.corrcoef(own.motion[0], own.motion[2])[0, 1] for own in library.recordings]
    assert np.mean(recorded) == pytest.approx(together, abs=0.08)
    assert least < np.mean(raised) < most


def test_recorded_speech_in_the_recorded_mood_gives_no_copy_of_the_recording():
    """Each part finds the same best moment. Arms may keep it more often than the rest of the body,
    as gestures may be two-handed."""
    library = made_of(4, r_energy=0.8, together=0.7, from_speech=True)
    own, shares = talk(0, together=0.7, r_energy=0.8), []
    shown = slice(100, 700)
    library = replace(library, slow_state=drawing(own.states[:, shown]))
    for copied in (0.0, 12.0, 100.0):
        weights = ChoiceWeights(copied=copied, place=5.0, chance=0.0)
        changed = replace(library, weights=weights)
        motion = changed.recall(own.speech[:, shown], rng_of())
        left, right, rest = (pieces.recorded_frames(library.lengths) for pieces in motion.pieces)
        arms = abs(left - right) < 2
        shares.append((arms.mean(), (arms & (abs(left - rest) < 2)).mean()))
    (arms, every), (arms_usual, every_usual), (arms_never, _) = shares
    assert every > 0.1 and every_usual < 0.2 * every, shares
    assert arms > 0.3 and 0.3 * arms < arms_usual and arms_never < 0.05, shares


def test_both_arms_begin_their_pieces_at_the_same_time(library):
    """Then two-handed pieces can be whole."""
    for seed in range(5):
        left, right, _ = library.recall(silence(10), rng_of(seed, seed)).pieces
        assert left.first == right.first and left.hop == right.hop


def test_both_arms_are_stretched_alike():
    library = made_of(6, r_energy=0.5, together=0.7, from_speech=True, stretch=0.25)
    for seed in range(3):
        own = talk(100 + seed, together=0.0, r_energy=0.5)
        motion = library.recall(own.speech, rng_of(seed, seed))
        left, right, rest = motion.pieces
        np.testing.assert_array_equal(left.offsets, right.offsets)
        assert np.abs(left.offsets).max() > 1 and rest.offsets is None
        # By it, hands move more when speech says so.
        recorded = replace(motion, pieces=tuple(replace(p, offsets=None) for p in motion.pieces))
        r, before = (
            np.mean([np.corrcoef(row, own.energy)[0, 1] for row in fast_of(library, made)[:2]])
            for made in (motion, recorded)
        )
        assert r > before


@pytest.mark.parametrize(("r", "divided"), [(0.5, 0.5), (0.1, 0.2)])
def test_arms_are_stretched_to_peaks_as_high_as_recorded_ones(monkeypatch, r, divided):
    """A conditional mean is r times as high, but hardly any correlation is not overrated."""
    library = made_of(4, r_energy=0.5, from_speech=True, stretch=0.25)
    wanted = replace(library.wanted, fast=replace(library.wanted.fast, r=r))
    speech, asked = talk(100, together=0.0, r_energy=0.5).speech[:, :300], []

    def offsets(*arguments) -> np.ndarray:
        asked.append(arguments)
        return np.arange(300.0)

    monkeypatch.setattr("gesturekit.multires.recall.library.time_offsets", offsets)
    left, right, _ = replace(library, wanted=wanted).recall(speech, rng_of()).pieces
    ((own, goals, fps, stretch),) = asked
    expected = wanted(speech)[0] / SPREAD / divided
    np.testing.assert_allclose(goals, [expected, expected], rtol=1e-6)
    assert (fps, stretch) == (FPS, 0.25)
    for row, k, pieces in zip(own, (0, 1), (left, right), strict=True):
        plain = replace(pieces, offsets=None)
        moved = plain.blend(library.fast_movement[k], library.lengths, 300)
        np.testing.assert_allclose(row, moved[0], atol=1e-5)
        np.testing.assert_array_equal(pieces.offsets, np.arange(300.0))


def test_arms_without_a_prediction_are_not_stretched():
    unheard = made_of(4, stretch=0.25)
    assert [p.offsets for p in unheard.recall(silence(10), rng_of()).pieces] == [None] * 3
