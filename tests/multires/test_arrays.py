"""A corpus that is not held in memory: arrays on disk, made once, read in windows."""

from __future__ import annotations

import errno
import json
import logging
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.lib.format as npy
import pytest
import soundfile
import torch

import gesturekit as gk
from gesturekit.corpus import Item, Manifest
from gesturekit.errors import ConfigError, CorpusError
from gesturekit.multires.training import trainer
from gesturekit.multires.training.batches import Batches
from gesturekit.multires.training.data import TrainingData
from gesturekit.multires.training.loading import load_training_data
from gesturekit.multires.training.stage import Stage
from gesturekit.multires.training.trainer import train
from gesturekit.systems import _part, _resolve, make_arrays
from gesturekit.training.run import plan
from gesturekit.training.run.session import session

UPPER_BODY = "Hips,Spine,Neck,Head,LeftArm,LeftForeArm,LeftHand,RightArm,RightForeArm,RightHand"
LONG = {"in_memory": 0.15}
"""Minutes; the corpus of the tests has 8.5 s of recordings and 5 s of unpaired speech."""


@pytest.fixture
def long_config(corpus, make_config, tmp_path):
    """long_config(**changes): the small configuration on a copy of the corpus, read from arrays."""
    folder = shutil.copytree(corpus.parent, tmp_path / "long")
    items = [
        replace(
            item,
            audio=folder / item.audio.relative_to(corpus.parent),
            motion=item.motion and folder / item.motion.relative_to(corpus.parent),
            take=item.id,
        )
        for item in Manifest.load(corpus)
    ]
    Manifest(items).save(folder / "corpus.jsonl")
    return lambda **changes: make_config(
        **{"corpus": str(folder / "corpus.jsonl"), **LONG, **changes}
    )


def arrays_in(config) -> dict[str, int]:
    """Return the time at which each array was written, by its name."""
    return {path.name: path.stat().st_mtime_ns for path in config.arrays_folder.rglob("*.npy")}


def test_frames_on_disk_are_those_of_memory(long_config):
    """The sample has all recordings here, so that all statistics are the same."""
    kept, read = load_training_data(long_config(in_memory=9)), load_training_data(long_config())
    assert kept.stored is None and read.stored is not None
    assert len(read.sample) == len(read.paired) == 2
    torch.testing.assert_close(read.normaliser.scale, kept.normaliser.scale, rtol=0, atol=0)
    for one, other in zip(kept.paired, read.paired, strict=True):
        assert (one.name, one.take, one.n_frames) == (other.name, other.take, other.n_frames)
        for part in ("motion", "speech"):
            mine, theirs = getattr(one, part)[:, 11:37], getattr(other, part)[:, 11:37]
            torch.testing.assert_close(theirs, mine, rtol=0, atol=2e-6)
        torch.testing.assert_close(other.z_star / other.sigma[0], one.z_star / one.sigma[0])
    torch.testing.assert_close(read.unpaired[0][:, :], kept.unpaired[0], rtol=0, atol=2e-6)
    for one, other in zip(kept.recalled, read.recalled, strict=True):
        torch.testing.assert_close(other.motion, one.motion, rtol=0, atol=2e-6)
    assert [source.motion for source in read.sources] == [source.motion for source in kept.sources]


def test_recordings_on_disk_may_have_no_speech(long_config):
    data = load_training_data(long_config(features=None, in_memory=0.1))
    assert data.stored is not None and data.conditioner is None
    assert [own.n_frames for own in data.paired] == [150, 63]
    for own in data.paired:
        assert own.speech.shape == (0, own.n_frames) and own.motion[:, 9:11].shape[1] == 2


