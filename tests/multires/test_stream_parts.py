"""Parts of a stream, worked out by hand: feet, recorded pieces, features and detail."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from rigs import PERSON, at_rest, rig_of

import audio_features as af
import gesturekit as gk
from gesturekit.motion import GROUND, quaternion_from_rotation_vector, rotation_angles
from gesturekit.multires import MultiresGenerator, Pyramid, RandomNoise
from gesturekit.multires.streaming.features import SpeechStream
from gesturekit.multires.streaming.feet import FootHold
from gesturekit.multires.streaming.levels import WindowLevels
from gesturekit.multires.streaming.plan import Forecast, LiveChoice, LivePlan

RATE = 16_000
FPS = 30.0


@pytest.fixture(scope="module")
def model():
    return gk.load("demo")


@pytest.fixture(scope="module")
def wave() -> af.Wave:
    return af.Wave.load(Path(gk.__file__).parent / "models" / "demo" / "speech.wav")


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


def held(ways, stands, rise: float = 0.0) -> tuple[np.ndarray, np.ndarray, list[gk.Motion]]:
    """Return ankles (T, 2, 3), the body's own displacement (T, 2), and the frames.

    The body slides along `ways` (T, 2) metres of x and z; `stands` (T, 2) are both feet's.
    """
    hold, made, shifts = FootHold(RIG, FPS), [], []
    for t, (way, own) in enumerate(zip(ways, stands, strict=True)):
        slid = displaced(pose(), way)
        slid.translation[:, 1] += rise * t
        # Heel and ball of either foot; 0.5 does not stand.
        contacts = np.array([[0.5, 0.9] if foot else [0.5, 0.5] for foot in own]).ravel()
        found = hold(slid, contacts, displaced)
        made.append(found)
        shifts.append((found.translation - slid.translation)[0, GROUND])
    return np.concatenate([m.positions()[:, ANKLES] for m in made]), np.array(shifts), made


def test_standing_feet_stay_and_the_body_follows_within_half_a_second():
    """It steps aside by 4.5 cm; half a second later, most of it is back over its feet."""
    ways = np.where(np.arange(40)[:, None] >= 5, [0.04, -0.02], [0.0, 0.0])
    ankles, shifts, made = held(ways, np.ones((40, 2), bool), 0.001)
    still = np.tile(ankles[:1, :, GROUND], (40, 1, 1))
    np.testing.assert_allclose(ankles[..., GROUND], still, atol=1e-6)
    left = np.linalg.norm(ways + shifts, axis=1)[5:] / np.linalg.norm(ways[5])
    assert (np.diff(left) < 0).all() and left[0] > 0.8 and 0.2 < left[15] < 0.5
    # Heights, how feet are turned, and arms are the motion's; knees bend forwards.
    own = pose().positions()[0, ANKLES, 1]
    np.testing.assert_allclose(ankles[..., 1], own + 0.001 * np.arange(40)[:, None], atol=1e-6)
    last, places = made[-1], made[-1].positions()[0]
    turned = rotation_angles(
        last.global_rotations()[:, ANKLES], pose().global_rotations()[:, ANKLES]
    )
    np.testing.assert_allclose(turned, 0, atol=1e-6)
    hips, knees = places[[j - 2 for j in ANKLES]], places[[j - 1 for j in ANKLES]]
    assert (knees[:, 2] > (hips[:, 2] + places[ANKLES, 2]) / 2 + 0.1).all()
    arm = RIG.index("LeftArm")
    np.testing.assert_array_equal(last.rotations[:, arm], pose().rotations[:, arm])


def test_a_foot_that_is_lifted_returns_to_its_path_within_an_eighth_of_a_second():
    ways = np.outer(np.minimum(np.arange(30), 10), [0.003, 0.002])
    stands = np.ones((30, 2), bool)
    stands[11:20, 1] = False
    ankles, shifts, _ = held(ways, stands)
    ankles = ankles[..., GROUND]
    free = pose().positions()[0, ANKLES][:, GROUND] + ways[:, None] + shifts[:, None]
    away = np.linalg.norm(ankles - free, axis=-1)[10:20, 1]
    assert away[0] > 0.01 and (np.diff(away) < 0).all() and away[4] < 0.5 * away[0]
    # Where it is put down again, it stays; the other one has stayed all the time.
    np.testing.assert_allclose(ankles[20:, 1], np.tile(ankles[20, 1], (10, 1)), atol=1e-6)
    np.testing.assert_allclose(ankles[:, 0], np.tile(ankles[0, 0], (30, 1)), atol=1e-6)
    # The body follows the only foot that stands.
    apart = np.linalg.norm(ankles[0, 0] - free[11:20, 0], axis=-1)
    assert (np.diff(apart) < 0).all()


def test_a_foot_is_held_within_a_fraction_of_the_leg():
    """A body that leaps by 0.3 m in frame 5 drags its feet along; there they stay."""
    ways = np.where(np.arange(12)[:, None] >= 5, [0.24, -0.18], [0.0, 0.0])
    ankles, _, _ = held(ways, np.ones((12, 2), bool))
    ankles = ankles[..., GROUND]
    free = pose().positions()[0, ANKLES][:, GROUND] + ways[:, None]
    np.testing.assert_allclose(ankles[4], free[4], atol=1e-6)
    away = (ankles[5] - free[5]) / [-0.8, 0.6]
    np.testing.assert_allclose(away, away[0, 0], atol=1e-5)
    assert 0.03 * LEG < away[0, 0] < 0.2 * LEG
    np.testing.assert_allclose(ankles[6:, 0], np.tile(ankles[5, 0], (6, 1)), atol=1e-6)


def test_a_body_without_legs_is_left_alone():
    torso = pose().keep([n for n in RIG.names if not n.endswith(("Leg", "Foot", "Toe"))])
    assert FootHold(torso.skeleton, FPS)(torso, np.ones(0), displaced) is torso


@pytest.fixture(scope="module")
def counted(model):
    """The demo's library, whose channels count the frames of all recordings, at mean movement."""
    recordings, first = [], 0
    for recording in model.library.recordings:
        n = recording.motion.shape[-1]
        ramp = first + torch.arange(n, dtype=torch.float32)
        level = torch.arange(1.0, 1.0 + len(recording.profiles))[:, None].expand(-1, n)
        rows = {"motion": recording.motion, "passive": recording.passive}
        rows = {name: 1e-3 * ramp.expand(own.shape) for name, own in rows.items()}
        recordings.append(replace(recording, profiles=level, **rows))
        first += n
    return replace(model.library, recordings=tuple(recordings))


