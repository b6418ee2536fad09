from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rigs import nameless

from gesturekit.corpus import Item, Manifest
from gesturekit.errors import CorpusError, MotionError

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
    assert json.loads(lines[0]) == {"schema": 1}
    assert list(json.loads(lines[1])) == list(RECORD)
    assert not Path(json.loads(lines[1])["audio"]).is_absolute()


def test_saving_elsewhere_keeps_pointing_at_the_same_files(tmp_path):
    item = Item(id="a", audio=tmp_path / "x" / "a.wav", motion=None, duration=1.0)
    (tmp_path / "y").mkdir()
    Manifest([item]).save(tmp_path / "y" / "m.jsonl")
    assert Manifest.load(tmp_path / "y" / "m.jsonl").items == (item,)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"colour": "red"}, "unknown field 'colour'"),
        ({"channel": 0}, "channel is 0; they count from 1"),
        ({"channel": "left"}, "channel must be a whole number"),
        ({"reading": "cm"}, "reading must be an object"),
        ({"reading": {"colour": "red"}}, "reading has 'colour'; it holds unit, up"),
        ({"reading": {"height": "tall"}}, "reading.height is 'tall'"),
        ({"reading": {"body_model": 3}}, "reading.body_model must be a path"),
        ({"reading": {"body_model": "/b.npz"}}, "reading.body_model is the absolute path"),
        ({"duration": "long"}, "duration must be a number of seconds"),
        ({"duration": True}, "duration must be a number of seconds"),
        ({"duration": 0}, "duration is 0"),
        ({"audio_start": -1}, "audio_start is -1"),
        ({"duration": 10**400}, "duration is too large"),
        ({"split": "dev"}, "split is 'dev'"),
        ({"audio": "/data/a.wav"}, "absolute path"),
        ({"audio": "C:\\data\\a.wav"}, "absolute path"),
        ({"motion": 3}, "motion must be a path or null"),
        ({"audio": None, "motion": None}, "neither audio nor motion"),
        ({"conditions": {"path": 1}}, r"conditions\['path'\] must be a path"),
        ({"audible": [[2, 1]]}, r"audible has \(2.*, 1.*\); expected START, END"),
        ({"audible": [[0, 1], [-1, 2]]}, r"audible has \(-1.*, 2.*\); expected START, END"),
        ({"audible": [[0, 1], [0, 1e308, 2]]}, "audible"),
        ({"id": "../../etc/a"}, "cannot be used"),
        ({"id": "a\nb"}, "cannot be used"),
    ],
)
def test_an_invalid_field_is_reported_with_file_and_line(tmp_path, change, message):
    path = write(tmp_path / "m.jsonl", {**RECORD, "id": "first"}, {**RECORD, **change})
    with pytest.raises(CorpusError, match=rf"m\.jsonl:3: .*{message}"):
        Manifest.load(path)


def test_a_missing_field_is_named(tmp_path):
    record = {name: value for name, value in RECORD.items() if name != "split"}
    with pytest.raises(CorpusError, match=r"m\.jsonl:2: missing field 'split'"):
        Manifest.load(write(tmp_path / "m.jsonl", record))


def test_an_id_used_twice_names_both_lines(tmp_path):
    with pytest.raises(CorpusError, match=r"m\.jsonl:3: id 'a' was already used on line 2"):
        Manifest.load(write(tmp_path / "m.jsonl", RECORD, RECORD))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "empty"),
        (b'{"schema": true}\n', "begins with"),
        (b'{"schema": 7}\n', "m.jsonl:1: manifest schema 7 is newer"),
        (b'{"schema": 1, "x": 2}\n', "got also x"),
        (b"id,audio\n", "m.jsonl:1: not a line of JSON.*gesturekit prepare writes manifests"),
        (b'{"schema": 1}\n[1]\n', "m.jsonl:2: expected a JSON object"),
        (b'{"schema": 1}\n{"id": "\xff"}\n', "m.jsonl:2: not a line of JSON"),
        (b'{"schema": 1}\n{"duration": NaN}\n', "m.jsonl:2: .*NaN"),
        (b'{"schema": 1}\n{"id": 1, "id": 2}\n', "m.jsonl:2: .*'id' is given twice"),
        (b'{"schema": 1}\n' + b"[" * 100_000 + b"\n", "m.jsonl:2: not a line of JSON"),
        (b'{"schema": 1}\n' + b" " * 3_000_000, "m.jsonl:2: line longer"),
    ],
)
def test_files_that_are_not_manifests_are_refused(tmp_path, content, message):
    path = tmp_path / "m.jsonl"
    with pytest.raises(CorpusError, match="cannot open"):
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
    with pytest.raises(CorpusError, match="speech alone"):
        manifest.unpaired()[0].load_motion()
    with pytest.raises(CorpusError, match="'dev'"):
        manifest.paired("dev")


def test_an_item_loads_its_own_stretch_of_both_files(tmp_path, write_pair, gesture):
    audio, motion = write_pair(tmp_path, "a", 4.0)
    item = Item(id="a", audio=audio, motion=motion, audio_start=1.0, motion_start=1.0, duration=2.0)
    assert item.load_wave().duration == 2.0
    part, whole = item.load_motion(), gesture(4.0)
    assert part.n_frames == 60
    assert abs(part.positions() - whole.positions()[30:90]).max() < 1e-4


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


def test_a_mirrored_item_swaps_left_and_right(tmp_path, write_pair, gesture):
    audio, motion = write_pair(tmp_path, "a", 2.0)
    item = Item(id="a", audio=audio, motion=motion, duration=2.0, mirror=True)
    mirrored, whole = item.load_motion().positions(), gesture(2.0)
    left, right = whole.skeleton.index("LeftHand"), whole.skeleton.index("RightHand")
    expected = whole.positions()[:, right] * [-1, 1, 1]
    assert abs(mirrored[:, left] - expected).max() < 1e-4


def test_an_item_longer_than_its_motion_is_an_error_with_both_lengths(tmp_path, write_pair):
    audio, motion = write_pair(tmp_path, "a", 2.0)
    item = Item(id="a", audio=audio, motion=motion, motion_start=1.0, duration=2.0)
    with pytest.raises(CorpusError, match=r"frames 30 to 90 of .*a\.bvh, which has 60 frames"):
        item.load_motion()


def test_an_item_is_mirrored_by_the_sides_named_by_hand(tmp_path, gesture):
    """No joint name tells a side; arms of unequal build leave the shape without one."""
    rig = gesture(1.0).skeleton
    motion, _ = nameless(gesture(1.0))
    names, offsets = motion.skeleton.names, rig.offsets.copy()
    offsets[rig.index("LeftForeArm")] *= 1.4
    replace(motion, skeleton=replace(motion.skeleton, offsets=offsets)).save(tmp_path / "a.bvh")
    item = Item(id="a", audio=None, motion=tmp_path / "a.bvh", duration=1.0, mirror=True)
    left, right = rig.index("LeftHand"), rig.index("RightHand")
    parts = {"left_wrist": names[left], "right_wrist": names[right]}
    plain = replace(item, mirror=False).load_motion().positions()
    mirrored = item.load_motion(parts).positions()
    np.testing.assert_allclose(mirrored[:, left], plain[:, right] * [-1, 1, 1], atol=1e-9)
    with pytest.raises(MotionError, match="cannot tell left from right"):
        item.load_motion()
