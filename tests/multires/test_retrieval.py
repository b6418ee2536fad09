"""Recorded motion that a model plays: fingers and faces, or whole bodies."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import soundfile
import torch
import yaml
from runs import same_weights, weights
from safetensors.torch import load_file, save_file
from small_runs import small_config
from speakers import RATE, SETTINGS, assert_played, recording, voice

import gesturekit as gk
from gesturekit.errors import ConfigError, ModelError
from gesturekit.motion.face import smplx_face, smplx_names
from gesturekit.motion.root_path import RootPath
from gesturekit.motion.rotations import quaternion_from_rotation_vector, rotation_angles
from gesturekit.multires import load_training_data, train
from gesturekit.multires.retrieval import (
    PassiveChannels,
    PieceSequence,
    RecordedLibrary,
    RecordedMotion,
    played_pieces,
)
from gesturekit.multires.training.state import TrainingState
from gesturekit.training.seeds import rng_for

# Pieces of whole bodies: 20 frames, of which 4 are a cross-fade from the one before.


def library_of(*states, channels=None, speakers=None, styles=None) -> RecordedLibrary:
    """Recordings with these states (T,) and channels (X, T), a millionth of the frame's number by
    default, counted across all of them: by so little, they are all alike."""
    first = np.cumsum([0, *map(len, states)])
    parts = []
    for k, state in enumerate(states):
        count = 1e-6 * np.arange(first[k], first[k] + len(state))[None]
        rows = state[None], count if channels is None else channels[k], np.empty((0, len(state)))
        about = speakers[k] if speakers else None, styles[k] if styles else 0
        parts.append(RecordedMotion(*map(torch.FloatTensor, rows), *about))
    return RecordedLibrary(10.0, PassiveChannels(), tuple(parts))


def shown(library: RecordedLibrary, state, seed=0, speaker=None, styles=None) -> np.ndarray:
    """Return what is played for a state (T,): the number of each frame, or (T, X) channels."""
    rows = np.array(state, float)[None]
    pieces = played_pieces(library, rows, lambda k: rng_for(seed, k), speaker, styles)
    values = pieces.values(np.arange(len(state)))
    return values if values.shape[1] > 1 else 1e6 * values[:, 0]


def test_pieces_are_those_with_the_nearest_state():
    """The first recording is calm, the second one lively from its middle on."""
    library = library_of(np.zeros(200), np.repeat([0.0, 1.0], 100))
    found = shown(library, np.repeat([0.0, 1.0, 0.0], 100))
    assert (found[:80] < 300).all() and (found[220:] < 300).all()
    assert (found[120:180] >= 300).all()


def test_pieces_go_on_from_what_is_shown():
    """Two channels that go round: where the next piece is elsewhere, a cross-fade is near 0."""
    turn = 2 * np.pi * np.arange(600) / 37
    library = library_of(np.zeros(600), channels=[np.stack([np.sin(turn), np.cos(turn)])])
    radius = np.linalg.norm(shown(library, np.zeros(400)), axis=1)
    assert radius.min() > 0.7


@pytest.mark.parametrize(
    ("speaker", "style", "expected"),
    [
        ("Bo", None, {1}),
        ("Cy", None, {0, 1, 2}),  # nobody's
        ("Di", None, {0, 1, 2}),  # shorter than a piece
        (None, 1, {2}),
        ("Ann", 1, {2}),
        ("Bo", 1, {2}),  # only Ann's
        ("Bo", 7, {1}),
    ],
)
def test_pieces_have_the_speaker_and_style_if_there_are_any(speaker, style, expected):
    about = {"speakers": ("Ann", "Bo", "Ann", "Di"), "styles": (0, 0, 1, 2)}
    library = library_of(*[np.zeros(n) for n in (100, 100, 100, 9)], **about)
    asked = speaker, None if style is None else np.full(200, style)
    found = np.concatenate([shown(library, np.zeros(200), seed, *asked) for seed in range(8)])
    assert {*(found.round() // 100)} == expected


def test_pieces_follow_a_style_that_changes():
    library = library_of(np.zeros(200), np.zeros(200), styles=(1, 0))
    found = shown(library, np.zeros(200), styles=np.repeat([0, 1], 100))
    assert (found[:80] >= 200).all() and (found[120:] < 200).all()


def test_seeds_choose_other_pieces_which_begin_elsewhere():
    """The motion begins inside the first piece, so that pieces meet elsewhere too."""
    library = library_of(np.zeros(300))
    one, again, other = (shown(library, np.zeros(90), seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    assert np.abs(one - other).max() > 1
    single = library_of(np.zeros(20))
    begun = {round(shown(single, np.zeros(5), seed)[0]) for seed in range(30)}
    assert len(begun) > 8 and begun <= set(range(16))


def test_what_was_just_shown_is_not_repeated_at_once():
    """There are 81 pieces in 100 frames; two of them overlap in 43 of 100 cases."""
    library, together = library_of(np.zeros(100)), []
    for seed in range(10):
        begun = PieceSequence(library, lambda k, seed=seed: rng_for(seed, k), None, None).next_frame
        starts = shown(library, np.zeros(200), seed)[begun + 16 + 8 :: 16]
        together += (np.abs(np.diff(starts)) < 20).tolist()
    assert np.mean(together) < 0.15


def test_pieces_fade_linearly_into_one_another():
    """From a recording of 8 to one of 0 in four frames, in the middle of each: 7/8, 5/8, ..."""
    ones = [np.full((1, 20), 8e-6), np.zeros((1, 20))]
    library = library_of(np.zeros(20), np.ones(20), channels=ones)
    pieces = PieceSequence(library, lambda k: rng_for(0, k), None, None)
    pieces.choose(np.zeros((1, 20)))
    border = pieces.next_frame
    pieces.choose(np.ones((1, 3)))  # its end is held
    found = 1e6 * pieces.values(np.arange(border - 2, border + 6))[:, 0]
    np.testing.assert_allclose(found, [8, 8, 7, 5, 3, 1, 0, 0], atol=1e-4)


@pytest.mark.parametrize("lengths", [(1,), (1, 3), (7, 5)])
def test_recordings_shorter_than_a_piece_are_played_over_and_over(lengths):
    library = library_of(*map(np.zeros, lengths))
    found = shown(library, np.zeros(50))
    first = sum(lengths[: np.argmax(lengths)])
    assert found.min() >= first - 1e-3 and found.max() < first + max(lengths)


# A model of two speakers.


@pytest.fixture(scope="module")
def speech():
    return voice(5.0, seed=3)


def test_fingers_and_the_face_are_those_of_recordings(state_model, speech):
    made = state_model.generate(speech, seed=1)
    assert made.n_frames == 150 and made.face.values.shape == (150, 100)
    assert_played(made)
    assert (made.face.values[:, 6:] == 0).all()
    assert_played(state_model.generate(speech, seed=1, fps=60.0))
    for speaker, mark in (("Ann", 1.0), ("Bo", -1.0)):
        own = state_model.generate(speech, seed=1, speaker=speaker)
        np.testing.assert_allclose(own.face.values[:, 5], mark, atol=1e-6)
    for other in (state_model.generate(speech, seed=2), *state_model.generate(speech, samples=2)):
        assert np.abs(other.face.values - made.face.values).max() > 0.1
    for seconds in (0.04, 3.0):
        assert len(state_model.generate(seconds=seconds).face.values) == round(30 * seconds)


def test_a_face_by_rules_replaces_a_recorded_one_only_if_asked_for(
    state_model, state_folder, speech, gesturekit, tmp_path
):
    recorded, ruled = (state_model.generate(speech, seed=1, face=way) for way in ("off", "energy"))
    assert (recorded.face.origin, ruled.face.origin) == ("recorded", "rules")
    np.testing.assert_array_equal(ruled.rotations, recorded.rotations)
    soundfile.write(tmp_path / "a.wav", speech.samples, speech.sample_rate)
    out = tmp_path / "take.npz"
    where = ("--from", tmp_path / "a.wav", "--fast", "--to", f"record:{out}")
    gesturekit("live", "--model", state_folder, *where).ok()
    assert gk.Motion.load(out).face.origin == "recorded"


def test_saved_and_loaded_it_gives_the_same_motion(state_model, state_folder, speech, tmp_path):
    first = state_model.generate(speech, seed=2)
    state_model.save(tmp_path / "copy")
    assert same_weights(tmp_path / "copy", state_folder)
    again = gk.load(tmp_path / "copy").generate(speech, seed=2)
    for part in ("rotations", "translation"):
        np.testing.assert_array_equal(getattr(again, part), getattr(first, part))
    np.testing.assert_array_equal(again.face.values, first.face.values)


def test_all_controls_move_fingers_and_the_face(state_model, speech):
    walk = RootPath(np.linspace([0.0, 0.0], [0.0, 2.0], 150), np.zeros(150), 30.0)
    walking = state_model.generate(speech, path=walk)
    assert np.ptp(walking.translation[:, 2]) == pytest.approx(2, abs=0.05)
    clip = recording(2.0, 0)
    kept = state_model.generate(speech, keep={1.0: clip})
    np.testing.assert_allclose(kept.rotations[30:90], clip.rotations, atol=1e-9)
    np.testing.assert_array_equal(kept.face.values[30:90], clip.face.values)
    ruled = replace(clip, face=replace(clip.face, origin="rules"))
    origins = [state_model.generate(speech, keep={1.0: c}).face.origin for c in (clip, ruled)]
    assert origins == ["recorded", "rules"]
    coarse = state_model.generate(speech, levels=2, seed=4)
    others = (
        {"keyframes": coarse, "keyframe_level": 2, "seed": 4},
        {"like": recording(5.0, 9)},
        {"state": state_model.state(clip)},
        {"liveliness": 0.5},
    )
    for made in (walking, kept, *(state_model.generate(speech, **asked) for asked in others)):
        assert_played(made, slice(92, None))


@pytest.mark.parametrize(
    ("name", "change", "named"),
    [
        ("recorded.0.state", lambda t: t[:-1], "recorded.0.state"),
        ("recorded.1.passive", lambda t: t[:, :-1], "recorded.1.passive"),
        ("recorded.1.passive", lambda t: t * torch.nan, "recorded.1.passive"),
        (None, lambda r: r["passive"]["joints"].append("tail"), "tail"),
        (None, lambda r: r["recordings"].append(["Ann", 0]), "recorded.2"),
        (None, lambda r: r["recordings"].clear(), "the model is damaged"),
    ],
)
def test_a_damaged_folder_is_one_error(state_folder, tmp_path, name, change, named):
    damaged = shutil.copytree(state_folder, tmp_path / "damaged")
    tensors, about = weights(damaged), damaged / "config.yaml"
    values = yaml.safe_load(about.read_text())
    if name is None:
        change(values["recorded"])
    else:
        tensors[name] = change(tensors[name]).contiguous()
    about.write_text(yaml.safe_dump(values))
    save_file(tensors, damaged / "model.safetensors")
    with pytest.raises(ModelError, match=named):
        gk.load(damaged)


@pytest.mark.parametrize(
    ("retrieval", "fps", "starts", "lengths"),
    [(False, 1.0, (55, 49), (159, 141)), (True, 1 / 6, (82, 73), (106, 94))],
)
def test_of_a_long_corpus_a_share_of_each_recording_is_kept(
    speakers, tmp_path, retrieval, fps, starts, lengths
):
    """As if 9 and 8 s were longer: 300 of 510 s of fingers, 1200 of 3060 s of whole bodies."""
    config = replace(small_config(speakers, tmp_path / "run", SETTINGS), retrieval=retrieval)
    data = load_training_data(config)
    state = TrainingState(data, config)
    whole, state.config = state.library(), replace(config, fps=fps)
    cut = state.library()
    for own, every, first, n in zip(cut.recordings, whole.recordings, starts, lengths, strict=True):
        for name in ("motion", "passive", "state"):
            assert torch.equal(getattr(own, name), getattr(every, name)[:, first : first + n])


# Whole bodies, without a network.

BASELINE = {"retrieval": True, "network": {"levels": 2}, "training": {"first_stage": 1}}


@pytest.fixture(scope="module")
def baseline(speakers, tmp_path_factory):
    run = tmp_path_factory.mktemp("retrieval") / "run"
    return gk.load(train(small_config(speakers, run, SETTINGS, BASELINE)))


def test_retrieval_plays_recorded_frames(baseline, speech):
    own = {"Ann": recording(9.0, 0, 1.0), "Bo": recording(8.0, 1, -1.0)}
    joints = [baseline.skeleton.index(name) for name in ("left_shoulder", "right_elbow", "head")]

    def recorded(motion, speakers) -> float:
        """The share of frames that are some frame of these speakers."""
        every = np.concatenate([own[name].rotations[:, joints] for name in speakers])
        near = [np.abs((f * every).sum(axis=-1)).min(axis=1).max() for f in motion]
        return np.mean(2 * np.arccos(np.minimum(near, 1.0)) < 2e-3)

    for speaker in (None, "Ann", "Bo"):
        made = baseline.generate(speech, foot_lock=False, smooth=0, speaker=speaker)
        assert recorded(made.rotations[:, joints], own if speaker is None else [speaker]) > 0.6
        assert_played(made)
    np.testing.assert_array_equal(*baseline.state_process.response)  # no network was calibrated


def test_the_card_says_what_makes_the_motion(baseline, state_model, tmp_path):
    for name, model, wanted in (("a", baseline, "recordings"), ("b", state_model, "the network")):
        model.save(tmp_path / name)
        card = (tmp_path / name / "README.md").read_text()
        (row,) = (line for line in card.splitlines() if line.startswith("- **Moved by**"))
        assert row.split(": ", 1)[1].startswith(wanted)
    stored = load_file(tmp_path / "b" / "model.safetensors")
    motion = [tensor for name, tensor in stored.items() if name.endswith(".motion")]
    assert motion and not any(len(tensor) for tensor in motion), "no recorded body"


def test_retrieval_takes_no_controls_of_levels_and_no_live_speech(baseline, speakers, tmp_path):
    clip = recording(1.0, 0)
    asked = {"levels": 1, "keep": {0.0: clip}, "level_speech": {"1": voice(1.0)}}
    for name, value in (asked | dict.fromkeys(("keyframes", "like", "path"), clip)).items():
        with pytest.raises(ModelError, match=name):
            baseline.generate(seconds=1.0, **{name: value})
    with pytest.raises(ModelError, match="stream"):
        baseline.stream(RATE)
    with pytest.raises(ConfigError, match="(?=.*retrieval)(?=.*state)"):
        plain = {"state": False, "losses": {"state": 0.0}}
        small_config(speakers, tmp_path, SETTINGS, BASELINE, plain)


# Joints and coefficients that are not modelled.
@pytest.mark.parametrize(("size", "moves"), [(0.005, False), (0.05, True)])
def test_joints_that_hardly_move_are_no_passive_channels(gesture, size, moves):
    """Six numbers of a rotation of a radian change by about as much as a sine, rms 0.7."""
    motion = gesture(3.0)
    modelled = [name for name in motion.skeleton.names if "Hand" not in name]
    motion.rotations[:, motion.skeleton.index("RightHand")] = [0, 0, 0, 1]
    turn = size * np.sin(6 * motion.times)[:, None] * [1.0, 0.0, 0.0]
    motion.rotations[:, motion.skeleton.index("LeftHand")] = quaternion_from_rotation_vector(turn)
    found = PassiveChannels.find([motion], modelled)
    assert found.joints == (("LeftHand",) if moves else ()) and not found.face
    faced = replace(motion, face=smplx_face(np.zeros((motion.n_frames, 10))))
    wider = replace(motion, face=smplx_face(np.zeros((motion.n_frames, 50))))
    assert PassiveChannels.find([faced, faced], modelled).face == smplx_names(10)
    ruled = replace(motion, face=replace(faced.face, origin="rules"))
    for other in (wider, motion, ruled):
        assert not PassiveChannels.find([faced, other], modelled).face
    assert not PassiveChannels.find([ruled], modelled).face


@pytest.mark.parametrize("n_frames", [5, 1030])
def test_passive_channels_come_back_as_they_were(gesture, n_frames):
    motion = gesture(n_frames / 30)
    motion = replace(motion, face=smplx_face(np.random.default_rng(0).random((n_frames, 4))))
    passive = PassiveChannels(("LeftHand", "RightHand"), smplx_names(4))
    values = passive.encode(motion)
    blank = motion.rotations.copy()
    blank[:, [motion.skeleton.index(name) for name in passive.joints]] = [0, 0, 0, 1]
    made = passive.applied(replace(motion, rotations=blank, face=None), lambda part: values[part])
    assert rotation_angles(made.rotations, motion.rotations).max() < 1e-3
    np.testing.assert_allclose(made.face.values, motion.face.values, atol=1e-6)
