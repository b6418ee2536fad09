import json
import math
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from audio_features import Wave
from gesturekit.corpus import Item, Manifest
from gesturekit.corpus.manifest import check_id, muted
from gesturekit.errors import CorpusError

RECORD = {
    "id": "a",
    "audio": "a.wav",
    "motion": "../elsewhere/a.bvh",
    "audio_start": 0.5,
    "motion_start": 1,
    "duration": 2.5,
    "speaker": None,
    "style": "calm",
    "split": "train",
    "text": None,
    "mirror": False,
    "conditions": {"path": "a_path.npz"},
}


def write(path: Path, *records: object) -> Path:
    lines = [json.dumps({"schema": 1}), *map(json.dumps, records)]
    path.write_text("".join(line + "\n" for line in lines))
    return path


def test_a_body_model_is_found_from_a_moved_manifest(tmp_path):
    record = RECORD | {"reading": {"body_model": "../models", "height": 1.7}}
    for name in ("old", "new"):
        (tmp_path / name / "corpus").mkdir(parents=True)
    (item,) = Manifest.load(write(tmp_path / "old/corpus/m.jsonl", record))
    assert item.reading == {"body_model": tmp_path / "old/models", "height": 1.7}
    Manifest([item]).save(tmp_path / "old/corpus/n.jsonl")
    (tmp_path / "old/corpus/n.jsonl").rename(tmp_path / "new/corpus/n.jsonl")
    (item,) = Manifest.load(tmp_path / "new/corpus/n.jsonl")
    assert item.reading == {"body_model": tmp_path / "new/models", "height": 1.7}


def test_paths_are_relative_to_the_manifest_and_may_lead_out_of_its_folder(tmp_path):
    folder = tmp_path / "corpus"
    folder.mkdir()
    item = Manifest.load(write(folder / "m.jsonl", RECORD)).items[0]
    assert item.audio == folder / "a.wav"
    assert item.motion == tmp_path / "elsewhere" / "a.bvh"
    assert item.conditions == {"path": folder / "a_path.npz"}
    assert (item.audio_start, item.motion_start, item.duration) == (0.5, 1.0, 2.5)


def test_a_saved_manifest_reads_back_and_has_the_same_bytes_whatever_the_order(tmp_path):
    about = {"motion": None, "duration": 1.0, "text": "Grüße"}
    items = [Item(id=n, audio=tmp_path / f"{n}.wav", **about) for n in ("b", "a/x", "c")]
    Manifest(items).save(tmp_path / "one.jsonl")
    Manifest(reversed(items)).save(tmp_path / "two.jsonl")
    assert (tmp_path / "one.jsonl").read_bytes() == (tmp_path / "two.jsonl").read_bytes()
    loaded = Manifest.load(tmp_path / "one.jsonl")
    assert loaded.items == tuple(sorted(items, key=lambda item: item.id))
    lines = (tmp_path / "one.jsonl").read_text().splitlines()
    assert json.loads(lines[0])["schema"] == 1
    assert json.loads(lines[1]).keys() >= RECORD.keys()
    assert not Path(json.loads(lines[1])["audio"]).is_absolute()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"colour": "red"}, "'colour'"),
        ({"channel": 0}, r"(?=.*channel).*\b0"),
        ({"reading": {"colour": "red"}}, "reading.colour.*'red'"),
        ({"reading": {"body_model": "/b.npz"}}, "(?=.*body_model).*/b.npz"),
        ({"duration": "long"}, "(?=.*duration).*long"),
        ({"duration": 10**400}, "duration"),
        ({"duration": 0}, "(?=.*duration).*above 0"),
        ({"audio_start": -0.5}, "(?=.*audio_start).*-0.5"),
        ({"motion_start": -0.5}, "(?=.*motion_start).*-0.5"),
        ({"split": "dev"}, "(?=.*split).*'dev'"),
        ({"audio": "/data/a.wav"}, "(?=.*audio).*'/data/a.wav'"),
        ({"audio": "C:\\data\\a.wav"}, "(?=.*audio).*'C:"),
        ({"audio": None, "motion": None}, "(?=.*audio).*motion"),
        ({"audible": [[2, 1]]}, r"(?=.*audible)(?=.*\b2\b).*\b1\b"),
        ({"audible": [[-1, 2]]}, "(?=.*audible).*-1"),
        ({"audible": [[0, 1, 2]]}, "audible"),
        ({"id": "../../etc/a"}, r"'\.\./\.\./etc/a'"),
        ({"id": "a\nb"}, r"'a\\nb'"),
    ],
)
def test_an_invalid_field_is_reported_with_file_and_line(tmp_path, change, message):
    path = write(tmp_path / "m.jsonl", {**RECORD, "id": "first"}, {**RECORD, **change})
    with pytest.raises(CorpusError, match=rf"m\.jsonl:3\b.*{message}"):
        Manifest.load(path)


