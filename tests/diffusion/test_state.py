"""The state of movement in a diffusion model: measured, drawn, given, and guided on apart."""

import shutil
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from runs import cut_off, same_weights
from safetensors.torch import load_file
from small_runs import small_diffusion

import audio_features as af
import gesturekit as gk
from gesturekit.corpus import Manifest
from gesturekit.diffusion import train
from gesturekit.diffusion.losses import state_distance
from gesturekit.diffusion.motion_vector import VectorPlaces, measured_state
from gesturekit.diffusion.training.batches import Batches
from gesturekit.diffusion.training.loading import load_training_data
from gesturekit.errors import ConfigError, ModelError
from gesturekit.state.process import StateProcess
from gesturekit.training.seeds import rng_for

FILE = "model.safetensors"
DROPPED = {"dropout_condition": 0.4, "dropout_state": 0.4, "state": 0.1}
SETTINGS = {
    "state": True,
    "features": {"extractors": [{"kind": "prosody"}]},
    "training": DROPPED,
    "noise": {"predict": "clean"},
    "checkpoint_every": 2,
}


@pytest.fixture(scope="module")
def config(corpus, tmp_path_factory):
    return small_diffusion(corpus, tmp_path_factory.mktemp("state") / "run", SETTINGS)


@pytest.fixture(scope="module")
def folder(config):
    return train(config)


@pytest.fixture(scope="module")
def model(folder) -> gk.Model:
    """A model whose predictions depend on its conditions: six updates teach nothing."""
    loaded = gk.load(folder)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        torch.nn.init.normal_(loaded.network.leave.weight, std=0.3)
    return loaded


def made(model: gk.Model, **options) -> np.ndarray:
    """Rotations of two seconds of silence, as sampled."""
    options = {"seconds": 2.0, "seed": 1, "raw": True, **options}
    return model.generate(**options).rotations


