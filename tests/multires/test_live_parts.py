"""Parts of a stream, worked out by hand: feet, the choice of pieces, features and detail."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from rigs import PERSON, at_rest, rig_of

import audio_features as af
import gesturekit as gk
from gesturekit.errors import ModelError
from gesturekit.motion.concatenation import stacked
from gesturekit.motion.kinematics import GROUND
from gesturekit.motion.rotations import quaternion_from_rotation_vector, rotation_angles
from gesturekit.multires.network.generator import MultiresGenerator
from gesturekit.multires.recall.pieces import PieceSearch
from gesturekit.multires.recall.slow_state import SlowState
from gesturekit.multires.streaming.features import SpeechStream
from gesturekit.multires.streaming.feet import FootHold
from gesturekit.multires.streaming.levels import FinerLevels
from gesturekit.multires.streaming.plan import Forecast, LiveChoice, LivePlan

RATE = 16_000
FPS = 30.0


@pytest.fixture(scope="module")
def model():
    return gk.load("demo")


@pytest.fixture(scope="module")
def speech(model) -> np.ndarray:
    wave = af.Wave.load(Path(gk.__file__).parent / "models" / "demo" / "speech.wav")
    return wave.resample(RATE).samples


# Feet.

RIG = rig_of(
    PERSON
    | {"LeftToe": ("LeftFoot", (0, -0.05, 0.14)), "RightToe": ("RightFoot", (0, -0.05, 0.14))}
)
ANKLES = [RIG.index("LeftFoot"), RIG.index("RightFoot")]
LEG = 0.84


def pose() -> gk.Motion:
    """One frame with bent knees, and feet that are turned outwards."""
    motion = at_rest(RIG, 1, (0.0, 0.9, 0.0), FPS)
    for side, out in (("Left", 0.3), ("Right", -0.2)):
        for bone, turn in (("UpLeg", (-0.4, 0, 0)), ("Leg", (0.8, 0, 0)), ("Foot", (-0.4, out, 0))):
            own = quaternion_from_rotation_vector(np.array(turn))
            motion.rotations[:, RIG.index(side + bone)] = own
    return motion


def displaced(motion: gk.Motion, by: np.ndarray) -> gk.Motion:
    return replace(motion, translation=motion.translation + [by[0], 0.0, by[1]])


def held(ways, stands, heights=None) -> tuple[np.ndarray, np.ndarray, list[gk.Motion]]:
    """Return ankles (T, 2, 3), the body's own displacement (T, 2), and the frames.

    The body slides along `ways` (T, 2) metres of x and z; `stands` (T, 2) are both feet's.
    """
    hold, made, shifts = FootHold(RIG, FPS), [], []
    for t, (way, own) in enumerate(zip(ways, stands, strict=True)):
        slid = displaced(pose(), way)
        if heights is not None:
            slid = replace(slid, translation=slid.translation + [0, heights[t], 0])
        # Heel and ball of either foot; 0.5 does not stand.
        contacts = np.array([[0.5, 0.9] if foot else [0.5, 0.5] for foot in own]).ravel()
        found = hold(slid, contacts, displaced)
        made.append(found)
        shifts.append((found.translation - slid.translation)[0, GROUND])
    return np.concatenate([m.positions()[:, ANKLES] for m in made]), np.array(shifts), made


def test_standing_feet_stay_and_the_body_follows_within_half_a_second():
    """Each frame it takes 1 - exp(-1 / 15) of the way from where it would be to its feet."""
    ways = np.outer(np.arange(40), [0.002, -0.001])
    ankles, shifts, made = held(ways, np.ones((40, 2), bool), 0.001 * np.arange(40))
    still = np.tile(ankles[:1, :, GROUND], (40, 1, 1))
    np.testing.assert_allclose(ankles[..., GROUND], still, atol=1e-6)
    expected, share = np.zeros(2), 1 - math.exp(-1 / (0.5 * FPS))
    for way, shift in zip(ways, shifts, strict=True):
        expected += share * (-way - expected)
        np.testing.assert_allclose(shift, expected, atol=1e-9)
    # Heights, and how feet are turned, are the motion's.
    own = pose().positions()[0, ANKLES, 1]
    np.testing.assert_allclose(ankles[..., 1], own + 0.001 * np.arange(40)[:, None], atol=1e-6)
    free = pose().global_rotations()[:, ANKLES]
    for frame in made[::13]:
        turned = rotation_angles(frame.global_rotations()[:, ANKLES], free)
        np.testing.assert_allclose(turned, 0, atol=1e-6)
        knees = frame.positions()[0, [j - 1 for j in ANKLES]]
        middle = (
            frame.positions()[0, [j - 2 for j in ANKLES]] / 2 + frame.positions()[0, ANKLES] / 2
        )
        assert (knees[:, 2] > middle[:, 2] + 0.1).all(), "knees bend forwards"
    arms = [RIG.index("LeftArm"), RIG.index("Spine")]
    np.testing.assert_array_equal(made[-1].rotations[:, arms], pose().rotations[:, arms])


def test_a_foot_that_is_lifted_returns_to_its_path_within_an_eighth_of_a_second():
    """Its correction becomes exp(-1 / (0.12 · 30)) of itself from frame to frame."""
    ways = np.outer(np.minimum(np.arange(30), 10), [0.003, 0.002])
    stands = np.ones((30, 2), bool)
    stands[11:20, 1] = False
    ankles, shifts, _ = held(ways, stands)
    free = pose().positions()[0, ANKLES][:, GROUND] + ways[:, None] + shifts[:, None]
    away = ankles[..., GROUND] - free
    kept = math.exp(-1 / (0.12 * FPS))
    for t in range(11, 20):
        np.testing.assert_allclose(away[t, 1], away[10, 1] * kept ** (t - 10), atol=1e-6)
    assert np.linalg.norm(away[10, 1]) > 0.01
    came = pose().positions()[0, ANKLES[1], GROUND] + ways[20] + shifts[19] + away[19, 1]
    np.testing.assert_allclose(ankles[20, 1, GROUND], came, atol=1e-6)
    # Where it is put down again, it stays; the other one has stayed all the time.
    np.testing.assert_allclose(
        ankles[20:, 1][:, GROUND], np.tile(ankles[20, 1, GROUND], (10, 1)), atol=1e-6
    )
    np.testing.assert_allclose(
        ankles[:, 0][:, GROUND], np.tile(ankles[0, 0, GROUND], (30, 1)), atol=1e-6
    )
    # The body follows the only foot that stands.
    share = 1 - math.exp(-1 / (0.5 * FPS))
    for t in (12, 16):
        missing = ankles[0, 0, GROUND] - (free[t, 0] - shifts[t] + shifts[t - 1])
        np.testing.assert_allclose(shifts[t] - shifts[t - 1], share * missing, atol=1e-6)


def test_a_foot_is_held_within_a_tenth_of_the_leg():
    """A body that leaps by 0.3 m in frame 5 drags its feet along, at 0.084 m."""
    ways = np.where(np.arange(12)[:, None] >= 5, [0.24, -0.18], [0.0, 0.0])
    ankles, shifts, _ = held(ways, np.ones((12, 2), bool))
    free = pose().positions()[0, ANKLES][:, GROUND] + ways[:, None]
    np.testing.assert_allclose(ankles[4, :, GROUND].T, free[4], atol=1e-6)
    away = ankles[5, :, GROUND].T - free[5]
    np.testing.assert_allclose(away, 0.1 * LEG * np.array([[-0.8, 0.6]] * 2), atol=1e-6)
    # It has been dragged: that is where it stays.
    np.testing.assert_allclose(
        ankles[6:, 0][:, GROUND], np.tile(ankles[5, 0, GROUND], (6, 1)), atol=1e-6
    )


def test_feet_that_slide_apart_do_not_move_the_body():
    """What both have in common does."""
    hold = FootHold(RIG, FPS)
    made = []
    for t in range(8):
        motion = pose()
        for side, sign in (("Left", 1), ("Right", -1)):
            turn = quaternion_from_rotation_vector(np.array([-0.4, 0, 0.01 * t * sign]))
            motion.rotations[:, RIG.index(side + "UpLeg")] = turn
        made.append(hold(motion, np.ones(4), displaced))
    body = stacked(made).translation
    np.testing.assert_allclose(body, np.tile(body[:1], (8, 1)), atol=1e-4)
    ankles = stacked(made).positions()[:, ANKLES][..., GROUND]
    np.testing.assert_allclose(ankles, np.tile(ankles[:1], (8, 1, 1)), atol=1e-4)


# Choice of pieces.


@pytest.fixture
def asked(monkeypatch) -> list[SimpleNamespace]:
    """What each choice of a piece asked for; the pieces are chosen as ever."""
    calls, choose = [], PieceSearch.following

    def following(self, rng, wanted, states, used, *, allowed=None, others=None, shown=None):
        own = SimpleNamespace(search=self, seed=rng.initial_seed(), wanted=wanted.copy())
        own.states, own.allowed, own.others, own.shown = states.copy(), allowed, others, shown
        best = choose(self, rng, wanted, states, used, allowed=allowed, others=others, shown=shown)
        own.frame = int(self.frame[best])
        calls.append(own)
        return best

    monkeypatch.setattr(PieceSearch, "following", following)
    return calls


CURVES = ("motion", "passive", "profiles", "states", "directions", "defective")


def counted(library, unit: float = 1.0):
    """A library whose every channel counts its frames across all recordings, at rest."""
    recordings, first = [], 0
    for recording in library.recordings:
        n = recording.motion.shape[-1]
        ramp = first + torch.arange(n, dtype=torch.float32)
        level = torch.arange(1.0, 1.0 + len(recording.profiles))[:, None].expand(-1, n)
        rows = {"motion": recording.motion, "passive": recording.passive}
        rows = {name: unit * ramp.expand(own.shape) for name, own in rows.items()}
        recordings.append(replace(recording, profiles=level, **rows))
        first += n
    return replace(library, recordings=tuple(recordings))


def forecast(*values: float, r: float = 0.5) -> Forecast:
    return Forecast(np.array([0.0, 0.1, 0.2, 0.4])[: len(values)], np.array(values), r)


def test_the_first_pieces_are_asked_for_what_is_predicted(model, asked):
    """Both arms for the movement, in standard deviations, until 0.6 s after the last prediction."""
    library = model.library
    plan = LivePlan(library, LiveChoice(seed=3), 12)
    plan.advance(forecast(0.1, 0.3), 1.0)
    left, right, rest = asked
    assert [own.shown for own in asked] == [None] * 3
    assert [own.allowed for own in asked] == [None] * 3
    for own, piece in ((left, 5), (right, 5), (rest, 11)):
        assert own.search.piece == len(own.wanted) == piece
        at = (np.arange(piece) + 0.5) / library.level_fps
        expected = np.interp(at, [0.0, 0.1], [0.1, 0.3]) / library.spread
        expected[at > 0.7] = np.nan
        assert np.isnan(expected).any() and np.isfinite(expected).any()
        np.testing.assert_allclose(own.wanted[:, 0], expected)
    assert [own.wanted.shape[1] for own in asked] == [1, 3, 1]
    # The second hand is asked to match the first one, which shows its piece from now on.
    hand = np.concatenate([own.directions[:2] for own in library.recordings], axis=1)
    shown = np.arange(left.frame, left.frame + 5)
    np.testing.assert_allclose(right.wanted[:, 1:], hand.T[shown], atol=1e-5)
    assert left.others is None
    np.testing.assert_array_equal(right.others, shown[:, None])
    np.testing.assert_array_equal(rest.others[:5], np.stack([shown, right.frame + np.arange(5)], 1))
    assert rest.others.shape == (11, 2)
    assert len({own.seed for own in asked}) == 3


def test_pieces_follow_after_their_hop(model, asked):
    """An arm's pieces have 3 frames of 5.34 a second between them, the trunk's 6."""
    library = counted(model.library)
    plan = LivePlan(library, LiveChoice(seed=3), 12)
    chosen, step = {}, library.level_fps / library.fps
    for frame in range(40):
        before = len(asked)
        plan.advance(forecast(0.0), 0.0)
        for own in asked[before:]:
            chosen.setdefault(id(own.search), []).append(frame)
            part = [s.piece for s in (own.search,)][0]
            assert part in (5, 11)
    left, right, rest = chosen.values()
    # 3 / 0.178 = 16.9 motion frames; the next is due 3 after that in which it was chosen.
    assert step == pytest.approx(0.178, abs=1e-4)
    assert left == right == [0, 17, 34] and rest == [0, 34]


def test_after_its_end_a_recording_shows_its_last_frame(model, asked):
    """Twelve frames; the trunk's piece has eleven, and begins beside arms that end earlier."""
    short = [
        replace(own, **{name: getattr(own, name)[:, :12] for name in CURVES})
        for own in model.library.recordings[:2]
    ]
    library = replace(counted(replace(model.library, recordings=tuple(short))), wanted=None)
    ended = 0
    for seed in range(4):
        asked.clear()
        LivePlan(library, LiveChoice(seed=seed), 12).advance(None, None)
        left, right, rest = asked
        for column, arm in enumerate((left, right)):
            last = 12 * (arm.frame // 12) + 11
            expected = np.minimum(arm.frame + np.arange(11), last)
            np.testing.assert_array_equal(rest.others[:, column], expected)
            ended += int(arm.frame + 10 > last)
    assert ended > 2


def test_liveliness_so_far_counts_less_and_less(model, monkeypatch):
    """The mean so far, with five seconds of 0, is reduced as that of a whole sound is."""
    asked, at = [], SlowState.at

    def spied(self, seed, seconds, predicted):
        asked.append((seconds, predicted))
        return at(self, seed, seconds, predicted)

    monkeypatch.setattr(SlowState, "at", spied)
    wanted = replace(model.library.wanted, mean_counts=0.25)
    plan = LivePlan(replace(model.library, wanted=wanted), LiveChoice(seed=3), 12)
    for frame in range(35):
        plan.advance(forecast(0.0), 1.0 + frame)
    expected = []
    for frame in (0, 17, 34):
        mean = sum(1.0 + k for k in range(frame + 1)) / (frame + 1 + 5 * 30)
        expected.append((frame / 30, 1.0 + frame - 0.75 * mean))
    assert asked == [pytest.approx(own) for own in expected]


def test_a_library_may_be_one_recording(model):
    plan = LivePlan(
        replace(model.library, recordings=model.library.recordings[:1]), LiveChoice(), 1
    )
    plan.advance(None, None)
    assert np.isfinite(plan.vectors(np.zeros(1))).all()


def test_a_piece_that_goes_on_is_no_new_one_and_few_are_remembered(model, asked):
    library = counted(model.library, 1e-3)
    plan = LivePlan(library, LiveChoice(seed=3), 12)
    shown = []
    for _ in range(200):
        before = len(asked)
        plan.advance(forecast(0.0), 0.0)
        vectors = plan.vectors(np.zeros(1))
        n = len(library.recordings[0].motion)
        np.testing.assert_allclose(vectors[0, n:], [1, 2, 3], atol=1e-5)
        shown.append([vectors[0, part.columns[0]] for part in library.parts])
        assert all(own.shown is not None for own in asked[max(3, before) :])
    assert max(map(len, plan.state()["_pieces"])) <= 4
    calls = [own for own in asked if own.search is asked[0].search]
    goes_on = [own.frame == own.shown for own in calls[1:]]
    assert any(goes_on) and not all(goes_on)
    # Fingers go with their arm.
    fingers, index = plan.passive()[:, 0].numpy(), library.passive.joints.index("LeftHandThumb1")
    np.testing.assert_allclose(fingers[6 * index : 6 * index + 6], shown[-1][0], atol=1e-6)
    other = library.passive.joints.index("RightHandPinky1")
    np.testing.assert_allclose(fingers[6 * other : 6 * other + 6], shown[-1][1], atol=1e-6)


def test_a_new_piece_continues_from_what_is_shown_now(model, asked):
    library = counted(model.library)
    plan = LivePlan(library, LiveChoice(seed=3), 12)
    last = None
    for _ in range(60):
        before = len(asked)
        plan.advance(forecast(0.0), 0.0)
        own = asked[before:]
        if own and last is not None and own[0].search is asked[0].search:
            # One motion frame later than the last that was seen.
            assert own[0].shown == round(float(last + library.level_fps / library.fps))
        last = plan.vectors(np.zeros(1))[0, library.parts[0].columns[0]]
        faded = plan.state()["_pieces"][0]
        if len(faded) > 1:
            break
    assert last is not None


def test_moods_seeds_and_names_decide_what_is_drawn(model, asked, monkeypatch):
    moods = []
    at = SlowState.at

    def spied(self, seed, seconds, predicted):
        moods.append((seed, seconds, predicted))
        return at(self, seed, seconds, predicted)

    monkeypatch.setattr(SlowState, "at", spied)

    def begun(**choice) -> tuple[int, tuple[int, ...]]:
        moods.clear(), asked.clear()
        LivePlan(model.library, LiveChoice(**choice), 12).advance(None, None)
        assert moods[0][1:] == (0.0, None)
        return moods[0][0], tuple(own.seed for own in asked)

    one = begun(seed=3, item="a")
    assert begun(seed=3, item="a") == one
    other, renamed, mood = (
        begun(seed=4, item="a"),
        begun(seed=3, item="b"),
        begun(seed=3, item="a", mood_seed=8),
    )
    for changed in (other, renamed):
        assert changed[0] != one[0] and not set(changed[1]) & set(one[1])
    assert mood[0] != one[0] and mood[1] == one[1], "another mood, with the same chance"
    assert begun(seed=9, item="a", mood_seed=8)[0] == mood[0]
    assert begun(seed=9, item="a", mood_seed=3)[0] == one[0]


def test_speakers_styles_and_liveliness_are_asked_for(model, asked):
    ann = [
        replace(own, speaker="Ann" if k < 4 else "Bo", style=k % 2)
        for k, own in enumerate(model.library.recordings)
    ]
    library = replace(model.library, recordings=tuple(ann))
    usual, lively = (
        [own.states for own in begun_with(library, asked, liveliness=x)] for x in (1.0, 2.0)
    )
    for one, other in zip(usual, lively, strict=True):
        assert other[0] - one[0] == pytest.approx(np.log(2.0))
        np.testing.assert_array_equal(other[1:], one[1:])
    for own in begun_with(library, asked, speaker="Ann", style=1):
        assert np.flatnonzero(own.allowed).tolist() == [1, 3]
        at = np.searchsorted(np.cumsum(library.lengths), own.frame, side="right")
        assert at in (1, 3)


@pytest.fixture(scope="module")
def styled(model):
    """An untrained network with two styles, of which every second recording has the second."""
    conditions = replace(model.conditions, styles=("calm", "glad"))
    network = MultiresGenerator(model.representation, conditions.width, model.network_config)
    own = [replace(one, style=k % 2) for k, one in enumerate(model.library.recordings)]
    library = replace(model.library, recordings=tuple(own))
    return replace(model, network=network.eval(), conditions=conditions, library=library)


def test_a_stream_has_one_style(styled, asked):
    """The one that is asked for, or one drawn by the seed and the stream's name."""

    def style_of(**choice) -> int:
        asked.clear()
        assert styled.stream(RATE, **choice).step(np.zeros(4000, np.float32)) is not None
        allowed = [set(np.flatnonzero(own.allowed) % 2) for own in asked]
        assert allowed == [allowed[0]] * 3 and len(allowed[0]) == 1
        return int(allowed[0].pop())

    assert [style_of(style=name) for name in ("calm", "glad")] == [0, 1]
    drawn = [style_of(seed=seed, item=item) for seed in range(2) for item in "ab"]
    assert set(drawn) == {0, 1} and style_of(seed=1, item="b") == drawn[-1]
    with pytest.raises(ModelError, match="a stream takes one style, without times"):
        styled.stream(RATE, style="calm@0-1,glad@1-2")
    with pytest.raises(ModelError, match="sad"):
        styled.stream(RATE, style="sad")


@pytest.mark.parametrize("samples", [[[0.0], [0.0]], [0.0, np.nan], [np.inf, 0.0]])
def test_samples_are_finite_and_of_one_channel(model, samples):
    stream = model.stream(RATE)
    with pytest.raises(
        ModelError, match=r"samples of shape \(2.*finite samples \(N,\), one channel"
    ):
        stream.step(np.array(samples))
    assert stream.step(np.zeros(0, np.float32)) is None


def begun_with(library, asked, **choice):
    asked.clear()
    LivePlan(library, LiveChoice(seed=3, **choice), 12).advance(None, 0.5)
    return list(asked)


@pytest.mark.parametrize(("r", "divided"), [(0.5, 0.5), (0.1, 0.2)])
def test_arms_that_move_already_need_not_run_faster(model, r, divided):
    """Pieces move by 0.1 sd more than the mean: the left arm by 0.3, the right one by -0.1."""
    library = counted(model.library)
    fast = [[torch.full((1, n), x) for n in library.lengths] for x in (0.3, -0.1, 5.0)]
    library.__dict__["fast_movement"] = tuple(fast)
    plan = LivePlan(library, LiveChoice(), 12)
    clocks = []

    def log_tempos(advances: int, value: float) -> np.ndarray:
        for _ in range(advances):
            plan.advance(forecast(value, r=r), 0.0)
            clocks.append(plan.state()["_clock"][-1])
        return np.log(np.diff(clocks[-advances:]) / (library.level_fps / library.fps))

    # A hand has mass: from frame to frame, exp(-1 / (0.05 fps)) of the difference is left.
    goal = 0.1 / divided - 0.1 * library.spread
    reached = 1 - np.exp(-np.arange(1, 40) / (0.05 * library.fps))
    np.testing.assert_allclose(log_tempos(40, 0.1), goal * reached, atol=1e-6)
    assert len(plan.state()["_clock"]) == 13
    for value, limit in ((50.0, np.log(3)), (-50.0, -np.log(3))):
        assert log_tempos(20, value)[-1] == pytest.approx(limit, abs=1e-4), "thrice as fast"
    plan.advance(None, 0.0)
    clock = plan.state()["_clock"]
    assert clock[-1] - clock[-2] == pytest.approx(library.level_fps / library.fps)


# Finer levels.


@pytest.mark.parametrize("part", [range(0, 3), range(157, 160)])
def test_finer_levels_at_the_ends_of_a_window(model, part):
    lengths = af.level_lengths(160, model.network_config.levels)
    finer = FinerLevels(model, lengths, [], part)
    whole = FinerLevels(model, lengths, [], range(160))
    level = model.library.level - 1
    assert whole.recalled == range(lengths[level])
    assert 0 <= finer.recalled.start < finer.recalled.stop <= lengths[level]
    assert len(finer.recalled) < lengths[level]
    rng = torch.Generator().manual_seed(0)
    recalled = torch.randn(model.representation.n_features, lengths[level], generator=rng)
    speech = torch.randn(160, model.conditions.conditioner.dim, generator=rng).numpy()
    own = recalled[:, finer.recalled.start : finer.recalled.stop]
    found, expected = finer(own, speech), whole(recalled, speech)
    torch.testing.assert_close(found, expected[:, part.start : part.stop], atol=1e-4, rtol=0)


# Features.


class Spied:
    """A conditioner that remembers the sums by which it centres a voice."""

    def __init__(self, conditioner) -> None:
        self.own, self.sums = conditioner, []

    def __getattr__(self, name):
        return getattr(self.own, name)

    def clip_centre(self, total, count):
        self.sums.append((total.copy(), count))
        return self.own.clip_centre(total, count)


@pytest.mark.parametrize("every", [1, 3])
def test_the_centre_of_a_voice_forgets_within_a_minute(model, speech, every):
    """Rows of active speech count; each is worth exp(-1/60) a second later."""
    conditioner = Spied(model.conditions.conditioner)
    stream = SpeechStream(conditioner, RATE, rows=40, every=every)
    sound = np.concatenate([np.zeros(RATE, np.float32), speech[: 3 * RATE]])
    windows, numbers = [], []
    for window in stream.push(sound):
        windows.append(window)
        numbers.append(stream.n_rows)
    assert numbers == list(range(every, stream.n_rows + 1, every))
    assert len(conditioner.sums) == len(windows)
    kept, total, count, active = math.exp(-every / (60 * 30)), 0.0, 0.0, []
    for (new, n), window in zip(list(conditioner.sums), windows, strict=True):
        active.append(n > count)
        if active[-1]:
            assert n == pytest.approx(kept * count + every)
            own = (new - kept * total) / every
            row = conditioner.scaled(own[None], conditioner.own.clip_centre(new, n))
            np.testing.assert_allclose(window.rows[-1], row[0], atol=1e-4)
        else:
            assert n == count
        total, count = new, n
    assert not any(active[: 28 // every]), "nothing is said in the first second"
    assert 0.5 < np.mean(active[45 // every :]) <= 1.0
    # Means over 2 and 8 s of all rows since the last window.
    means = np.repeat(conditioner.silence(1).astype(float), 2, axis=0)
    for window in windows:
        for mean, seconds in zip(means, (2.0, 8.0), strict=True):
            mean += (window.rows[-every:].mean(axis=0) - mean) * every / (seconds * 30)
        np.testing.assert_allclose(window.averages, means, atol=1e-6)


def test_rows_of_a_window_are_those_before_it(model, speech):
    """Whatever its length; rows before the stream are silent."""
    conditioner = model.conditions.conditioner
    long, short = (
        list(SpeechStream(conditioner, RATE, rows=rows).push(speech[: 2 * RATE]))
        for rows in (50, 12)
    )
    for one, other in zip(long, short, strict=True):
        assert one.rows.shape == (50, conditioner.dim) and other.rows.shape == (12, conditioner.dim)
        np.testing.assert_allclose(one.rows[-12:], other.rows, atol=2e-3)
    silence = conditioner.silence(1)
    np.testing.assert_array_equal(long[20].rows[:29], np.repeat(silence, 29, axis=0))
    assert (
        np.abs(long[48].rows[:1] - silence).max() == 0 < np.abs(long[49].rows[:1] - silence).max()
    )
    stream = SpeechStream(conditioner, RATE, rows=4)
    assert [stream.rows_ahead(stream.reach + k / 30) for k in (-1, 0, 3)] == [-1, 0, 3]
    assert stream.rows_ahead(stream.reach + 2.9 / 30) == 2


# Streams.


@pytest.mark.parametrize(
    ("look_ahead", "ahead", "used"),
    [(0.0, -2, 0.0), (0.05, -2, 0.0), (0.1, 1, 0.1), (0.2, 4, 0.2), (0.39, 4, 0.2), (5.0, 10, 0.4)],
)
def test_the_latency_is_that_of_the_next_smaller_look_ahead(model, look_ahead, ahead, used):
    """Row k is complete 0.5 / 30 + 0.032 + 0.01 = 0.0587 s later: (0.4 - 0.0587) 30 = 10.2."""
    expected = max(0.0, ahead / 30 + 0.5 / 30 + 0.042)
    assert model.stream(RATE, look_ahead).latency == pytest.approx(expected)
    assert expected <= used + 0.0


@pytest.mark.parametrize("rate", [RATE, 44_100])
@pytest.mark.parametrize(("look_ahead", "frames"), [(0.0, 7), (0.1, 6), (0.4, 6)])
def test_the_last_frames_come_when_the_stream_is_finished(model, rate, look_ahead, frames):
    """The sound lasts 0.2 s; without look-ahead frame 6 of 30 fps, at 0.2 s, comes 8 ms before."""
    stream = model.stream(rate, look_ahead)
    parts = [stream.step(np.zeros(rate // 5, np.float32)), stream.finish()]
    assert sum(part.n_frames for part in parts if part is not None) == frames


def test_detail_is_made_of_what_is_known_and_then_of_its_mean(model, speech, monkeypatch):
    """From 1.6 s before a frame to what is known ahead; then the mean of the last half second."""
    given, finer = [], FinerLevels.__call__

    def spied(self, recalled, features):
        given.append(features.copy())
        return finer(self, recalled, features)

    monkeypatch.setattr(FinerLevels, "__call__", spied)
    conditioner = model.conditions.conditioner
    windows = list(SpeechStream(conditioner, RATE, rows=80).push(speech[: 3 * RATE // 2]))
    stream = model.stream(RATE, 0.2, seed=3)
    made = stream.step(speech[: 3 * RATE // 2])
    assert made.n_frames == len(given)
    for frame in (0, 30):
        # Four rows after the frame's own are known, so that the last is row `frame` + 4.
        rows = windows[frame + 4].rows
        assert given[frame].shape == (96, conditioner.dim)
        np.testing.assert_allclose(given[frame][:53], rows[-53:], atol=2e-3)
        np.testing.assert_allclose(
            given[frame][53:], np.tile(rows[-15:].mean(axis=0), (43, 1)), atol=2e-3
        )


def test_smoothed_streams_are_a_gaussian_mean_of_those_that_are_not(model, speech):
    """The Gaussian has 0.03 s; arms rest meanwhile, so that their motion is the recalled one."""
    resting = [replace(own, profiles=own.profiles * 0 - 10) for own in model.library.recordings]
    library = replace(model.library, recordings=tuple(resting), wanted=None)
    own = replace(model, library=library)
    smooth, raw = (
        own.stream(RATE, seed=3, smooth=smooth, foot_lock=False).step(speech[: 3 * RATE // 2])
        for smooth in (0.1, 0)
    )
    arm = own.skeleton.index("LeftForeArm")
    weights = np.exp(-0.5 * (np.arange(-4, 5) / (0.03 * 30)) ** 2)
    weights /= weights.sum()
    q = raw.rotations[:, arm]
    around = np.stack([q[4 + k : len(q) - 4 + k] for k in range(-4, 5)])
    around *= np.sign((around * around[4]).sum(axis=-1, keepdims=True))
    mean = np.einsum("k,ktc->tc", weights, around)
    mean /= np.linalg.norm(mean, axis=-1, keepdims=True)
    apart = np.degrees(rotation_angles(mean, smooth.rotations[4:-4, arm]))
    before = np.degrees(rotation_angles(q[4:-4], smooth.rotations[4:-4, arm]))
    assert np.median(apart) < 0.25 * np.median(before)


def test_the_body_returns_to_its_place_within_half_a_minute(model, speech):
    """From frame to frame it keeps 1 - 1 / 900 of its way, and makes its step."""
    layout, decoded = model.representation.layout, []
    decode = type(model.representation).decode

    class Decoding(type(model.representation)):
        def decode(self, values, fps, *, skeleton=None):
            decoded.append(values[0].copy())
            return decode(self, values, fps, skeleton=skeleton)

    fields = {
        name: getattr(model.representation, name)
        for name in model.representation.__dataclass_fields__
    }
    stream = replace(model, representation=Decoding(**fields)).stream(RATE, seed=3, foot_lock=False)
    made = stream.step(speech[: 2 * RATE])
    place, scale = np.zeros(2), model.representation.scale
    for t, (vector, root) in enumerate(zip(decoded, made.translation, strict=True)):
        if t:
            place = (1 - 1 / 900) * place + vector[layout.root_xz]
        np.testing.assert_allclose(root[[0, 2]], scale * place, atol=1e-9)
    assert np.abs(made.translation[:, [0, 2]]).max() > 1e-3


@pytest.mark.parametrize("look_ahead", [float("nan"), float("inf"), -1e-3])
def test_a_look_ahead_is_a_time_from_now_on(model, look_ahead):
    with pytest.raises(ModelError, match="look_ahead=.*: seconds from 0"):
        model.stream(RATE, look_ahead)
