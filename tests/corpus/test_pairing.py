"""Sound and motion that belong together, and the recordings that are held out."""

from collections import Counter
from math import inf

import numpy as np
import pytest

from gesturekit.corpus.pairing import pair, recording_ids, scan
from gesturekit.corpus.splits import as_intervals, choose_held_out, cut
from gesturekit.errors import CorpusError


def touch(folder, *names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"x")
    return folder


def paired(*folders):
    result = pair([scan(folder)[0] for folder in folders])
    return result, [(a.path.name, b.path.name) for a, b in result.pairs]


def test_files_of_one_path_or_unique_stem_are_pairs(tmp_path):
    touch(tmp_path, "s1/a.wav", "s1/a.bvh", "s2/a.WAV", "s2/a.npz", "notes.txt", ".hidden.wav")
    touch(tmp_path, "audio/b.flac", "audio/c.wav", "mocap/take/b.bvh", "mocap/d.bvh")
    result, names = paired(tmp_path)
    assert {*names} == {("a.wav", "a.bvh"), ("a.WAV", "a.npz"), ("b.flac", "b.bvh")}
    assert [f.path.name for f in result.speech] == ["c.wav"] and not result.problems
    assert [f.path.name for f in result.motion] == ["d.bvh"]
    touch(tmp_path, "wav/p1/a.wav", "wav/p2/a.wav", "bvh/p1/a.bvh", "bvh/p2/a.bvh")
    result, _ = paired(tmp_path / "wav", tmp_path / "bvh")
    assert [(a.key, b.key) for a, b in result.pairs] == [("p1/a", "p1/a"), ("p2/a", "p2/a")]


@pytest.mark.parametrize(
    ("speech", "motion"),
    [
        ("T05.wav", "t05.bvh"),
        ("Take 02.wav", "take_02.bvh"),
        ("take-1_audio.wav", "take-1_motion.bvh"),
        ("wav/a_Voice.wav", "mocap/A.bvh"),
        ("te\u0301.wav", "t\u00e9.bvh"),
    ],
)
def test_similar_names_are_a_pair_with_a_warning(tmp_path, speech, motion):
    touch(tmp_path, speech, motion, "same.wav", "same.bvh", "Other_1.wav", "other_11.bvh")
    result, names = paired(tmp_path)
    similar = (speech.split("/")[-1], motion.split("/")[-1])
    assert set(names) == {("same.wav", "same.bvh"), similar}
    (problem,) = result.problems
    assert problem.severity == "warning" and all(name in problem.message for name in similar)
    assert len(result.speech) == len(result.motion) == 1


@pytest.mark.parametrize(
    "names", ["a.wav a.flac a.bvh", "a.wav x/a.bvh y/a.npz", "x/a.wav y/a.wav z/a.bvh"]
)
def test_an_ambiguous_name_lists_every_file_and_pairs_none(tmp_path, names):
    names = names.split()
    touch(tmp_path, *names, "fine.wav", "fine.bvh")
    result, pairs = paired(tmp_path)
    assert pairs == [("fine.wav", "fine.bvh")]
    (problem,) = result.problems
    assert problem.severity == "error" and "'a'" in problem.message
    assert all(str(tmp_path / name) in problem.message for name in names)
    assert not result.speech and not result.motion


def test_takes_of_equal_names_in_two_folders_stay_apart_and_get_ids_of_their_own(tmp_path):
    touch(tmp_path, "one/a.wav", "one/a.bvh", "two/a.wav", "two/a.bvh")
    result, _ = paired(tmp_path / "one", tmp_path / "two")
    assert [a.path.parent == b.path.parent for a, b in result.pairs] == [True, True]
    assert sorted(recording_ids([a for a, _ in result.pairs])) == ["one/a", "two/a"]


def test_features_and_body_models_are_not_taken_for_motion(tmp_path, capsule_body):
    touch(tmp_path, "a.wav", "a.bvh")
    np.savez(tmp_path / "SMPL.npz", **capsule_body(24))
    np.savez(tmp_path / "a.npz", values=np.zeros((2, 1)), times=np.zeros(2), spec="{}")
    result, names = paired(tmp_path)
    assert names == [("a.wav", "a.bvh")] and not result.motion and not result.problems


def test_a_name_that_is_not_text_is_a_problem_of_its_own(tmp_path):
    touch(tmp_path, "a.wav")
    try:
        (tmp_path / "b\udcff.wav").write_bytes(b"x")
    except OSError:
        pytest.skip("this file system refuses names that are not UTF-8")
    found, problems = scan(tmp_path)
    assert [file.key for file in found] == ["a"]
    assert "udcff.wav" in str(problems[0]) and str(problems[0]).isprintable()


def test_a_link_that_leads_back_up_is_followed_once_and_a_missing_folder_named(tmp_path):
    touch(tmp_path, "real/a.wav")
    (tmp_path / "real" / "loop").symlink_to(tmp_path)
    assert [file.key for file in scan(tmp_path)[0]] == ["real/a"]
    with pytest.raises(CorpusError, match="none"):
        scan(tmp_path / "none")


def test_a_fraction_is_held_out_for_test_and_valid_in_turn():
    splits = choose_held_out([f"r{i}" for i in range(40)], 0.1, seed=0)
    assert Counter(splits.values()) == {"train": 36, "test": 2, "valid": 2}


def test_the_choice_depends_on_the_seed_and_not_on_the_order():
    ids = [f"r{i}" for i in range(40)]
    assert choose_held_out(ids, 0.2, 0) == choose_held_out(ids[::-1], 0.2, 0)
    assert choose_held_out(ids, 0.2, 0) != choose_held_out(ids, 0.2, 1)


def test_intervals_are_read_and_wrong_ones_refused():
    assert as_intervals("10-20.5, 55-") == [(10.0, 20.5), (55.0, inf)]
    for text in (" ", "10", "20-10", "10-10", "a-b", "10-20;30-40", "-5"):
        with pytest.raises(CorpusError):
            as_intervals(text)


def test_cutting_leaves_the_rest_for_training():
    for begin, end, intervals, parts in (
        (0.0, 10.0, [(4.0, 6.0)], [("train", 0, 4), ("test", 4, 6), ("train", 6, 10)]),
        (1.0, 10.0, [(8.0, inf), (0.0, 2.0)], [("test", 1, 2), ("train", 2, 8), ("test", 8, 10)]),
        (0.0, 5.0, [(7.0, 9.0)], [("train", 0, 5)]),
        (0.0, 5.0, [(0.0, 5.0)], [("test", 0, 5)]),
        (0.0, 5.0, [(1.0, 3.0), (2.0, 4.0)], [("train", 0, 1), ("test", 1, 4), ("train", 4, 5)]),
    ):
        wanted = [(split, (float(first), float(last))) for split, first, last in parts]
        assert cut(begin, end, intervals) == wanted