def test_fingers_and_face_are_read_with_their_recording(long_config):
    changes = {"joints": ["Hips", "Spine", "Neck", "Head", "LeftArm", "RightArm"]}
    recall = {"recall": {"level": 4}, "losses": {"arm_speed": 0.0}}
    kept = load_training_data(long_config(in_memory=9, **changes, **recall))
    read = load_training_data(long_config(**changes, **recall))
    assert kept.passive.joints and kept.passive == read.passive
    for one, other in zip(kept.paired, read.paired, strict=True):
        assert other.passive.shape == one.passive.shape
        torch.testing.assert_close(other.passive[:, 5:60], one.passive[:, 5:60])


def test_a_model_is_trained_from_arrays_and_remembers_it_on_resuming(long_config, monkeypatch):
    config = long_config(recall={"level": 4})
    whole = train(replace(config, out=config.out.with_name("whole")))
    iterate = Stage.iterate

    def killed(self, iteration):
        if self.first == 2:
            raise KeyboardInterrupt
        return iterate(self, iteration)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Stage, "iterate", killed)
        train(config)
    resumed = train(config, resume=True)
    for name in ("model.safetensors", "config.yaml", "skeleton.json"):
        assert (whole / name).read_bytes() == (resumed / name).read_bytes()
    motion = gk.load(resumed).generate(seconds=2.0)
    assert np.isfinite(motion.positions()).all() and motion.n_frames == 60
    assert "each stage draws a second as real motion about" in (whole / "README.md").read_text()


def test_a_resumed_run_names_the_arrays_that_it_misses(long_config, tmp_path):
    config = long_config()
    load_training_data(config).save(tmp_path / "data")
    moved = config.arrays_folder.rename(tmp_path / "moved")
    with pytest.raises(ConfigError, match="arrays of this run are missing; arrays=FOLDER"):
        TrainingData.load(tmp_path / "data", config)
    again = TrainingData.load(tmp_path / "data", replace(config, arrays=moved))
    assert again.paired[0].motion[:, 3:5].shape == (again.representation.n_features, 2)


def test_arrays_are_made_once_and_anew_for_what_has_changed(long_config, write_speech):
    config = long_config()
    load_training_data(config)
    before = arrays_in(config)
    assert len(before) == 5  # two motions, two of their sounds and one more
    load_training_data(config)
    load_training_data(replace(config, seed=7))
    assert arrays_in(config) == before
    # The same length and time of writing, another sound.
    sound = config.corpus.parent / "paired" / "a.wav"
    times = sound.stat()
    write_speech(sound, 6.0, level=0.03)
    os.utime(sound, ns=(times.st_atime_ns, times.st_mtime_ns))
    data = load_training_data(config)
    new = set(arrays_in(config)) - set(before)
    assert new == {data.paired[0].speech.array.path.name}
    load_training_data(replace(config, fps=20.0))
    assert len(arrays_in(config)) == 5 + 1 + 5
    features = replace(config.features, extractors=({"kind": "logmel", "n_mels": 12},))
    load_training_data(replace(config, features=features))
    assert len(arrays_in(config)) == 11 + 3


def test_what_was_made_before_an_error_is_kept(long_config):
    config = long_config()
    broken = config.corpus.parent / "paired" / "b.wav"
    content = broken.read_bytes()
    broken.write_bytes(b"RIFF")
    with pytest.raises(CorpusError, match=r"item b: .*arrays made so far are kept"):
        load_training_data(config)
    before = arrays_in(config)
    broken.write_bytes(content)
    load_training_data(config)
    after = arrays_in(config)
    assert len(before) == 3 and before.items() <= after.items() and len(after) == 5


def test_an_array_that_was_cut_off_is_made_again(long_config):
    config = long_config()
    data = load_training_data(config)
    path = data.paired[0].motion.array.path
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ConfigError, match="cannot be read"):
        data.paired[0].motion[:, :]
    load_training_data(config)
    assert path.read_bytes() == whole
    # One that is too long is not read either: its frames would be others.
    path.write_bytes(whole + whole)
    with pytest.raises(ConfigError, match="cannot be read"):
        data.paired[0].motion[:, :]


