"""Recall by speech: training on recalled motion, and motion generated from recorded pieces."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import soundfile
import torch
import yaml
from runs import same_weights, weights
from safetensors.torch import save_file
from scipy.stats import norm, rankdata
from small_runs import small_config

import audio_features as af
import gesturekit as gk
from gesturekit.corpus import Item, Manifest
from gesturekit.errors import ConfigError, ModelError
from gesturekit.formats.smpl.skeleton import smpl_skeleton
from gesturekit.motion.root_path import RootPath
from gesturekit.motion.rotations import quaternion_from_rotation_vector
from gesturekit.multires.config import MultiresConfig
from gesturekit.multires.network.resampling import resample
from gesturekit.multires.recall.ahead import AheadPrediction
from gesturekit.multires.recall.library import averaged
from gesturekit.multires.recall.parts import (
    hand_directions,
    joint_places,
    movements,
    slow_part,
    slow_states,
)
from gesturekit.multires.recall.pieces import ChoiceWeights
from gesturekit.multires.recall.slow_state import normal_scores
from gesturekit.multires.recall.wanted import WantedMovement
from gesturekit.multires.training.ahead import with_live_predictions
from gesturekit.multires.training.loading import load_training_data
from gesturekit.multires.training.recall_library import build_library
from gesturekit.multires.training.trainer import train
from gesturekit.training.recordings import training_items
from gesturekit.training.run.checkpoint import Checkpoints

RATE = 16_000
FINGERS = ("left_index1", "right_thumb2")
LEVEL = 2
SETTINGS = {
    "features": {"extractors": [{"kind": "prosody"}, {"kind": "effort", "seconds": 2.0}]},
    "network": {"channels": [2, 2]},
    "recall": {"level": LEVEL, "piece": 1.0, "overlap": 0.3},
    "training": {"first_stage": 3, "further_stages": 3, "window": 2.0, "renew_every": 2},
    "checkpoint_every": 1,
}


SHORT = {"first_stage": 1, "further_stages": 1}


def liveliness_over(seconds: float) -> np.ndarray:
    """Return how lively somebody is (T,) at 30 fps: calm and lively by turns of eight seconds."""
    time = np.arange(round(seconds * 30)) / 30
    return 0.5 - 0.4 * np.cos(2 * np.pi * time / 16)


def recording(seconds: float, seed: int) -> gk.Motion:
    """Arms, fingers and the face move, the arms more in lively stretches."""
    skeleton, rng = smpl_skeleton(55), np.random.default_rng(seed)
    n = round(seconds * 30)
    time = np.arange(n)[:, None] / 30
    wave = np.sin(2 * np.pi * 0.9 * time + rng.uniform(0, 6, 3)) * liveliness_over(seconds)[:, None]
    turns = np.zeros((n, 55, 3))
    turns[:, skeleton.index("left_shoulder")] = [0.0, 0.0, -1.2] + 0.5 * wave
    turns[:, skeleton.index("right_shoulder")] = [0.0, 0.0, 1.2] + 0.5 * wave[:, ::-1]
    for joint in ("pelvis", "left_elbow", "right_elbow", "spine2", "head"):
        turns[:, skeleton.index(joint)] = (0.02 if joint == "pelvis" else 0.2) * wave
    for finger in FINGERS:
        turns[:, skeleton.index(finger), 2] = 0.4 + 0.4 * np.sin(2 * np.pi * 0.5 * time[:, 0])
    face = np.zeros((n, 100))
    face[:, 3] = 1.5 + np.sin(2 * np.pi * 0.5 * time[:, 0])
    rotations = quaternion_from_rotation_vector(turns)
    return gk.Motion(skeleton, rotations, np.tile([0, 0.93, 0], (n, 1)), 30.0, expressions=face)


def voice(seconds: float, *, lively: float | None = None, seed: int = 0) -> af.Wave:
    """Syllables whose pitch and upper harmonics rise with liveliness."""
    at = np.arange(round(seconds * RATE)) / RATE
    own = liveliness_over(seconds) if lively is None else np.full(round(seconds * 30), lively)
    level = np.interp(at, np.arange(len(own)) / 30, own)
    pitch = 110.0 + 110.0 * level
    if lively is not None:  # a voice is never monotonous
        pitch *= 1.0 + 0.08 * np.sin(2 * np.pi * 1.1 * at)
    phase = 2 * np.pi * np.cumsum(pitch) / RATE + seed
    tone = sum(np.sin(k * phase) / k ** (2 - level) for k in range(1, 16))
    syllables = np.maximum(np.sin(2 * np.pi * (2.0 + level) * at + seed), 0.0)
    return af.Wave((0.1 * syllables * tone).astype(np.float32), RATE)


@pytest.fixture(scope="session")
def recordings(tmp_path_factory):
    """A manifest of two speakers, and of a held-out recording with the arms held up."""
    where, items = tmp_path_factory.mktemp("recall"), []
    takes = (("a", 16.0, "Ann", 0), ("b", 12.0, "Bo", 1), ("c", 16.0, "Ann", 5))
    for name, seconds, speaker, seed in takes:
        files = {"audio": where / f"{name}.wav", "motion": where / f"{name}.npz"}
        split = "test" if name == "c" else "train"
        items.append(Item(id=name, duration=seconds, speaker=speaker, split=split, **files))
        motion = recording(seconds, seed)
        for side, turn in (("left", 1.3), ("right", -1.3)) if split == "test" else ():
            raised = np.tile([0.0, 0.0, turn], (motion.n_frames, 1))
            arm = motion.skeleton.index(f"{side}_shoulder")
            motion.rotations[:, arm] = quaternion_from_rotation_vector(raised)
        motion.save(files["motion"])
        soundfile.write(files["audio"], voice(seconds, seed=ord(name)).samples, RATE)
    Manifest(items).save(where / "corpus.jsonl")
    return where / "corpus.jsonl"


def settings(corpus, out, **changes) -> MultiresConfig:
    return small_config(corpus, out, SETTINGS, changes)


@pytest.fixture(scope="module")
def config(recordings, tmp_path_factory) -> MultiresConfig:
    return settings(recordings, tmp_path_factory.mktemp("run") / "run")


@pytest.fixture(scope="module")
def folder(config):
    return train(config)


@pytest.fixture(scope="module")
def model(folder):
    model = gk.load(folder)
    return replace(model, recorded_fps=model.fps)


@pytest.fixture(scope="module")
def plain(recordings, tmp_path_factory):
    """A model without recall."""
    return gk.load(train(settings(recordings, tmp_path_factory.mktemp("plain"), recall=None)))


@pytest.fixture
def speech() -> af.Wave:
    return voice(5.0, seed=3)


@pytest.fixture(scope="module")
def data(config):
    return load_training_data(config)


@pytest.fixture(scope="module")
def library(data, config):
    """Recall library of a training on the data."""
    return build_library(data, config)


def hand_speed(motion: gk.Motion) -> float:
    positions = motion.positions()
    hand = positions[:, motion.skeleton.index("left_wrist")] - positions[:, 0]
    return float(np.linalg.norm(np.diff(hand, axis=0), axis=1).mean() * motion.fps)


# The library.


def test_only_training_recordings_are_recalled(data, library, model):
    assert [item.name for item in data.paired] == ["a", "b"]
    assert [own.speaker for own in library.recordings] == ["Ann", "Bo"]
    stored = model.library.recordings
    for sequence, own, loaded in zip(data.paired, library.recordings, stored, strict=True):
        n = af.level_lengths(sequence.n_frames, 4)[LEVEL - 1]
        torch.testing.assert_close(own.motion, resample(sequence.motion[None], n)[0])
        torch.testing.assert_close(own.motion, loaded.motion, atol=0, rtol=0)
        torch.testing.assert_close(own.passive, loaded.passive, atol=0, rtol=0)
        assert own.profiles.shape == (3, n) and own.directions.shape == (4, n)
        # Movement, height, distance and width of each hand, and movement of the rest.
        assert own.states.shape == (4 + 4 + 1, n)
    # Movement of the hands is in standard deviations, but for what the level averages away.
    hands = np.concatenate([own.profiles[:2] for own in library.recordings], axis=1)
    assert hands.mean() == pytest.approx(0, abs=0.1) and 0.5 < hands.std() < 1.1
    # The held-out recording has its arms up; nobody else has.
    for seed in range(3):
        motion = model.generate(voice(4.0, seed=seed), seed=seed)
        hands = motion.positions()[:, motion.skeleton.index("left_wrist"), 1]
        shoulders = motion.positions()[:, motion.skeleton.index("left_shoulder"), 1]
        assert (hands < shoulders).all()


def test_arms_and_the_rest_are_recalled_apart(model):
    columns = np.concatenate([part.columns for part in model.library.parts])
    assert sorted(columns) == list(range(model.representation.n_features))
    left, right, rest = model.library.parts
    assert left.moving == ("left_wrist",) or left.moving == ("left_elbow",)
    assert {"left_index1", "left_elbow", "left_shoulder", "left_collar"} <= {*left.joints}
    assert "right_thumb2" in right.joints and {"pelvis", "head", "left_hip"} <= {*rest.joints}
    assert rest.moving == ("head",)
    # Finer levels keep their detail in legs, contacts and the root, which foot locking needs.
    columns = model.representation.joint_columns
    calmed = [name for name in model.representation.joints if columns(name).start in rest.calmed]
    assert {"pelvis", "spine1", "head"} <= {*calmed} and not {"left_hip", "left_knee"} & {*calmed}
    assert rest.calmed.max() < columns(model.representation.joints[-1]).stop
    names = [name for part in model.library.parts for name in part.joints]
    assert sorted(names) == sorted(model.skeleton.names)
    # The pieces of an arm are those of its fingers; the face goes with the rest.
    passive = model.library.passive.columns(model.library.parts)
    assert [[*part] for part in passive] == [[*range(6)], [*range(6, 12)], [*range(12, 112)]]
    left, _, rest = model.library.searches
    assert rest.piece == pytest.approx(2 * left.piece, abs=1) and rest.overlap >= left.overlap


def seeded(seed: int = 0):
    """Return the random generators of all parts, which have one seed."""
    return lambda _: torch.Generator().manual_seed(seed)


def features_of(model, wave: af.Wave) -> np.ndarray:
    return model.conditions.conditioner(wave).T


def places(made) -> list[list[tuple[int, int]]]:
    """Return (recording, start) of each part's pieces."""
    return [[*zip(p.recordings.tolist(), p.starts.tolist(), strict=True)] for p in made.pieces]