@pytest.mark.parametrize("field", ["duration", "audio_start", "motion_start"])
def test_an_item_neither_begins_nor_ends_at_infinity(tmp_path, field):
    fields = {"duration": 1.0, field: math.inf}
    with pytest.raises(CorpusError, match=f"(?=.*{field}).*inf"):
        Item(id="a", audio=None, motion=tmp_path / "a.bvh", **fields)


def test_an_id_used_twice_is_named(tmp_path):
    with pytest.raises(CorpusError, match=r"m\.jsonl.*'a'"):
        Manifest.load(write(tmp_path / "m.jsonl", RECORD, RECORD))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "m.jsonl.*schema"),
        (b'{"schema": 7}\n', "m.jsonl:1.*7 "),
        (b"id,audio\n", "m.jsonl:1.*gesturekit prepare"),
        (b'{"schema": 1}\n[1]\n', "m.jsonl:2: "),
        (b'{"schema": 1}\n{"id": "\xff"}\n', "m.jsonl:2: "),
        (b'{"schema": 1}\n{"duration": NaN}\n', "m.jsonl:2.*NaN"),
        (b'{"schema": 1}\n' + b"[" * 100_000 + b"\n", "m.jsonl:2: "),
        (b'{"schema": 1}\n' + b" " * 3_000_000, "m.jsonl:2: "),
    ],
)
def test_files_that_are_not_manifests_are_refused(tmp_path, content, message):
    path = tmp_path / "m.jsonl"
    with pytest.raises(CorpusError, match="m.jsonl"):
        Manifest.load(path)
    path.write_bytes(content)
    with pytest.raises(CorpusError, match=message):
        Manifest.load(path)


def test_items_are_found_by_kind_and_split(tmp_path):
    pair = Item(id="pair", audio=tmp_path / "a.wav", motion=tmp_path / "a.bvh", duration=1.0)
    held, speech = replace(pair, id="held", split="test"), replace(pair, id="speech", motion=None)
    manifest = Manifest([pair, held, speech, replace(pair, id="dance", audio=None)])
    assert [item.id for item in manifest.paired()] == ["held", "pair"]
    assert [item.id for item in manifest.paired("train")] == ["pair"]
    assert [item.id for item in manifest.unpaired("train")] == ["speech"]
    assert [item.id for item in manifest.motion_alone()] == ["dance"]
    with pytest.raises(CorpusError, match="'speech'"):
        manifest.unpaired()[0].load_motion()
    with pytest.raises(CorpusError, match="(?=.*'dance').*audio"):
        manifest.motion_alone()[0].load_wave()
    with pytest.raises(CorpusError, match="'dev'"):
        manifest.paired("dev")


def test_an_item_loads_its_own_stretch_of_both_files(tmp_path, write_pair, gesture):
    audio, motion = write_pair(tmp_path, "a", 4.0)
    item = Item(id="a", audio=audio, motion=motion, audio_start=1.0, motion_start=1.0, duration=2.0)
    assert item.load_wave().duration == 2.0
    part, whole = item.load_motion(), gesture(4.0)
    assert part.n_frames == 60
    assert abs(part.positions() - whole.positions()[30:90]).max() < 1e-4
    mirrored = replace(item, mirror=True).load_motion().positions()
    left, right = whole.skeleton.index("LeftHand"), whole.skeleton.index("RightHand")
    assert abs(mirrored[:, left] - part.positions()[:, right] * [-1, 1, 1]).max() < 1e-4
    with pytest.raises(CorpusError, match=r"(?=.*\b30\b)(?=.*\b150\b)(?=.*a\.bvh).*\b120\b"):
        replace(item, duration=4.0).load_motion()


