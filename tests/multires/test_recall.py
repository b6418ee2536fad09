"""Recall by speech, as a user sees it: training, generation, controls and the model folder."""

import copy
import shutil
from dataclasses import replace

import numpy as np
import pytest
import soundfile
import torch
import yaml
from runs import cut_off, same_weights, weights
from safetensors.torch import save_file
from small_runs import small_config

import audio_features as af
import gesturekit as gk
from gesturekit.corpus import Item, Manifest
from gesturekit.errors import ConfigError, ModelError
from gesturekit.formats import smpl_skeleton
from gesturekit.motion import RootPath, quaternion_from_rotation_vector
from gesturekit.multires import MultiresConfig, train

RATE = 16_000
FINGERS = ("left_index1", "right_thumb2")
NAN = float("nan")
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
    """Return how lively somebody is (T,) at 30 fps: calm and lively by turns of four seconds."""
    time = np.arange(round(seconds * 30)) / 30
    return 0.5 - 0.4 * np.cos(2 * np.pi * time / 8)


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


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """A manifest of two speakers, and of a held-out recording with the arms held up."""
    where, items = tmp_path_factory.mktemp("recall"), []
    takes = (("a", 9.0, "Ann", 0), ("b", 8.0, "Bo", 1), ("c", 2.5, "Ann", 5))
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
    return gk.load(
        train(settings(recordings, tmp_path_factory.mktemp("plain"), recall=None, training=SHORT))
    )


@pytest.fixture
def speech() -> af.Wave:
    return voice(5.0, seed=3)


def speed_of(motion: gk.Motion, joint: str = "left_wrist") -> float:
    """Return the mean speed of a joint beside the hips, m/s."""
    places = motion.positions()
    place = places[:, motion.skeleton.index(joint)] - places[:, 0]
    return float(np.linalg.norm(np.diff(place, axis=0), axis=1).mean() * motion.fps)


def bend(motion: gk.Motion, joint: str) -> np.ndarray:
    """Return the angles (T,) of a joint about its Z axis."""
    quaternions = motion.rotations[:, motion.skeleton.index(joint)]
    return 2 * np.arctan2(quaternions[:, 2], quaternions[:, 3])


def apart_from(recordings: list[gk.Motion], motion: gk.Motion) -> np.ndarray:
    """Return the angle (T,) between each frame's arms and those of the nearest recorded frame."""
    joints = [motion.skeleton.index(name) for name in ("left_shoulder", "right_elbow")]
    every = np.concatenate([own.rotations[:, joints] for own in recordings])
    near = [np.abs((f * every).sum(axis=-1)).min(axis=1).max() for f in motion.rotations[:, joints]]
    return 2 * np.arccos(np.minimum(near, 1.0))


def test_only_training_recordings_are_recalled(model, speech):
    """The held-out recording has its arms up; nobody else has."""
    assert [own.speaker for own in model.library.recordings] == ["Ann", "Bo"]
    for seed in range(3):
        places = model.generate(voice(4.0, seed=seed), seed=seed).positions()
        hands, shoulders = (
            places[:, model.skeleton.index(name), 1] for name in ("left_wrist", "left_shoulder")
        )
        assert (hands < shoulders).all()


def test_speech_seed_and_speaker_choose_the_motion(model, speech):
    def coarse(sound: af.Wave = speech, **asked) -> np.ndarray:
        return model.generate(sound, levels=LEVEL, **asked).rotations

    first = coarse(seed=1)
    np.testing.assert_array_equal(coarse(seed=1), first)
    np.testing.assert_array_equal(coarse(seed=1, mood_seed=1), first)
    for other in (
        coarse(seed=2),
        coarse(voice(5.0, lively=0.95), seed=1),
        coarse(seed=1, mood_seed=2),
        coarse(seed=1, item="b"),
    ):
        assert np.abs(other - first).max() > 1e-3


def test_saved_and_loaded_it_gives_the_same_motion(model, folder, speech, tmp_path):
    first = model.generate(speech, seed=2)
    assert first.n_frames == 125
    model.save(tmp_path / "copy")
    assert same_weights(tmp_path / "copy", folder)
    for again in (model, gk.load(tmp_path / "copy")):
        same = again.generate(speech, seed=2, fps=25.0)
        for part in ("rotations", "translation", "expressions"):
            np.testing.assert_array_equal(getattr(same, part), getattr(first, part))
    one, two = model.generate(speech, seed=2, samples=2)
    np.testing.assert_array_equal(one.rotations, first.rotations)
    assert np.abs(one.rotations - two.rotations).max() > 1e-3
    card = (tmp_path / "copy" / "README.md").read_text("utf-8")
    wanted = model.library.wanted
    assert f"{wanted.fast.r:.2f}" in card and f"{wanted.slow.r:.2f}" in card