def chosen(model, wave: af.Wave, seed: int = 0, **options):
    """Return the places of the pieces for a sound; parts have different seeds."""
    generators = {}

    def rng_of(part: str) -> torch.Generator:
        number = seed + len(generators)
        return generators.setdefault(part, torch.Generator().manual_seed(number))

    return places(model.library.recall(features_of(model, wave), rng_of, **options))


def test_speech_seed_and_speaker_choose_the_pieces(model, speech):
    first = chosen(model, speech)
    assert chosen(model, speech) == first
    assert chosen(model, speech, seed=10) != first
    assert chosen(model, voice(5.0, lively=0.95)) != first
    for number, speaker in enumerate(("Ann", "Bo")):
        used = chosen(model, speech, speaker=speaker)
        assert {recording for part in used for recording, _ in part} == {number}
    assert chosen(model, speech, speaker="Cy") == first, "a speaker without recordings"


def test_a_speaker_with_short_recordings_only_shares_the_rest_of_the_body(model, speech):
    """Bo has pieces as long as those of the arms: the rest is chosen among Ann's."""
    ann, bo = model.library.recordings
    kept = round(1.5 * model.library.level_fps)
    rows = ("motion", "passive", "profiles", "states", "directions", "defective")
    short = replace(bo, **{name: getattr(bo, name)[:, :kept] for name in rows})
    shared = replace(model.library, recordings=(ann, short))
    features = features_of(model, speech)
    made = [places(shared.recall(features, seeded(n), speaker="Bo")) for n in range(4)]
    arms = [place for left, right, _ in made for place in left + right]
    assert {recording for recording, _ in arms} == {1}
    assert len({tuple(rest) for _, _, rest in made}) > 1, "seeds differ"


