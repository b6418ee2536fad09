"""Training: what each step reads, exact resume, and a model that renders."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest
import torch
from rigs import nameless
from runs import logged, same_weights, weights

import audio_features as af
import gesturekit as gk
from audio_features import WeightsError
from gesturekit.corpus import prepare
from gesturekit.errors import ConfigError, ModelError
from gesturekit.multires.config import LossConfig
from gesturekit.multires.network.discriminator import LevelDiscriminator
from gesturekit.multires.network.generator import LevelGenerator
from gesturekit.multires.network.resampling import resample
from gesturekit.multires.network.torch_backend import TorchBackend
from gesturekit.multires.training import trainer
from gesturekit.multires.training.stage import Stage
from gesturekit.multires.training.trainer import train
from gesturekit.training.config import dump_yaml, to_dict
from gesturekit.training.run.checkpoint import Checkpoints
from gesturekit.training.run.held_out import HeldOutMetrics
from gesturekit.training.run.session import session

RANDOM = {"discriminator", "adversarial", "contact", "smoothness", "arm_speed"}
ALL = RANDOM | {"reconstruction"}


def test_a_run_leaves_metrics_checkpoints_and_a_model(make_config):
    config = make_config(losses={"arm_acceleration": 3}, notes={"Licence": "CC0"})
    folder = train(config)
    card = (folder / "README.md").read_text("utf-8")
    for words in (
        "**Kind**: multires, 4 levels\n",
        "**Motion**: 25 fps, resampled to 30 fps, 19 of 19 joints modelled\n",
        "**Recordings**: 2 recordings, 8 s at 30 fps, trained at 25 fps\n",
        "**Unpaired speech**: 5 s in 1 file\n",
        "**Use of the recordings**: each stage draws a second as real motion about 2.8 times",
        "**Began with**: random weights\n",
        "**Training steps**: 10\n",
        "**Last losses**: discriminator ",
        "**Measured**: on 2 training recordings (8 s): ",
        "**Licence**: CC0\n",
        'model.generate("speech.wav", seed=0)',
    ):
        assert words in card
    assert [line["level"] for line in logged(config.out)] == [1, 1, 1, 3, 3]
    lines = logged(config.out)
    assert [line["step"] for line in lines] == [2, 4, 6, 8, 10]
    assert ALL | {"arm_acceleration"} <= set(lines[-1])
    for name in ("config.yaml", "command.txt", "versions.json", "checkpoints", "events"):
        assert (config.out / name).exists(), name
    model = gk.load(folder)
    motion = model.generate(seconds=2.0, fps=25)
    assert motion.n_frames == 50 and motion.skeleton.n_joints == 19


def test_a_model_keeps_the_rate_of_its_recordings(make_config, corpus, tmp_path):
    config = make_config(fps=20.0)
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(dump_yaml(to_dict(config) | {"corpus": "elsewhere", "fps": 10.0}))
    folder = gk.train(recipe, {"fps": 20.0}, corpus=corpus, training={"further_stages": 2})
    model = gk.load(folder)
    assert (model.fps, model.recorded_fps) == (20.0, 30.0)
    motion = model.generate(seconds=2.0)
    assert (motion.fps, motion.n_frames) == (30.0, 60)
    speech = corpus.parent / "paired" / "b.wav"
    made = model.reconstruct("b", speech)
    assert (made.fps, made.n_frames) == (20.0, model.noise.sequences["b"].frames)
    wave = af.Wave.load(speech)
    longer = af.Wave(np.pad(wave.samples, (0, wave.sample_rate)), wave.sample_rate)
    assert model.reconstruct("b", longer).n_frames == made.n_frames, "the rest is left out"
    with pytest.raises(ModelError, match="'b': the model has speech input; give"):
        model.reconstruct("b")
    with pytest.raises(ModelError, match=f"'b': it has {made.n_frames} frames, its speech 20"):
        model.reconstruct("b", af.Wave.load(speech, duration=1.0))


@pytest.fixture
def announced(make_config, tmp_path, caplog):
    """announced(**changes): what a run logs before its first step, and its losses."""
    caplog.set_level(logging.INFO)

    def make(**changes) -> tuple[str, LossConfig]:
        config = make_config(**changes, out=str(tmp_path / f"{len(caplog.text)}"))
        caplog.clear()
        with session(config, resume=False) as (run, device, processes):
            made = trainer.Trainer(config, run, device, processes, resume=False)
        return caplog.text, made.config.losses

    return make


def test_a_run_says_what_it_trains_and_on_what(announced, motions):
    corpus = str(motions(old=[3.0], angry=[3.0]))
    two = "2 recordings, 8 s at 30 fps, trained at 25 fps, "
    for changes, mode, content in (
        ({}, "speech mode", f"{two}5 s of unpaired speech, 28 features, 19 of 19 joints modelled"),
        ({"features": None}, "no condition", f"{two}19 of 19 joints modelled"),
        (
            {"features": None, "styles": {}, "corpus": corpus, "joints": ["Hips", "Head", "Neck"]},
            "labels mode",
            "2 recordings, 6 s at 30 fps, trained at 25 fps, 2 styles, 3 of 19 joints modelled",
        ),
    ):
        said, _ = announced(**changes)
        assert f": multires, {mode}, 4 levels, 10 iterations (longer=1)." in said
        assert content in said


def test_losses_on_parts_that_a_rig_lacks_are_left_out(announced, gesture, write_speech, tmp_path):
    motion, parts = nameless(gesture(3.0))
    write_speech(tmp_path / "in" / "a.wav", 3.0)
    motion.save(tmp_path / "in" / "a.bvh")
    prepare([tmp_path / "in"], tmp_path / "in.jsonl", holdout=0.0)
    corpus, losses = str(tmp_path / "in.jsonl"), {"arm_speed": 2.0, "contact": 3.0}
    said, found = announced(corpus=corpus, losses=losses)
    assert (found.arm_speed, found.arm_acceleration, found.contact) == (0.0, 0.0, 0.0)
    assert (
        "cannot be identified: no losses on the arms, no contact labels or loss, recordings keep "
        "their heading, all joints are modelled. If it has them, name them by hand"
    ) in said
    assert "no losses on the arms" not in announced(corpus=corpus, losses={"arm_speed": 0.0})[0]
    said, found = announced(corpus=corpus, losses=losses, parts=parts)
    assert (found.arm_speed, found.contact) == (2.0, 3.0) and "identified" not in said


def test_a_verdict_on_unfinished_levels_says_which_they_are(make_config, monkeypatch, caplog):
    asked = []

    def measure(self, step, model, what, **about):
        asked.append((step, what, about))
        return "verdict"

    monkeypatch.setattr(HeldOutMetrics, "measure", measure)
    config = make_config()
    with session(config, resume=False) as (run, device, processes):
        made = trainer.Trainer(config, run, device, processes, resume=False)
    assert made.stages() == [(0, 6), (2, 4)]
    assert [made.measure(5, 2), made.measure(9, 4, keep=True)] == ["verdict"] * 2
    assert asked == [
        (5, ", levels 1-2 of 4", {"keep": False, "levels": 2}),
        (9, "", {"keep": True}),
    ]
    # A corpus that is gone at the end costs the model its use for live speech only.
    made.config = replace(config, corpus=config.corpus.with_name("gone.jsonl"))
    assert made._live_predictions(None) == ()
    assert "The model cannot stream, without predictions for live speech: " in caplog.text
    assert "gone.jsonl" in caplog.text


def test_levels_side_by_side_train_as_one_after_the_other(make_config, monkeypatch):
    changes = {"threads": 2, "losses": {"coarse": 1.0, "arm_acceleration": 3}}
    beside = make_config(**changes)
    train(beside)
    engine = pytest.importorskip("gesturekit.multires.cpu.engine", reason="the engine is absent")
    monkeypatch.setattr(engine.NumbaBackend, "run_tasks", TorchBackend.run_tasks)
    in_turn = make_config(**changes, out=str(beside.out) + "_in_turn")
    train(in_turn)
    assert same_weights(beside.out / "model", in_turn.out / "model")


def test_finer_levels_learn_to_leave_what_is_coarse(make_config):
    training = {"first_stage": 60, "discriminator_steps": 0, "reconstruction_steps": 0}
    losses = {"adversarial": 0, "arm_speed": 0, "coarse": 20, "detail": 1}
    config = make_config(training=training, losses=losses, log_every=10)
    train(config)
    lines = logged(config.out)
    pair = [line for line in lines if line["level"] == 1]
    assert pair[-1]["coarse"] < 0.6 * pair[0]["coarse"]
    assert pair[-1]["detail"] < pair[0]["detail"]


@pytest.mark.parametrize("cache", [None, 3])
def test_random_steps_take_unpaired_clips_whole_and_read_no_target(make_config, monkeypatch, cache):
    clips = {2: 3.0, 40: 4.0, 90: 5.0, 200: 6.0}
    read = {"_discriminator_steps": set(), "_random_step": set(), "_reconstruction_step": set()}
    step = []

    def marked(config, device, *, trial):
        data = load_training_data(config)
        for sequence in data.paired:
            sequence.speech.fill_(1.0)
        unpaired = tuple(torch.full((data.n_speech, n), value) for n, value in clips.items())
        return replace(data, unpaired=unpaired, silence=torch.zeros(data.n_speech, 200))

    def generate(self, windows):
        if self.first == 2:
            finest = windows.conditions[-1]
            heard = (finest.shape[-1], *finest.unique().tolist(), windows.targets is not None)
            read[step[-1]].add(heard)
        return whole_generate(self, windows)

    def recorded(name, method):
        def run(self, *arguments):
            step.append(name)
            return method(self, *arguments)

        return run

    load_training_data, whole_generate = trainer.load_training_data, Stage._generate
    monkeypatch.setattr(trainer, "load_training_data", marked)
    monkeypatch.setattr(Stage, "_generate", generate)
    for name in read:
        monkeypatch.setattr(Stage, name, recorded(name, getattr(Stage, name)))
    training = {"window": None, "window_cache": cache, "silence": 0.0, "further_stages": 16}
    config = make_config(features={"residual": False}, training=training)
    train(config)
    whole = {(n, value, False) for n, value in clips.items()}
    assert read["_random_step"] | read["_discriminator_steps"] == whole
    assert read["_random_step"] and read["_discriminator_steps"]
    assert read["_reconstruction_step"] == {(150, 1.0, True), (63, 1.0, True)}
    assert all(np.isfinite(value) for line in logged(config.out) for value in line.values())


@pytest.mark.parametrize(
    ("levels", "window", "warned"), [(10, None, True), (9, None, False), (10, 3.0, False)]
)
def test_clips_shorter_than_a_patch_at_level_1_are_warned_about(
    make_config, caplog, levels, window, warned
):
    """The clip has 125 frames: 9.4 of them at level 1 of 10, and 12.5 of 9; a patch has 13."""
    network = {"levels": levels, "kernel": 5, "channels": [2, 2]}
    trainer.plan_training(make_config(network=network, training={"window": window}))
    assert ("1 of 1 clips of unpaired speech" in caplog.text) is warned
    assert ("13 frames" in caplog.text and "clips of 6.7 s or more" in caplog.text) is warned


def test_silence_is_as_long_as_the_longest_unpaired_clip(
    make_config, cache_of, write_pair, write_speech, tmp_path
):
    write_pair(tmp_path / "paired", "a", 3.0, seed=1)
    write_speech(tmp_path / "more" / "b.wav", 5.0)
    corpus = tmp_path / "corpus.jsonl"
    prepare([tmp_path / "paired"], corpus, unpaired=[tmp_path / "more"], holdout=0.0)
    training = {"window": None, "silence": 0.999, "margins": True}
    config = make_config(corpus=str(corpus), features={"residual": False}, training=training)
    cache = cache_of(config)
    windows = cache.random(cache.data.paired, 125, 2, 1, torch.Generator().manual_seed(0))
    expected = cache.data.conditioner.silence(125 + 2 * config.random_margin)
    assert torch.equal(windows.conditions[-1][0].T, torch.from_numpy(expected))


def test_with_margins_a_whole_clip_continues_in_them_as_in_generation(make_config, cache_of):
    config = make_config(training={"window": None, "margins": True, "silence": 0.0})
    data = trainer.load_training_data(config)
    (clip,) = data.unpaired
    cache = cache_of(replace(config, features=None), data)
    rng = torch.Generator().manual_seed(0)
    windows = cache.random(data.paired, clip.shape[-1], 2, 1, rng)
    margin = config.random_margin
    around = np.pad(clip.numpy(), ((0, 0), (margin, margin)), mode="reflect")
    np.testing.assert_array_equal(windows.conditions[-1][0].numpy(), around)


def test_reconstruction_from_real_motion_starts_levels_from_the_one_below(make_config, monkeypatch):
    targets, upsampled, checked = [None], [], []
    forward, draw = LevelGenerator.forward, Stage._draw

    def record_input(self, up, noise, *others):
        upsampled.append(up)
        if targets[-1] is not None and len(upsampled) == 2:
            coarse, fine = targets[-1]
            checked.append(torch.equal(up, resample(coarse, fine.shape[-1])))
        return forward(self, up, noise, *others)

    def record_windows(self, *arguments):
        windows = draw(self, *arguments)
        targets.append(windows.targets)
        upsampled.clear()
        return windows

    monkeypatch.setattr(LevelGenerator, "forward", record_input)
    monkeypatch.setattr(Stage, "_draw", record_windows)
    train(make_config(losses={"rec_input": "real"}))
    assert len(checked) == 10 and all(checked), "each iteration"


def test_a_window_cache_holds_a_whole_sequence_once(make_config, cache_of):
    cache = cache_of(make_config(training={"window": None}))
    data = cache.data
    for n_frames, members in data.window_lengths().items():
        sequences = [data.paired[i] for i in members]
        windows = cache.paired(sequences, n_frames, 2, 8, torch.Generator().manual_seed(0))
        assert len(windows.coarser) == len(sequences) and windows.speech is None
        assert torch.equal(windows.targets[-1], torch.stack([s.motion for s in sequences]))


@pytest.mark.parametrize(("cache", "repeats"), [(2, True), (None, False)])
def test_without_a_cache_random_windows_are_drawn_anew(make_config, monkeypatch, cache, repeats):
    config = make_config(training={"window_cache": cache, "renew_every": 50})
    generate, noises = Stage._generate, []

    def record(self, windows):
        if windows.targets is None and self.first == 0:
            noises.extend(tuple(row.tolist()) for row in windows.noise[0][:, 0])
        return generate(self, windows)

    monkeypatch.setattr(Stage, "_generate", record)
    train(config)
    # Six iterations of a discriminator and a generator step, two windows each.
    assert len(noises) == 24
    assert (len(set(noises)) < 24) == repeats


def test_with_margins_losses_use_the_middle_of_longer_motions(make_config, monkeypatch):
    config = make_config(training={"margins": True, "window": 2.0, "first_stage": 1})
    seen = set()
    original = LevelDiscriminator.forward

    def forward(self, x, *others):
        seen.add(x.shape[-1])
        return original(self, x, *others)

    generated = {}
    within = Stage._within

    def kept(self, made, n_frames):
        middles = within(self, made, n_frames)
        generated.update({m.shape[-1]: (m, middle) for m, middle in zip(made, middles)})
        return middles

    monkeypatch.setattr(LevelDiscriminator, "forward", forward)
    monkeypatch.setattr(Stage, "_within", kept)
    train(config)
    assert config.network.margin == 5
    assert seen == {21, 28, 38, 50} and set(generated) == {25, 34, 45, 60}
    for motion, middle in generated.values():
        before = (motion.shape[-1] - middle.shape[-1]) // 2
        assert torch.equal(middle, motion[..., before : before + middle.shape[-1]])


def test_a_model_keeps_the_speed_of_its_fastest_second_in_metres(make_config, gesture, tmp_path):
    """In-betweening plans gaps by it. Bodies of twice the usual size; walks of 0.4 and 1.8 m/s."""
    (tmp_path / "walks").mkdir()
    for name, speed in {"slow": 0.4, "fast": 1.8}.items():
        walk = gesture(3.0)
        there = np.clip(walk.times - 1.0, 0.0, 1.0) * speed  # one second in the middle
        walk.translation[:] = np.stack([there, np.full_like(there, 1.8), 0 * there], axis=1)
        giant = replace(walk.skeleton, offsets=2.0 * walk.skeleton.offsets)
        replace(walk, skeleton=giant).save(tmp_path / "walks" / f"{name}.bvh")
    prepare([], tmp_path / "w.jsonl", unpaired_motion=[tmp_path / "walks"], holdout=0.0)
    short = {"features": None, "training": {"first_stage": 1}}
    model = gk.load(train(make_config(corpus=str(tmp_path / "w.jsonl"), **short)))
    assert model.representation.scale == pytest.approx(2.0, rel=0.2)
    assert model.fastest == pytest.approx(1.8, rel=0.02)


def test_a_recording_of_one_frame_at_the_coarsest_level_trains(make_config, write_pair, tmp_path):
    for stem, seconds in {"long": 1.0, "short": 0.5}.items():
        write_pair(tmp_path / "pairs", stem, seconds)
    prepare([tmp_path / "pairs"], tmp_path / "short.jsonl", holdout=0.0)
    changes = {"network": {"levels": 10}, "training": {"first_stage": 20, "further_stages": 1}}
    config = make_config(corpus=str(tmp_path / "short.jsonl"), **changes)
    assert (train(config) / "config.yaml").is_file()


def test_no_checkpoint_is_written_after_nan(make_config, monkeypatch):
    step = Stage._random_step

    def broken(self, n_frames, rng):
        report = step(self, n_frames, rng)
        with torch.no_grad():
            next(self.generators.parameters()).fill_(float("nan"))
        return report

    monkeypatch.setattr(Stage, "_random_step", broken)
    config = make_config(training={"reconstruction_steps": 0}, checkpoint_every=1, log_every=100)
    with pytest.raises(ModelError, match="step 1: the loss became NaN or infinite"):
        train(config)
    assert Checkpoints(config.out / "checkpoints").latest() is None


def test_a_run_resumes_only_with_the_weights_it_began_with(make_config, write_wavlm, tmp_path):
    write_wavlm(tmp_path / "weights")
    features = {"extractors": [{"kind": "wavlm"}], "weights": str(tmp_path / "weights")}
    config = make_config(features=features, training={"first_stage": 1, "further_stages": 1})
    train(config)
    assert train(config, resume=True).is_dir()
    write_wavlm(tmp_path / "weights", seed=1)
    with pytest.raises(WeightsError, match="fingerprint"):
        train(config, resume=True)


def test_without_unpaired_speech_the_run_says_what_it_does(make_config, tmp_path, caplog, corpus):
    prepare([corpus.parent / "paired"], tmp_path / "alone.jsonl", holdout=0.0)
    short = {"first_stage": 1, "further_stages": 1}
    train(make_config(corpus=str(tmp_path / "alone.jsonl"), training=short))
    assert "random steps take the paired speech" in caplog.text


@pytest.mark.parametrize(
    ("changes", "losses"),
    [
        ({"training": {"window": None}}, ALL),
        ({"training": {"margins": True}}, ALL),
        ({"training": {"discriminator_steps": 0, "generator_steps": 0}}, {"reconstruction"}),
        ({"training": {"reconstruction_steps": 0}}, RANDOM),
        ({"features": {"residual": False}, "network": {"film": "input"}}, ALL),
        ({"losses": {"arm_speed": 0, "rec_input": "real"}}, ALL - {"arm_speed"}),
        ({"network": {"levels": 3}}, ALL),
        ({"joints": "all"}, ALL),
        ({"precision": "bfloat16"}, ALL),
    ],
    # The order of a set depends on the process.
    ids=lambda value: "losses" if isinstance(value, set) else str(value),
)
def test_variants_train_on_the_losses_that_they_name(make_config, changes, losses):
    config = make_config(**changes)
    train(config)
    # The finest level is at the full rate, where every loss applies.
    named = set(logged(config.out)[-1]) - {"step", "level"}
    assert named == losses
    trained = weights(config.out / "model")
    assert all(torch.isfinite(value).all() for value in trained.values())
    # One more iteration moves every level that the last pair trains.
    longer = make_config(**changes, out=str(config.out) + "_longer")
    train(replace(longer, training=replace(longer.training, further_stages=5)))
    again, finest = weights(longer.out / "model"), f"levels.{config.network.levels - 1}.layers"
    moved = [name for name in trained if finest in name and name.endswith("weight")]
    assert moved
    assert all(not torch.equal(trained[name], again[name]) for name in moved)


def test_betas_reach_the_optimisers_and_wrong_ones_are_refused(make_config, tmp_path):
    other = make_config(training={"betas": [0.5, 0.95]}, out=str(tmp_path))
    assert not same_weights(train(make_config()), train(other))
    for betas in ([0.9], [0.9, 1.0]):
        with pytest.raises(ConfigError, match="betas"):
            make_config(training={"betas": betas})
