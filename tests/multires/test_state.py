"""The state of movement: measured, drawn, and given to a model."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from runs import cut_off, logged, same_weights
from safetensors.torch import load_file, save_file
from scipy.ndimage import gaussian_filter1d
from small_runs import small_config

import gesturekit as gk
from gesturekit.errors import ConfigError, FormatError, ModelError
from gesturekit.motion import Skeleton
from gesturekit.multires import VectorKinematics, load_training_data, losses, train
from gesturekit.multires.training.state import TrainingState
from gesturekit.multires.training.targets import StateTarget
from gesturekit.state.channels import StateChannels, averaged
from gesturekit.state.process import (
    RecordedState,
    StateProcess,
    load_state,
    state_tensors,
    state_values,
)

FPS = 25.0
HANDS = StateChannels(((1,), (2,)), trunk=3, shoulders=(4, 5))
NAMES = HANDS.names
FAST = NAMES.index("left fast")


def channels_of(left: np.ndarray, right: np.ndarray) -> dict[str, np.ndarray]:
    """Return the channels of hands at places (3, T), beside a root that walks away facing +X."""
    n = left.shape[1]
    root = np.stack([np.arange(n) / FPS, np.ones(n), np.zeros(n)])
    shoulder = np.array([[0.0], [0.4], [0.2]])
    places = np.stack(
        [root, root + left, root + right, root + 0.5, root - shoulder, root + shoulder]
    )
    rows = HANDS(torch.from_numpy(places)[None], FPS)[0].numpy()
    return dict(zip(NAMES, rows, strict=True))


def test_channels_are_those_worked_out_by_hand():
    n = 500
    still = np.tile([[0.3], [-0.2], [0.4]], n)
    rising = np.stack([np.full(n, 0.3), 0.4 * np.arange(n) / FPS, np.zeros(n)])
    found = {name: row[n // 2] for name, row in channels_of(still, rising).items()}
    # A hand at rest, at the least speed and width. It is 0.3 m before the root, on the wrong side.
    assert found["left movement"] == found["trunk movement"] == pytest.approx(np.log(0.05), 1e-3)
    assert found["left height"] == pytest.approx(-0.2)
    assert found["left forward"] == pytest.approx(0.3)
    assert found["left side"] == pytest.approx(-0.4)
    assert found["right side"] == pytest.approx(0.0, abs=1e-6)
    assert found["right forward"] == pytest.approx(0.3)
    assert found["left width"] == pytest.approx(np.log(0.01), abs=0.02)
    # A hand at 0.4 m/s, which is 4 m up after 10 s; over a Gaussian of 2 s it is 0.8 m wide.
    assert found["right movement"] == pytest.approx(np.log(0.45), abs=1e-3)
    assert found["right height"] == pytest.approx(4.0, abs=0.01)
    assert found["right width"] == pytest.approx(np.log(0.81), abs=0.03)
    assert found["left fast"] == pytest.approx(0, abs=1e-9)
    assert found["right fast"] == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize(("phase", "expected"), [(0.0, 1.0), (np.pi, -1.0), (np.pi / 2, 0.0)])
def test_hands_that_rise_together_are_coupled(phase, expected):
    """Over a second: a quarter of a wave apart, they move alike as often as against each other."""
    hands = np.zeros((2, 3, 500))
    hands[:, 1] = 0.3 * np.sin(2 * np.pi * np.arange(500) / FPS + [[0.0], [phase]])
    assert channels_of(*hands)["coupling"][200:300] == pytest.approx(expected, abs=0.01)


def test_a_burst_of_movement_is_fast_and_not_slow():
    """A stroke of 0.4 s in a hand that rests."""
    place = np.zeros((3, 500))
    place[1] = 0.2 / (1 + np.exp(-(np.arange(500) - 250) / 1.5))
    found = channels_of(place, np.zeros((3, 500)))
    assert found["left fast"].argmax() in range(248, 253) and found["left fast"].max() > 2
    assert np.ptp(found["left movement"]) < 1 and np.abs(found["right fast"]).max() < 1e-9


def test_rigs_without_known_arms_have_two_channels():
    chain = Skeleton(
        ("a", "b", "c"), (-1, 0, 1), np.array([[0, 0, 0], [0, 1, 0], [0, 1, 0]], float)
    )
    channels = StateChannels.find(chain, chain.names)
    assert channels.names == ("movement", "fast") and channels.n_carriers == 4
    assert channels(torch.zeros(1, 3, 3, 50), FPS).shape == (1, 2, 50)


def test_the_trunk_is_the_joint_that_carries_both_arms(skeleton):
    channels = StateChannels.find(skeleton, skeleton.names)
    shoulders = [skeleton.index(f"{side}Arm") for side in ("Left", "Right")]
    carried = {*skeleton.descendants(channels.trunk)}
    assert carried.issuperset(shoulders)
    for child in skeleton.names:
        if skeleton.parents[skeleton.index(child)] == channels.trunk:
            assert not {*skeleton.descendants(skeleton.index(child))}.issuperset(shoulders)


def test_a_head_that_moves_is_seen_where_there_is_one(skeleton):
    """0.2 m/s to the side, relative to the root; the other joints are still."""
    names = [name for name in skeleton.names if name != "Head"]
    assert "head movement" not in StateChannels.find(skeleton, names).names
    channels = StateChannels.find(skeleton, skeleton.names)
    places = torch.zeros(1, skeleton.n_joints, 3, 500)
    places[0, skeleton.index("Head"), 0] = 0.2 * torch.arange(500) / FPS
    found = dict(zip(channels.names, channels(places, FPS)[0, :, 250].tolist(), strict=True))
    assert found["head movement"] == pytest.approx(np.log(0.25), abs=1e-3)
    assert found["trunk movement"] == pytest.approx(np.log(0.05), abs=1e-2)


def test_levels_get_means_of_the_channels():
    values = np.array([[1.0, 2.0, 3.0, 4.0]])
    np.testing.assert_allclose(averaged(values, 2), [[1.5, 3.5]])
    np.testing.assert_allclose(averaged(values, 3), [[1.25, 2.5, 3.75]])
    np.testing.assert_allclose(averaged(values, 3, 1, 3), [[2.5, 3.75]])
    np.testing.assert_array_equal(averaged(values, 4, 1, 3), [[2.0, 3.0]])


# The process.


def recorded(seed: int, seconds: float = 120.0, *, lively: float = 0.0) -> np.ndarray:
    """Channels of a speaker whose hands share their fast movement, at about 0.8 Hz."""
    rng, n = np.random.default_rng(seed), round(seconds * FPS)
    rows = np.repeat(rng.standard_normal((len(NAMES), n // 50)), 50, axis=1)
    smooth = np.exp(-0.5 * (np.arange(-12, 13) / 4) ** 2)
    shared = np.convolve(rng.standard_normal(n), smooth / np.linalg.norm(smooth), mode="same")
    for i, name in enumerate(NAMES):
        own = np.convolve(rng.standard_normal(n), smooth / np.linalg.norm(smooth), mode="same")
        if name.endswith("fast"):
            rows[i] = np.exp(0.6 * (0.8 * shared + 0.6 * own))  # skewed
    rows[HANDS.movement] += 1.0 + lively
    return rows


def fitted(groups=(("Ann", None), ("Bo", None))) -> StateProcess:
    recordings = [
        RecordedState(recorded(k, lively=2.0 * k), np.empty((0, 3000)), f"take {k}", group)
        for k, group in enumerate(groups)
    ]
    return StateProcess.fit(HANDS, recordings, FPS, None)


@pytest.fixture(scope="module")
def process() -> StateProcess:
    return fitted()


def drawn(process: StateProcess, seconds: float, seed: int = 0, **options) -> np.ndarray:
    return process.draw(seed, np.empty((0, round(seconds * FPS))), **options)


def test_drawn_values_are_distributed_as_recorded(process):
    every = np.concatenate([recorded(0), recorded(1, lively=2.0)], axis=1)
    made = np.concatenate([drawn(process, 100, seed) for seed in range(150)], axis=1)
    for name, row, own in zip(NAMES, made, every, strict=True):
        found, wanted = (np.quantile(part, (0.1, 0.5, 0.9)) for part in (row, own))
        np.testing.assert_allclose(found, wanted, atol=0.25 * own.std(), err_msg=name)


def test_fast_movement_is_small_where_a_hand_rests():
    """A hand at 0.01 m/s and at 0.4 m/s, whose speed varies by the same factors."""
    rng, n = np.random.default_rng(0), 6000
    resting = (np.arange(n) // 500 % 2).astype(bool)
    smooth = np.exp(-0.5 * (np.arange(-12, 13) / 4) ** 2)
    factor = np.exp(
        0.8 * np.convolve(rng.standard_normal(n), smooth / np.linalg.norm(smooth), "same")
    )
    values = np.zeros((len(NAMES), n))
    usual = np.where(resting, 0.01, 0.4)
    values[HANDS.movement] = np.log(usual + 0.05)
    values[HANDS.fast] = np.log(usual * factor + 0.05) - np.log(usual + 0.05)
    own = RecordedState(values, np.empty((0, n)), "take", (None, None))
    made = drawn(StateProcess.fit(HANDS, [own], FPS, None), 2000)
    calm = made[HANDS.of_hands] < np.log(0.1)
    spread = made[HANDS.fast][calm].std() / made[HANDS.fast][~calm].std()
    wanted = values[HANDS.fast][:, resting].std() / values[HANDS.fast][:, ~resting].std()
    assert wanted < 0.3 and spread < 0.65, "which would be 1 if both were drawn alike"


def test_speeds_are_zero_at_rest_and_in_proportion_to_the_speed(process):
    values = np.zeros((len(NAMES), 300))
    values[HANDS.of_hands, :100] = np.log(0.05)
    values[HANDS.of_hands, 100:200] = np.log(0.35)
    values[HANDS.of_hands, 200:] = np.log(0.65)
    left, right = process.condition(3, values)[len(NAMES) : len(NAMES) + 2]
    for row in (left, right):
        assert np.abs(row[:100]).max() < 1e-6 and row[150] > 0
        assert row[250] == pytest.approx(2 * row[150], rel=1e-5)


def test_fast_movement_has_the_recorded_rhythm_and_is_shared_by_the_hands(process):
    made, own = (part[HANDS.fast] for part in (drawn(process, 400), recorded(0, 400)))
    for lag in (3, 6, 20):
        found, wanted = (np.corrcoef(part[0, lag:], part[0, :-lag])[0, 1] for part in (made, own))
        assert found == pytest.approx(wanted, abs=0.1)
    assert np.corrcoef(made)[0, 1] == pytest.approx(np.corrcoef(own)[0, 1], abs=0.1)


def test_each_speaker_has_an_own_distribution(process):
    ann, bo = (drawn(process, 300, group=(name, None)) for name in ("Ann", "Bo"))
    assert (bo - ann)[HANDS.movement].mean() == pytest.approx(2.0, abs=0.3)
    unknown = drawn(process, 10, group=("Cy", 3))
    np.testing.assert_array_equal(unknown, drawn(process, 10))


def test_noise_depends_on_the_time_alone(process):
    """So a part can be drawn by itself, and streams and tiles draw what a whole motion has."""
    whole = process.noise(5, np.arange(-40, 700))
    np.testing.assert_allclose(process.noise(5, np.arange(300, 500)), whole[:, 340:540], atol=1e-12)
    assert not np.allclose(process.noise(6, np.arange(300, 500)), whole[:, 340:540])


def test_noise_has_no_seam_between_its_blocks():
    """It is drawn in blocks of 256 points: 64 s within takes, 32 takes of 120 s between them."""
    for process, border in ((replace(fitted(), between=np.zeros(12)), 64.0), (takes(1.0), 3840.0)):
        noise = process.noise(7, np.arange(*(round(process.fps * (border + s)) for s in (-20, 20))))
        slow = noise[~HANDS.fast]
        steps = np.abs(np.diff(slow))
        assert (steps.max(axis=1) < 12 * np.median(steps, axis=1) + 1e-6).all()
        assert (np.ptp(slow, axis=1) > 0.01).all()


def test_slow_noise_is_the_same_in_seconds_at_any_frame_rate(process):
    """Each third frame at 75 fps lies in the middle of one at 25 fps."""
    slow = process.noise(3, np.arange(400))[~HANDS.fast]
    faster = replace(process, fps=3 * FPS).noise(3, np.arange(1200))[~HANDS.fast]
    np.testing.assert_allclose(faster[:, 1::3], slow, atol=1e-9)


def takes(between: float, seconds: float = 2.0, count: int = 40) -> StateProcess:
    """The process of takes of two minutes, in each of which the channels have levels of their own,
    and change as white noise smoothed by a Gaussian of some seconds does, at 5 fps."""
    rng, recordings = np.random.default_rng(0), []
    for k in range(count):
        own = gaussian_filter1d(rng.standard_normal((len(NAMES), 800)), 5 * seconds)[:, 100:-100]
        own *= np.sqrt((1 - between) * 2 * np.sqrt(np.pi) * 5 * seconds)  # of variance 1
        own += np.sqrt(between) * rng.standard_normal((len(NAMES), 1))
        recordings.append(RecordedState(own, np.empty((0, 600)), f"take {k}", (None, None)))
    return StateProcess.fit(HANDS, recordings, 5.0, None)


@pytest.mark.parametrize(("between", "seconds"), [(0.0, 2.0), (0.5, 6.0)])
def test_width_and_share_between_takes_are_those_of_the_recordings(between, seconds):
    process = takes(between, seconds)
    assert process.between.mean() == pytest.approx(between, abs=0.15)
    assert np.median(process.width) == pytest.approx(seconds, rel=0.3)
    assert process.take == pytest.approx(120)


def test_ranks_are_those_among_recordings_of_the_same_speaker_and_style():
    """Two speakers of whom one is always livelier: no change from take to take, unless they are
    one person."""
    moves = HANDS.movement[~HANDS.fast]
    others = [
        fitted(groups).between[moves].mean()
        for groups in ((("Ann", None), ("Bo", None)), ((None, 0), (None, 1)), ((None, None),) * 2)
    ]
    assert max(others[:2]) < 0.85 * others[2]


def test_scores_are_quantiles_of_the_recorded_values(process):
    """The middle one has 0, and of 100 values 16 lie below -1; the furthest ones have ends."""
    every = np.concatenate([recorded(0), recorded(1, lively=2.0)], axis=1)
    asked = np.quantile(every, (0.5, 0.1587, 0.0), axis=1).T
    scores = process.scores(asked, np.empty((0, 3)))
    np.testing.assert_allclose(scores[:, 0], 0, atol=0.1)
    np.testing.assert_allclose(scores[:, 1], -1, atol=0.1)
    assert (scores[:, 2] < -2).all() and np.isfinite(scores).all()


@pytest.mark.parametrize("values", [np.zeros((14, 1)), np.zeros((14, 20)), np.eye(14)[:, :2]])
def test_short_and_still_recordings_give_a_process_too(values):
    rows = [RecordedState(values, np.empty((0, values.shape[1])), t, (None, None)) for t in "ab"]
    process = StateProcess.fit(HANDS, rows, FPS, None)
    made = process.draw(1, np.empty((0, 30)))
    assert made.shape == (14, 30) and np.isfinite(process.condition(1, made)).all()
    assert (process.between >= 0).all() and (process.between <= 1).all() and process.take > 0


def test_liveliness_is_a_factor_on_the_speed(process):
    usual, livelier = drawn(process, 20), drawn(process, 20, liveliness=1.5)
    moved = np.where(HANDS.movement, np.log(1.5), 0.0)[:, None]
    np.testing.assert_allclose(livelier, usual + moved)


def test_carriers_run_with_the_hand_and_stand_while_it_rests(process):
    values = np.full((len(NAMES), 500), np.log(0.05))
    values[HANDS.fast] = 0.0
    right = NAMES.index("right movement")
    values[right, 250:] = np.log(0.65)  # 0.6 m/s
    clocks = np.cumsum(process.clocks(values), axis=1)
    left, moving = np.split(np.abs(np.diff(process.carriers(3, clocks))), 2)
    assert max(left.max(), moving[:, :249].max()) < 1e-9
    assert moving[:, 251:].mean() > 0.02


def test_where_a_hand_is_held_stands_still_while_it_rests(process):
    values = np.full((len(NAMES), 500), np.log(0.05))
    values[HANDS.fast] = 0.0
    for side in ("left", "right"):
        values[NAMES.index(f"{side} height")] = np.linspace(0.0, 0.3, 500)
    values[NAMES.index("right movement"), 200:] = np.log(0.65)  # 0.6 m/s
    given = process.condition(3, values)
    left, right = (given[NAMES.index(f"{side} height")] for side in ("left", "right"))
    assert np.ptp(left) == 0 and np.ptp(right[:199]) < 1e-6
    assert np.diff(right[230:]).min() > 0, "it follows while the hand moves"


def test_speeds_of_which_a_network_shows_too_much_or_too_little_are_asked_for_otherwise(process):
    """A network that shows 0.8 of each channel's deviation from its mean, and adds 0.1."""
    speeds = HANDS.movement | HANDS.fast

    def shown(process: StateProcess, values: np.ndarray) -> np.ndarray:
        clocks = np.zeros((2, values.shape[1]))
        clocks[:] = np.arange(values.shape[1]) * 100.0  # as if the hands were always fast
        given = process.condition(0, values, clocks)[: len(NAMES)] * process.scale[:, None]
        return 0.8 * given + process.mean[:, None] + 0.1

    for seed in range(5):
        values = drawn(process, 200, seed)
        process = process.calibrated(values, shown(process, values))
    values = drawn(process, 200, 9)
    found, wanted = (
        np.quantile(rows, (0.2, 0.5, 0.8), axis=1) for rows in (shown(process, values), values)
    )
    np.testing.assert_allclose(found[:, speeds], wanted[:, speeds], atol=0.1)
    before = np.quantile(shown(fitted(), values), (0.2, 0.5, 0.8), axis=1)
    np.testing.assert_array_equal(found[:, ~speeds], before[:, ~speeds])
    assert np.abs(before - wanted)[:, speeds].max() > 0.2, "the test can tell"