def test_styles_are_recalled_from_their_recordings(model, speech):
    ann, bo = model.library.recordings
    styled = replace(model.library, recordings=(ann, replace(bo, style=1)))
    n_level = af.level_lengths(125, 4)[LEVEL - 1]
    styles = np.zeros(n_level, int)
    styles[n_level // 2 :] = 1
    features = features_of(model, speech)[:, :125]
    made = styled.recall(features, seeded(), styles=styles)
    for pieces in made.pieces:
        assert (np.diff(pieces.recordings) >= 0).all()
        assert set(pieces.recordings) == {0, 1}

    def chosen_for(styles: np.ndarray | None, **options) -> list[tuple[int, int]]:
        return sum(places(styled.recall(features, seeded(), styles=styles, **options)), [])

    unknown = chosen_for(np.full(n_level, 7))
    assert {recording for recording, _ in unknown} == {0, 1}
    assert unknown == chosen_for(None), "a style that nobody has is any style"
    theirs = chosen_for(np.zeros(n_level, int), speaker="Bo")
    assert {recording for recording, _ in theirs} == {0}, "nobody else's style where Bo has none"


def test_movement_is_that_of_the_hands_beside_the_body(data, config, library):
    representation, n = data.representation, 60
    standing = recording(2.0, 0)
    still = replace(standing, rotations=np.tile(standing.rotations[:1], (n, 1, 1)))
    walking = replace(still, translation=still.translation + np.linspace(0, 2, n)[:, None])
    for motion in (still, walking):
        values = torch.from_numpy(representation.encode(motion).T.copy()).float()
        places = joint_places(representation, config.fps, values)
        for movement in movements(library.parts, representation.joints, config.fps, places):
            np.testing.assert_allclose(movement[5:-5], np.log(0.05), atol=0.05)


@pytest.mark.parametrize("rising", [True, False])
def test_directions_are_upwards_and_away_from_the_body(data, library, rising):
    """The left arm turns sideways, between hanging and horizontal, wherever she faces."""
    representation, standing = data.representation, recording(1.0, 0)
    turns = np.zeros((standing.n_frames, 55, 3))
    angles = np.linspace(-1.5, 0.0, 30)
    turns[:, standing.skeleton.index("left_shoulder"), 2] = angles if rising else angles[::-1]
    hand, part = standing.skeleton.index("left_wrist"), library.parts[0]
    found = []
    for heading in (0.0, 1.0):
        turns[:, 0] = [0.0, heading, 0.0]
        motion = replace(standing, rotations=quaternion_from_rotation_vector(turns))
        values = torch.from_numpy(representation.encode(motion).T.copy()).float()
        places = joint_places(representation, motion.fps, values)
        found.append(hand_directions(part, representation.joints, motion.fps, places)[:, 5:-5])
    np.testing.assert_allclose(found[0], found[1], atol=1e-3)
    x, y, z = (motion.positions()[:, hand] - motion.positions()[:, 0]).T
    for of_hand, place in zip(found[0], (y, np.hypot(x, z)), strict=True):
        speed = np.gradient(place, 1 / 30)[5:-5]
        assert ((speed > 0) == rising).all()
        expected = np.log1p(np.abs(speed) / 0.1)
        np.testing.assert_allclose(of_hand, expected if rising else -expected, atol=0.03)


def test_the_second_arm_is_chosen_to_match_the_first(library, model, speech):
    features = features_of(model, speech)
    differences = []
    for together in (0.0, 5.0):
        changed = replace(library, weights=ChoiceWeights(together=together))
        apart = []
        for seed in range(6):
            made = changed.recall(features, seeded(seed))
            directions = [own.directions for own in library.recordings]
            left, right = (p.blend(directions, made.lengths, 100) for p in made.pieces[:2])
            apart.append(float((left - right).square().mean()))
        differences.append(np.mean(apart))
    assert differences[1] < 0.7 * differences[0], differences


def test_a_library_has_the_curves_of_its_recordings(data, config, library, monkeypatch):
    """Movement relative to that of both hands; that of the trunk by the quantiles of theirs."""
    parts, joints, fps = library.parts, data.representation.joints, config.fps
    values = [data.normaliser.inverse(own.motion[None])[0] for own in data.paired]
    places = [joint_places(data.representation, fps, own) for own in values]
    moved = [np.stack(movements(parts, joints, fps, own)) for own in places]
    hands, trunk = (np.concatenate([own[k].mean(axis=0) for own in moved]) for k in ([0, 1], [2]))
    assert library.mean == pytest.approx(hands.mean())
    assert library.spread == pytest.approx(hands.std())
    shares = np.linspace(0, 1, 101)
    factors, every = [], []
    for own, at, curves in zip(library.recordings, places, moved, strict=True):
        n = own.motion.shape[1]
        curves[2] = np.interp(curves[2], np.quantile(trunk, shares), np.quantile(hands, shares))
        expected = averaged((curves - hands.mean()) / hands.std(), n)
        np.testing.assert_allclose(own.profiles, expected, atol=1e-4)
        states = [slow_states(part, joints, fps, at, row) for part, row in zip(parts, curves)]
        every.append(np.concatenate(states))
        np.testing.assert_allclose(own.states, averaged(every[-1], n), atol=1e-4)
        directions = [hand_directions(part, joints, fps, at) for part in parts[:2]]
        directions = averaged(np.concatenate(directions), n)
        found = own.directions.numpy()
        factors.append((found * directions).sum(axis=1) / (directions**2).sum(axis=1))
        np.testing.assert_allclose(found, factors[-1][:, None] * directions, atol=1e-4)
    np.testing.assert_allclose(*factors, rtol=1e-4)
    assert (np.array(factors)[:, [1, 3]] > 0.1).all(), "hands go away from the body together"
    assert library.slow_state.take == pytest.approx((16.0 + 12.0) / 2)
    whole = build_library(data, replace(config, recall=replace(config.recall, parts="body")))
    assert whole.mean == pytest.approx(library.mean)
    assert whole.spread == pytest.approx(library.spread)
    assert [own.profiles.shape[0] for own in whole.recordings] == [1, 1]
    assert whole.recordings[0].directions.shape[0] == 0
    assert build_library(data, replace(config, recall=None)) is None
    # What speech is to predict: both hands, and ranks of their slow part for each speaker.
    asked = []
    monkeypatch.setattr(
        WantedMovement,
        "fit",
        lambda *given, **about: asked.append((given, about)) or library.wanted,
    )
    build_library(data, config)
    (((speeches, movement, slow, rate, effort, smaller), about),) = asked
    assert (rate, tuple(effort)) == (25.0, (4, 5, 6))
    assert smaller == (data.conditioner.acoustic, data.conditioner.prosody)
    assert about == {"takes": [own.take for own in data.paired]}
    scores = normal_scores(every, ["Ann", "Bo"])
    for own, speech, curves, hand, score, level in zip(
        data.paired, speeches, moved, movement, scores, slow, strict=True
    ):
        np.testing.assert_array_equal(speech, own.speech)
        np.testing.assert_allclose(hand, curves[:2].mean(axis=0))
        np.testing.assert_allclose(level, score[[0, 4]].mean(axis=0))


def test_profiles_of_all_parts_have_one_distribution(library):
    """Movement that speech asks of the hands can then be asked of every part of the body."""
    profiles = torch.cat([own.profiles for own in library.recordings], dim=1)
    assert profiles.shape[0] == 3
    np.testing.assert_allclose(profiles.mean(dim=1), 0.0, atol=0.1)
    np.testing.assert_allclose(profiles.std(dim=1), 1.0, atol=0.2)


# Generated motion.


def bend(motion: gk.Motion, joint: str) -> np.ndarray:
    """Return the angles (T,) of a joint about its Z axis."""
    quaternions = motion.rotations[:, motion.skeleton.index(joint)]
    return 2 * np.arctan2(quaternions[:, 2], quaternions[:, 3])


def test_saved_and_loaded_it_gives_the_same_motion(model, folder, speech, tmp_path):
    first = model.generate(speech, seed=2)
    assert first.n_frames == 125
    model.save(tmp_path / "copy")
    assert same_weights(tmp_path / "copy", folder)
    for again in (model, gk.load(tmp_path / "copy")):
        same = again.generate(speech, seed=2, fps=25.0)
        np.testing.assert_array_equal(same.rotations, first.rotations)
        np.testing.assert_array_equal(same.translation, first.translation)
        np.testing.assert_array_equal(same.expressions, first.expressions)
    one, two = model.generate(speech, seed=2, samples=2)
    np.testing.assert_array_equal(one.rotations, first.rotations)
    assert np.abs(one.rotations - two.rotations).max() > 1e-3
    assert np.abs(model.generate(speech, seed=3).rotations - first.rotations).max() > 1e-3


def test_recall_can_be_turned_off(model, plain, speech):
    own, off = model.generate(speech), model.generate(speech, recall=False)
    assert off.n_frames == own.n_frames and np.abs(off.rotations - own.rotations).max() > 1e-2
    np.testing.assert_array_equal(model.generate(speech, recall=True).rotations, own.rotations)
    assert plain.generate(speech, recall=False, liveliness=1.0).n_frames == 150


def test_a_model_without_recall_refuses_what_needs_it(model, plain, speech):
    for some, asked, told in (
        (plain, {"recall": True}, "recall=True: .* not trained with recall"),
        (plain, {"liveliness": 1.5}, "liveliness=1.5: only models trained with recall"),
        (model, {"recall": False, "liveliness": 0.5}, "liveliness=0.5: without recall it has no"),
        (model, {"like": recording(1.0, 0), "liveliness": 0.5}, "liveliness=0.5: like sets the"),
    ):
        with pytest.raises(ModelError, match=told):
            some.generate(speech, **asked)
    with pytest.raises(ModelError, match="liveliness=1.5: only models trained with recall"):
        plain.check_controls(liveliness=1.5)


@pytest.mark.parametrize("value", [0, -1.0, float("nan"), float("inf"), "high"])
def test_a_bad_liveliness_is_one_error(model, plain, speech, value):
    for some in (model, plain):
        with pytest.raises(ModelError, match="liveliness=.*: expected a number above 0"):
            some.generate(speech, liveliness=value)


def test_more_liveliness_asks_for_more_movement_everywhere_and_gives_it(model, speech):
    searched = []

    class Spy:
        piece = model.library.searches[0].piece

        def __init__(self, search):
            self.search = search

        def choose_from_any_frame(self, rng, wanted, states, *rest, **options):
            searched.append(states[:, 0])
            return self.search.choose_from_any_frame(rng, wanted, states, *rest, **options)

    library = replace(model.library)
    library.__dict__["searches"] = tuple(map(Spy, model.library.searches))
    features = features_of(model, speech)
    speeds = []
    for amount in (0.5, 1.0, 1.5):
        library.recall(features, seeded(), liveliness=amount)
        motions = model.generate(speech, liveliness=amount, samples=5, foot_lock=False)
        speeds.append(np.mean([hand_speed(motion) for motion in motions]))
    for part in range(3):
        calm, usual, lively = searched[part::3]
        np.testing.assert_allclose(usual - calm, np.log(2))
        np.testing.assert_allclose(lively - usual, np.log(1.5))
    assert speeds[0] < 0.95 * speeds[1] and speeds[1] < speeds[2], speeds


def test_fingers_and_the_face_are_recalled(model, plain, speech):
    """They move as recorded: once in two seconds, at any rate of the output."""
    assert model.library.passive.joints == FINGERS
    made = model.generate(speech, seed=1)
    for finger in FINGERS:
        angle = bend(made, finger)
        assert -0.05 < angle.min() < 0.3 and 0.5 < angle.max() < 0.85
        assert np.abs(np.diff(angle)).max() < 0.2
    assert made.expressions.shape == (125, 100)
    smile = made.expressions[:, 3]
    assert 0.45 < smile.min() < 1.2 and 1.8 < smile.max() < 2.55
    assert (made.expressions[:, 4:] == 0).all()
    assert model.generate(speech, seed=1, fps=50.0).expressions.shape == (250, 100)
    still = plain.generate(speech)
    assert np.ptp(still.rotations[:, still.skeleton.index(FINGERS[0])], axis=0).max() < 1e-6


def test_fingers_keep_time_with_their_arm(model, speech):
    """A finger that copies its elbow in the recordings copies it in the generated motion."""
    network = copy.deepcopy(model.network)
    for weight in network.parameters():
        torch.nn.init.zeros_(weight)  # finer levels add nothing
    elbows = [model.representation.joint_columns(f"{side}_elbow") for side in ("left", "right")]
    copied = []
    for own in model.library.recordings:
        plain = model.normaliser.inverse(own.motion[None])[0]
        passive = torch.cat([*(plain[columns] for columns in elbows), own.passive[12:]])
        copied.append(replace(own, passive=passive))
    library = replace(model.library, recordings=tuple(copied))
    changed = replace(model, network=network, library=library)
    made = changed.generate(speech, seed=1)
    for finger, elbow in zip(FINGERS, ("left_elbow", "right_elbow"), strict=True):
        one, other = (made.rotations[:, made.skeleton.index(name)] for name in (finger, elbow))
        angle = 2 * np.arctan2(*one[:, [0, 3]].T), 2 * np.arctan2(*other[:, [0, 3]].T)
        assert np.ptp(angle[0]) > 0.05
        np.testing.assert_allclose(*angle, atol=0.02)


def test_no_speech_is_silence(model):
    motion = model.generate(seconds=3.0)
    assert motion.n_frames == 75 and np.isfinite(motion.rotations).all()
    for seconds in (0.04, 0.4):
        assert model.generate(seconds=seconds).n_frames == round(25 * seconds)
    assert model.generate(voice(0.3)).n_frames == 8


def test_all_other_controls_go_with_recall_and_move_fingers_and_the_face(model, speech):
    walk = RootPath(np.linspace([0.0, 0.0], [0.0, 2.0], 125), np.zeros(125), 25.0)
    walking = model.generate(speech, path=walk)
    np.testing.assert_allclose(walking.translation[-1, 2] - walking.translation[0, 2], 2, atol=0.05)

    clip = recording(2.0, 0).resample(25.0)
    kept = model.generate(speech, keep={1.0: clip})
    np.testing.assert_allclose(kept.rotations[25:75], clip.rotations, atol=1e-9)
    np.testing.assert_array_equal(kept.expressions[25:75], clip.expressions)

    coarse = model.generate(speech, levels=LEVEL, seed=4)
    assert coarse.n_frames == af.level_lengths(125, 4)[LEVEL - 1]
    edit = model.generate(speech, keyframes=coarse, keyframe_level=LEVEL, seed=4)
    coarsest = model.generate(speech, levels=1, seed=4)
    keyed = model.generate(speech, keyframes=coarsest, seed=4)
    like = model.generate(speech, like=recording(5.0, 9))
    for made in (walking, kept, edit, keyed, like, model.generate(speech, speaker="Bo")):
        assert made.n_frames == 125
        for finger in FINGERS:
            assert np.ptp(bend(made, finger)[75:]) > 0.3, finger
        assert np.ptp(made.expressions[75:, 3]) > 0.5


def test_coarse_levels_are_the_recalled_motion(model, speech):
    finest_recalled = model.generate(speech, levels=LEVEL, seed=4)
    coarser = model.generate(speech, levels=1, seed=4)
    assert coarser.n_frames < finest_recalled.n_frames
    close = finest_recalled.resample(coarser.fps, coarser.n_frames)
    turned = np.abs((close.rotations * coarser.rotations).sum(axis=-1)).min()
    assert turned > np.cos(0.15 / 2)
    known = [own.motion.T for own in model.library.recordings]
    left = model.library.parts[0].columns
    vectors = model.representation.encode(finest_recalled).T[None]
    made = model.normaliser.forward(torch.from_numpy(vectors).float())[0, left].T
    apart = (made[:, None] - torch.cat(known)[:, left]).abs().amax(dim=2).amin(dim=1)
    assert (apart < 0.01).float().mean() > 0.5


def test_finer_levels_leave_a_resting_arm_alone(model, speech):
    def arms(model) -> np.ndarray:
        motion = model.generate(speech, seed=0, foot_lock=False)
        return motion.rotations[:, [motion.skeleton.index(f"{s}_elbow") for s in ("left", "right")]]

    def changed_by_the_network(model) -> float:
        network = copy.deepcopy(model.network)
        for value in network.parameters():
            value.data += 0.3 * torch.randn(value.shape, generator=torch.Generator().manual_seed(1))
        return float(np.abs(arms(replace(model, network=network)) - arms(model)).max())

    assert changed_by_the_network(model) > 0.01
    rested = [replace(own, profiles=own.profiles - 10) for own in model.library.recordings]
    resting = replace(model, library=replace(model.library, recordings=tuple(rested)))
    assert changed_by_the_network(resting) < 1e-6


def test_the_command_line_has_the_controls(folder, speech, tmp_path, render):
    wav = tmp_path / "new.wav"
    soundfile.write(wav, speech.samples, RATE)

    def rendered(*options) -> bytes:
        done = render(folder, wav, "--fps", 25, *options)
        assert done.status == 0, done.err
        return (tmp_path / "out" / "new.bvh").read_bytes()

    own = rendered()
    assert rendered("--recall", "--liveliness", 1) == own
    assert len({own, rendered("--no-recall"), rendered("--liveliness", 0.5)}) == 3
    made = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").rglob("*")}
    for value, said in (("0", "--liveliness"), ("-1", "x>0"), ("nan", "a number above 0")):
        done = render(folder, wav, "--liveliness", value)
        assert done.status == 2 and "Traceback" not in done.err and said in done.err
    assert made == {path: path.stat().st_mtime_ns for path in (tmp_path / "out").rglob("*")}


# Times other than recorded.


def recalled(model, speech, stretch: float, seed: int = 0):
    library = replace(model.library, stretch=stretch)
    features = features_of(model, speech)
    return library, library.recall(features, seeded(seed))


def test_stretching_aligns_arms_with_the_predicted_movement(model, speech):
    asked = model.library.wanted(model.conditions.conditioner(speech).T)[0]
    together = {}
    for stretch in (0.0, 0.25):
        found = []
        for seed in range(4):
            library, motion = recalled(model, speech, stretch, seed)
            n = motion.pieces[0].n_frames
            goal = averaged(asked[None], n)[0] / library.spread
            for i, pieces in enumerate(motion.pieces[:2]):
                profiles = [own.profiles[i : i + 1] for own in library.recordings]
                own = pieces.blend(profiles, motion.lengths, n)[0].numpy()
                fast = own - slow_part(own, library.level_fps)
                found.append(np.corrcoef(fast, goal)[0, 1])
            stretched = [pieces.offsets is not None for pieces in motion.pieces]
            assert stretched == [bool(stretch)] * 2 + [False]
        together[stretch] = np.mean(found)
    assert together[0.25] > together[0.0] + 0.05, together


def test_both_arms_are_stretched_alike(model, speech):
    """A two-handed gesture stays one; the rest of the body keeps its recorded times."""
    _, motion = recalled(model, speech, 0.25)
    left, right, rest = motion.pieces
    assert left.offsets.any() and rest.offsets is None
    np.testing.assert_array_equal(left.offsets, right.offsets)


def test_joins_differ_between_seeds(model, speech):
    """Else the pieces that fit would be much the same in all of them."""
    features = features_of(model, speech)
    made = (model.library.recall(features, seeded(seed)) for seed in (*range(100), 7))
    *firsts, again = ([pieces.first for pieces in motion.pieces] for motion in made)
    for first, search in zip(np.transpose(firsts), model.library.searches, strict=True):
        assert first.min() == 0 and first.max() == search.hop - 1
    assert again == firsts[7]


def test_stretch_is_saved_with_the_model(model, speech, tmp_path):
    own = model.generate(speech, seed=1)
    other = replace(model, library=replace(model.library, stretch=0.25))
    made = other.generate(speech, seed=1)
    assert np.abs(made.rotations - own.rotations).max() > 1e-3
    other.save(tmp_path / "model")
    loaded = gk.load(tmp_path / "model")
    assert loaded.library.stretch == 0.25
    assert "arms up to 25 % faster or slower" in (tmp_path / "model/README.md").read_text("utf-8")
    model.save(tmp_path / "own")
    assert "faster" not in (tmp_path / "own/README.md").read_text("utf-8")
    np.testing.assert_array_equal(loaded.generate(speech, seed=1).rotations, made.rotations)


def test_defects_of_the_recordings_travel_with_the_model(model, speech, tmp_path):
    own = model.generate(speech, seed=1)
    recordings = model.library.recordings
    flags = [part.defective.clone() for part in recordings]
    for part, own_flags in zip(recordings, flags, strict=True):
        assert own_flags.shape == (3, part.motion.shape[-1]) and not own_flags.any()
    flags[0][:, 20:] = flags[1][:, 30:] = True
    damaged = tuple(replace(p, defective=f) for p, f in zip(recordings, flags, strict=True))
    other = replace(model, library=replace(model.library, recordings=damaged))
    made = other.generate(speech, seed=1)
    assert np.abs(made.rotations - own.rotations).max() > 1e-2
    other.save(tmp_path / "model")
    again = gk.load(tmp_path / "model").generate(speech, seed=1)
    np.testing.assert_array_equal(again.rotations, made.rotations)
    path = tmp_path / "model" / "model.safetensors"
    save_file({**weights(tmp_path / "model"), "recall.0.defective": flags[0][:1]}, path)
    with pytest.raises(ModelError, match=r"recall.0.defective"):
        gk.load(tmp_path / "model")


@pytest.mark.parametrize("value", [-0.1, 0.01, 0.9, float("nan"), "much", None])
def test_a_bad_value_in_a_model_folder_is_one_error(model, tmp_path, value):
    model.save(tmp_path)
    values = yaml.safe_load((tmp_path / "config.yaml").read_text())
    values["recall"].pop("stretch") if value is None else values["recall"].update(stretch=value)
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(values))
    with pytest.raises(ModelError, match="stretch"):
        gk.load(tmp_path)


