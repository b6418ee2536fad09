"""Record of the recordings that a model was trained on."""

import math

import pytest

from gesturekit.corpus.manifest import file_fingerprint
from gesturekit.training.origin import (
    TrainedSegment,
    is_trained_on,
    load_sources,
    save_sources,
    unused_labels,
)


def labelled(*labels: tuple[str | None, str | None]) -> list[TrainedSegment]:
    return [TrainedSegment("r", "m", None, 0.0, 5.0, 30.0, style, name) for style, name in labels]


def test_the_record_in_a_model_folder_is_read_again_and_a_damaged_one_is_none(tmp_path):
    one = TrainedSegment("a", "m", "s", 1.0, 5.0, 30.0, "old", "ann")
    save_sources(tmp_path, [one, TrainedSegment("b", "m", None, 0.0, 2.5, 24.0)])
    assert load_sources(tmp_path) == (one, TrainedSegment("b", "m", None, 0.0, 2.5, 24.0))
    for text in ("{", "3", '[{"id": "a"}]'):
        (tmp_path / "trained_on.json").write_text(text)
        assert load_sources(tmp_path) == ()
    assert load_sources(tmp_path / "missing") == ()


def test_one_style_or_speaker_is_no_choice():
    one = labelled(("calm", "ada"), (None, None), ("calm", "ada"))
    assert unused_labels(one, ()) == []
    two = labelled(("calm", "ada"), ("wild", "bob"), (None, "cy"))
    styles, speakers = unused_labels(two, ())
    assert "2 styles" in styles and "3 speakers" in speakers
    assert unused_labels(two, ("calm", "wild")) == [speakers]
    assert unused_labels(two, (), state=True) == [styles]


@pytest.mark.parametrize(
    ("start", "duration", "is_known"),
    [(0.0, math.inf, True), (0.0, 10.0, False), (14.8, 5.0, True), (15.0, math.inf, False)],
)
def test_a_recording_is_known_where_it_overlaps_a_trained_segment(
    tmp_path, start, duration, is_known
):
    """The model was trained on seconds 10 to 15 of a file, which may have been copied."""
    motion, audio, copy, other = (tmp_path / name for name in ("m", "a", "copy", "other"))
    for path, text in ((motion, "motion"), (audio, "sound"), (copy, "motion"), (other, "else")):
        path.write_text(text)
    known = [TrainedSegment("r", file_fingerprint(motion), file_fingerprint(audio), 10, 5, 30.0)]
    when = {"start": start, "duration": duration}
    assert is_trained_on(known, motion, **when) == is_known
    assert is_trained_on(known, copy, **when) == is_known
    assert is_trained_on(known, other, audio, **when) == is_known
    assert is_trained_on(known, None, audio, **when) == is_known
    assert not is_trained_on(known, other, other, **when) and not is_trained_on([], motion)
