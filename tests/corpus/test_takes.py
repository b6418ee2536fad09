"""Takes that were cut into files: their names, whole in the splits, and held-out neighbours."""

import re
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gesturekit.corpus import Item, prepare
from gesturekit.corpus.recording import Recording
from gesturekit.corpus.splits import split_items
from gesturekit.corpus.takes import name_takes, neighbours, pieces_of_takes
from gesturekit.errors import CorpusError
from gesturekit.motion import Motion

PARTS = r"(.*)_part\d+"


@pytest.fixture
def sessions(tmp_path, write_pair):
    """Four sessions of three files each."""
    for day in "abcd":
        for part in range(3):
            write_pair(tmp_path / "in", f"{day}_part{part}", 1.0, seed=part)
    return tmp_path / "in"


def takes_by_split(items: Iterable[Item]) -> dict[str, set[str]]:
    splits = {item.split for item in items}
    return {split: {i.take for i in items if i.split == split} for split in splits}


def parts(*names: str, **about) -> list[Recording]:
    """Three files of each of four days, or files of these names, without being on disk."""
    names = names or tuple(f"{day}_part{part}" for day in "abcd" for part in range(3))
    files = {"audio": Path("/in/a.wav"), "motion": Path("/in/a.bvh"), "fps": 30.0, "stop": 1.0}
    return [Recording(name, **files | about) for name in names]


@pytest.mark.parametrize(("holdout", "n_trained"), [(0.1, 3), (0.5, 2)])
def test_the_files_of_a_take_have_one_split(holdout, n_trained):
    for seed in range(4):
        items, _ = split_items(name_takes(parts(), PARTS, None)[0], holdout, [], seed)
        found = takes_by_split(items)
        assert set().union(*found.values()) == set("abcd")
        assert sum(map(len, found.values())) == 4, "no take is in two splits"
        assert len(found["train"]) == n_trained and neighbours(items) == ""


def test_a_table_names_takes_before_a_pattern(sessions, tmp_path):
    table = tmp_path / "takes.csv"
    table.write_text("take,id\nmonday,a_part0\nmonday,b_part1\n")
    report = prepare(sessions, take_table=table, take_pattern="^c")
    takes = {item.id: item.take for item in report.manifest}
    assert takes["a_part0"] == takes["b_part1"] == "monday" and takes["c_part0"] == "c"
    assert takes["d_part2"] == "d_part2", "a recording is a take of its own"
    assert "^c" in str(report)


@pytest.mark.parametrize(
    ("table", "pattern", "says"),
    [
        (None, "xyz", r"(?=.*xyz)(?=.*\b12\b).*a_part0"),
        ("id,take\na_prt0,x\n", None, "(?=.*'a_prt0').*a_part0"),
        ("id,take\na_part0,\n", None, r"takes.csv.*(?=.*\b2\b).*a_part0"),
        ("id,take\nb_part1,x\nsame,x\n", None, "line 3.*'same'"),
    ],
)
def test_wrong_takes_are_one_clear_error(tmp_path, table, pattern, says):
    file = tmp_path / "takes.csv"
    file.write_text(table or "")
    more = parts("x/same", "y/same") if table and "same" in table else []
    with pytest.raises(CorpusError, match=says):
        name_takes(parts() + more, pattern, None if table is None else file)


def warnings_of(recordings: list[Recording], pattern: str | None = None) -> list[str]:
    problems = name_takes(recordings, pattern, None)[1]
    return [problem.text for problem in problems if problem.severity == "warning"]


def test_a_pattern_that_merges_speakers_says_so():
    names = ("anna/talk1_part0", "ben/talk1_part0", "ben/talk2_part0")
    (said,) = warnings_of(parts(*names), r"(talk\d+)")
    assert re.search(r"(?=.*talk1 )(?=.*anna)(?=.*ben).*\b1 take\b", said) and "talk2" not in said
    assert warnings_of(parts(*names), r"(.*/talk\d+)") == []
    (said,) = warnings_of(parts("x_1", speaker="me") + parts("x_2", speaker="you"), "(x)")
    assert "me" in said and "you" in said


@pytest.mark.parametrize(
    ("names", "facts", "pattern"),
    [
        ([f"{day}_part{k:02d}" for day in "ab" for k in range(20)], ["40 files", "2 rec"], "part"),
        ([f"in/t{k // 2}-chunk{k % 2}" for k in range(8)] + ["x"], ["9 files", "5 rec"], "chunk"),
        (["a_seg1", "a_seg2", "b.clip1", "b.clip2"], ["4 files", "2 rec"], "seg"),
        (["part1", "part2", "d/clip 3", "d/clip 4", "clip5"], [], ""),
        (["a_part1", "b_part1"], [], ""),
    ],
)
def test_names_of_pieces_are_asked_about_with_the_pattern_to_use(names, facts, pattern):
    said = warnings_of(parts(*names))
    assert len(said) == bool(facts) and all(fact in said[0] for fact in facts)
    if facts:
        given = re.search(r"--take-pattern '(.*)'", said[0])[1]
        assert pattern in given
        named, problems = name_takes(parts(*names), given, None)
        assert f"{len({r.take for r in named})} rec" in facts[1]
        assert not any(problem.severity == "warning" for problem in problems)