def damaged_value(*keys: str, value: object):
    """Return a change of a value of config.yaml; None removes it."""

    def change(folder) -> None:
        config = yaml.safe_load((folder / "config.yaml").read_text())
        of = config["recall"]
        for key in keys[:-1]:
            of = of[key]
        of.pop(keys[-1]) if value is None else of.update({keys[-1]: value})
        (folder / "config.yaml").write_text(yaml.safe_dump(config))

    return change


def damaged_tensor(name: str, change):
    """Return a change of a tensor of the recall library."""

    def changed(folder) -> None:
        tensors = {key: value.clone() for key, value in weights(folder).items()}
        tensors[f"recall.{name}"] = change(tensors[f"recall.{name}"]).contiguous()
        save_file(tensors, folder / "model.safetensors")

    return changed


def with_last(value: float):
    """Return a change of a tensor's last number."""

    def change(tensor: torch.Tensor) -> torch.Tensor:
        tensor.view(-1)[-1] = value
        return tensor

    return change


DAMAGED = [
    *(
        (f"take {v}", damaged_value("slow_state", "take", value=v), "take")
        for v in (1e-9, -1.0, 0, 1e9, None)
    ),
    *(
        (f"take {v}", damaged_value("slow_state", "take", value=float(v)), "take is")
        for v in ("nan", "inf")
    ),
    ("take", damaged_value("slow_state", "take", value="much"), "much"),
    *((f"spread {v}", damaged_value("spread", value=v), "spread") for v in (0, -1.0, 1e9, None)),
    ("spread nan", damaged_value("spread", value=float("nan")), "spread is nan"),
    *(
        (f"{name} {v}", damaged_value("wanted", name, value=v), name)
        for name in ("mean_counts", "spread")
        for v in (float("nan"), -1.0, 1e9, None)
    ),
    *(
        (f"{name} short", damaged_tensor(f"slow_state.{name}", lambda t: t[..., :-1]), name)
        for name in ("explained", "mixing", "between", "width")
    ),
    *(
        (f"{name} {v}", damaged_tensor(f"slow_state.{name}", with_last(v)), f"{name} is {v}")
        for name in ("explained", "mixing", "between", "width")
        for v in (float("nan"), float("inf"), -5.0)
    ),
    *(
        (f"{name} {v}", damaged_tensor(name, with_last(v)), f"{name} has numbers that are not")
        for name in ("0.motion", "1.profiles", "0.states", "0.directions", "fast.weights", "voices")
        for v in (float("nan"), float("inf"))
    ),
    ("width 0", damaged_tensor("slow_state.width", with_last(0.0)), "width is 0"),
    ("width 1e9", damaged_tensor("slow_state.width", with_last(1e9)), "width is 1"),
    *(
        (f"directions {n}", damaged_tensor("0.directions", lambda t, n=n: t[:n]), "0.directions")
        for n in range(4)
    ),
    ("states", damaged_tensor("1.states", lambda t: t[:-1]), "1.states"),
    ("frames", damaged_tensor("1.states", lambda t: t[:, :-1]), "1.states"),
    ("level 0", damaged_value("level", value=0), "recall: level 0 of 4"),
    ("level 5", damaged_value("level", value=5), "recall: level 5 of 4"),
    *(
        (f"{name} {v}", damaged_value(name, value=v), f"recall: {name} is {v}")
        for name, v in (("mean", 10001.0), ("mean", -10001.0), ("piece", "2"), ("spread", 9e-7))
    ),
    *(
        (f"{name} {v}", damaged_value("wanted", name, value=v), f"wanted.{name} is {v}, not from 0")
        for name, v in (("mean_counts", 1.001), ("mean_counts", -0.001), ("spread", -0.001))
    ),
    *(
        (f"{name} {v}", damaged_tensor(f"slow_state.{name}", with_last(v)), f"{name} is {v}, not")
        for name, v in (
            *(("explained", -2.5), ("explained", 2.5), ("mixing", 2.5)),
            *(("between", -0.25), ("between", 1.25), ("width", 0.0625)),
        )
    ),
    *(
        (f"ahead {name}", damaged_value("ahead", 1, name, value=v), named)
        for name, v, named in (
            ("look_ahead", 1.001, "ahead.look_ahead is 1.001, not from 0 to 1"),
            ("look_ahead", -0.001, "ahead.look_ahead is -0.001"),
            ("fast_columns", [99], "live predictions do not fit"),
            ("slow_columns", [0, 1, 2, 3, 4], "live predictions do not fit"),
        )
    ),
    *(
        (f"{name} rows", damaged_tensor(name, lambda t: t[:-1]), f"recall.{name} has the shape")
        for name in ("0.motion", "1.passive", "0.profiles", "1.defective")
    ),
    ("flags", damaged_tensor("1.defective", torch.Tensor.float), "defective is torch.float32, not"),
    ("weights", damaged_tensor("slow.weights", lambda t: t[:-1]), "no 7 speech features fit"),
]


