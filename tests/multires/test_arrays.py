"""A corpus that is not held in memory: arrays on disk, made once, read in windows."""

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
from runs import cut_off

import gesturekit as gk
from gesturekit.corpus import Manifest
from gesturekit.errors import ConfigError, CorpusError
from gesturekit.multires import TrainingData, load_training_data, train
from gesturekit.multires.training.trainer import Trainer
from gesturekit.training.config import dump_yaml, to_dict
from gesturekit.training.session import session

LONG = {"in_memory": 0.15}
"""Minutes; the corpus of the tests has 6.5 s of recordings and 5 s of unpaired speech."""


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
    return {path.name: path.stat().st_mtime_ns for path in config.arrays_folder.rglob("*.npy")}


def test_a_resumed_run_names_the_arrays_that_it_misses(long_config, tmp_path):
    config = long_config()
    load_training_data(config).save(tmp_path / "data")
    moved = config.arrays_folder.rename(tmp_path / "moved")
    with pytest.raises(ConfigError, match=f"(?=.*{config.arrays_folder})(?=.*arrays=)"):
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
    with pytest.raises(CorpusError, match="item b"):
        load_training_data(config)
    before = arrays_in(config)
    broken.write_bytes(content)
    load_training_data(config)
    after = arrays_in(config)
    assert len(before) == 3 and before.items() <= after.items() and len(after) == 5


def test_a_full_disk_is_one_line_and_loses_nothing(long_config, monkeypatch):
    config, write = long_config(), npy.write_array_header_1_0
    writes = iter(range(100))

    def full(file, header):
        if next(writes) == 2:
            raise OSError(errno.ENOSPC, "No space left on device")
        write(file, header)

    with monkeypatch.context() as patch:
        patch.setattr(npy, "write_array_header_1_0", full)
        with pytest.raises(gk.GestureKitError, match="No space left"):
            load_training_data(config)
    assert len(arrays_in(config)) == 2
    load_training_data(config)
    assert len(arrays_in(config)) == 5