def played(library, forecast: Forecast | None, frames: int, **choice) -> np.ndarray:
    """Return the recorded frame (T, 3) that each part shows."""
    plan, found = LivePlan(library, LiveChoice(**choice), 12), []
    for _ in range(frames):
        plan.advance(forecast, None if forecast is None else 0.0)
        vectors = plan.vectors(np.zeros(1))[0]
        found.append([1e3 * vectors[part.columns[0]] for part in library.parts])
    n = len(library.recordings[0].motion)
    np.testing.assert_allclose(vectors[n:], [1, 2, 3], atol=1e-5)
    names = library.passive.joints
    for finger, column in (("LeftHandThumb1", 0), ("RightHandPinky1", 1)):
        own = 1e3 * plan.passive()[6 * names.index(finger), 0]
        assert own == pytest.approx(found[-1][column], abs=0.02), "fingers go with their arm"
    return np.array(found)


def test_pieces_play_in_real_time_and_others_follow_after_their_hop(counted):
    """An arm's pieces have 3 frames of 5.34 a second between them, 17 of 30, the trunk's 6; they
    fade into each other in between."""
    step = counted.level_fps / counted.fps
    shown = played(counted, None, 103, seed=3)
    steady = np.abs(np.diff(shown, axis=0) - step) < 5e-3
    assert steady[:16].all(), "the first pieces, up to the next choice"
    for part in range(3):
        assert 0.1 < steady[:, part].mean() < 0.9, "some piece is a new one"


@pytest.mark.parametrize(("wanted", "tempo"), [(0.0, 1.0), (0.3, np.exp(0.3 / 0.5)), (9.0, 3.0)])
def test_arms_run_as_fast_as_speech_predicts(counted, wanted, tempo):
    """Pieces of mean movement: log m/s wanted, divided by its correlation; at most three times.
    A hand has mass: it is not as fast at once.
    """
    shown = played(counted, Forecast(np.zeros(1), np.full(1, wanted), 0.5, np.ones(1)), 16)
    step = counted.level_fps / counted.fps
    speeds = np.diff(shown, axis=0) / step
    np.testing.assert_allclose(speeds[:, 2], 1.0, atol=0.03)
    np.testing.assert_allclose(speeds[8:, 0], tempo, rtol=0.05)
    assert tempo == 1 or 1 < speeds[0, 0] < 0.9 * tempo


def test_a_forecast_holds_a_while():
    """Linear between the known times, and the last value for half a second more."""
    forecast = Forecast(np.array([0.0, 0.1, 0.2]), np.array([1.0, 3.0, 2.0]), 0.4, np.ones(3))
    found = forecast.at(np.array([0.0, 0.05, 0.15, 0.2, 0.6, 2.0]))
    np.testing.assert_allclose(found, [1.0, 2.0, 2.5, 2.0, 2.0, np.nan])


def test_speakers_styles_moods_and_names_decide_what_is_shown(counted):
    own = [
        replace(one, speaker="Ann" if k < 4 else "Bo", style=k % 2)
        for k, one in enumerate(counted.recordings)
    ]
    library = replace(counted, recordings=tuple(own))
    first = np.cumsum([0, *library.lengths])

    def begun(**choice) -> list[float]:
        return played(library, None, 1, **{"seed": 3, "item": "a"} | choice)[0].tolist()

    for frame in begun(speaker="Ann", style=1):
        assert np.searchsorted(first, frame + 0.1, side="right") - 1 in (1, 3)
    one = begun()
    assert begun() == one == begun(mood_seed=3)
    for other in ({"seed": 4}, {"item": "b"}, {"mood_seed": 8}, {"liveliness": 4.0}):
        assert begun(**other) != one