def test_recall_can_be_turned_off(model, plain, speech):
    own, off = model.generate(speech), model.generate(speech, recall=False)
    assert off.n_frames == own.n_frames and np.abs(off.rotations - own.rotations).max() > 1e-2
    np.testing.assert_array_equal(model.generate(speech, recall=True).rotations, own.rotations)
    assert plain.generate(speech, recall=False, liveliness=1.0).n_frames == 150
    still = plain.generate(speech)
    assert np.ptp(still.rotations[:, still.skeleton.index(FINGERS[0])], axis=0).max() < 1e-6
    assert plain.library is None
    # The three columns of vocal effort, for recall, are no input of the network.
    assert len(plain.conditions.columns) - len(model.conditions.columns) == 3


@pytest.mark.parametrize(
    ("kind", "asked", "expected"),
    [
        ("plain", {"recall": True}, "recall=True"),
        ("plain", {"liveliness": 1.5}, "liveliness=1.5"),
        ("plain", {"mood_seed": 0}, "mood_seed=0"),
        ("model", {"recall": False, "liveliness": 0.5}, "(?=.*liveliness=0.5)(?=.*recall)"),
        ("model", {"recall": False, "mood_seed": 0}, "(?=.*mood_seed=0)(?=.*recall)"),
        ("model", {"like": 1, "liveliness": 0.5}, "(?=.*liveliness=0.5)(?=.*like)"),
        *(("model", {"liveliness": v}, f"liveliness={v!r}") for v in (0, -1.0, NAN, "high")),
        *(("model", {"mood_seed": v}, f"mood_seed={v!r}") for v in (-1, 1.5, "one", True)),
    ],
)
def test_controls_of_recall_that_make_no_sense_are_one_error(
    request, kind, asked, expected, speech
):
    asked = asked | ({"like": recording(1.0, 0)} if "like" in asked else {})
    with pytest.raises(ModelError, match=expected):
        request.getfixturevalue(kind).generate(speech, **asked)


def test_more_liveliness_gives_more_movement(model, speech):
    speeds = []
    for amount in (0.5, 1.0, 1.5):
        motions = model.generate(speech, liveliness=amount, samples=4, foot_lock=False)
        speeds.append(np.mean([speed_of(motion) for motion in motions]))
    assert speeds[0] < 0.95 * speeds[1] and speeds[1] < speeds[2], speeds


def test_fingers_and_the_face_are_recalled(model, speech):
    """They move as recorded: once in two seconds, at any rate of the output."""
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


def test_no_speech_is_silence(model):
    assert np.isfinite(model.generate(seconds=3.0).rotations).all()
    for seconds in (0.04, 0.4, 3.0):
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
    like = model.generate(speech, like=recording(5.0, 9))
    for made in (walking, kept, edit, like, model.generate(speech, speaker="Bo")):
        assert made.n_frames == 125
        for finger in FINGERS:
            assert np.ptp(bend(made, finger)[75:]) > 0.3, finger
        assert np.ptp(made.expressions[75:, 3]) > 0.5


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
    soundfile.write(wav, speech.samples[: 2 * RATE], RATE)

    def rendered(*options) -> bytes:
        render(folder, wav, "--fps", 25, *options).ok()
        return (tmp_path / "out" / "new.bvh").read_bytes()

    own = rendered()
    assert rendered("--recall", "--liveliness", 1, "--mood-seed", 0) == own
    others = [("--no-recall",), ("--liveliness", 0.5), ("--mood-seed", 4)]
    assert len({own, *(rendered(*options) for options in others)}) == 4
    for option, value in (("--liveliness", "0"), ("--liveliness", "nan"), ("--mood-seed", "-1")):
        render(folder, wav, option, value).fails(2, option.strip("-").split("-")[0])
    render(folder, wav, "--mood-seed", 3, "--no-recall").fails(2, "mood_seed=3", "recall")


def test_stretch_is_saved_with_the_model(model, speech, tmp_path):
    own = model.generate(speech, seed=1)
    other = replace(model, library=replace(model.library, stretch=0.25))
    made = other.generate(speech, seed=1)
    assert np.abs(made.rotations - own.rotations).max() > 1e-3
    other.save(tmp_path / "model")
    loaded = gk.load(tmp_path / "model")
    assert "25 %" in (tmp_path / "model/README.md").read_text("utf-8")
    np.testing.assert_array_equal(loaded.generate(speech, seed=1).rotations, made.rotations)


