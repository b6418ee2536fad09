"""Training on a long corpus, whose recordings stay on disk."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from runs import cut_off, same_weights
from small_runs import small_diffusion

from gesturekit.corpus import Manifest, prepare
from gesturekit.corpus.speech import one_blas_thread
from gesturekit.diffusion import DiffusionConfig, train
from gesturekit.diffusion.training.batches import Batches
from gesturekit.diffusion.training.loading import load_training_data

ON_DISK = {"in_memory": 0.06}
"""A sample of 3.6 s of 13 s."""
KINDS: dict[str, dict[str, Any]] = {
    "speech": {"features": {"extractors": [{"kind": "logmel", "n_mels": 8}, {"kind": "prosody"}]}},
    "path": {"features": None, "path": True, "events": True, "styles": {"handed": ["left"]}},
    "all": {"path": True, "events": True, "styles": {}},
}
EVENTS = "time,name,duration\n0.5,kickLeft,0\n1.7,kickRight,0.4\n2.9,kickLeft,0\n"


@pytest.fixture
def mixed(tmp_path, write_pair, write_speech, gesture) -> Path:
    """A manifest of two styles with tables, and motion without speech.

    One recording is at 60 fps; the other's motion ends a frame before its speech.
    """
    folder = tmp_path / "in"
    for stem, fps, seed in (("a", 60.0, 1), ("b", 30.0, 2)):
        write_pair(folder, stem, 4.5, fps=fps, seed=seed)
        (folder / f"{stem}.events.csv").write_text(EVENTS)
    (folder / "a.path.csv").write_text("time,x,z,heading\n0,0,0,0\n2,1,2,90\n4,3,2,90\n")
    (tmp_path / "alone").mkdir()
    gesture(4.0, 30.0, seed=3).save(tmp_path / "alone" / "c.bvh")
    prepare([folder], tmp_path / "all.jsonl", unpaired_motion=[tmp_path / "alone"], holdout=0.0)
    write_speech(folder / "b.wav", 6.0, level=0.1)
    items = []
    for item in Manifest.load(tmp_path / "all.jsonl"):
        is_b = item.id == "b"
        items.append(replace(item, style="left" if is_b else "calm"))
        if is_b:
            items[-1] = replace(items[-1], duration=item.duration + 0.02)
    held_out = replace(items[0], id="held_out", duration=0.5, split="test")
    Manifest([*items, held_out]).save(tmp_path / "mixed.jsonl")
    return tmp_path / "mixed.jsonl"


@pytest.fixture
def config_of(mixed, tmp_path) -> Callable[..., DiffusionConfig]:
    """config_of("speech", seed=1, ...): a run of a kind of `KINDS` with changes."""
    base = {"augmentation": {"stretch": 0.6}, "unpaired": {"share": 0.3}}

    def make(kind: str, **changes: Any) -> DiffusionConfig:
        folders = {"out": str(tmp_path / "run"), "arrays": str(tmp_path / "arrays")}
        training = {"training": {"batch": 12}}
        return small_diffusion(mixed, tmp_path, training, base, KINDS[kind], folders, changes)

    return make


@pytest.fixture
def start(config_of, tmp_path) -> Callable[[str], str]:
    """start(kind): a model of this kind, whose statistics further runs take over."""

    def make(kind: str) -> str:
        return str(train(config_of(kind, out=str(tmp_path / "start"), training={"updates": 1})))

    return make


def arrays_in(folder: Path) -> set[str]:
    return {path.stem for path in folder.rglob("*.npy")}


@pytest.mark.parametrize("kind", [pytest.param("path", marks=pytest.mark.stress), "all"])
def test_windows_from_disk_are_those_from_memory(config_of, start, kind):
    changes = {"start_from": start(kind)}
    with one_blas_thread():  # as for arrays; the last bits depend on it
        memory = load_training_data(config_of(kind, **changes))
    disk = load_training_data(config_of(kind, **changes, **ON_DISK))
    assert memory.stored is None and disk.stored is not None
    known = [[(r.name, r.n_frames, r.is_paired) for r in d.recordings] for d in (memory, disk)]
    assert known[0] == known[1] and len(known[0]) == (9 if kind == "path" else 8)
    assert memory.seconds == pytest.approx(disk.seconds) and memory.sources == disk.sources
    batches = [Batches(data, config_of(kind, **changes)) for data in (memory, disk)]
    for update in range(5):
        one, other = (sampler.draw(update, slice(0, 12)) for sampler in batches)
        for name, value in vars(one).items():
            assert torch.equal(value, getattr(other, name)), name
    for one, other in zip(memory.recordings, disk.recordings, strict=True):
        assert np.array_equal(one.motion, other.motion[:])
        assert np.array_equal(one.condition, other.condition[:])


def test_statistics_are_those_of_a_sample(config_of, tmp_path, write_pair):
    write_pair(tmp_path / "long", "l", 40.0, seed=4)
    prepare([tmp_path / "long"], tmp_path / "long.jsonl", holdout=0.0)
    changes = {"corpus": str(tmp_path / "long.jsonl"), "unpaired": None}
    memory, disk = (
        load_training_data(config_of("speech", **changes, in_memory=m)) for m in (1.0, 0.3)
    )
    assert {disk.recordings[i].name for i, *_ in disk.sampled} == {"l", "l (mirrored)"}
    assert [one.n_frames for one in memory.recordings] == [40 * 30] * 2
    scale = memory.normaliser.scale
    assert ((memory.normaliser.mean - disk.normaliser.mean) / scale).abs().max() < 0.2
    assert (disk.normaliser.scale / scale).log().abs().max() < 0.1
    assert (disk.changes() / memory.changes()).log().abs().max() < 0.1


@pytest.mark.parametrize("kind", ["speech", pytest.param("path", marks=pytest.mark.stress)])
def test_a_run_from_disk_is_resumed_to_the_last_bit(config_of, tmp_path, kind):
    whole, cut = (
        config_of(kind, **ON_DISK, out=str(tmp_path / name), training={"changes": 0})
        for name in ("whole", "cut")
    )
    train(whole)
    shutil.copytree(whole.out, cut.out)
    cut_off(cut.out, 6)
    train(cut, resume=True)
    assert same_weights(whole.out / "model", cut.out / "model")


def test_only_what_has_changed_makes_new_arrays(config_of, start, tmp_path, gesture):
    model, folder = start("all"), tmp_path / "arrays"

    def new(**changes: Any) -> int:
        known = arrays_in(folder)
        load_training_data(config_of("all", start_from=model, **ON_DISK | changes))
        return len(arrays_in(folder) - known)

    # Three recordings, and the speech of three phases.
    assert new() == 6
    assert new() == 0
    assert new(seed=1, in_memory=0.1, training={"window": 1.0}) == 0
    assert new(augmentation={"mirror": False}) == 3
    (tmp_path / "in" / "b.events.csv").write_text(EVENTS.replace("1.7", "1.9"))
    assert new() == 1
    gesture(4.5, 30.0, seed=9).save(tmp_path / "in" / "b.bvh")
    assert new() == 1


@pytest.mark.stress
def test_workers_make_the_arrays_of_one_process(config_of, tmp_path):
    one, two = (
        load_training_data(config_of("speech", **ON_DISK, arrays=str(tmp_path / str(n)), workers=n))
        for n in (1, 2)
    )
    assert one.stored == two.stored
    files = [sorted((tmp_path / str(n)).rglob("*.npy")) for n in (1, 2)]
    assert len(files[0]) == 6
    for first, second in zip(*files, strict=True):
        assert first.read_bytes() == second.read_bytes()
