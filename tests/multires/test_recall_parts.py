"""Parts of the body and their library: settings of the search, movement, and unmodelled joints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.interpolate import make_interp_spline
from scipy.ndimage import gaussian_filter1d

import gesturekit as gk
from gesturekit.motion.rotations import quaternion_from_rotation_vector, rotation_angles
from gesturekit.multires.motion_vector import MultiresRepresentation
from gesturekit.multires.recall.library import RecallLibrary
from gesturekit.multires.recall.library_format import library_row, live_rows
from gesturekit.multires.recall.parts import (
    MotionPart,
    PassiveChannels,
    hand_directions,
    motion_parts,
    movements,
    slow_rows,
)
from gesturekit.multires.sampling.sampler import Sampler

FPS = 20.0
NONE = np.zeros(0, int)


@pytest.fixture(scope="module")
def library():
    return gk.load("demo").library


@pytest.mark.parametrize(("r", "movement"), [(0.3, 24 * 0.6), (0.7, 24.0), (-0.2, 0.0)])
def test_searches_of_arms_and_trunk(library, r, movement):
    """At 5.34 frames a second. Speech that predicts little counts less; the trunk's pieces are
    twice as long, and its feet should not slide; hands may copy a recording together.
    """
    wanted = replace(library.wanted, fast=replace(library.wanted.fast, r=r))
    left, right, rest = replace(library, wanted=wanted).searches
    assert [(own.piece, own.overlap, own.hop) for own in (left, right, rest)] == [
        *[(11, 2, 9)] * 2,  # of 10.7 and 2.1
        (21, 4, 17),  # of 21.4 and 4.3
    ]
    for own, continuity, copied in ((left, 3.0, 3.0), (right, 3.0, 3.0), (rest, 18.0, 12.0)):
        assert own.weights.movement == pytest.approx(movement)
        assert (own.weights.continuity, own.weights.copied) == (continuity, copied)
        assert (own.weights.slow, own.weights.place, own.weights.together) == (12.0, 0.5, 2.5)
    assert [own.profiles.shape[1] for own in (left, right, rest)] == [11, 33, 21]
    shrinkage = np.repeat([max(r, 0) ** 2, 0.5, 0.5], 11)
    np.testing.assert_allclose(right.squares, right.profiles**2 * shrinkage, rtol=1e-4)
    short = library.searches_of(0.1, 0.01, library.weights)
    assert [(own.piece, own.overlap) for own in short] == [(2, 1)] * 3


def test_without_a_prediction_movement_has_no_weight(library):
    for own in replace(library, wanted=None).searches:
        assert own.weights.movement == 0.0


def test_fast_movement_is_what_is_faster_than_two_seconds(library):
    for part in range(3):
        for own, recording in zip(library.fast_movement[part], library.recordings, strict=True):
            profile = recording.profiles[part].numpy()
            slow = gaussian_filter1d(profile, 2.0 * library.level_fps, mode="nearest")
            np.testing.assert_allclose(own[0], profile - slow, atol=1e-5)


@pytest.mark.parametrize(
    ("speaker", "styles", "expected"),
    [
        (None, None, None),
        ("Ann", None, [0, 2]),
        ("Bo", None, [1, 3, 4]),
        ("Cy", None, None),  # nobody's: all
        ("Di", None, None),  # too short: all
        (None, [0], [0, 1]),
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
    if styles == [1]:
        assert some.allowed(9, 3, "Di", np.array([3] * 3)).sum() == 3, "now it is long enough"
        both = some.allowed(10, 3, None, np.array([0, 1, 1]))
        assert [np.flatnonzero(row).tolist() for row in both] == [[0, 1], [2, 3], [2, 3]]


# Movement.


def part_of(*moving: str, name: str = "left") -> MotionPart:
    return MotionPart(name, NONE, (), moving, NONE, 0.35, 1.0)


def test_movement_is_the_log_of_the_smoothed_speed():
    """0.5 m/s for three seconds, then rest; the other hand rests. 0.05 m/s are added to both."""
    n = 120
    way = 0.5 / FPS * np.minimum(np.arange(n), 60)
    hand = np.outer([0.6, 0.0, -0.8], way)
    places = np.stack([np.zeros((3, n)), hand, np.ones((3, n))])
    joints = ("hips", "hand", "other")
    both, one, rest = movements(
        [part_of("hand", "other"), part_of("hand"), part_of("other")], joints, FPS, places
    )
    assert one[20] == pytest.approx(np.log(0.55)) and rest[20] == pytest.approx(np.log(0.05))
    np.testing.assert_allclose(both, (one + rest) / 2)
    np.testing.assert_allclose(rest, np.log(0.05))
    # Speeds are central differences, smoothed over a frame; logarithms over 0.1 s, two frames.
    speed = np.where(np.arange(n) < 60, 0.5, np.where(np.arange(n) == 60, 0.25, 0.0))
    bell = np.exp(-0.5 * np.arange(-4, 5) ** 2.0)
    speed = np.convolve(np.pad(speed, 4, mode="symmetric"), bell / bell.sum(), mode="valid")
    bell = np.exp(-0.5 * (np.arange(-8, 9) / 2) ** 2)
    log = np.convolve(np.pad(np.log(speed + 0.05), 8, mode="edge"), bell / bell.sum(), mode="valid")
    np.testing.assert_allclose(one, log, atol=1e-9)
    (single,) = movements([part_of("hand")], joints, FPS, places[..., :1])
    np.testing.assert_allclose(single, np.log(0.05))


def test_directions_of_a_hand_are_compressed_velocities_up_and_away():
    """0.3 m/s down, and 0.2 m/s away from the body: log(1 + 3) and log(1 + 2)."""
    n = 60
    time = np.arange(n) / FPS
    away = 0.3 + 0.2 * time
    hand = np.stack([away * np.sin(time), 1.0 - 0.3 * time, away * np.cos(time)])
    places = np.stack([np.zeros((3, n)), hand])
    found = hand_directions(part_of("hand"), ("hips", "hand"), FPS, places)
    np.testing.assert_allclose(found[0], -np.log(4.0), atol=1e-6)
    np.testing.assert_allclose(found[1], np.log(3.0), atol=1e-6)


def test_rows_of_slow_channels_follow_each_other():
    parts = [part_of("a"), part_of("b", name="right"), part_of("c", name="rest")]
    assert slow_rows(parts) == (slice(0, 4), slice(4, 8), slice(8, 9))
    assert slow_rows([part_of("c", name="body")]) == (slice(0, 1),)


# Joints that are not modelled.


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
    assert found.is_empty == (not moves)
    faced = replace(motion, expressions=np.zeros((motion.n_frames, 10)))
    assert PassiveChannels.find([faced, faced], modelled).expressions == 10
    assert not PassiveChannels.find([faced], modelled).is_empty
    wider = replace(motion, expressions=np.zeros((motion.n_frames, 50)))
    assert PassiveChannels.find([faced, wider], modelled).expressions == 0
    assert PassiveChannels.find([faced, motion], modelled).expressions == 0


@pytest.mark.parametrize("n_frames", [5, 1024, 1030])
def test_passive_channels_come_back_as_they_were(gesture, n_frames):
    motion = gesture(n_frames / 30)
    motion = replace(motion, expressions=np.random.default_rng(0).random((n_frames, 4)))
    passive = PassiveChannels(("LeftHand", "RightHand"), 4)
    values = passive.encode(motion)
    assert values.shape == (16, n_frames) and values.dtype == torch.float32
    blank = motion.rotations.copy()
    hands = [motion.skeleton.index(name) for name in passive.joints]
    blank[:, hands] = [0, 0, 0, 1]
    other = replace(motion, rotations=blank, expressions=None)
    asked = []

    def of(part: slice) -> torch.Tensor:
        asked.append(part)
        return values[:, part]

    made = passive.applied(other, of)
    assert rotation_angles(made.rotations, motion.rotations).max() < 1e-3
    np.testing.assert_allclose(made.expressions, motion.expressions, atol=1e-6)
    assert [own.start for own in asked] == list(range(0, n_frames, 1024))
    assert (other.rotations[:, hands] == [0, 0, 0, 1]).all() and other.expressions is None
    representation = MultiresRepresentation.fit([motion])
    parts = motion_parts(representation, separate=True)
    left, right, rest = passive.columns(parts)
    assert (left.tolist(), right.tolist()) == (list(range(6)), list(range(6, 12)))
    assert rest.tolist() == [12, 13, 14, 15], "the face goes with the trunk"
    (whole,) = motion_parts(representation, separate=False)
    assert whole.name == "body" and whole.length == 1.0 and not whole.is_arm
    assert whole.columns.tolist() == list(range(representation.n_features))
    assert [own.length for own in parts] == [1.0, 1.0, 2.0]
    assert [own.moving for own in parts] == [("LeftHand",), ("RightHand",), ("Head",)]
    assert [own.full_detail for own in parts] == [0.35, 0.35, 1.0]
    only_hands = PassiveChannels(("LeftHand",)).applied(motion, lambda part: values[:6, part])
    assert only_hands.expressions is motion.expressions


# Generation.


@pytest.fixture
def generated(monkeypatch):
    """generated(model, detail): the motion vectors (T, D) that are decoded, and the recalled
    level (1, D, T_l), where `detail(T)` says how much finer levels may add."""
    found, decoded, recalled = {}, Sampler._decoded, Sampler._recalled_level

    def decoding(self, values):
        found["values"] = values.copy()
        return decoded(self, values)

    def recalling(self, choice):
        found["recalled"] = recalled(self, choice)
        return found["recalled"]

    monkeypatch.setattr(Sampler, "_decoded", decoding)
    monkeypatch.setattr(Sampler, "_recalled_level", recalling)

    def make(model, detail):
        monkeypatch.setattr(RecallLibrary, "detail", lambda _, profiles: detail(profiles.shape[1]))
        model.generate(seconds=2.0, seed=1, foot_lock=False)
        return found["values"], found["recalled"]

    return make


def test_where_a_hand_rests_finer_levels_add_no_detail(generated):
    """Motion is then that of the recalled level, on a smooth curve, and in between elsewhere."""
    model = gk.load("demo")
    width, margin = model.representation.n_features, model.network_config.margin

    def some(n_frames: int) -> np.ndarray:
        rng = np.random.default_rng(0)
        return rng.random((width, n_frames)).astype(np.float32)

    whole, _ = generated(model, lambda n: np.ones((width, n), np.float32))
    none, recalled = generated(model, lambda n: np.zeros((width, n), np.float32))
    n_frames = len(whole) + 2 * margin
    times = (np.arange(n_frames) + 0.5) * recalled.shape[-1] / n_frames - 0.5
    curve = make_interp_spline(np.arange(recalled.shape[-1]), recalled[0].numpy(), axis=1)
    smooth = torch.from_numpy(curve(np.clip(times, 0, recalled.shape[-1] - 1)))[None]
    expected = model.normaliser.to_values(smooth.float())[margin:-margin]
    np.testing.assert_allclose(none, expected, atol=1e-4)
    assert np.abs(whole - none).max() > 0.02
    mixed, _ = generated(model, some)
    share = some(n_frames).T[margin:-margin]
    np.testing.assert_allclose(mixed, none + share * (whole - none), atol=1e-6)


def test_recall_needs_no_joints_beside_those_of_the_network(generated):
    model = gk.load("demo")
    width = model.representation.n_features
    bare = [replace(own, passive=own.passive[:0]) for own in model.library.recordings]
    library = replace(model.library, passive=PassiveChannels(), recordings=tuple(bare))

    def ones(n_frames: int) -> np.ndarray:
        return np.ones((width, n_frames), np.float32)

    found = [generated(own, ones)[0] for own in (model, replace(model, library=library))]
    np.testing.assert_array_equal(*found)


# README.


def test_a_readme_says_how_much_can_be_recalled(library):
    two = library.recordings[:2]
    values = [own.motion.numel() + own.passive.numel() + own.profiles.numel() for own in two]
    values = [n + own.states.numel() + own.directions.numel() for n, own in zip(values, two)]
    # Numbers have four bytes, flags one, and nine channels of the slow state eight each.
    size = 4 * sum(values) + sum(own.defective.numel() for own in two) + 8 * (3 * 9 + 81)
    plain = replace(library, recordings=two, wanted=None, ahead=(), stretch=0.0)
    words = f"2 recordings at level 2 (5.3 fps), {size / 1e6:.1f} MB of model.safetensors"
    assert library_row(plain) == words
    stretched = library_row(replace(plain, stretch=0.125))
    assert stretched == f"{words}, arms up to 12.5 % faster or slower"
    assert library_row(replace(plain, recordings=two[:1])).startswith("1 recording at level 2")
    assert float(words.split(", ")[1].split()[0]) > 0


def test_a_readme_gives_the_correlations_of_each_look_ahead(library):
    def row(look_ahead: float, fast: float, slow: float):
        one = library.ahead[0]
        parts = {
            name: replace(getattr(one, name), r=r) for name, r in [("fast", fast), ("slow", slow)]
        }
        return replace(one, look_ahead=look_ahead, **parts)

    two = replace(library, ahead=(row(0.0, 0.123, 0.456), row(0.2, 0.2, 0.5)))
    words = "with 0, 0.2 s of look-ahead, r = 0.12, 0.20 (calm or lively 0.46, 0.50)"
    assert live_rows(two) == {"Live": words}
    assert live_rows(replace(library, ahead=())) == {}
