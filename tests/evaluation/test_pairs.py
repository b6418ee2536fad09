"""Generated clips find their recordings, sounds and tracks by name."""

import re
from pathlib import Path

import pytest

from gesturekit.corpus import Item, Manifest
from gesturekit.errors import CorpusError
from gesturekit.evaluation import Items, find_pairs


@pytest.fixture
def touch(tmp_path):
    """touch(folder, name, ...): empty files; returns the folder."""

    def make(folder: str, *names: str) -> Path:
        for name in names:
            path = tmp_path / folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
        return tmp_path / folder

    return make


@pytest.fixture
def recorded(touch):
    """recorded(name, ...): recordings in a folder."""
    return lambda *names: Items.of_folder(touch("recordings", *names))


def test_clips_find_their_recordings_by_path_stem_sample_and_window(touch, recorded):
    recordings = recorded("anna/a.bvh", "anna/b.bvh", "ben/b.bvh", "c_s2.bvh")
    made = touch("made", "anna/b.npz", "a_s1.npz", "a_s2.npz", "a_w003_s1.bvh", "c_s2.bvh")
    found = find_pairs(made, recordings)
    assert [(pair.name, pair.stem, pair.window) for pair in found.pairs] == [
        ("a_s1", "anna/a", None),
        ("a_s2", "anna/a", None),
        ("a_w003_s1", "anna/a", 3),
        ("anna/b", "anna/b", None),
        ("c_s2", "c_s2", None),  # a recording that is called so, not a sample of c
    ]
    assert found.excluded == []


def test_recordings_without_sound_are_reported_once(touch, recorded, tmp_path):
    recordings = recorded("a.bvh", "b.bvh")
    made = touch("made", "a_s1.npz", "a_s2.npz", "b_s1.npz")
    found = find_pairs(made, recordings, audio=touch("sound", "b.wav"))
    assert [(item.name, item.what) for item in found.excluded] == [("a", "speech")]
    assert str(tmp_path / "sound") in found.excluded[0].reason
    assert len(found.pairs) == 3


def test_clips_without_a_recording_are_excluded_with_a_reason(touch, recorded):
    recordings = recorded("anna/b.bvh", "ben/b.bvh", "speech.bvh")
    found = find_pairs(touch("made", "b.npz", "speach.npz", "speech.npz"), recordings)
    assert [pair.name for pair in found.pairs] == ["speech"]
    reasons = {item.name: item.reason for item in found.excluded}
    assert "anna/b, ben/b" in reasons["b"]
    assert "speech" in reasons["speach"]


def test_one_file_is_the_reference_of_everything(touch):
    made = touch("made", "x_s1.npz", "y.npz")
    reference = Items.of_folder(touch("recordings", "a.bvh", "b.bvh") / "a.bvh")
    assert {pair.stem for pair in find_pairs(made, reference).pairs} == {"a"}


def test_sound_and_semantic_tracks_come_along(touch, recorded):
    made, recordings = touch("made", "a_s1.npz", "b.npz"), recorded("p/a.bvh", "b.bvh")
    sounds, tracks = touch("wav", "p/a.flac"), touch("sem", "a.txt")
    a, b = reversed(find_pairs(made, recordings, audio=sounds, semantic=tracks).pairs)
    assert (a.audio.audio.name, a.semantic.name) == ("a.flac", "a.txt")
    assert (b.audio, b.semantic) == (None, None)


def test_wrong_folders_are_errors_that_name_what_was_found(touch, recorded, tmp_path):
    made, recordings = touch("made", "a.npz"), recorded("b.bvh")
    with pytest.raises(CorpusError, match=r"(?=.*\ba\b).*\bb\b"):
        find_pairs(made, recordings)
    with pytest.raises(CorpusError, match=r"\bz\b"):
        find_pairs(touch("again", "b.npz"), recordings, audio=touch("wav", "z.wav"))
    with pytest.raises(CorpusError, match=r"sounds.*\.npz"):
        find_pairs(touch("sounds", "a.wav"), recordings)
    with pytest.raises(CorpusError, match="absent"):
        find_pairs(tmp_path / "absent", recordings)
    with pytest.raises(CorpusError, match=r"a\.wav.*\.npz"):
        find_pairs(touch("sounds", "a.wav") / "a.wav", recordings)


