"""The report of a corpus from recordings and items made by hand, without any file."""

from pathlib import Path

import numpy as np
import pytest

from gesturekit.corpus import Item, Manifest, Problem, Report
from gesturekit.corpus.alignment import LEAD, Correlation
from gesturekit.corpus.layouts.listing import root_with
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
    values[125] = 1.0  # a second after, of arms that are ahead by LEAD
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
    found = rows(items, recordings, (Problem("error", Path("x.wav"), "odd"),), (Path("z.wav"),))
    for row, facts in {
        "paired": "2 |3 |1.8 min|train 1 |80.0 s|valid 1 |9.9 s|test 1 |20.0 s",
        "speech alone": "1 |100.0 min|test 1",
        "motion alone": "1 |99.9 s|train 1",
        "takes": "3",
        "frame rates": "30 fps|29.97 fps",
        "body heights": "1 |1.5 m",
        "joints": "2 ",
        "sample rates": "16000 Hz|44100 Hz",
        "speakers": "ann (2), bob (1), not named (1)",
        "styles": "not named (3), calm (1)",
        "shift": f"{1 + LEAD:.2f} s",
        "left out": "1 ",
    }.items():
        assert all(fact in found[row] for fact in facts.split("|")), row
    assert rows(items, recordings[2:])["styles"] == "none named"
    many = [recording(f"{k}", style=f"s{k:02d}") for k in range(13)]
    assert rows([], many)["styles"].endswith("s10 (1), s11 (1) and 1 more")


def test_a_corpus_is_found_in_its_folder_or_one_below(tmp_path):
    for name in ("one/data", "empty", "two/data"):
        (tmp_path / name).mkdir(parents=True)
    assert root_with(tmp_path / "one", ["other", "data"], "X") == tmp_path / "one"
    for folder, says in (
        (tmp_path, rf"{tmp_path}(?=.*other)(?=.*data).*\bX\b"),
        (tmp_path / "empty", r"empty(?=.*other)(?=.*data).*\bX\b"),
        (tmp_path / "none", r"none.*\bX\b"),
    ):
        with pytest.raises(CorpusError, match=says):
            root_with(folder, ["other", "data"], "X")
    (tmp_path / "two" / "data").rmdir()
    assert root_with(tmp_path, ["other", "data"], "X") == tmp_path / "one"