def test_what_speech_tells_is_followed_and_kept_in_the_folder(model):
    """Hands that are fast where a feature is high, and calm in pauses, which are left out too."""
    conditioner, rng = model.conditions.conditioner, np.random.default_rng(0)
    recordings, n = [], 2000
    for k in range(4):
        speech = np.repeat(rng.standard_normal((conditioner.dim, n // 20)), 20, axis=1)
        paused = np.zeros(n, bool)
        paused[300:600] = paused[1500:1700] = True
        speech[:, paused] = conditioner.silence(1).T
        values = recorded(10 + k, 80.0)
        values[np.ix_(HANDS.movement, paused)] -= 3.0
        values[HANDS.fast] = (
            np.where(paused, -1.0, 0.5) + 0.7 * speech[0] + 0.3 * values[HANDS.fast]
        )
        recordings.append(RecordedState(values, speech.astype(np.float32), f"{k}", (None, None)))
    process = StateProcess.fit(HANDS, recordings[:3], FPS, conditioner)
    held = recordings[3]
    made = process.draw(1, held.speech)
    for row, own in zip(made[HANDS.fast], held.values[HANDS.fast], strict=True):
        assert np.corrcoef(row, own)[0, 1] > 0.5
        assert row[350:550].mean() < row[700:1400].mean() - 1
    calm, lively = (
        made[HANDS.movement, part].mean() for part in (slice(350, 550), slice(700, 1400))
    )
    assert calm < lively - 1, "hands rest in long pauses"
    # A network that follows a part of the fast movement is given more of the speech in it.
    deaf = replace(process, followed=np.full(len(NAMES), 0.6))
    assert (
        np.corrcoef(deaf.draw(1, held.speech)[FAST], held.values[FAST])[0, 1]
        > np.corrcoef(made[FAST], held.values[FAST])[0, 1]
    )
    folder = state_values(process), state_tensors(process)
    again = load_state(*folder, HANDS, FPS, conditioner.dim)
    np.testing.assert_allclose(again.draw(1, held.speech), made)
    np.testing.assert_allclose(again.condition(2, made), process.condition(2, made))


# A model.

FILE = "model.safetensors"
ROOT = Path(__file__).resolve().parents[2]

SETTINGS = {
    "state": True,
    "features": {"extractors": [{"kind": "prosody"}, {"kind": "effort", "seconds": 2.0}]},
    "losses": {"state": 100.0, "arm_speed": 0.0},
    "checkpoint_every": 2,
}


@pytest.fixture(scope="module")
def config(corpus, tmp_path_factory):
    return small_config(corpus, tmp_path_factory.mktemp("state") / "run", SETTINGS)


@pytest.fixture(scope="module")
def folder(config):
    return train(config)


@pytest.fixture(scope="module")
def model(folder):
    return gk.load(folder)


def test_a_motion_is_made_of_seed_and_mood(model):
    a, b, c = (model.generate(seconds=4, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(a.rotations, b.rotations)
    assert not np.allclose(a.rotations, c.rotations)
    states = [model.state(model.generate(seconds=4, seed=s, mood_seed=7)) for s in (1, 2)]
    assert not np.allclose(*states)
    livelier = model.generate(seconds=4, seed=1, liveliness=1.5)
    assert not np.allclose(livelier.rotations, a.rotations)


def test_a_state_can_be_measured_changed_and_given(model, gesture, tmp_path):
    state = model.state(gesture(4.0))
    assert state.shape == (4 * model.fps, len(model.state_process.channels.names))
    np.save(tmp_path / "state.npy", state)
    given = model.generate(seconds=4, seed=1, state=state)
    again = model.generate(seconds=4, seed=1, state=tmp_path / "state.npy")
    np.testing.assert_array_equal(given.rotations, again.rotations)
    whole = [model.generate(seconds=1, state=np.ones((1, 15), kind)) for kind in (int, float)]
    np.testing.assert_array_equal(*(motion.rotations for motion in whole))
    other = model.generate(seconds=4, seed=1, state=state + 1.0)
    assert not np.allclose(given.rotations, other.rotations)
    held = model.generate(seconds=6, seed=1, state=state)  # longer than the state
    assert held.n_frames == 1.5 * given.n_frames


@pytest.mark.parametrize(
    ("state", "says"),
    [
        (np.zeros((4, 2)), r"\(4, 2\)"),
        (np.zeros(4), r"\(4,\)"),
        (np.zeros((0, 15)), r"\(0, 15\)"),
        (np.zeros((4, 15, 1)), r"\(4, 15, 1\)"),
        (np.zeros((4, 15), complex), "complex128"),
        (np.full((4, 15), np.nan), "finite"),
        (np.full((4, 15), "a"), "U1"),
    ],
)
def test_a_state_that_does_not_fit_is_refused(model, state, says):
    with pytest.raises(ModelError, match=f"state: .*{says}"):
        model.generate(seconds=1, state=state)


def test_an_array_of_objects_is_not_unpickled(model, tmp_path):
    np.save(tmp_path / "bad.npy", np.array([{}], object), allow_pickle=True)
    with pytest.raises(FormatError, match="bad.npy"):
        model.generate(seconds=1, state=tmp_path / "bad.npy")


def test_what_a_state_excludes_is_said(model, config, corpus, tmp_path):
    with pytest.raises(ModelError, match="liveliness"):
        model.generate(seconds=1, state=np.zeros((9, 15)), liveliness=2.0)
    with pytest.raises(ConfigError, match="state"):
        replace(config, state=False)
    alone = {"features": {"extractors": [{"kind": "effort"}]}}
    with pytest.raises(ConfigError, match="(?=.*features.extractors)(?=.*effort)(?=.*prosody)"):
        small_config(corpus, tmp_path, SETTINGS, alone)


def test_the_loss_is_the_weighted_distance_of_channels():
    shown, given = (
        torch.tensor([[[1.0, 3.0], [5.0, 5.0]]]),
        torch.tensor([[[0.0, 1.0], [5.0, 7.0]]]),
    )
    assert losses.state(shown, given, torch.tensor([[2.0], [1.0]])) == (2 + 4 + 0 + 2) / 4


def test_random_steps_are_held_to_their_state(config, folder):
    assert all(line["state"] > 0 for line in logged(config.out))


def test_a_level_shows_most_of_the_state_of_its_own_recording(config, folder):
    data = load_training_data(config)
    state, kinematics = TrainingState(data, config), VectorKinematics(data.representation, FPS)
    one, other = data.paired

    def places(motion: torch.Tensor) -> torch.Tensor:
        return kinematics.places(data.normaliser.inverse(motion))

    motion, n = one.motion[:, :62][None], len(data.conditions.state.names)
    own, others = (torch.from_numpy(state.recorded(s)[None, :n, :62]) for s in (one, other))
    finest = StateTarget(state, 3, places)
    assert finest(places(motion), own) < 0.5 * finest(places(motion), others)


def test_a_resumed_run_is_the_same(config, folder, tmp_path):
    again = replace(config, out=tmp_path / "run")
    shutil.copytree(config.out, again.out)
    cut_off(again.out, 10)
    assert same_weights(train(again, resume=True), folder)


def test_training_starts_from_a_model_without_a_state(corpus, tmp_path):
    """Its output does not change until the first step: new columns of weights are zeros."""
    plain = {"features": {"extractors": [{"kind": "prosody"}]}, "losses": {"arm_speed": 0.0}}
    plain |= {"network": {"levels": 2}, "training": {"first_stage": 1}}
    start = train(small_config(corpus, tmp_path / "plain", plain))
    still = {**plain, "start_from": str(start), "state": True, "losses": SETTINGS["losses"]}
    still["training"] = {"first_stage": 1, "learning_rate": 1e-12}
    widened = load_file(train(small_config(corpus, tmp_path / "run", still)) / FILE)
    for name, weights in load_file(start / FILE).items():
        if name.startswith("network."):
            own = widened[name]
            torch.testing.assert_close(own[tuple(map(slice, weights.shape))], weights)
            assert float(own.abs().sum()) == pytest.approx(float(weights.abs().sum()), rel=1e-4)
    back = {**plain, "start_from": str(tmp_path / "run" / "model")}
    with pytest.raises(ConfigError, match="state"):
        train(small_config(corpus, tmp_path / "back", back))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("between", 1.01),
        ("followed", 0.09),
        ("scale", 0.0),
        ("kernel", float("nan")),
        ("mean", 1e9),
        ("mixing", None),
    ],
)
def test_a_damaged_folder_is_refused(folder, tmp_path, name, value):
    damaged = shutil.copytree(folder, tmp_path / "model")
    tensors = load_file(damaged / FILE)
    tensors[f"state.{name}"] = (
        torch.ones(3, 7) if value is None else torch.full_like(tensors[f"state.{name}"], value)
    )
    save_file(tensors, damaged / FILE)
    with pytest.raises(ModelError, match=f"state.{name}"):
        gk.load(damaged)


def test_channels_of_another_rig_are_refused(folder, tmp_path):
    damaged = shutil.copytree(folder, tmp_path / "model")
    about = yaml.safe_load((damaged / "config.yaml").read_text())
    about["state"]["channels"] = ["movement", "fast"]
    (damaged / "config.yaml").write_text(yaml.safe_dump(about))
    with pytest.raises(ModelError, match="channels"):
        gk.load(damaged)


def test_recordings_on_disk_train_too(corpus, tmp_path):
    own = shutil.copytree(corpus.parent, tmp_path / "corpus") / corpus.name  # arrays lie beside it
    short = {"network": {"levels": 2}, "training": {"first_stage": 1}}
    config = small_config(own, tmp_path / "run", SETTINGS, {"in_memory": 0.1}, short)
    made = gk.load(train(config)).generate(seconds=2)
    assert np.isfinite(made.rotations).all()


@pytest.mark.stress
def test_the_network_obeys_the_state_that_it_is_given(shared_data, tmp_path):
    """A minute of motion: its own states, and livelier ones."""
    folder = shared_data / "paired" / "zeggs_067_Speech_2"
    gk.prepare([folder], tmp_path / "corpus.jsonl", holdout=0)
    recipe = ROOT / "recipes" / "multires_speech" / "light.yaml"
    model = gk.load(gk.train(recipe, corpus=tmp_path / "corpus.jsonl", out=tmp_path / "run"))
    state = model.state(next(folder.glob("*.bvh")))
    given = model.generate(seconds=30, state=state)
    livelier = model.generate(seconds=30, state=faster(model, state))
    shown = model.state(given)
    names = model.state_process.channels.names
    for name, a, b in zip(names, state.T, shown.T, strict=True):
        assert np.corrcoef(a[: len(b)], b[: len(a)])[0, 1] > 0.6, name
    assert speed_of(livelier) > 1.15 * speed_of(given)


def faster(model: gk.Model, state: np.ndarray) -> np.ndarray:
    """Return a state in which everything moves at 1.5 times the speed."""
    return state + np.log(1.5) * model.state_process.channels.movement


def speed_of(motion: gk.Motion) -> float:
    """Return the mean speed of both hands beside the hips, m/s."""
    places = motion.positions() - motion.positions()[:, :1]
    hands = [motion.skeleton.index(name) for name in ("LeftHand", "RightHand")]
    return float(np.linalg.norm(np.diff(places[:, hands], axis=0), axis=-1).mean() * motion.fps)