def test_defects_of_the_recordings_travel_with_the_model(model, speech, tmp_path):
    own = model.generate(speech, seed=1)
    recordings = model.library.recordings
    flags = [part.defective.clone() for part in recordings]
    flags[0][:, 20:] = flags[1][:, 30:] = True
    damaged = tuple(replace(p, defective=f) for p, f in zip(recordings, flags, strict=True))
    other = replace(model, library=replace(model.library, recordings=damaged))
    made = other.generate(speech, seed=1)
    assert np.abs(made.rotations - own.rotations).max() > 1e-2
    other.save(tmp_path / "model")
    again = gk.load(tmp_path / "model").generate(speech, seed=1)
    np.testing.assert_array_equal(again.rotations, made.rotations)


def value_of(*keys: str, value: object):
    """Return a change of a value of config.yaml's `recall`; None removes it."""

    def change(folder) -> None:
        config = yaml.safe_load((folder / "config.yaml").read_text())
        of = config["recall"]
        for key in keys[:-1]:
            of = of[key]
        of.pop(keys[-1]) if value is None else of.update({keys[-1]: value})
        (folder / "config.yaml").write_text(yaml.safe_dump(config))

    return change


def tensor_of(name: str, change):
    """Return a change of a tensor of the recall library; a number becomes its last one."""

    def changed(folder) -> None:
        tensors = {key: value.clone() for key, value in weights(folder).items()}
        own = tensors[f"recall.{name}"]
        if callable(change):
            tensors[f"recall.{name}"] = change(own).contiguous()
        else:
            own.view(-1)[-1] = change
        save_file(tensors, folder / "model.safetensors")

    return changed


DAMAGED = [
    *((value_of("slow_state", "take", value=v), "take") for v in (1e-9, NAN)),
    (value_of("slow_state", "take", value="much"), "much"),
    *((value_of("spread", value=v), "spread") for v in (0.0, NAN)),
    *((value_of("stretch", value=v), "stretch") for v in (0.9, "much")),
    (value_of("mean", value=1e6), "mean"),
    *((value_of("level", value=v), rf"level\W+{v}\b") for v in (0, 5)),
    (value_of("piece", value="2"), "piece"),
    *((value_of("wanted", "mean_counts", value=v), "mean_counts") for v in (2.0, None)),
    (value_of("wanted", "spread", value=1e9), "wanted.spread"),
    (value_of("ahead", 1, "look_ahead", value=9.0), "look_ahead"),
    (value_of("ahead", 1, "fast_columns", value=[99]), "live"),
    (tensor_of("slow_state.width", lambda t: t[..., :-1]), "width"),
    *((tensor_of(f"slow_state.{k}", -5.0), k) for k in ("mixing", "width")),
    *((tensor_of(name, NAN), name) for name in ("0.motion", "fast.weights")),
    *((tensor_of(name, lambda t: t[:-1]), name) for name in ("0.motion", "1.passive")),
    (tensor_of("1.defective", torch.Tensor.float), "(?=.*1.defective)(?=.*float32)"),
    (tensor_of("slow.weights", lambda t: t[:-1]), "7 speech"),
]


@pytest.mark.parametrize(("change", "named"), DAMAGED)
def test_a_damaged_library_is_one_error(folder, tmp_path, change, named):
    """It is found when the model is loaded, before anything is drawn: no hours of noise are."""
    damaged = shutil.copytree(folder, tmp_path / "damaged")
    change(damaged)
    with pytest.raises(ModelError, match=named):
        gk.load(damaged)


def test_retrieval_gives_recorded_frames(recordings, speech, tmp_path):
    changes = {"recall": {"parts": "body", "overlap": 0.2}, "network": {"levels": 2}}
    model = gk.load(train(settings(recordings, tmp_path / "run", **changes, training=SHORT)))
    made = model.generate(speech, foot_lock=False, smooth=0, fps=model.fps)
    known = [recording(16.0, 0).resample(25.0), recording(12.0, 1).resample(25.0)]
    # 4 of 20 frames are cross-fades, the rest are recorded; a margin moves the grid by < a frame.
    assert np.mean(apart_from(known, made) < 1e-3) > 0.7
    # A speaker's motion is made of their own recordings, others' of anybody's.
    for speaker, own, other in (("Ann", *known), ("Bo", *known[::-1])):
        theirs = model.generate(speech, foot_lock=False, smooth=0, fps=model.fps, speaker=speaker)
        assert np.mean(apart_from([own], theirs) < 1e-3) > 0.7
        assert np.mean(apart_from([other], theirs) < 1e-3) < 0.1
    unknown = model.generate(speech, foot_lock=False, smooth=0, fps=model.fps, speaker=None)
    np.testing.assert_array_equal(unknown.rotations, made.rotations)