@pytest.mark.parametrize(
    ("change", "named"), [case[1:] for case in DAMAGED], ids=[c[0] for c in DAMAGED]
)
def test_a_damaged_slow_state_is_one_error(model, tmp_path, change, named):
    """It is found when the model is loaded, before anything is drawn: no hours of noise are."""
    model.save(tmp_path)
    change(tmp_path)
    with pytest.raises(ModelError, match=named):
        gk.load(tmp_path)


@pytest.mark.parametrize(("take", "width"), [(0.2, 0.5), (20 * 3600.0, 24.0)])
def test_the_shortest_and_longest_takes_are_loaded_and_drawn(model, speech, tmp_path, take, width):
    """A corpus of twenty hours may name a single take."""
    state = model.library.slow_state
    state = replace(state, take=take, width=np.full_like(state.width, width))
    other = replace(model, library=replace(model.library, slow_state=state))
    other.save(tmp_path)
    loaded = gk.load(tmp_path)
    made, again = (of.generate(speech, seed=1) for of in (other, loaded))
    assert np.isfinite(made.rotations).all()
    np.testing.assert_array_equal(made.rotations, again.rotations)


def test_the_slow_state_and_the_prediction_travel_with_the_model(model, tmp_path):
    model.save(tmp_path)
    one, other = model.library, gk.load(tmp_path).library
    for name in ("explained", "trust", "mixing", "between", "width", "take"):
        np.testing.assert_array_equal(
            getattr(one.slow_state, name), getattr(other.slow_state, name)
        )
    speech = np.random.default_rng(0).standard_normal((7, 90)).astype(np.float32)
    np.testing.assert_array_equal(one.wanted(speech), other.wanted(speech))
    assert one.wanted.summary() == other.wanted.summary()
    assert one.wanted.summary() in (tmp_path / "README.md").read_text("utf-8")


