"""Motions below a folder."""

import os

import numpy as np

from gesturekit.formats.sources import motions_in, visible_folders


def test_folders_that_cannot_be_opened_are_yielded_once_and_one_is_left_out(tmp_path, monkeypatch):
    for name in ("a.bvh", "b/b.bvh", "c/c.bvh", "out/d.bvh", "z/e.BVH", "z/notes.txt", ".x/f.bvh"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"HIERARCHY")
    scan = os.scandir

    def locked(path):
        if str(path).endswith("b"):
            raise PermissionError(13, "Permission denied", str(path))
        return scan(path)

    monkeypatch.setattr(os, "scandir", locked)
    found = list(motions_in(tmp_path, but=tmp_path / "out"))
    problems = [one for one in found if isinstance(one, OSError)]
    assert [one.filename for one in problems] == [str(tmp_path / "b")]
    files = [one for one in found if one not in problems]
    assert files == [tmp_path / name for name in ("a.bvh", "c/c.bvh", "z/e.BVH")]
    trouble = []
    folders = [folder for folder, _, _ in visible_folders(tmp_path, trouble.append)]
    assert folders == [tmp_path, *(tmp_path / name for name in ("c", "out", "z"))]
    assert [one.filename for one in trouble] == [str(tmp_path / "b")]


def test_npz_files_of_features_and_sequences_of_keypoints_are_no_motions(tmp_path):
    """One key in common, and the last frame, do not matter."""
    for name, keys in (
        ("motion.npz", ("poses", "times", "kintree_table")),
        ("features.npz", ("values", "times")),
        ("body.npz", ("v_template", "kintree_table")),
    ):
        np.savez(tmp_path / name, **dict.fromkeys(keys, 1))
    for name, frames in (("sequence", ('[{"Rh": 0}]', "[]")), ("keypoints", ("[]", '[{"Rh": 0}]'))):
        (tmp_path / name).mkdir()
        for number, text in zip(("000000", "000001"), frames):
            (tmp_path / name / f"{number}.json").write_text(text)
    assert list(motions_in(tmp_path)) == [tmp_path / "motion.npz", tmp_path / "sequence"]