@pytest.mark.stress
def test_recall_without_speech(recordings, tmp_path):
    model = gk.load(train(settings(recordings, tmp_path / "run", features=None, training=SHORT)))
    assert model.library.wanted is None
    calm, usual, lively = (
        np.mean([speed_of(m) for m in model.generate(seconds=5.0, samples=4, liveliness=amount)])
        for amount in (0.4, 1.0, 2.5)
    )
    assert calm < 0.9 * usual and lively > usual


@pytest.mark.parametrize(
    ("recall", "message"),
    [
        ({"level": 3}, r"(?=.*recall.level)(?=.*\b3\b)(?=.*even)"),
        ({"piece": 0.5}, "(?=.*recall.overlap)(?=.*0.3)(?=.*0.5)"),
        ({"overlap": 0}, "recall.overlap"),
        ({"own_movement": 2}, "recall.own_movement"),
        ({"stretch": 0.9}, "(?=.*recall.stretch)(?=.*0.9)(?=.*0.5)"),
        ({"pieces": 2}, "recall.pieces"),
    ],
)
def test_bad_settings_name_their_key(recall, message, tmp_path):
    with pytest.raises(ConfigError, match=message):
        settings(tmp_path / "none.jsonl", tmp_path, recall=recall)


def test_vocal_effort_alone_is_no_input_beside_recall(tmp_path):
    """Recall keeps it from the network, which would have no speech."""
    alone = {"features": {"extractors": [{"kind": "effort"}]}}
    with pytest.raises(ConfigError, match="(?=.*features.extractors)(?=.*effort)(?=.*prosody)"):
        settings(tmp_path / "none.jsonl", tmp_path, **alone)
    assert settings(tmp_path / "none.jsonl", tmp_path, **alone, recall=None).recall is None


@pytest.mark.stress
def test_training_depends_on_the_recalled_motion(recordings, folder, tmp_path):
    """Levels up to the recalled one are trained as without it, the finer ones are not."""
    changed = train(settings(recordings, tmp_path / "other", recall={"piece": 1.5}))
    one, other = weights(folder), weights(changed)
    same = {name: torch.equal(one[name], other[name]) for name in one if "levels." in name}
    fine = [int(name.split("levels.")[1].split(".")[0]) >= LEVEL for name in same]
    assert any(fine) and not all(fine)
    assert [not own for own in same.values()] == fine


@pytest.mark.stress
def test_a_run_with_recall_resumes_bitwise(config, folder):
    whole = (folder / "model.safetensors").read_bytes()
    cut_off(config.out, 6)
    assert (train(config, resume=True) / "model.safetensors").read_bytes() == whole


@pytest.mark.stress
def test_training_fits_predictions_for_live_speech_and_so_does_the_command(
    folder, plain, recordings, gesturekit, tmp_path
):
    """The same bytes, whether training adds them or `live --fit` adds them later."""
    trained = gk.load(folder)
    assert len(trained.library.ahead) > 1
    for one in trained.library.ahead:
        assert one.slow.r > 0.3, "calm and lively stretches are predicted"
        assert max(one.fast_columns) < 4, "pitch and energy; vocal effort is of no use here"
    other = tmp_path / "model"
    empty = replace(trained, library=replace(trained.library, ahead=()))
    empty.save(other, notes={"Note": "kept"})
    with pytest.raises(ModelError, match="live --fit"):
        gk.load(other).stream(RATE)
    before = (other / "README.md").read_text().splitlines()
    cards = set()
    for _ in range(2):
        gesturekit("live", "--fit", recordings, "--model", other).ok()
        assert gk.load(other).fingerprint() == trained.fingerprint()
        cards.add((other / "README.md").read_text())
        assert len(cards) == 1 and set(before) < set(max(cards).splitlines())
    assert gk.load(other).stream(RATE).step(voice(1.0).samples).n_frames > 15
    plain.save(tmp_path / "plain")
    done = gesturekit("live", "--fit", recordings, "--model", tmp_path / "plain")
    assert done.status != 0 and "recall" in done.err