def test_retrieval_gives_recorded_frames(recordings, speech, tmp_path):
    changes = {"level": 4, "parts": "body", "overlap": 0.2}
    config = settings(recordings, tmp_path / "run", recall=changes, training=SHORT)
    model = gk.load(train(config))
    model = replace(model, recorded_fps=model.fps)
    made = model.generate(speech, foot_lock=False, smooth=0)
    known = [recording(16.0, 0).resample(25.0), recording(12.0, 1).resample(25.0)]
    joints = [made.skeleton.index(name) for name in ("left_shoulder", "right_elbow")]
    every = np.concatenate([motion.rotations[:, joints] for motion in known])
    frames = made.rotations[:, joints]
    nearest = [np.abs((frame * every).sum(axis=-1)).min(axis=1).max() for frame in frames]
    # 4 of 20 frames are cross-fades, the rest are recorded; a margin moves the grid by < a frame.
    apart = 2 * np.arccos(np.minimum(nearest, 1.0))
    assert np.mean(apart < 1e-3) > 0.7


def test_recall_without_speech(recordings, tmp_path):
    model = gk.load(train(settings(recordings, tmp_path / "run", features=None, training=SHORT)))
    assert model.library.wanted is None
    stretched = replace(model.library, stretch=0.25).recall(np.zeros((0, 90)), seeded())
    assert [pieces.offsets for pieces in stretched.pieces] == [None] * 3
    calm, usual, lively = (
        np.mean([hand_speed(m) for m in model.generate(seconds=5.0, samples=4, liveliness=amount)])
        for amount in (0.4, 1.0, 2.5)
    )
    assert calm < 0.9 * usual and lively > usual


