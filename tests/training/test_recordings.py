"""Recordings of a run: the items that are read, and what is known of them."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gesturekit.corpus import Item, Manifest
from gesturekit.corpus.item import file_fingerprint
from gesturekit.errors import ConfigError, CorpusError
from gesturekit.training.data.sources import TrainedSegment
from gesturekit.training.recordings import Recordings, load_motions, load_recordings
from gesturekit.training.run_config import RunConfig

Corpus = Callable[..., RunConfig]


@pytest.fixture
def corpus(tmp_path, gesture) -> Corpus:
    """corpus({"id": "a", "seconds": 3.0, "fps": 60.0, ...}, ...): a run on these recordings.

    Each may have `speech`, `size` of its body, and fields of `Item`; its sound is never read.
    """

    def make(*recordings: dict[str, Any], **settings: Any) -> RunConfig:
        items = []
        for given in recordings:
            one = {"seconds": 2.0, "fps": 10.0, "speech": True, "size": 1.0, "moves": True} | given
            seconds, fps, size = (one.pop(name) for name in ("seconds", "fps", "size"))
            file = tmp_path / f"{one['id']}.npz"
            gesture(seconds, fps).scaled(size).save(file)
            audio = Path("/sound.wav") if one.pop("speech") else None
            motion = file if one.pop("moves") else None
            items.append(Item(audio=audio, motion=motion, **{"duration": seconds} | one))
        Manifest(items).save(tmp_path / "c.jsonl")
        settings = {"fps": 10.0, "checkpoint_every": 1} | settings
        return RunConfig(corpus=tmp_path / "c.jsonl", out=tmp_path / "run", **settings)

    return make


def read(config: RunConfig, **changes: Any) -> Recordings:
    return load_recordings(config, config.parts, **{"speech": True, "styles": False} | changes)


def test_a_model_of_speech_reads_pairs_and_one_of_motion_all_that_moves(corpus):
    config = corpus(
        {"id": "pair"},
        {"id": "alone", "speech": False},
        {"id": "talk", "moves": False, "seconds": 7.0},
        {"id": "test", "split": "test"},
    )
    paired, moved = read(config), read(config, speech=False)
    assert [[item.id for item in found.items] for found in (paired, moved)] == [
        *(["pair"], ["alone", "pair"])
    ]
    assert [item.id for item in paired.unpaired] == ["talk"] and moved.unpaired == ()
    assert paired.lengths == (2.0, 7.0) and moved.lengths == (4.0, 0.0)
    assert paired.excerpts is None and paired.read == paired.items
    assert [motion.n_frames for motion in moved.motions] == [20, 20]
    other = read(config, others=lambda manifest: manifest.in_split("test"))
    assert [item.id for item in other.unpaired] == ["test"] and other.lengths == (2.0, 2.0)
    assert paired.styles == () and paired.style_of == [0] and moved.style_of == [0, 0]


def test_held_out_parts_of_a_training_take_are_warned_about(corpus, caplog):
    read(corpus({"id": "a", "take": "monday"}, {"id": "b", "split": "test", "take": "tuesday"}))
    assert not caplog.messages
    read(corpus({"id": "a", "take": "monday"}, {"id": "b", "split": "test", "take": "monday"}))
    assert "held-out items with neighbours in training, of the same take (monday)" in caplog.text


def test_a_corpus_without_what_a_model_needs_is_refused(corpus):
    config = corpus({"id": "alone", "speech": False}, {"id": "test", "split": "test"})
    with pytest.raises(CorpusError, match=r"c\.jsonl: no item of split train has both audio and"):
        read(config)
    config = corpus({"id": "talk", "moves": False}, {"id": "test", "split": "test"})
    with pytest.raises(CorpusError, match="no item of split train has motion; run gesturekit"):
        read(config, speech=False)


def test_styles_are_in_alphabetical_order_and_checked_before_motion_is_read(corpus, tmp_path):
    labels = ("wild", "calm", "old", "calm")
    config = corpus(*({"id": f"r{k}", "style": style} for k, style in enumerate(labels)))
    found = read(config, styles=True)
    assert found.styles == ("calm", "old", "wild") and found.style_of == [2, 0, 1, 0]
    assert read(config).styles == ()
    trial = read(config, styles=True, trial=True)
    assert trial.style_of == [2, 0, 1, 0], "a short corpus is tried whole"
    for file in tmp_path.glob("*.npz"):
        file.unlink()

    def check(styles: Any) -> None:
        raise ConfigError(", ".join(styles))

    with pytest.raises(ConfigError, match="^calm, old, wild$"):
        read(config, styles=True, check_styles=check)
    config = corpus({"id": "a", "style": "old"}, {"id": "b"}, {"id": "c"})
    with pytest.raises(CorpusError, match=r"item b has no style \(2 have none\)"):
        read(config, styles=True)


def test_rates_are_those_of_files_and_the_most_common_one_is_the_corpus_s(corpus):
    rates = (20.0, 10.0, 10.0, 30.0)
    found = read(corpus(*({"id": f"r{k}", "fps": fps} for k, fps in enumerate(rates))))
    assert found.rates == [20.0, 10.0, 10.0, 30.0] and found.recorded_fps == 10.0
    assert [motion.fps for motion in found.motions] == found.rates


@pytest.mark.parametrize(("fps", "warned"), [(30.0, False), (30.1, True)])
def test_the_frame_rate_is_compared_with_the_highest_of_the_files(corpus, caplog, fps, warned):
    """Half as much again as 20 fps is no reason to warn."""
    read(corpus({"id": "a", "fps": 20.0}, {"id": "b", "fps": 10.0}, fps=fps))
    assert ("far above the recordings' 20" in caplog.text) == warned


def test_a_speaker_has_a_skeleton_and_an_unnamed_one_has_none(corpus):
    people = [("ann", 1.2), (None, 1.0), ("bob", 0.9), ("ann", 1.2)]
    named = [{"id": f"r{k}", "speaker": s, "size": m} for k, (s, m) in enumerate(people)]
    found = read(corpus(*named))
    usual = found.motions[1].skeleton.offsets
    assert set(found.speakers) == {"ann", "bob"}
    for name, size in (("ann", 1.2), ("bob", 0.9)):
        np.testing.assert_allclose(found.speakers[name].offsets, size * usual, atol=1e-9)


def test_the_record_of_a_training_has_every_recording_with_its_rate(corpus):
    config = corpus({"id": "a", "style": "old", "fps": 20.0}, {"id": "b", "speaker": "ann"})
    found = read(config, speech=False)
    assert [item.audio for item in found.items] == [Path("/sound.wav")] * 2
    silent = [replace(item, audio=None) for item in found.items]
    known = replace(found, items=tuple(silent), whole=(tuple(silent), ()))
    known = replace(known, whole=(known.items, ()))
    prints = [file_fingerprint(item.motion) for item in silent]
    one = TrainedSegment("a", prints[0], None, 0.0, 2.0, 20.0, "old", None)
    other = TrainedSegment("b", prints[1], None, 0.0, 2.0, 10.0, None, "ann")
    assert known.sources([20.0, 10.0]) == (one, other)


def test_a_trial_reads_half_a_minute_and_knows_the_whole(corpus, tmp_path):
    """The record of the whole corpus is made without reading its files."""
    talk = {"id": "talk", "moves": False, "seconds": 50.0}
    styles = ("old", "wild", "wild")
    long = [{"id": f"r{k}", "seconds": 40.0, "style": style} for k, style in enumerate(styles)]
    rare = {"id": "rare", "seconds": 0.5, "style": "rare"}
    config = corpus(*long, talk, rare)
    found = read(config, styles=True, trial=True)
    assert [part.duration for part in found.items] == [10.0] * 3  # of three styles
    assert [motion.n_frames for motion in found.motions] == [100] * 3
    assert found.styles == ("old", "rare", "wild")
    assert [found.styles[k] for k in found.style_of] == [part.style for part in found.items]
    assert found.unpaired[0].duration == 30.0 and found.lengths == (120.5, 50.0)
    sources = found.sources([])
    assert [source.id for source in sources] == ["r0", "r1", "r2", "rare"]
    assert [source.duration for source in sources] == [40.0, 40.0, 40.0, 0.5]
    assert sources[2].motion == str(tmp_path / "r2.npz") and sources[2].audio == "/sound.wav"


@pytest.mark.parametrize(("minutes", "is_long"), [(1.0, False), (0.99, True)])
def test_a_corpus_longer_than_memory_is_sampled(corpus, minutes, is_long):
    """45 s with motion and 15 s without are a minute."""
    talk = {"id": "talk", "moves": False, "seconds": 15.0}
    config = corpus({"id": "a", "seconds": 45.0}, talk, in_memory=minutes)
    found = read(config)
    assert found.is_long(config) == is_long == (found.excerpts is not None)
    config = replace(config, in_memory=minutes / 3)
    part = read(config)
    assert [item.id for item in part.items] == ["a"] and part.items[0].duration == 45.0
    read_seconds = sum(item.duration for item in part.read)
    assert read_seconds == pytest.approx(20.0 * minutes)
    assert sum(motion.duration for motion in part.motions) == pytest.approx(read_seconds, abs=0.2)


def test_motion_is_read_again_on_the_rig_of_the_corpus(corpus, gesture, tmp_path):
    config = corpus({"id": "a", "fps": 20.0}, {"id": "b"})
    found = read(config)
    rig = found.rig(RunConfig(corpus=Path("c.jsonl"), out=Path(), fps=10, checkpoint_every=1), {})
    again = rig.load(found.items[0])
    assert again.info["recorded_fps"] == 20.0
    np.testing.assert_array_equal(again.rotations, found.motions[0].rotations)
    gesture(2.0, 10.0).keep(["Hips", "Spine"]).save(tmp_path / "b.npz")
    with pytest.raises(CorpusError, match=r"c\.jsonl: item b: another skeleton"):
        rig.load(found.items[1])
    with pytest.raises(CorpusError, match=r"c\.jsonl: item b: another skeleton"):
        read(config)


def test_all_that_an_array_of_motion_depends_on_is_in_its_origin(corpus, tmp_path):
    config = corpus({"id": "a", "speaker": "ann"})
    found = read(config)
    (item,), rig = found.items, found.rig(config, {})
    known = rig.origin(item)
    for changed in (
        replace(item, duration=1.9),
        replace(item, motion_start=0.1),
        replace(item, mirror=True),
        replace(item, reading={"height": 1.8}),
    ):
        assert rig.origin(changed) != known
    assert replace(rig, parts={"hips": "Hips"}).origin(item) != known
    assert rig.origin(replace(item, audio=None, id="b")) == known
    item.motion.write_bytes(item.motion.read_bytes() + b" ")
    assert rig.origin(item) != known


@pytest.fixture
def shaped(tmp_path) -> Callable[..., list[Item]]:
    """shaped(("ann", "female", 1.0), ...): recordings of body models, each with one beta."""

    def make(*people: tuple[str | None, str | None, float]) -> list[Item]:
        items = []
        for k, (speaker, gender, beta) in enumerate(people):
            values = {"poses": np.zeros((20, 72)), "trans": np.zeros((20, 3)), "betas": [beta]}
            values |= {} if gender is None else {"gender": gender}
            file = tmp_path / f"{k}.npz"
            np.savez(file, mocap_framerate=10, **values)
            items.append(Item(id=str(k), audio=None, motion=file, duration=2.0, speaker=speaker))
        return items

    return make


def test_each_speaker_has_one_body_and_recordings_of_nobody_are_of_one_person(shaped, caplog):
    caplog.set_level(logging.WARNING)
    items = shaped(
        *(("ann", "female", 1.0), ("bob", "male", 5.0), ("ann", "female", 2.0)),
        *((None, None, -1.0), ("bob", "male", 5.0), (None, None, -3.0), (None, "male", 9.0)),
        *((None, "female", 9.0),),
    )
    motions = load_motions(items, Path("c.jsonl"), 10.0, {})
    shapes = [motion.skeleton.body_shape for motion in motions]
    assert [shape.betas for shape in shapes] == [
        *((1.5,), (5.0,), (1.5,), (-2.0,), (5.0,), (-2.0,), (-2.0,), (-2.0,))
    ]
    ann, nobody = [line for line in caplog.messages if "body shapes" in line]
    assert ann == (
        "c.jsonl: 2 recordings of speaker ann have 2 body shapes; the mean of their betas is used"
    )
    assert nobody.startswith("c.jsonl: 4 recordings of an unnamed speaker (gesturekit prepare")
    assert "have 4 body shapes and genders female, male; the mean" in nobody
    assert nobody.endswith("is used, as neutral")


def test_motion_is_read_again_on_the_body_of_its_speaker(shaped, tmp_path):
    Manifest(shaped(("ann", None, 1.0), ("bob", None, 5.0), ("ann", None, 2.0))).save(
        tmp_path / "c.jsonl"
    )
    config = RunConfig(corpus=tmp_path / "c.jsonl", out=tmp_path, fps=10, checkpoint_every=1)
    found = read(config, speech=False)
    rig = found.rig(config, {})
    for item, beta in zip(found.items, (1.5, 5.0, 1.5), strict=True):
        assert rig.load(item).skeleton.body_shape.betas == (beta,)
        assert rig.origin(item)["body"] == [beta]
    unknown = replace(found.items[0], speaker="cy")
    assert rig.load(unknown).skeleton.body_shape.betas == (1.0,)
    assert rig.origin(unknown)["body"] is None


def test_a_speaker_of_two_genders_is_of_that_of_most_recordings(shaped, caplog):
    people = [("ann", "female", 1.0), ("ann", "male", 9.0), ("ann", "female", 2.0)]
    motions = load_motions(shaped(*people), Path("c.jsonl"), 10.0, {})
    assert {motion.skeleton.body_shape.gender for motion in motions} == {"female"}
    assert "genders female, male; the mean of their betas is used, as female" in caplog.text


def test_a_plan_says_that_it_counts_the_bodies_of_an_excerpt(shaped, tmp_path, caplog):
    """Of 40 s in recordings of 2 s, a plan reads 30 s."""
    Manifest(shaped(*((None, None, float(k)) for k in range(20)))).save(tmp_path / "c.jsonl")
    config = RunConfig(corpus=tmp_path / "c.jsonl", out=tmp_path, fps=10, checkpoint_every=1)
    read(config, speech=False, trial=True)
    assert "c.jsonl (an excerpt of it, 15 of 20 recordings): 15 recordings of an" in caplog.text
    caplog.clear()
    read(config, speech=False)
    assert "excerpt" not in caplog.text and "20 recordings of an unnamed" in caplog.text
