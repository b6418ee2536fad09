import numpy as np
import pytest

from gesturekit.corpus.speech import style_track
from gesturekit.errors import ModelError

NAMES = ("angry", "old", "sad")


@pytest.mark.parametrize(
    ("wanted", "expected"),
    [
        ("old", "oooooooooo"),
        ("angry@0-3,old@3-10", "aaaooooooo"),  # the frame at 3 s is the first of `old`
        ("old@3-10,angry@0-3", "aaaooooooo"),
        ("angry@0-2,old@8-10", "aaaaaooooo"),  # between the spans the nearest one applies
        ("angry@0-2,old@7-10", "aaaaaooooo"),  # at 4 s the last frame, at 1 s, is as far as 7 s
        ("old@4-5", "oooooooooo"),
        ("angry@0-5,old@4-10", "aaaa?ooooo"),  # both, in equal parts
    ],
)
def test_spans_of_styles_frame_by_frame(wanted, expected):
    """At one frame per second a transition is shorter than a frame; ? is a mixture."""
    track = style_track(NAMES, wanted, 10, 1.0)
    letters = (NAMES[row.argmax()][0] if row.max() == 1 else "?" for row in track)
    assert "".join(letters) == expected


def test_styles_cross_over_in_a_second_around_the_border():
    track = style_track(NAMES, "angry@0-2,old@2-4", 40, 10.0)
    ramp = np.clip((np.arange(40) - 14) / 11, 0, 1)  # 14 to 25: half way between frames 19 and 20
    np.testing.assert_allclose(track, np.stack([1 - ramp, ramp, 0 * ramp], axis=1), atol=1e-6)
    equal = style_track(NAMES, "angry@0-4,sad@0-4", 40, 10.0)
    np.testing.assert_allclose(equal, np.tile([0.5, 0.0, 0.5], (40, 1)))


@pytest.mark.parametrize(
    ("wanted", "says"),
    [
        ("glad", "(?=.*'glad')(?=.*angry)(?=.*old).*sad"),
        ("glad@0-1", "'glad'"),
        ("old@2-2", "'old@2-2'"),
        ("old@2", "(?=.*'old@2').*@0-10"),
    ],
)
def test_styles_that_cannot_be_read_are_refused(wanted, says):
    with pytest.raises(ModelError, match=says):
        style_track(NAMES, wanted, 10, 1.0)
