"""Record of the recordings that a model was trained on."""

from __future__ import annotations

from gesturekit.training.data.sources import TrainedSegment, describe_rates, unused_labels


def test_frame_rates_have_one_order_whatever_the_hashes_of_the_files():
    recordings = [
        TrainedSegment(f"r{i}", f"file {i}", None, 0.0, 5.0, fps)
        for i, fps in enumerate((120.0, 30.0, 24.0, 30.0, 30000 / 1001, 60.0, 90.0))
    ]
    assert describe_rates(recordings, 25.0) == (
        "(2 at 30 fps, 1 at 24 fps, 1 at 29.97 fps, 1 at 60 fps, 1 at 90 fps, 1 at 120 fps), "
        "trained at 25 fps"
    )


def labelled(*labels: tuple[str | None, str | None]) -> list[TrainedSegment]:
    return [TrainedSegment("r", "m", None, 0.0, 5.0, 30.0, style, name) for style, name in labels]


def test_one_style_or_speaker_is_no_choice():
    one = labelled(("calm", "ada"), (None, None), ("calm", "ada"))
    assert unused_labels(one, ()) == []
    two = labelled(("calm", "ada"), ("wild", "bob"), (None, "cy"))
    styles, speakers = unused_labels(two, ())
    assert styles.startswith("2 styles") and speakers.startswith("3 speakers")
    assert unused_labels(two, ("calm", "wild")) == [speakers]
    assert unused_labels(two, (), recalls=True) == [styles]
