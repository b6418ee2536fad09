from __future__ import annotations

import numpy as np
import pytest

from gesturekit.corpus.pairing import pair, recording_ids, scan
from gesturekit.errors import CorpusError


def touch(folder, *names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"x")
    return folder


def paired(*folders):
    result = pair([scan(folder)[0] for folder in folders])
    return result, [(a.path.name, b.path.name) for a, b in result.pairs]


def test_same_path_without_extension_is_a_pair_whatever_the_case_of_the_extension(tmp_path):
    touch(tmp_path, "s1/a.wav", "s1/a.bvh", "s2/a.WAV", "s2/a.npz", "notes.txt", ".hidden.wav")
    result, names = paired(tmp_path)
    assert names == [("a.wav", "a.bvh"), ("a.WAV", "a.npz")]
    assert not result.speech and not result.motion and not result.problems


def test_same_path_in_two_folders_is_a_pair(tmp_path):
    touch(tmp_path, "wav/p1/a.wav", "wav/p2/a.wav", "bvh/p1/a.bvh", "bvh/p2/a.bvh")
    result, names = paired(tmp_path / "wav", tmp_path / "bvh")
    assert [(a.key, b.key) for a, b in result.pairs] == [("p1/a", "p1/a"), ("p2/a", "p2/a")]


def test_a_unique_stem_is_a_pair(tmp_path):
    touch(tmp_path, "audio/a.flac", "audio/b.wav", "mocap/take/a.bvh", "mocap/c.bvh")
    result, names = paired(tmp_path)
    assert names == [("a.flac", "a.bvh")]
    assert [f.path.name for f in result.speech] == ["b.wav"]
    assert [f.path.name for f in result.motion] == ["c.bvh"]


def test_stems_that_differ_in_case_and_separators_are_paired_with_a_note(tmp_path):
    # An umlaut as one letter, and as a letter and a mark, as file systems of Macs have it.
    touch(
        tmp_path,
        "wav/S01_Take-1.wav",
        "bvh/s01 take 1.bvh",
        "a/M\u00fcller.wav",
        "Mu\u0308ller.bvh",
    )
    touch(tmp_path, "b/S01_take-2.wav", "S01 take 3.bvh")
    result, names = paired(tmp_path)
    assert names == [("M\u00fcller.wav", "Mu\u0308ller.bvh"), ("S01_Take-1.wav", "s01 take 1.bvh")]
    assert len(result.speech) == len(result.motion) == 1
    assert {problem.severity for problem in result.problems} == {"note"}
    shown = " ".join(str(problem) for problem in result.problems)
    assert (
        "S01_Take-1.wav: paired with" in shown and "s01 take 1.bvh, whose name is similar" in shown
    )
    touch(tmp_path, "S01 take_1.npz")
    (error,) = [p for p in paired(tmp_path)[0].problems if p.severity == "error"]
    assert "ambiguous" in error.message


@pytest.mark.parametrize(
    "names",
    [
        ("a.wav", "a.flac", "a.bvh"),
        ("a.wav", "x/a.bvh", "y/a.npz"),
        ("x/a.wav", "y/a.wav", "z/a.bvh"),
    ],
)
def test_an_ambiguous_name_lists_every_file_and_pairs_none(tmp_path, names):
    touch(tmp_path, *names, "fine.wav", "fine.bvh")
    result, pairs = paired(tmp_path)
    assert pairs == [("fine.wav", "fine.bvh")]
    (problem,) = result.problems
    assert problem.severity == "error" and "'a' is ambiguous" in problem.message
    assert all(str(tmp_path / name) in problem.message for name in names)
    assert not result.speech and not result.motion


def test_takes_of_equal_names_in_two_folders_stay_apart_and_get_ids_of_their_own(tmp_path):
    touch(tmp_path, "one/a.wav", "one/a.bvh", "two/a.wav", "two/a.bvh")
    result, _ = paired(tmp_path / "one", tmp_path / "two")
    assert [a.path.parent == b.path.parent for a, b in result.pairs] == [True, True]
    assert sorted(recording_ids([a for a, _ in result.pairs])) == ["one/a", "two/a"]


def test_a_feature_file_beside_its_speech_is_not_taken_for_motion(tmp_path):
    touch(tmp_path, "a.wav", "a.bvh")
    np.savez(tmp_path / "a.npz", values=np.zeros((2, 1)), times=np.zeros(2), spec="{}")
    _, names = paired(tmp_path)
    assert names == [("a.wav", "a.bvh")]


def test_a_link_that_leads_back_up_is_followed_once(tmp_path):
    touch(tmp_path, "real/a.wav")
    (tmp_path / "real" / "loop").symlink_to(tmp_path)
    found, _ = scan(tmp_path)
    assert [file.key for file in found] == ["real/a"]


def test_a_name_that_is_not_text_is_a_problem_of_its_own(tmp_path):
    touch(tmp_path, "a.wav")
    try:
        (tmp_path / "b\udcff.wav").write_bytes(b"x")
    except OSError:
        pytest.skip("this file system refuses names that are not UTF-8")
    found, problems = scan(tmp_path)
    assert [file.key for file in found] == ["a"]
    assert "rename" in str(problems[0]) and str(problems[0]).isprintable()


def test_a_folder_that_is_not_there_is_an_error(tmp_path):
    with pytest.raises(CorpusError, match="no such folder"):
        scan(tmp_path / "none")
    with pytest.raises(CorpusError, match="is a file"):
        scan(touch(tmp_path, "a.wav") / "a.wav")


def test_a_body_model_beside_the_motion_is_not_taken_for_one(tmp_path, capsule_body):
    np.savez(tmp_path / "SMPL.npz", **capsule_body(24))
    assert scan(tmp_path) == ([], [])