def test_numbered_motions_that_continue_one_another_are_asked_about(tmp_path, gesture):
    whole = gesture(4.0, 20.0)
    for k in range(4):
        whole[k * 20 : k * 20 + 20].save(tmp_path / "cut" / f"day_{k}.npz")
        gesture(1.0, 20.0, seed=k).save(tmp_path / "other" / f"day_{k}.npz")

    def numbered(folder: str) -> list[Recording]:
        files = [tmp_path / folder / f"day_{k}.npz" for k in range(4)]
        return [Recording(f.stem, motion=f, fps=20.0, stop=1.0) for f in files]

    (said,) = warnings_of(numbered("cut"))
    assert "4 files, perhaps 1 recording" in said and r"'(.*)_\d+'" in said
    assert warnings_of(numbered("other")) == [] == warnings_of(numbered("cut"), "(day)")
    for k in range(4):  # from rest to rest: each begins as the one before ends, and as it began
        sway = np.sin(np.pi * np.arange(20) / 19.0)[:, None] * [0.6, 0.0, 0.0]
        turned = whole.rotations[np.zeros(20, int)].copy()
        turned[:, 1] = Rotation.from_rotvec((1.0 + k) * sway).as_quat()
        still = replace(whole[:20], rotations=turned, translation=np.zeros((20, 3)))
        still.save(tmp_path / "rest" / f"day_{k}.npz")
    assert warnings_of(numbered("rest")) == []
    (tmp_path / "other" / "day_1.npz").write_bytes(b"")
    assert warnings_of(numbered("other")) == [], "what cannot be read is reported elsewhere"


@pytest.fixture
def bent(gesture):
    """bent(degrees, x): one joint of a resting body turns, and its root is at `x` metres."""

    def make(degrees: list[float], x: list[float]) -> Motion:
        still = gesture(len(degrees) / 20.0, 20.0)
        rotations = np.repeat(still.rotations[:1], len(degrees), axis=0)
        rotations[:, 1] = Rotation.from_rotvec(
            np.radians(degrees)[:, None] * [1.0, 0.0, 0.0]
        ).as_quat()
        return replace(still, rotations=rotations, translation=np.array([[a, 0.9, 0.0] for a in x]))

    return make


TURN, WALK, STILL = [0.0, 2.0, 3.0, 6.0, 9.0], [0.0, 0.1, 0.15, 0.3, 0.45], [0.0] * 5


@pytest.mark.parametrize(
    ("before", "first", "continues"),
    [
        *(((TURN, STILL), (14.9, 0.0), True), ((TURN, STILL), (15.1, 0.0), False)),
        *(((TURN, WALK), (9.0, 0.74), True), ((TURN, WALK), (9.0, 0.76), False)),
        *(((TURN, STILL), (9.0, 0.019), True), ((TURN, STILL), (9.0, 0.021), False)),
        # Half as far from the end as from the beginning, and a little farther.
        (([0.0, 5.0, 8.0, 5.0, 2.5], STILL), (4.9, 0.0), True),
        (([0.0, 5.0, 8.0, 5.0, 2.5], STILL), (5.1, 0.0), False),
        (([0.0], [0.0]), (0.0, 0.0), False),
    ],
)
def test_a_motion_continues_another_within_twice_its_largest_step(bent, before, first, continues):
    motions = {"a_1": lambda: bent(*before), "a_2": lambda: bent([first[0], 90.0], [first[1], 9.0])}
    assert len(pieces_of_takes(motions)) == continues


def test_most_of_three_pairs_spread_over_the_recordings_decide(bent, quadruped):
    read = []

    def of(names: str, place: float = 0.0):
        read.append(names)
        return bent([place + degree for degree in TURN], STILL)

    motions = {f"a_{k:02d}": partial(of, f"a_{k:02d}", 10.0 * k) for k in range(13)}
    (said,) = pieces_of_takes(motions)
    assert "13 files, perhaps 1 recording:" in said
    assert read == ["a_00", "a_01", "a_04", "a_05", "a_08", "a_09"]
    assert pieces_of_takes(dict([*motions.items()][::2])) == [], "none follows another"
    elsewhere = partial(of, "", 170.0)
    assert len(pieces_of_takes({**motions, "a_05": elsewhere})) == 1
    assert pieces_of_takes(dict([*motions.items()][:2], a_02=elsewhere)) == [], "one of two"
    other = bent(TURN, STILL)
    other = Motion(
        quadruped, np.tile([0.0, 0, 0, 1], (5, quadruped.n_joints, 1)), other.translation, 20.0
    )
    assert pieces_of_takes({"a_1": lambda: other, "a_2": motions["a_00"]}) == []


def test_neighbours_are_counted_by_the_takes_of_the_training_split():
    def item(name: str, split: str, take: str, motion: Path | None = Path("/in/a.bvh")) -> Item:
        return Item(id=name, take=take, split=split, audio=Path("/in/a.wav"), motion=motion,
                    duration=1.0)  # fmt: skip

    items = [
        *(item("a", "train", "in/t1"), item("b", "train", "t2"), item("c", "test", "in/t1")),
        *(item("d", "test", "t3"), item("e", "valid", "t2"), item("f", "test", "t2", None)),
        item("g", "train", "t3", None),
    ]
    assert re.search(r"(?=.*t1)(?=.*t2).*\b2 of 3", neighbours(items))
    assert re.search(r"(?=.*t1).*\b1 of 2", neighbours(items, "test"))
    assert re.search(r"(?=.*t2).*\b1 of 1", neighbours(items, "valid"))
    assert neighbours(items, "train") == neighbours(items[3:4]) == neighbours([]) == ""
