"""Recordings of a run: the items that are read, and what is known of them."""

import logging
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gesturekit.corpus import Item, Manifest
from gesturekit.errors import ConfigError, CorpusError
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
    with pytest.raises(CorpusError, match=r"(?=.*item b\b)(?=.*style)(?=.*\b2\b)"):
        read(config, styles=True)


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


@pytest.mark.parametrize(("fps", "warned"), [(30.0, False), (31.0, True)])
def test_rates_are_those_of_files_and_a_far_higher_one_is_warned_about(corpus, caplog, fps, warned):
    rates = (20.0, 10.0, 10.0)
    found = read(corpus(*({"id": f"r{k}", "fps": x} for k, x in enumerate(rates)), fps=fps))
    assert found.rates == [20.0, 10.0, 10.0] and found.recorded_fps == 10.0
    assert [motion.fps for motion in found.motions] == found.rates
    assert bool(re.search(r"(?=.*\b31\b)(?=.*\b20\b)", caplog.text)) == warned


@pytest.mark.parametrize(("speech", "needs"), [(True, "audio"), (False, "motion")])
def test_a_corpus_without_what_a_model_needs_is_refused(corpus, speech, needs):
    alone = {"id": "alone", "speech": False} if speech else {"id": "talk", "moves": False}
    with pytest.raises(CorpusError, match=rf"(?=.*c\.jsonl)(?=.*train)(?=.*{needs})"):
        read(corpus(alone, {"id": "test", "split": "test"}), speech=speech)


def test_each_speaker_has_one_body_and_recordings_of_nobody_are_of_one_person(shaped, caplog):
    caplog.set_level(logging.WARNING)
    items = shaped(
        *(("ann", "female", 1.0), ("bob", "male", 5.0), ("ann", "female", 2.0)),
        *(("ann", "male", 3.0), (None, None, -1.0), (None, "male", -3.0)),
    )
    shapes = [m.skeleton.body_shape for m in load_motions(items, Path("c.jsonl"), 10.0, {})]
    assert [shape.betas for shape in shapes] == [(x,) for x in (1.5, 5.0, 1.5, 1.5, -1.0, -1.0)]
    assert {shape.gender for shape in shapes[:4:2]} == {"female"}, "as most of hers"
    ann, nobody = caplog.messages
    assert re.search(r"(?=.*\bann\b)(?=.*\b3\b)", ann) and re.search(r"\b2\b", nobody)