@pytest.mark.parametrize("film, residual", [("all", False), ("input", True)])
@pytest.mark.parametrize("part", [range(0, 3), range(20, 24), range(61, 64)])
def test_finer_levels_of_a_frame_are_those_of_the_whole_window(model, film, residual, part):
    """Some of 64 frames, as sampling without noise makes them, with two styles."""
    torch.manual_seed(0)
    config = replace(model.network_config, film=film, rectify_embedding=not residual)
    conditions = replace(model.conditions, styles=("a", "b"), residual=residual)
    network = MultiresGenerator(model.representation, conditions.width, config).eval()
    for own in (film for level in network.levels for film in level.films):
        torch.nn.init.normal_(own.gain.weight, std=0.3)
        torch.nn.init.normal_(own.shift.bias, std=0.3)
    own = replace(model, network=network, conditions=conditions)
    lengths = af.level_lengths(64, config.levels)
    styles = [torch.tensor([[0.25], [0.75]]).expand(1, 2, n) for n in lengths]
    speech = np.random.default_rng(0).standard_normal((64, model.conditions.conditioner.dim))
    speech = speech.astype(np.float32)
    level = model.library.level - 1
    recalled = torch.randn(1, model.representation.n_features, lengths[level])
    condition = conditions.of_motion(speech, lengths, styles)
    quiet = RandomNoise(torch.zeros(0), 0, None)
    whole = Pyramid(own, lengths, condition, quiet, None, recalled, level).random()
    finer = WindowLevels(own, lengths, styles, part)
    used = recalled[0, :, finer.first.start : finer.first.stop]
    found = own.normaliser.to_values(finer(speech, used)[None])
    np.testing.assert_allclose(found, whole[part.start : part.stop], atol=1e-4)
    assert np.abs(whole[20:24] - whole[24:28]).max() > 0.1, "the test can tell frames apart"


def test_features_of_a_stream_are_those_of_the_file_where_both_know_as_much(model, wave):
    """Level, pitch and mean of a voice are the same after some seconds of it."""
    conditioner = model.conditions.conditioner
    whole = conditioner(wave)
    stream = SpeechStream(conditioner, wave.sample_rate, rows=40)
    windows = list(stream.push(wave.samples))
    assert stream.n_rows == len(windows) == pytest.approx(len(whole), abs=3)
    rows = np.stack([one.rows[-1] for one in windows])
    names = list(conditioner.extractor.names)
    for name in ("mel_3", "mel_12", "voicing", "energy", "onset"):
        column = names.index(name)
        ours, theirs = rows[150:, column], whole[150 : len(windows), column]
        assert np.corrcoef(ours, theirs)[0, 1] > 0.9, name
        assert abs(np.mean(ours - theirs)) < 0.6, name
    silence = conditioner.silence(1)
    np.testing.assert_array_equal(windows[9].rows[:30], np.repeat(silence, 30, axis=0))
    # Running means over 2 and 8 s.
    means = np.repeat(silence.astype(float), 2, axis=0)
    for row in rows:
        means += (row - means) / (np.array([[2.0], [8.0]]) * model.fps)
    np.testing.assert_allclose(windows[-1].averages, means, atol=1e-6)
    # Rows do not depend on how many of them a window has; the last of three is kept.
    short = list(SpeechStream(conditioner, wave.sample_rate, rows=12).push(wave.samples[:RATE]))
    for one, other in zip(windows, short, strict=False):
        np.testing.assert_allclose(one.rows[-12:], other.rows, atol=2e-3)
    thirds = SpeechStream(conditioner, wave.sample_rate, rows=12, every=3)
    for k, window in enumerate(thirds.push(wave.samples[:RATE])):
        np.testing.assert_allclose(window.rows[-1], rows[3 * k + 2], atol=0.3)


def test_a_second_without_speech_is_a_pause(model, wave):
    """The first word is spoken after 1.1 s, the last one until 3 s."""
    stream = SpeechStream(model.conditions.conditioner, RATE, rows=4)
    silence = np.zeros(RATE // 2, np.float32)
    sound = np.concatenate([silence, wave.resample(RATE).samples[: 5 * RATE // 2], *[silence] * 3])
    paused = np.array([window.paused for window in stream.push(sound)])
    assert paused[: round(1.0 * model.fps)].all() and paused[round(4.1 * model.fps) :].all()
    assert not paused[round(1.3 * model.fps) : round(3.9 * model.fps)].any()


def test_a_row_is_complete_with_the_last_frame_that_it_needs(model):
    """Row 0 of 30 fps takes frames 0 and 10 ms, which need 32 ms more."""
    stream = SpeechStream(model.conditions.conditioner, RATE, rows=4)
    assert not list(stream.push(np.zeros(640, np.float32)))
    assert len(list(stream.push(np.zeros(320, np.float32)))) == 1
    assert 0.04 < stream.reach < 0.08
    assert [stream.rows_ahead(stream.reach + k / 30) for k in (-1, 0, 2.9)] == [-1, 0, 2]