def manifest(folder: Path, *items: Item) -> Items:
    Manifest(items).save(folder / "corpus.jsonl")
    return Items.of_manifest(folder / "corpus.jsonl", "test")


def test_clips_of_other_items_of_a_manifest_are_set_aside_and_missing_ones_named(touch, tmp_path):
    sound = touch("sound", "a.wav") / "a.wav"
    motion = touch("motion", "a.bvh") / "a.bvh"
    more = {"motion": motion, "duration": 2.0, "speaker": "ann", "style": "sad"}
    reference = manifest(
        tmp_path,
        Item(id="a", audio=sound, split="test", take="day", **more),
        Item(id="b", audio=None, split="test", **more),
        Item(id="c", audio=None, split="test", **more),
        *(Item(id=f"t{k}", audio=None, split="train", **more) for k in range(4)),
        Item(id="v", audio=None, split="valid", **more),
        Item(id="quiet", audio=sound, motion=None, duration=2.0, split="test"),
    )
    made = touch(
        "made", "a_s1.npz", "a_s2.npz", "b.npz", *(f"t{k}.npz" for k in range(4)), "quiet.npz",
        "x.npz",
    )  # fmt: skip
    found = find_pairs(made, reference)
    assert [(p.name, p.stem, p.take, p.speaker, p.style) for p in found.pairs] == [
        ("a_s1", "a", "day", "ann", "sad"),
        ("a_s2", "a", "day", "ann", "sad"),
        ("b", "b", found.pairs[2].reference.take, "ann", "sad"),
    ]
    assert [p.audio and p.audio.id for p in found.pairs] == ["a", "a", None]
    assert [(e.name, e.what) for e in found.excluded] == [("x", "clip"), ("c", "clip")]
    assert str(made) in found.excluded[1].reason
    quiet, train = found.notes
    for note, facts in ((quiet, "1 corpus.jsonl quiet"), (train, "4 train t0 t1")):
        assert all(re.search(rf"\b{fact}\b", note) for fact in facts.split()), note
    with pytest.raises(CorpusError, match="t0"):
        find_pairs(touch("train", "t0.npz", "quiet.npz"), reference)
    with pytest.raises(CorpusError, match=r"(?=.*\bt0\b).*\bz\b"):
        find_pairs(touch("other", "t0.npz", "z.npz"), reference)
    none = manifest(tmp_path, Item(id="q", audio=sound, motion=None, duration=2.0, split="test"))
    with pytest.raises(CorpusError, match="corpus.jsonl.*motion"):
        find_pairs(made, none)


def test_names_of_parts_of_recordings_are_advised_to_give_the_corpus(touch, recorded, tmp_path):
    recordings = recorded("a.bvh")
    for name, advised in (("x@1.5-2.25_s1", True), ("x@1-2", True), ("x@1", False)):
        made = touch(name, f"{name}.npz")
        with pytest.raises(CorpusError) as refused:
            find_pairs(made, recordings)
        assert ("--corpus" in str(refused.value)) == advised
    assert str(recordings) == str(tmp_path / "recordings") and not recordings.training
    (pair,) = find_pairs(touch("made", "a.npz"), recordings).pairs
    assert (pair.take, pair.speaker, pair.audio) == ("a", None, None)


def test_the_sound_of_a_recording_is_one_file_or_that_of_its_name(touch, recorded):
    recordings = recorded("p/a.bvh", "q/a.bvh", "b.bvh")
    made = touch("made", "p/a.npz", "b.npz")
    sounds = touch("sound", "x/a.wav", "y/a.wav", "b.wav")
    found = find_pairs(made, recordings, audio=sounds)
    assert [pair.audio and pair.audio.audio.name for pair in found.pairs] == ["b.wav", None]
    assert [(e.name, e.what) for e in found.excluded] == [("p/a", "speech")]
    one = find_pairs(made, recordings, audio=sounds / "b.wav", semantic=touch("t", "b.txt"))
    assert [pair.audio.audio.name for pair in one.pairs] == ["b.wav", "b.wav"]
    assert [(e.name, e.what) for e in one.excluded] == [("p/a", "srgr")]
