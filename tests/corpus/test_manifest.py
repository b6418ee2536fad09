from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rigs import nameless

from audio_features import Wave
from gesturekit.corpus import Item, Manifest
from gesturekit.corpus.item import check_id, muted
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
        ({"audible": [[0, 1], [0, 1e308, 2]]}, r"audible must be a list of \[start, end\]"),
        ({"audible": [[0, 10**400]]}, r"audible must be a list of \[start, end\] in seconds"),
        ({"audible": [["a", 2]]}, r"audible must be a list of \[start, end\] in seconds"),
        ({"audible": [3]}, r"audible must be a list of \[start, end\] in seconds"),
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
        (b'{"schema": 1}\n' + b" " * (1 << 20) + b"\n", "m.jsonl:2: line longer"),
        (b'{"schema": 1}\n' + b" " * ((1 << 20) - 1) + b"\n[1]\n", "m.jsonl:3: expected a JSON"),
    ],
)
def test_files_that_are_not_manifests_are_refused(tmp_path, content, message):
    path = tmp_path / "m.jsonl"
    with pytest.raises(CorpusError, match="cannot open"):
        Manifest.load(path)
    path.write_bytes(content)
    with pytest.raises(CorpusError, match=message):
        Manifest.load(path)


def test_two_items_of_one_id_are_refused(tmp_path):
    one = Item(id="a", take="a", audio=tmp_path / "a.wav", motion=None, duration=1.0, split="train")
    with pytest.raises(CorpusError, match="more than one item is called 'a'"):
        Manifest([one, replace(one, id="b"), replace(one, duration=2.0)])


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
    with pytest.raises(CorpusError, match="'dance' has no audio: it is motion alone"):
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


def test_events_are_those_that_reach_into_the_item(tmp_path):
    (tmp_path / "e.csv").write_text(
        "time,name,duration\n0,gone,1.5\n1,ends,1\n1.5,nod,2\n2,kick,\n3.5,long,9\n4,next,1\n"
    )
    about = {"duration": 2.0, "motion_start": 2.0, "conditions": {"events": tmp_path / "e.csv"}}
    item = Item(id="a", audio=Path("a.wav"), motion=Path("a.bvh"), audio_start=0.5, **about)
    assert [(e.time, e.name, e.duration) for e in item.load_events()] == [
        *((0.0, "ends", 0.0), (0.0, "nod", 1.5), (0.0, "kick", 0.0), (1.5, "long", 9.0)),
    ]
    alone = replace(item, motion=None).load_events()
    assert [(e.time, e.name, e.duration) for e in alone][:2] == [
        *((0.0, "gone", 1.0), (0.5, "ends", 1.0)),
    ]


class Model:
    """A model that takes a path and the event `kick`, of one style and one speaker."""

    fps, styles, speakers = 10.0, ("calm",), ("ann",)
    inputs = SimpleNamespace(path=True, events=("kick",))


def test_a_model_is_controlled_by_what_it_has_of_an_item(tmp_path, gesture):
    (tmp_path / "e.csv").write_text("time,name,duration\n1,kick,\n1.25,nod,\n1.5,kick,0.25\n")
    (tmp_path / "p.csv").write_text("time,x,z\n0,0,0\n9,0,9\n")
    files = {"events": tmp_path / "e.csv", "path": tmp_path / "p.csv"}
    item = Item(
        id="a", audio=Path("a.wav"), motion=None, duration=1.26, style="calm", speaker="bob",
        conditions=files,
    )  # fmt: skip
    found = item.controls(Model())
    assert found.keys() == {"style", "path", "events"} and found["style"] == "calm"
    assert found["events"] == "kick@1" and found["path"].n_frames == 13
    later = replace(item, audio_start=0.75, speaker="ann", style="old").controls(Model())
    assert later["speaker"] == "ann" and "style" not in later
    assert later["events"] == "kick@0.25,kick@0.75:0.25"
    short = replace(item, duration=0.04, conditions={"path": tmp_path / "p.csv"})
    assert short.controls(Model())["path"].n_frames == 1
    gesture(2.0).save(tmp_path / "a.npz")
    moves = replace(item, motion=tmp_path / "a.npz", conditions={}, duration=1.0)
    assert moves.controls(Model())["path"].n_frames == 30, "the motion itself"
    assert "path" not in replace(item, conditions={}).controls(Model())
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


@pytest.mark.parametrize(("frames", "is_there"), [(59, True), (60, True), (61, True), (62, False)])
def test_a_frame_may_be_missing_at_the_end_of_a_file(tmp_path, gesture, frames, is_there):
    gesture(2.0).save(tmp_path / "a.npz")
    item = Item(id="a", audio=None, motion=tmp_path / "a.npz", duration=frames / 30)
    if is_there:
        assert item.load_motion().n_frames == min(frames, 60)
        return
    with pytest.raises(CorpusError, match="frames 0 to 62 of .*, which has 60 frames at 30 fps"):
        item.load_motion()


def test_an_interval_begins_and_ends_at_the_nearest_frames(tmp_path, gesture):
    whole = gesture(2.0)
    whole.save(tmp_path / "a.npz")
    item = Item(
        id="a", audio=None, motion=tmp_path / "a.npz", motion_start=0.45 / 30, duration=10.55 / 30
    )
    for start, duration, first, last in (
        (0.45, 10.55, 0, 11), (0.55, 10.45, 1, 11), (1.0, 59.0, 1, 60), (0.0, 59.0, 0, 59)
    ):  # fmt: skip
        part = replace(item, motion_start=start / 30, duration=duration / 30).load_motion()
        np.testing.assert_allclose(part.rotations, whole.rotations[first:last], atol=1e-6)
    with pytest.raises(CorpusError, match="frames 60 to 61 of"):
        replace(item, motion_start=2.0, duration=1 / 30).load_motion()


@pytest.mark.parametrize(
    ("name", "is_id"),
    [
        ("a/b c/é", True),
        ("x" * 230, True),
        ("x" * 231, False),
        ("é" * 116, False),
        ("a//b", False),
        ("a/.", False),
        ("..", False),
        ("", False),
        (3, False),
        ("a\tb", False),
    ],
)
def test_an_id_is_a_relative_path_that_any_system_can_have(name, is_id):
    if is_id:
        assert check_id(name) is None
    else:
        with pytest.raises(CorpusError, match="of up to 230 bytes each"):
            check_id(name)