def test_ranges_of_frames_are_those_of_a_tensor(long_config):
    motion = load_training_data(long_config()).paired[0].motion
    whole = motion[:, :]
    assert whole.shape == motion.shape == (len(whole), 150)
    for frames in (slice(5, 5), slice(0, 1), slice(140, None), slice(-3, None), slice(7, 400)):
        torch.testing.assert_close(motion[:, frames], whole[:, frames], rtol=0, atol=0)


def test_a_full_disk_is_one_line_and_loses_nothing(long_config, monkeypatch):
    config, write = long_config(), npy.write_array_header_1_0
    writes = iter(range(100))

    def full(file, header):
        if next(writes) == 2:
            raise OSError(errno.ENOSPC, "No space left on device")
        write(file, header)

    with monkeypatch.context() as patch:
        patch.setattr(npy, "write_array_header_1_0", full)
        with pytest.raises(gk.GestureKitError, match="No space left on device; make room"):
            load_training_data(config)
    assert len(arrays_in(config)) == 2
    load_training_data(config)
    assert len(arrays_in(config)) == 5


def test_a_folder_that_cannot_be_written_to_names_the_option(long_config, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(gk.GestureKitError, match="arrays=FOLDER names another folder"):
        load_training_data(long_config(arrays=str(tmp_path / "file" / "arrays")))


def test_the_command_makes_arrays_with_workers_and_the_training_finds_them(
    long_config, gesturekit, tmp_path, caplog
):
    caplog.set_level(logging.INFO)
    config = long_config()
    where = ["own_corpus", f"corpus={config.corpus}", f"out={tmp_path / 'run'}", "in_memory=0.15"]
    gesturekit("train", *where, "--plan").ok()
    assert "Arrays of 0.0 GB in" in caplog.text and not config.arrays_folder.exists()
    assert "2 recordings, 8 s at 30 fps" in caplog.text
    gesturekit("train", *where, "--arrays", "--workers", "2").ok()
    made = arrays_in(config)
    assert len(made) == 5 and "are ready in" in caplog.text
    assert not (tmp_path / "run").exists()
    short = ["training.first_stage=1", "training.further_stages=1", "threads=1"]
    gesturekit("train", *where, *short).ok()
    assert arrays_in(config) == made
    assert gesturekit("train", "--resume", tmp_path / "run", "--arrays").status == 2


def test_arrays_of_workers_are_those_of_one_process(long_config, tmp_path):
    one, two = (
        long_config(arrays=str(tmp_path / "one")),
        long_config(arrays=str(tmp_path / "two"), workers=2),
    )
    load_training_data(one)
    load_training_data(two)
    for path in one.arrays_folder.rglob("*.*"):
        assert (
            two.arrays_folder / path.relative_to(one.arrays_folder)
        ).read_bytes() == path.read_bytes()


def test_a_stranger_in_the_corpus_is_named(long_config, tmp_path):
    config = long_config()
    path = config.corpus.parent / "paired" / "b.bvh"
    path.write_text(path.read_text().replace("LeftHand", "LeftClaw"))
    with pytest.raises(CorpusError, match="item b: another skeleton"):
        load_training_data(config)


def test_a_hostile_array_is_refused(long_config):
    config = long_config()
    data = load_training_data(config)
    path: Path = data.paired[0].motion.array.path
    np.save(path, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(ConfigError, match="cannot be read"):
        data.paired[0].motion[:, :4]
    facts = path.with_suffix(".json")
    facts.write_text(json.dumps([1, 2]))
    assert load_training_data(config).paired[0].motion[:, :4].isfinite().all()


@pytest.mark.parametrize(
    ("recipe", "changes"),
    [
        # The other joints are kept as they were recorded.
        ("own_corpus", [f"joints=[{UPPER_BODY}]", "losses.contact=0"]),
        ("diffusion_speech/small", []),
    ],
)
def test_the_plan_gives_the_size_of_the_arrays(long_config, recipe, changes, tmp_path, caplog):
    """Sizes of both systems are estimated before anything is made."""
    caplog.set_level(logging.INFO)
    config = long_config()
    where = [f"corpus={config.corpus}", f"out={tmp_path / 'run'}"]
    settings = [*where, "in_memory=0.1", "threads=1", *changes]
    make_arrays(recipe, settings)
    made = sum(np.load(path).nbytes for path in config.arrays_folder.rglob("*.npy"))
    system, loaded = _resolve(recipe, settings, {}, resume=False)
    make = _part(system.train).__globals__["Trainer"]
    with session(loaded, resume=False, folder=tmp_path / "plan") as (run, device, processes):
        trial = make(loaded, run, device, processes, resume=False, trial=True)
        estimate = trial.estimate()
    unpaired = 5.0 if recipe == "own_corpus" else 0.0
    assert np.dot(estimate.rates, (8.5, unpaired)) == pytest.approx(made, rel=0.01)
    assert estimate.training > 0


@pytest.mark.parametrize(("window", "in_memory", "kept"), [(2.0, 0.15, 212.5), (None, 0.1, 150)])
def test_the_plan_counts_steps_renewals_and_preparation(
    long_config, monkeypatch, tmp_path, window, in_memory, kept
):
    """The library takes 40 s here, each of two stages 7 s to begin, 50 for its first iteration and
    1 for the others, and each renewal 3 s.

    The trial has all recordings, 8.5 s in 213 frames; library and stages of the run read no more
    frames than are held in memory.
    """
    clock = [0.0]

    def taking(seconds, work):
        def run(*arguments):
            clock[0] += seconds(arguments[0]) if callable(seconds) else seconds
            return work and work(*arguments)

        return run

    begun = set()
    iteration = taking(lambda stage: 1.0 if stage in begun else begun.add(stage) or 50.0, None)
    monkeypatch.setattr(trainer.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(trainer, "build_library", taking(40.0, None))
    monkeypatch.setattr(Stage, "__init__", taking(7.0, Stage.__init__))
    monkeypatch.setattr(Stage, "iterate", iteration)
    monkeypatch.setattr(Batches, "renew", taking(3.0, None))
    steps = {"first_stage": 100, "further_stages": 60, "window_cache": 4, "renew_every": 50}
    training, recall = {**steps, "window": window}, {"level": 4, "minutes": 0.1}
    config = long_config(training=training, in_memory=in_memory, recall=recall)
    with session(config, resume=False, folder=tmp_path / "plan") as (run, device, processes):
        trial = trainer.Trainer(config, run, device, processes, resume=False, trial=True)
        seconds = trial.estimate().training
    iterations = 160 if window else 160 * 212.5 / 213
    share = kept / 213
    assert seconds == pytest.approx(40 * share + 2 * 7 * share + 4 * 3 + iterations, abs=1e-6)


@pytest.mark.parametrize(("in_memory", "minutes"), [(9.0, 60), (0.1125, 50)])
def test_the_plan_adds_loading_reading_and_training(
    long_config, gesturekit, monkeypatch, tmp_path, caplog, in_memory, minutes
):
    """Loading took 10 min of processor time, reading takes 20 and all steps 30.

    Of 13.5 s of a long corpus, statistics need 6.75 s, half of the reading.
    """
    caplog.set_level(logging.INFO)
    monkeypatch.setattr(plan.time, "process_time", lambda: 600.0)
    taken = iter([400.0, 1200.0])  # motion alone, and motion with its features
    monkeypatch.setattr(plan, "quickest", lambda work, times: next(taken))
    monkeypatch.setattr(
        trainer.Trainer, "estimate", lambda self: plan.Estimate(1800.0, 0.0, (0.0, 0.0))
    )
    where = f"corpus={long_config().corpus}", f"out={tmp_path / 'run'}", f"in_memory={in_memory}"
    gesturekit("train", "own_corpus", *where, "threads=1", "--plan").ok()
    assert f"Time: about {minutes} min on this machine while it is idle" in caplog.text
    assert f"{0.8 * minutes:.0f} min to {2 * minutes / 60:.1f} h beside" in caplog.text


@pytest.mark.parametrize("recipe", ["own_corpus", "diffusion_speech/small"])
def test_a_plan_makes_no_arrays(long_config, gesturekit, recipe, tmp_path, caplog):
    caplog.set_level(logging.INFO)
    config = long_config()
    where = f"corpus={config.corpus}", f"out={tmp_path / 'run'}", "in_memory=0.1", "threads=1"
    gesturekit("train", recipe, *where, "--plan").ok()
    assert not config.arrays_folder.exists() and "making those that are missing" in caplog.text
    # What a few steps on an excerpt find out is not true of the corpus.
    assert "Hand movement predicted" not in caplog.text


def test_a_plan_counts_what_is_trained_on(long_config, gesturekit, gesture, tmp_path, caplog):
    """Motion without speech is no recording of a model of speech: 8.5 s fit into memory."""
    caplog.set_level(logging.INFO)
    config = long_config()
    gesture(20.0).save(tmp_path / "alone.bvh")
    alone = Item(id="alone", audio=None, motion=tmp_path / "alone.bvh", duration=20.0)
    Manifest([*Manifest.load(config.corpus), alone]).save(config.corpus)
    where = f"corpus={config.corpus}", f"out={tmp_path / 'run'}", "in_memory=0.25", "threads=1"
    gesturekit("train", "diffusion_speech/small", *where, "--plan").ok()
    assert "Time: about" in caplog.text and "Arrays of" not in caplog.text


def test_a_plan_reads_half_a_minute_of_any_number_of_speakers(long_config):
    config = long_config(losses={"arm_speed": 0.0})
    pairs = [item for item in Manifest.load(config.corpus) if item.is_paired]
    items = [
        replace(item, id=f"{item.id}{k}", take=f"{item.id}{k}", speaker=f"{item.id}{k}")
        for item in pairs
        for k in range(20)
    ]
    Manifest(items).save(config.corpus)
    data = load_training_data(config, trial=True)
    assert sum(one.n_frames for one in data.paired) == pytest.approx(30 * config.fps, rel=0.35)


def test_styles_and_a_sound_that_ends_early_are_read_from_disk_too(long_config):
    config = long_config(styles={}, losses={"arm_speed": 0.0})
    sound = config.corpus.parent / "paired" / "a.wav"
    samples, rate = soundfile.read(sound)
    soundfile.write(sound, samples[: -rate // 12], rate)
    items = [replace(i, style="ba"[i.id == "a"]) for i in Manifest.load(config.corpus)]
    Manifest(items).save(config.corpus)
    kept, read = load_training_data(replace(config, in_memory=9)), load_training_data(config)
    assert read.styles == ("a", "b")
    for one, other in zip(kept.paired, read.paired, strict=True):
        assert (one.style, one.n_frames) == (other.style, other.n_frames)
        assert other.motion.shape[1] == other.speech.shape[1] == other.passive.shape[1]
    assert read.paired[0].n_frames < 150 and {s.style for s in read.paired} == {0, 1}


def test_noise_without_a_voice_is_reported_from_disk_too(long_config, caplog):
    config = long_config()
    path = config.corpus.parent / "more" / "c.wav"
    noise = np.random.default_rng(0).standard_normal(5 * 16000)
    soundfile.write(path, 0.01 * noise, 16000)
    for _ in range(2):  # made, and found again
        caplog.clear()
        data = load_training_data(config)
        assert "1 of 1 sounds have no voice and count as silence (c)" in caplog.text
    assert data.unpaired[0][:, :].isfinite().all()
