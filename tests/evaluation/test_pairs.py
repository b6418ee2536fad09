from __future__ import annotations

from pathlib import Path

import pytest

from gesturekit.errors import CorpusError
from gesturekit.evaluation.pairs import find_pairs


@pytest.fixture
def touch(tmp_path):
    """touch(folder, name, ...): empty files; returns the folder."""

    def make(folder: str, *names: str) -> Path:
        for name in names:
            path = tmp_path / folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
        return tmp_path / folder

    return make


def test_clips_find_their_recordings_by_path_stem_sample_and_window(touch):
    recordings = touch("recordings", "anna/a.bvh", "anna/b.bvh", "ben/b.bvh", "c_s2.bvh")
    made = touch("made", "anna/b.npz", "a_s1.npz", "a_s2.npz", "a_w003_s1.bvh", "c_s2.bvh")
    found = find_pairs(made, recordings)
    assert [(pair.name, pair.stem, pair.window) for pair in found.pairs] == [
        ("a_s1", "anna/a", None),
        ("a_s2", "anna/a", None),
        ("a_w003_s1", "anna/a", 3),
        ("anna/b", "anna/b", None),
        ("c_s2", "c_s2", None),  # a recording that is called so, not a sample of c
    ]
    assert found.excluded == []


def test_recordings_without_sound_are_reported_once(touch):
    recordings = touch("recordings", "a.bvh", "b.bvh")
    made = touch("made", "a_s1.npz", "a_s2.npz", "b_s1.npz")
    found = find_pairs(made, recordings, audio=touch("sound", "b.wav"))
    assert [(item.name, item.what) for item in found.excluded] == [("a", "speech")]
    assert "no sound" in found.excluded[0].reason
    assert len(found.pairs) == 3


def test_clips_without_a_recording_are_excluded_with_a_reason(touch):
    recordings = touch("recordings", "anna/b.bvh", "ben/b.bvh", "speech.bvh")
    found = find_pairs(touch("made", "b.npz", "speach.npz", "speech.npz"), recordings)
    assert [pair.name for pair in found.pairs] == ["speech"]
    reasons = {item.name: item.reason for item in found.excluded}
    assert reasons["b"] == "several recordings fit it: anna/b, ben/b"
    assert "did you mean speech?" in reasons["speach"]


def test_npz_comes_before_bvh_and_hidden_files_count_for_nothing(touch):
    made = touch("made", "a.bvh", "a.npz", ".a.npz", ".old/b.npz", "a.html")
    (pair,) = find_pairs(made, touch("recordings", "a.bvh", "b.bvh")).pairs
    assert pair.generated.name == "a.npz"


def test_one_file_is_the_reference_of_everything(touch):
    made = touch("made", "x_s1.npz", "y.npz")
    reference = touch("recordings", "a.bvh", "b.bvh") / "a.bvh"
    assert {pair.stem for pair in find_pairs(made, reference).pairs} == {"a"}


def test_sound_and_semantic_tracks_come_along(touch):
    made, recordings = touch("made", "a_s1.npz", "b.npz"), touch("recordings", "p/a.bvh", "b.bvh")
    sounds, tracks = touch("wav", "p/a.flac"), touch("sem", "a.txt")
    a, b = reversed(find_pairs(made, recordings, audio=sounds, semantic=tracks).pairs)
    assert (a.audio.name, a.semantic.name) == ("a.flac", "a.txt")
    assert (b.audio, b.semantic) == (None, None)


def test_wrong_folders_are_errors_that_name_what_was_found(touch, tmp_path):
    made, recordings = touch("made", "a.npz"), touch("recordings", "b.bvh")
    with pytest.raises(CorpusError, match=r"of 1 clip \(a\) none has a recording .*\(b\)"):
        find_pairs(made, recordings)
    with pytest.raises(CorpusError, match=r"none of its sounds \(z\) has the name"):
        find_pairs(touch("again", "b.npz"), recordings, audio=touch("wav", "z.wav"))
    with pytest.raises(CorpusError, match=r"no motion files \(\.npz, \.bvh, \.glb"):
        find_pairs(touch("sounds", "a.wav"), recordings)
    with pytest.raises(CorpusError, match="no such file or folder"):
        find_pairs(tmp_path / "absent", recordings)
    with pytest.raises(CorpusError, match="no motion file; expected"):
        find_pairs(touch("sounds", "a.wav") / "a.wav", recordings)
