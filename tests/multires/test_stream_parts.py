"""Parts of a stream, worked out by hand: feet, features, the drawn state and levels."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from rigs import PERSON, at_rest, rig_of

import audio_features as af
import gesturekit as gk
from gesturekit.motion.rotations import quaternion_from_rotation_vector, rotation_angles
from gesturekit.motion.skeleton import GROUND
from gesturekit.multires import MultiresGenerator
from gesturekit.multires.pyramid import generated
from gesturekit.multires.stream import (
    FootHold,
    Forecast,
    LiveState,
    SpeechStream,
    WindowLevels,
)

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


def test_what_is_to_come_is_not_predicted(state_model):
    """The forecast counts up to its last time, as far as it is known; noise does the rest."""
    fast, around = state_model.state_process.channels.fast, 40
    process = replace(state_model.state_process, explained=np.where(fast, 0.6, 0.0))
    speech = np.zeros((2 * around, state_model.conditions.conditioner.dim))

    def drawn(value: float, share: float) -> np.ndarray:
        own = LiveState(process, around, (1, 2))
        times, known = np.array([0.0, 0.2]), np.array([1.0, share])
        own.advance(speech, Forecast(times, known * value, known, 0.0))
        return own.coming[fast]

    higher, usual = drawn(9.0, 0.5), drawn(0.0, 0.5)
    assert (higher[:, 0] > usual[:, 0]).all()
    np.testing.assert_array_equal(higher[:, 7:], usual[:, 7:])
    assert not np.array_equal(drawn(9.0, 0.1)[:, 3], higher[:, 3])


def test_what_was_drawn_for_a_frame_stays_though_more_becomes_known(state_model):
    """A prediction changes the movement to come."""
    fast, around = state_model.state_process.channels.fast, 40
    process = replace(state_model.state_process, explained=np.where(fast, 0.6, 0.0))
    own, windows, coming = LiveState(process, around, (1, 2)), [], []
    for k in range(4):
        forecast = Forecast(np.array([0.0, 0.2]), np.full(2, float(k % 2)), np.ones(2), 0.0)
        speech = np.zeros((2 * around, state_model.conditions.conditioner.dim))
        windows.append(own.advance(speech, forecast)[: len(fast)][fast])
        coming.append(own.coming[fast].copy())
    for before, after in zip(windows, windows[1:], strict=False):
        np.testing.assert_allclose(after[:, :around], before[:, 1 : around + 1])
    assert (coming[0][:, 1:5] < coming[1][:, :4]).all()


@pytest.mark.parametrize(
    ("film", "residual", "factor"),
    [("all", False, 4 / 3), ("input", True, 2.0), ("concatenate", True, 4 / 3)],
)
@pytest.mark.parametrize("part", [range(0, 3), range(20, 24), range(61, 64)])
def test_levels_of_a_frame_are_those_of_the_whole_window(state_model, film, residual, factor, part):
    """Some of 64 frames, as sampling makes them, with two styles."""
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    changes = {"film": film, "rectify_embedding": not residual, "factor": factor}
    config = replace(state_model.network_config, **changes)
    conditions = replace(state_model.conditions, styles=("a", "b"), residual=residual)
    network = MultiresGenerator(state_model.representation, conditions.width, config).eval()
    for own in (film for level in network.levels for film in level.films):
        torch.nn.init.normal_(own.gain.weight, std=0.3)
        torch.nn.init.normal_(own.shift.bias, std=0.3)
    own = replace(state_model, network=network, network_config=config, conditions=conditions)
    lengths = config.lengths(64)
    styles = [torch.tensor([[0.25], [0.75]]).expand(1, 2, n) for n in lengths]
    speech = rng.standard_normal((64, conditions.conditioner.dim)).astype(np.float32)
    state = rng.standard_normal((conditions.state.width, 64)).astype(np.float32)
    condition = conditions.of_motion(speech, lengths, styles, (), state)
    noise = own.noise.random(own.styles)
    noises = noise.clocked(state[None], conditions.n_carriers, lengths)
    whole = generated(own, noises, lengths, condition)
    found = WindowLevels(own, lengths, styles, part)(speech, state=state)
    found = own.normaliser.to_values(found[None])
    np.testing.assert_allclose(found, whole[part.start : part.stop], atol=1e-4)
    assert np.abs(whole[20:24] - whole[24:28]).max() > 0.005, "the test can tell frames apart"


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


def test_a_row_is_complete_with_the_last_frame_that_it_needs(model):
    """Row 0 of 30 fps takes frames 0 and 10 ms, which need 32 ms more."""
    stream = SpeechStream(model.conditions.conditioner, RATE, rows=4)
    assert not list(stream.push(np.zeros(640, np.float32)))
    assert len(list(stream.push(np.zeros(320, np.float32)))) == 1
    assert 0.04 < stream.reach < 0.08
    assert [stream.rows_ahead(stream.reach + k / 30) for k in (-1, 0, 2.9)] == [-1, 0, 2]
