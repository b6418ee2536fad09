"""The report of a corpus from recordings and items made by hand, without any file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gesturekit.corpus import Item, Manifest, Report
from gesturekit.corpus.alignment import Correlation
from gesturekit.corpus.checks import Problem
from gesturekit.corpus.layouts.listing import Listing, root_with
from gesturekit.corpus.layouts.listing import rows as rows_of
from gesturekit.corpus.recording import Recording
from gesturekit.errors import CorpusError
from gesturekit.motion import Skeleton

RIG, TALL = (Skeleton(("Hips", "Spine"), (-1, 0), [[0, 0, 0], [0, n, 0]]) for n in (1, 1.5))


def recording(name: str, **about) -> Recording:
    files = {"audio": Path(f"/in/{name}.wav"), "motion": Path(f"/in/{name}.bvh")}
    known = {"fps": 30.0, "skeleton": RIG, "sample_rate": 16_000, "take": name}
    return Recording(name, **files | known | about)


def item(name: str, split: str, duration: float, **files) -> Item:
    files = {"audio": Path(f"/in/{name}.wav"), "motion": Path(f"/in/{name}.bvh"), **files}
    return Item(id=f"{name}{split}", split=split, duration=duration, **files)


def rows(items, recordings, problems=(), left_over=()) -> dict[str, str]:
    return dict(Report(Manifest(items), tuple(recordings), problems, left_over).rows())


def test_every_row_of_a_report():
    values = np.zeros(201)
    values[125] = 1.0  # a second after, of arms that are 0.15 s ahead
    shifted = Correlation(values, 0.125, 100)
    recordings = [
        recording("a", speaker="ann", style="calm", correlation=shifted),
        recording("b", speaker="ann", take="a", fps=29.97, skeleton=TALL),
        recording("c", speaker="bob", audio=None, sample_rate=None),
        recording("d", motion=None, fps=None, skeleton=None, sample_rate=44_100),
    ]
    items = [
        *(item("a", "train", 80.0), item("a", "test", 20.0), item("b", "valid", 9.94)),
        *(item("c", "train", 99.9, audio=None), item("d", "test", 6000.0, motion=None)),
    ]
    problems = (
        *(Problem("error", Path("x.wav"), why) for why in ("odd", "short")),
        *(Problem("error", None, "two of one name"), Problem("note", None, "n")),
    )
    assert rows(items, recordings, problems, (Path("z.wav"), Path("z.npz"))) == {
        "paired": "2 recordings in 3 parts, 1.8 min: train 1 (80.0 s), valid 1 (9.9 s), "
        "test 1 (20.0 s)",
        "speech alone": "1 recording, 100.0 min: test 1 (100.0 min)",
        "motion alone": "1 recording, 99.9 s: train 1 (99.9 s)",
        "takes": "3",
        "frame rates": "30 fps (2), 29.97 fps (1)",
        "body heights": "1 to 1.5 m",
        "joints": "2 (3)",
        "sample rates": "16000 Hz (2), 44100 Hz (1)",
        "speakers": "ann (2), bob (1), not named (1)",
        "styles": "not named (3), calm (1)",
        "shift": "the motion comes 1.15 s after the sound (a correlation 8.0 standard deviations "
        "above chance)",
        "left out": "2 recordings with errors, 2 files not used",
    }


def test_rows_that_say_nothing_are_left_out():
    values = np.zeros(201)
    values[96] = 1.0
    in_time = Correlation(values, 0.125, 100)
    found = rows([item("a", "train", 100.0)], [recording("a", correlation=in_time)])
    assert found["paired"] == "1 recording, 1.7 min: train 1 (1.7 min)"
    assert found["shift"].startswith("in time: the motion comes 0.01 s before the sound")
    assert found["speakers"] == found["styles"] == "none named"
    assert not {"takes", "left out", "speech alone", "motion alone"} & {*found}
    assert found["body heights"] == "1 m"
    unclear = replace(in_time, sd=1.0)
    assert "shift" not in rows([], [recording("a", correlation=unclear)])


def test_of_many_speakers_the_first_twelve_are_named():
    many = [recording(f"{n}", speaker=f"s{n:02d}") for n in range(14)]
    shown = rows([], [*many, recording("x", speaker="s13")])["speakers"]
    assert shown.startswith("s13 (2), s00 (1), ") and shown.endswith("s10 (1) and 2 more")
    assert rows([], many[:12])["speakers"].endswith("s11 (1)")


def test_unused_files_are_listed_by_folder_with_the_option_that_uses_them():
    left = tuple(Path(p) for p in ("b/2.bvh", "a/1.wav", "a/4.wav", "a/2.flac", "a/3.mp3"))
    report = Report(Manifest([]), (), (Problem("note", None, "odd"),), left)
    assert report.problem_lines() == [
        "note: odd",
        "left out: speech without motion in a: 1.wav, 4.wav, 2.flac and 1 more (to use it alone: "
        "--unpaired a)",
        "left out: motion without speech in b: 2.bvh (to use it alone: --unpaired-motion b)",
    ]
    assert not report.is_complete and replace(report, left_over=()).is_complete
    broken = (Problem("error", None, "odd"),)
    assert not replace(report, left_over=(), problems=broken).is_complete


def test_a_corpus_is_found_in_its_folder_or_one_below(tmp_path):
    for name in ("one/data", "empty", "two/data", "file"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "file").rmdir()
    (tmp_path / "file").touch()
    assert root_with(tmp_path / "one", ["other", "data"], "X") == tmp_path / "one"
    for folder, says in (
        (tmp_path, "other or data: several folders have one; give the folder of the X corpus"),
        (tmp_path / "empty", "other or data: not found; give"),
        (tmp_path / "none", "no such folder; give"),
        (tmp_path / "file", "is a file, not a folder; give"),
    ):
        with pytest.raises(CorpusError, match=says):
            root_with(folder, ["other", "data"], "X")
    (tmp_path / "two" / "data").rmdir()
    assert root_with(tmp_path, ["other", "data"], "X") == tmp_path / "one"
    listing = Listing(30.0)
    listing.missing("file", [], tmp_path, "error")
    listing.note("odd", [], tmp_path)
    assert listing.problems == []
    listing.missing("file", ["b", "a"], tmp_path, "error")
    listing.note("odd", ["b", "a"], tmp_path)
    assert [(p.severity, p.file, p.message) for p in listing.problems] == [
        ("error", tmp_path, "not there: 2 files: a, b"),
        ("note", tmp_path, "odd: 2: a, b"),
    ]


def test_a_table_has_its_columns_and_others_only_where_it_may(tmp_path):
    table = tmp_path / "t.csv"
    table.write_text("\ufeffID, More ,type\na,x,train\nb,,test\n", encoding="utf-8")
    assert [dict(row) for _, row in rows_of(table, ("id", "type"), others=True)] == [
        {"id": "a", "more": "x", "type": "train"},
        {"id": "b", "more": "", "type": "test"},
    ]
    with pytest.raises(CorpusError, match="t.csv.*download it again"):
        rows_of(table, ("id", "type"))
    for others in (True, False):
        with pytest.raises(CorpusError, match="none.csv.*download it again"):
            rows_of(tmp_path / "none.csv", ("id",), others)
    table.write_bytes(b"id,type\n\xff,train\n")
    with pytest.raises(CorpusError, match="t.csv.*download it again"):
        rows_of(table, ("id", "type"), others=True)
    table.write_text("type\ntrain\n")
    with pytest.raises(CorpusError, match="t.csv.*'?id'?.*download it again"):
        rows_of(table, ("id", "type"), others=True)
    table.write_text("")
    with pytest.raises(CorpusError, match="download it again"):
        rows_of(table, ("id", "type"), others=True)