def test_recordings_show_what_their_state_says(config):
    """Measured in each recording and mirrored copy, in standard deviations from the mean."""
    data = load_training_data(config)
    process, columns = data.state_process, data.conditions.columns["state"]
    given = np.concatenate([own.condition[:, columns] for own in data.recordings])
    assert columns.stop == given.shape[1] + columns.start == data.conditions.width
    assert 0.1 < np.abs(given).mean() < 3 and np.isfinite(given).all()
    plain, mirrored = data.recordings[0], data.recordings[len(data.recordings) // 2]
    assert mirrored.name == f"{plain.name} (mirrored)"
    names = process.channels.names
    left, right = (names.index(f"{side} movement") for side in ("left", "right"))

    def movement(recording, which: int) -> np.ndarray:
        own = recording.condition[:, columns][:, which]
        return own * process.scale[which] + process.mean[which]

    np.testing.assert_allclose(movement(plain, left), movement(mirrored, right), atol=0.05)
    assert np.abs(movement(plain, left) - movement(plain, right)).max() > 0.1


def test_the_state_and_all_else_are_dropped_apart(config):
    data = load_training_data(config)
    batch = Batches(data, replace(config, training=replace(config.training, batch=200)))
    condition = batch.draw(0, slice(200)).condition
    state = condition[..., data.conditions.columns["state"]].abs().sum(dim=(1, 2)) > 0
    speech = condition[..., data.conditions.columns["speech"]].abs().sum(dim=(1, 2)) > 0
    for kept, share in ((state, 0.6), (speech, 0.6), (state & speech, 0.36)):
        assert float(kept.float().mean()) == pytest.approx(share, abs=0.1)


def test_the_loss_is_the_distance_of_what_is_shown(config):
    """In standard deviations of the recordings; nothing for the recording itself."""
    data = load_training_data(config)
    distance = partial(state_distance, VectorPlaces(data.representation), data.state_process)
    own = torch.from_numpy(data.recordings[0].motion[:60])[None]
    mean = data.normaliser.mean
    calmer = mean + 0.5 * (own - mean)
    assert float(distance(own, own)) == 0
    process = data.state_process
    apart = [
        measured_state(part[0].numpy(), data.representation, process.channels, process.fps)
        for part in (calmer, own)
    ]
    away = np.abs(apart[0] - apart[1]) / process.scale[:, None]
    expected = np.where(process.channels.fast, 4, 1) @ away.mean(axis=1) / len(away)
    assert float(distance(calmer, own)) == pytest.approx(expected, rel=1e-3)


def test_the_loss_changes_what_is_learnt(config, folder, tmp_path):
    without = replace(config, out=tmp_path, training=replace(config.training, state=0.0))
    learnt, other = load_file(folder / FILE), load_file(train(without) / FILE)
    assert not torch.equal(learnt["network.leave.weight"], other["network.leave.weight"])


def test_what_the_model_shows_decides_what_is_asked(config, folder):
    """A model of six updates hardly moves: more is asked of it than it is to show."""
    recorded, asked = gk.load(folder).state_process.response
    fitted = load_training_data(config).state_process.response
    np.testing.assert_allclose(recorded, fitted[0], atol=1e-5)
    movement = gk.load(folder).state_process.channels.movement
    assert (asked - recorded)[movement].mean() > 0.1
    assert np.abs(fitted[1] - fitted[0]).max() == 0


def test_a_motion_is_made_of_seed_mood_and_liveliness(model):
    usual = made(model)
    np.testing.assert_array_equal(usual, made(model, mood_seed=1))
    for options in ({"seed": 2}, {"mood_seed": 2}, {"liveliness": 1.5}, {"item": "b"}):
        assert not np.allclose(usual, made(model, **options)), options
    one, two = model.generate(seconds=2, seed=1, raw=True, samples=2, batch=2)
    np.testing.assert_allclose(one.rotations, usual, atol=1e-4)
    assert not np.allclose(two.rotations, usual)


def test_a_long_motion_is_made_in_tiles_of_the_same_state(model):
    whole, tiled = made(model), made(replace(model, window=40))
    other = made(model, mood_seed=2)
    assert np.abs(whole - tiled).max() < 0.1 * np.abs(whole - other).max()


def test_a_state_can_be_measured_changed_and_given(model, gesture, tmp_path):
    state = model.state(gesture(2.0))
    assert state.shape == (2 * model.fps, len(model.state_process.channels.names))
    np.save(tmp_path / "state.npy", state)
    given = made(model, state=state)
    np.testing.assert_array_equal(given, made(model, state=tmp_path / "state.npy", mood_seed=None))
    assert not np.allclose(given, made(model, state=state + 1.0))
    # A motion to redo has its own state.
    redone = made(model, like=gesture(2.0), change=1.0)
    same = made(model, like=gesture(2.0), change=1.0, state=state)
    np.testing.assert_allclose(redone, same, atol=1e-6)


def test_guidance_on_the_state_and_on_the_speech_are_apart(model, corpus):
    """Each is linear in the network's predictions: 1 is the plain model, 0 leaves a part out."""
    rng = np.random.default_rng(0)
    state = rng.standard_normal((60, len(model.state_process.channels.names)))

    def of(sound: np.ndarray, **options) -> np.ndarray:
        return made(model, speech=sound, sample_rate=16_000, seconds=None, **options)

    wave = af.Wave.load(next(iter(Manifest.load(corpus))).audio).resample(16_000)
    one, other = wave.samples[:32_000], wave.samples[31_999::-1].copy()
    usual = of(one, state=state)
    both = of(one, state=state, guidance=1.0, state_guidance=1.0)
    np.testing.assert_allclose(both, usual, atol=1e-5)
    deaf = of(one, state=state, guidance=0.0)
    np.testing.assert_allclose(deaf, of(other, state=state, guidance=0.0), atol=1e-5)
    free = of(one, state=state, state_guidance=0.0)
    np.testing.assert_allclose(free, of(one, state=state + 1, state_guidance=0.0), atol=1e-5)
    strong = [of(one, state=state, **{g: 3.0}) for g in ("guidance", "state_guidance")]
    for made_otherwise in (deaf, free, *strong, of(other, state=state), of(one, state=state + 1)):
        assert np.abs(made_otherwise - usual).max() > 1e-2
    assert np.abs(np.subtract(*strong)).max() > 1e-2


@pytest.mark.parametrize(
    ("options", "style"),
    [({"style": "b"}, 1), ({"style": "a:0.7,b:0.3"}, 0), ({"samples": 3}, None)],
)
def test_the_state_is_that_of_the_style_and_one_for_all_experts(
    model, untrained, monkeypatch, options, style
):
    process = replace(model.state_process, wanted=None, silence=np.empty(0))
    styled = untrained(styles=("a", "b"), droppable=("styles", "state"), state=process.channels)
    styled, drawn = replace(styled, state_process=process), []

    def draw(self, seed, speech, group, **kept):
        drawn.append((seed, group))
        return usual(self, seed, speech, group, **kept)

    usual = StateProcess.draw
    monkeypatch.setattr(StateProcess, "draw", draw)
    asked = {"guidance": 1.5, "state_guidance": 1.5, **options}
    styled.generate(seconds=1, seed=2, steps=1, **asked)
    assert len(set(drawn)) == options.get("samples", 1)
    rngs = [rng_for(2, "", "sample", k, "style") for k in range(len(set(drawn)))]
    random = [int(torch.randint(2, (), generator=rng)) for rng in rngs]
    expected = random if style is None else [style]
    assert [group for _, group in dict.fromkeys(drawn)] == [(None, own) for own in expected]


def test_what_has_no_effect_is_refused(config, model, untrained, gesture):
    plain = untrained()
    for options in ({"state": np.zeros((9, 12))}, {"liveliness": 2.0}, {"mood_seed": 1}):
        with pytest.raises(ModelError, match=next(iter(options))):
            plain.generate(seconds=1, **options)
    with pytest.raises(ModelError, match="dropout_state"):
        replace(model, droppable=("all",)).generate(seconds=1, state_guidance=2.0)
    with pytest.raises(ConfigError, match="training.state: 0.1 needs state: true"):
        replace(config, state=False, training=replace(config.training, dropout_state=0.0))
    with pytest.raises(ModelError, match="liveliness.*like"):
        model.generate(like=gesture(1.0), liveliness=2.0)


def test_the_folder_keeps_the_state(model, folder, tmp_path):
    model.save(tmp_path / "model")
    again = gk.load(tmp_path / "model")
    np.testing.assert_array_equal(made(model), made(again))
    assert again.fingerprint() == model.fingerprint()
    card = (folder / "README.md").read_text()
    assert "left movement" in card and "dropout of all conditions and the state of movement" in card


def test_a_resumed_run_is_the_same(config, folder, tmp_path):
    again = replace(config, out=tmp_path / "run")
    shutil.copytree(config.out, again.out)
    cut_off(again.out, 6)
    assert same_weights(train(again, resume=True), folder)


def test_training_starts_from_a_model_without_a_state(corpus, tmp_path):
    """Its predictions do not change until the first step: new columns of weights are zeros."""
    plain = {name: SETTINGS[name] for name in ("features", "noise")}
    plain |= {"training": {"updates": 1}}
    start = train(small_diffusion(corpus, tmp_path / "plain", plain))
    still = {**SETTINGS, "start_from": str(start)}
    still["training"] = {**DROPPED, "updates": 1, "learning_rate": 1e-12}
    widened = load_file(train(small_diffusion(corpus, tmp_path / "run", still)) / FILE)
    for name, weights in load_file(start / FILE).items():
        if name.startswith("network."):
            own = widened[name]
            torch.testing.assert_close(own[tuple(map(slice, weights.shape))], weights)
            total = float(weights.abs().sum())
            assert float(own.abs().sum()) == pytest.approx(total, rel=1e-4, abs=1e-6)
    back = {**plain, "start_from": str(tmp_path / "run" / "model")}
    with pytest.raises(ConfigError, match="state"):
        train(small_diffusion(corpus, tmp_path / "back", back))


def test_recordings_on_disk_train_too(corpus, tmp_path):
    """Frames of a recording on disk have the state that they have in memory."""
    own = shutil.copytree(corpus.parent, tmp_path / "corpus") / corpus.name  # arrays lie beside it
    config = small_diffusion(own, tmp_path / "run", SETTINGS, {"in_memory": 0.1})
    data = load_training_data(config)
    assert data.stored is not None and data.state_process is not None
    recording = data.recordings[0]
    whole = recording.condition[:]
    np.testing.assert_array_equal(recording.condition[20:30], whole[20:30])
    assert whole.shape == (recording.n_frames, data.conditions.width)
    assert np.abs(whole[:, data.conditions.columns["state"]]).max() > 0.1
    assert np.isfinite(made(gk.load(train(config)))).all()