def test_a_path_begins_where_the_motion_does_or_else_the_sound(tmp_path):
    """A walk of 1 m/s along +Z and 0.5 m/s to the left: mirrored, it leads to the right."""
    (tmp_path / "p.csv").write_text("time,x,z\n0,0,0\n10,5,10\n")
    begins = {"audio_start": 1.0, "motion_start": 3.0, "duration": 2.0}
    item = Item(
        id="a", audio=Path("a.wav"), motion=None, conditions={"path": tmp_path / "p.csv"}, **begins
    )
    for own, first in ((item, 1.0), (replace(item, motion=Path("a.bvh")), 3.0)):
        path = own.load_path(10.0, 21)
        np.testing.assert_allclose(path.positions[0], [first / 2, first], atol=1e-6)
        np.testing.assert_allclose(path.positions[20], [first / 2 + 1, first + 2], atol=1e-6)
        turned = replace(own, mirror=True).load_path(10.0, 21)
        np.testing.assert_allclose(turned.positions, path.positions * [-1, 1], atol=1e-6)
    assert replace(item, conditions={}).load_path(10.0, 21) is None


def test_events_are_those_that_reach_into_the_item(tmp_path):
    (tmp_path / "e.csv").write_text(
        "time,name,duration\n0,gone,1.5\n1.5,nod,2\n2,kick,\n3.5,long,9\n4,next,1\n"
    )
    about = {"duration": 2.0, "motion_start": 2.0, "conditions": {"events": tmp_path / "e.csv"}}
    item = Item(id="a", audio=Path("a.wav"), motion=Path("a.bvh"), audio_start=0.5, **about)
    wanted = [(0.0, "nod", 1.5), (0.0, "kick", 0.0), (1.5, "long", 9.0)]
    assert [(e.time, e.name, e.duration) for e in item.load_events()] == wanted
    first = replace(item, motion=None).load_events()[0]
    assert (first.time, first.name, first.duration) == (0.0, "gone", 1.0)


class Model:
    """A model that takes a path and the event `kick`, of one style and one speaker."""

    fps, styles, speakers = 10.0, ("calm",), ("ann",)
    inputs = SimpleNamespace(path=True, events=("kick",))


def test_a_model_is_controlled_by_what_it_has_of_an_item(tmp_path):
    (tmp_path / "e.csv").write_text("time,name,duration\n1,kick,\n1.25,nod,\n1.5,kick,0.25\n")
    (tmp_path / "p.csv").write_text("time,x,z\n0,0,0\n9,0,9\n")
    files = {"events": tmp_path / "e.csv", "path": tmp_path / "p.csv"}
    about = {"style": "calm", "speaker": "bob", "conditions": files}
    item = Item(id="a", audio=Path("a.wav"), motion=None, duration=1.26, **about)
    found = item.controls(Model())
    assert found.keys() == {"style", "path", "events"} and found["style"] == "calm"
    assert found["events"] == "kick@1" and found["path"].n_frames == 13
    later = replace(item, audio_start=0.75, speaker="ann", style="old").controls(Model())
    assert later["speaker"] == "ann" and "style" not in later
    assert later["events"] == "kick@0.25,kick@0.75:0.25"
    blind = SimpleNamespace(**vars(Model) | {"inputs": SimpleNamespace(path=False, events=())})
    assert item.controls(blind).keys() == {"style"}


def test_sound_is_muted_outside_of_intervals_of_its_file():
    """Two seconds of a file, from 2 s on."""
    wave = Wave(np.linspace(0.1, 0.9, 8000), 4000, None, offset=2.0)
    kept_sound = muted(wave, [(1.0, 2.25), (2.96, 3.3), (3.9, 9.0), (0.0, 1.0)]).samples
    kept = np.zeros(8000, bool)
    for first, last in ((0, 1000), (3840, 5200), (7600, 8000)):
        kept[first:last] = True
    np.testing.assert_array_equal(kept_sound, np.where(kept, wave.samples, 0))


@pytest.mark.parametrize(
    ("name", "is_id"),
    [("a/b c/é", True), ("x" * 100, True), ("a//b", False), ("..", False), ("a\tb", False)],
)
def test_an_id_is_a_relative_path_that_any_system_can_have(name, is_id):
    if is_id:
        assert check_id(name) is None
    else:
        with pytest.raises(CorpusError, match=re.escape(repr(name))):
            check_id(name)