def test_without_recall_nothing_of_it_is_stored(plain, model, folder):
    assert not [name for name in weights(plain.folder) if name.startswith("recall")]
    assert [name for name in weights(folder) if name.startswith("recall")]
    assert plain.library is None and plain.conditions.columns == [*range(7)]
    # Vocal effort for recall is not an input of the network.
    assert model.conditions.columns == [*range(4)]
    assert model.conditions.conditioner.effort == model.library.wanted.effort == (4, 5, 6)


@pytest.mark.parametrize(
    ("recall", "message"),
    [
        ({"level": 3}, "recall.level: 3 must be even"),
        ({"level": 0}, "level: 0 must be above 0"),
        ({"level": 6}, "recall.level: 6 is above network.levels 4"),
        ({"piece": 0.5}, r"recall.overlap: 0.3 must be at most half of piece \(0.5\)"),
        ({"overlap": 0}, "overlap: 0.* must be above 0"),
        ({"piece": float("nan")}, "piece: nan must be above 0"),
        ({"own_movement": 1.1}, "recall.own_movement: 1.1 must be from 0 to 1"),
        ({"stretch": 0.6}, "recall.stretch: 0.6 must be 0 or from 0.05 to 0.5"),
        ({"stretch": 0.04}, "recall.stretch: 0.04 must be 0 or"),
        ({"stretch": -0.25}, "recall.stretch: -0.25 must be 0 or"),
        ({"stretch": float("nan")}, "recall.stretch: nan must be 0 or"),
        ({"parts": "legs"}, "parts"),
        ({"pieces": 2}, "recall.pieces"),
    ],
)
def test_bad_settings_name_their_key(recall, message, tmp_path):
    with pytest.raises(ConfigError, match=message):
        settings(tmp_path / "none.jsonl", tmp_path, recall=recall)


def test_vocal_effort_alone_is_no_input_beside_recall(tmp_path):
    """Recall keeps it from the network, which would have no speech."""
    alone = {"features": {"extractors": [{"kind": "effort"}]}}
    with pytest.raises(ConfigError, match=r"features.extractors: effort alone; .* prosody"):
        settings(tmp_path / "none.jsonl", tmp_path, **alone)
    assert settings(tmp_path / "none.jsonl", tmp_path, **alone, recall=None).recall is None


def test_windows_start_from_recalled_and_from_recorded_motion(data, config, library, cache_of):
    cache = cache_of(config, data)
    cache.library = library

    def windows(first: int, kind: str):
        rng = torch.Generator().manual_seed(1)
        return getattr(cache, kind)(data.paired, 50, first, 3, rng)

    lengths = af.level_lengths(50, 4)
    below = windows(0, "random")
    assert below.coarser is None and below.recalled is None
    above = windows(LEVEL, "random")
    assert above.coarser.shape[-1] == lengths[LEVEL - 1]
    assert [level.shape[-1] for level in above.recalled] == lengths[LEVEL:]
    # Every arm has been recorded so, beside the frames of a cross-fade.
    left = library.parts[0].columns
    every = torch.cat([own.motion[left] for own in library.recordings], dim=1)
    for window in above.coarser:
        apart = (window[left].T[:, None] - every.T).abs().amax(dim=2).amin(dim=1)
        assert (apart < 1e-5).float().mean() > 0.5  # a fade takes 4 of 10 frames
    # What is recalled at finer levels is the same motion.
    finest = resample(above.recalled[-1], lengths[LEVEL - 1])
    assert float((finest - above.coarser).abs().mean()) < 0.1

    # A library without chance recalls what the window's own speech asks for. Arms' pieces begin in
    # every frame, so that chance does not decide where they do either.
    certain = replace(library.weights, chance=0.0)
    one_mood = SimpleNamespace(draw=lambda rng, n_frames, *_: np.zeros((9, n_frames)))
    cache.library = replace(library, weights=certain, piece=0.15, slow_state=one_mood)
    assert [search.hop for search in cache.library.searches[:2]] == [1, 1]
    arms = np.concatenate([part.columns for part in library.parts[:2]])
    made = windows(LEVEL, "random")
    motions = [own.motion for own in library.recordings]
    for speech, coarser in zip(made.speech[-1], made.coarser, strict=True):
        choice = cache.library.recall(speech.numpy(), lambda _: torch.Generator())
        own = choice.vectors(motions, lengths[LEVEL - 1])
        torch.testing.assert_close(coarser[arms], own[arms])

    paired = windows(LEVEL, "paired")
    assert paired.recalled is None
    finest = paired.targets[-1]
    torch.testing.assert_close(paired.coarser, resample(finest, lengths[LEVEL - 1]))


