"""Takes that were cut into files: their names, whole in the splits, and held-out neighbours."""

from __future__ import annotations

import pytest

from gesturekit.corpus import Manifest, prepare
from gesturekit.corpus.takes import take_in
from gesturekit.errors import CorpusError

PARTS = r"(.*)_part\d+"


@pytest.fixture
def sessions(tmp_path, write_pair):
    """Four sessions of three files each."""
    for day in "abcd":
        for part in range(3):
            write_pair(tmp_path / "in", f"{day}_part{part}", 1.0, seed=part)
    return tmp_path / "in"


def takes_by_split(manifest) -> dict[str, set[str]]:
    splits = {item.split for item in manifest}
    return {split: {i.take for i in manifest if i.split == split} for split in splits}


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("holdout", [0.1, 0.5])
def test_the_files_of_a_take_have_one_split(sessions, tmp_path, seed, holdout):
    report = prepare(
        sessions, tmp_path / "corpus.jsonl", take_pattern=PARTS, holdout=holdout, seed=seed
    )
    found = takes_by_split(Manifest.load(tmp_path / "corpus.jsonl"))
    assert set().union(*found.values()) == set("abcd")
    assert sum(map(len, found.values())) == 4, "no take is in two splits"
    assert len(found["train"]) == (3 if holdout == 0.1 else 2)
    assert "neighbours" not in str(report) and "takes         4" in str(report)


def test_a_table_names_takes_before_a_pattern(sessions, tmp_path):
    table = tmp_path / "takes.csv"
    table.write_text("take,id\nmonday,a_part0\nmonday,b_part1\n")
    report = prepare(sessions, take_table=table, take_pattern="^c")
    takes = {item.id: item.take for item in report.manifest}
    assert takes["a_part0"] == takes["b_part1"] == "monday" and takes["c_part0"] == "c"
    assert takes["d_part2"] == "d_part2", "a recording is a take of its own"
    assert "name does not match take pattern ^c" in str(report)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"take_table": None}, "none.csv: no such file"),
        ({"take_pattern": "("}, r"take pattern \( is not a regular expression"),
        ({"take_pattern": "xyz"}, "matches none of 12 recordings, such as a_part0"),
        ({"take_table": "id,take\na_prt0,x\n"}, "'a_prt0' is no usable recording; did you mean"),
        ({"take_table": "id,take\na_part0,\n"}, "takes.csv.*2: no take of a_part0"),
        ({"take_table": "id,session\na_part0,x\n"}, "takes.csv"),
    ],
)
def test_wrong_takes_are_one_clear_error(sessions, tmp_path, options, says):
    if table := options.get("take_table", ""):
        (tmp_path / "takes.csv").write_text(table)
    if "take_table" in options:
        options = {"take_table": tmp_path / ("takes.csv" if table else "none.csv")}
    with pytest.raises(CorpusError, match=says):
        prepare(sessions, **options)


@pytest.mark.parametrize(
    ("name", "pattern", "take"),
    [
        ("day1/a_03", r"_\d+$", "_03"),
        ("day1/a_03", r"(\w+)_\d+$", "a"),
        ("day1/a_03", r"(\w+)/(?P<take>\w+)_", "a"),
        ("other", r"_\d+$", ""),
    ],
)
def test_the_take_is_a_group_or_the_whole_match(name, pattern, take):
    assert take_in(name, pattern) == take


def test_files_of_the_only_take_are_split_and_that_is_said(sessions, tmp_path):
    report = prepare(sessions, tmp_path / "corpus.jsonl", take_pattern="_part")
    assert takes_by_split(report.manifest) == {"train": {"_part"}, "test": {"_part"}}
    assert "neighbours in training, of the same take (_part): 1 of 1" in str(report)


def test_cut_by_seconds_parts_of_a_take_are_named_as_neighbours(sessions):
    report = prepare(sessions, hold_out_seconds="0.5-")
    assert "(a_part0, a_part1, a_part2 and 9 more): 12 of 12" in str(report)
    assert {item.take for item in report.manifest} == {item.id[:7] for item in report.manifest}


def test_speech_alone_follows_the_motion_of_its_take(tmp_path, write_pair, write_speech):
    for day in "abcdefgh":
        write_pair(tmp_path / "in", f"{day}_1", 1.0)
        write_speech(tmp_path / "in" / f"{day}_2.wav", 1.0)
    report = prepare(
        tmp_path / "in", unpaired=tmp_path / "in", take_pattern="(.)_", holdout=0.5, seed=1
    )
    split = {item.take: item.split for item in report.manifest if item.motion}
    assert len(set(split.values())) > 1
    assert all(item.split == split[item.take] for item in report.manifest)


def test_a_manifest_without_takes_has_those_of_its_motion_files(sessions, tmp_path):
    path = tmp_path / "corpus.jsonl"
    prepare(sessions, path, hold_out_seconds="0.5-")
    lines = path.read_text().splitlines()
    bare = [line.replace(f'"take": "{name}", ', "") for name, line in _with_takes(lines)]
    path.write_text("\n".join([lines[0], *bare]) + "\n")
    manifest = Manifest.load(path)
    assert len({item.take for item in manifest}) == 12 and len(manifest) == 24
    manifest.save(path)
    assert '"take"' not in path.read_text(), "paths of this machine are not stored"


def _with_takes(lines: list[str]) -> list[tuple[str, str]]:
    return [(line.split('"take": "')[1].split('"')[0], line) for line in lines[1:]]