def test_a_folder_that_cannot_be_written_to_names_the_option(long_config, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(gk.GestureKitError, match="(?=.*file/arrays)(?=.*arrays=)"):
        load_training_data(long_config(arrays=str(tmp_path / "file" / "arrays")))


def test_a_stranger_in_the_corpus_is_named(long_config, tmp_path):
    config = long_config()
    path = config.corpus.parent / "paired" / "b.bvh"
    path.write_text(path.read_text().replace("LeftHand", "LeftClaw"))
    with pytest.raises(CorpusError, match="(?=.*item b)(?=.*LeftClaw)"):
        load_training_data(config)


PLAIN_JOINTS = {"joints": ["Hips", "Spine", "Neck", "Head", "LeftArm", "RightArm"]}


@pytest.mark.parametrize("speech", [True, False])
def test_frames_on_disk_are_those_of_memory(long_config, speech):
    """The sample has all recordings here, so that all statistics are the same. Fingers, styles and
    a sound that ends early are read with their recording."""
    changes = {"state": True, "losses": {"arm_speed": 0.0}, "styles": {}, **PLAIN_JOINTS}
    config = long_config(**changes, **({} if speech else {"features": None, "in_memory": 0.1}))
    sound = config.corpus.parent / "paired" / "a.wav"
    samples, rate = soundfile.read(sound)
    soundfile.write(sound, samples[: -rate // 12], rate)
    items = [replace(i, style="ba"[i.id == "a"]) for i in Manifest.load(config.corpus)]
    Manifest(items).save(config.corpus)
    kept, read = load_training_data(replace(config, in_memory=9)), load_training_data(config)
    assert not kept.is_stored and read.is_stored and read.conditions.styles == ("a", "b")
    assert len(read.sample) == len(read.paired) == 2
    torch.testing.assert_close(read.normaliser.scale, kept.normaliser.scale, rtol=0, atol=0)
    assert kept.passive.joints and kept.passive == read.passive
    for one, other in zip(kept.paired, read.paired, strict=True):
        for name in ("name", "take", "n_frames", "style"):
            assert getattr(one, name) == getattr(other, name)
        for part in ("motion", "speech", "passive"):
            for frames in (slice(11, 37), slice(5, 5), slice(50, None), slice(-3, None)):
                mine, theirs = getattr(one, part)[:, frames], getattr(other, part)[:, frames]
                torch.testing.assert_close(theirs, mine, rtol=0, atol=2e-6)
        torch.testing.assert_close(other.z_star / other.sigma[0], one.z_star / one.sigma[0])
    assert speech == (read.paired[0].n_frames < 100)
    for one, other in zip(kept.unpaired, read.unpaired, strict=True):
        torch.testing.assert_close(other[:, :], one[:, :], rtol=0, atol=2e-6)


def test_a_model_is_trained_from_arrays_and_remembers_it_on_resuming(long_config):
    small = {"network": {"levels": 2}, "training": {"first_stage": 2}}
    config = long_config(**small, checkpoint_every=1)
    folder = train(config)
    files = {path.name: path.read_bytes() for path in folder.iterdir()}
    cut_off(config.out, 2)
    train(config, resume=True)
    for name in ("model.safetensors", "config.yaml", "skeleton.json"):
        assert (folder / name).read_bytes() == files[name]
    motion = gk.load(folder).generate(seconds=2.0)
    assert np.isfinite(motion.positions()).all() and motion.n_frames == 60


@pytest.mark.parametrize("damage", ["short", "long", "pickle", "facts"])
def test_an_array_that_is_not_as_it_was_made_is_refused(long_config, damage):
    """Neither half of an array, nor one with other frames behind, nor a pickle is read."""
    config = long_config()
    data = load_training_data(config)
    path: Path = data.paired[0].motion.array.path
    whole = path.read_bytes()
    if damage == "pickle":
        np.save(path, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    elif damage == "facts":
        path.with_suffix(".json").write_text(json.dumps([1, 2]))
    else:
        path.write_bytes(whole[: len(whole) // 2] if damage == "short" else whole + whole)
    if damage != "facts":
        with pytest.raises(ConfigError, match=path.name):
            data.paired[0].motion[:, :4]
    if damage == "long":
        path.unlink()
    assert load_training_data(config).paired[0].motion[:, :4].isfinite().all()
    assert path.read_bytes() == whole


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.stress)])
def test_the_commands_plan_and_make_arrays_with_workers_and_train(
    long_config, gesturekit, tmp_path, caplog, workers
):
    """Those of workers are those of one process, as large as planned, and the training's."""
    caplog.set_level(logging.INFO)
    small = {"network": {"levels": 2}, "training": {"first_stage": 1}}
    config = long_config(**PLAIN_JOINTS, **small, losses={"arm_speed": 0.0}, in_memory=0.1)
    file = tmp_path / "config.yaml"
    file.write_text(dump_yaml(to_dict(config)))
    gesturekit("train", file, "--plan").ok()
    assert str(config.arrays_folder) in caplog.text and not config.arrays_folder.exists()
    gesturekit("train", file, "--arrays", "--workers", workers).ok()
    made = arrays_in(config)
    assert len(made) == 5 and not config.out.exists()
    with session(config, resume=False, folder=tmp_path / "plan") as (run, device, processes):
        trial = Trainer(config, run, device, processes, resume=False, trial=True)
        rates = trial.estimate().rates
    size = sum(np.load(path).nbytes for path in config.arrays_folder.rglob("*.npy"))
    assert np.dot(rates, (6.5, 5.0)) == pytest.approx(size, rel=0.005)
    gesturekit("train", file).ok()
    assert arrays_in(config) == made
    assert gesturekit("train", "--resume", config.out, "--arrays").status == 2
    alone = replace(config, arrays=tmp_path / "one")
    load_training_data(alone)
    for path in alone.arrays_folder.rglob("*.*"):
        other = config.arrays_folder / path.relative_to(alone.arrays_folder)
        assert other.read_bytes() == path.read_bytes()