@pytest.mark.parametrize("change", [{"piece": 1.5}, {"own_movement": 0.0}])
def test_training_depends_on_the_recalled_motion(recordings, folder, tmp_path, change):
    """Levels up to the recalled one are trained as without it, the finer ones are not."""
    changed = train(settings(recordings, tmp_path / "other", recall=change))
    one, other = weights(folder), weights(changed)
    same = {name: torch.equal(one[name], other[name]) for name in one if "levels." in name}

    def level_of(name: str) -> int:
        return int(name.split("levels.")[1].split(".")[0])

    assert {level_of(name) for name in same} == set(range(4))
    assert all(same[name] for name in same if level_of(name) < LEVEL)
    assert not any(same[name] for name in same if level_of(name) >= LEVEL)


def test_a_run_with_recall_resumes_bitwise(recordings, folder, tmp_path):
    config = settings(recordings, tmp_path / "run")
    again = train(config)
    whole = (again / "model.safetensors").read_bytes()
    assert whole == (folder / "model.safetensors").read_bytes()
    checkpoints = Checkpoints(config.out / "checkpoints")
    assert checkpoints.steps()[-1] == 6
    checkpoints.path(6).unlink()
    (again / "model.safetensors").unlink()
    train(config, resume=True)
    assert (again / "model.safetensors").read_bytes() == whole


def test_training_fits_predictions_for_live_speech_and_so_does_the_command(
    folder, recordings, gesturekit, tmp_path
):
    """The same bytes, whether training adds them or `live --fit` adds them later."""
    trained = gk.load(folder)
    assert [one.look_ahead for one in trained.library.ahead] == [0.0, 0.1, 0.2, 0.4]
    for one in trained.library.ahead:
        assert one.slow.r > 0.3, "calm and lively stretches are predicted"
        assert max(one.fast_columns) < 4, "pitch and energy; vocal effort is of no use here"
    other = tmp_path / "model"
    empty = replace(trained, library=replace(trained.library, ahead=()))
    empty.save(other, notes={"Note": "kept"})
    with pytest.raises(ModelError, match="live --fit corpus.jsonl --model"):
        gk.load(other).stream(RATE)
    before = (other / "README.md").read_text().splitlines()
    assert gesturekit("live", "--fit", recordings, "--model", other).status == 0
    assert gk.load(other).fingerprint() == trained.fingerprint()
    card = (other / "README.md").read_text()
    assert [line for line in card.splitlines() if not line.startswith("- **Live")] == before
    last = max(i for i, line in enumerate(before) if line.startswith("- **"))
    assert card.splitlines()[last + 1].startswith("- **Live**: "), "after the other facts"
    assert "- **Note**: kept" in card and card.count("- **Live**: with 0, 0.1, 0.2, 0.4 s") == 1
    assert gesturekit("live", "--fit", recordings, "--model", other).status == 0
    assert (other / "README.md").read_text() == card
    sound = voice(1.0).samples
    assert gk.load(other).stream(RATE).step(sound).n_frames > 15


def test_live_predictions_are_fitted_to_what_was_known_before_each_frame(
    recordings, model, monkeypatch
):
    """Every third row of features, 2, 5, 8 ..., belongs to a frame as many rows earlier as are
    complete after the look-ahead; movement is that of both hands together, over both takes."""
    asked = []

    def fit(look_ahead, *arguments):
        asked.append((look_ahead, *arguments))
        return model.library.ahead[0]

    monkeypatch.setattr(AheadPrediction, "fit", fit)
    items = training_items(Manifest.load(recordings), recordings, with_audio=True)
    with_live_predictions(model, items)
    assert [own[0] for own in asked] == [0.0, 0.1, 0.2, 0.4]
    parts, joints, fps = model.library.parts, model.representation.joints, model.fps
    curves = []
    for name in "ab":
        motion = gk.Motion.load(recordings.parent / f"{name}.npz").resample(fps)
        values = torch.from_numpy(model.representation.encode(motion).T).float()
        places = joint_places(model.representation, fps, values)
        curves.append(np.stack(movements(parts, joints, fps, places)[:2]))
    both = [own.mean(axis=0) for own in curves]
    fast = [own - slow_part(own, fps) for own in both]
    slow = np.concatenate([np.log(slow_part(np.exp(own), fps)) for own in curves], axis=1)
    shares = (rankdata(slow, axis=1) - 0.5) / slow.shape[1]
    scores = np.split(norm.ppf(shares).mean(axis=0), [len(both[0])])
    for look_ahead, windows, own_fast, own_slow, takes, wanted, columns, rate in asked:
        # Row k is complete 0.5 / 25 + 0.032 + 0.01 s after frame k.
        ahead = math.floor((look_ahead - 0.062) * 25 + 1e-6)
        assert takes == [item.take for item in items] and wanted is model.library.wanted
        assert rate == pytest.approx(25 / 3) and all(set(own) == {0, 1, 2, 3} for own in columns)
        for known, found, states, moved, level in zip(
            windows, own_fast, own_slow, fast, scores, strict=True
        ):
            frames = [k - ahead for k in range(2, len(moved) + 30, 3)]
            frames = [frame for frame in frames if 0 <= frame < len(moved)]
            assert len(known) == len(frames) and {own.rows.shape for own in known} == {(25, 7)}
            np.testing.assert_allclose(found, moved[frames], atol=1e-4)
            np.testing.assert_allclose(states, level[frames], atol=1e-3)


def test_a_model_without_recall_gets_no_live_predictions(plain, recordings, gesturekit, tmp_path):
    plain.save(tmp_path / "plain")
    done = gesturekit("live", "--fit", recordings, "--model", tmp_path / "plain")
    assert done.status != 0 and "the model cannot stream: it needs recall" in done.err
