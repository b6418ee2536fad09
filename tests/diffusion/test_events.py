"""Events as they are asked for: names and times, the beats of a sound, or a table."""

from pathlib import Path

import numpy as np
import pytest

import audio_features as af
from gesturekit.diffusion.conditions import asked_events, wants_beats
from gesturekit.errors import ModelError
from gesturekit.formats.tables import Event


@pytest.mark.parametrize(
    ("text", "events"),
    [
        ("kick@1.0", [Event(1.0, "kick", 0.0)]),
        ("punch@2.5:0.5, kick@1", [Event(1.0, "kick", 0.0), Event(2.5, "punch", 0.5)]),
        ("high kick@.5:2.", [Event(0.5, "high kick", 2.0)]),
        ("a@b@3", [Event(3.0, "a@b", 0.0)]),
    ],
)
def test_names_and_seconds_are_events_in_order_of_time(text, events):
    assert list(asked_events(text, None)) == events
    assert not wants_beats(text)


@pytest.mark.parametrize("text", ["kick", "kick@-1", "kick@1:", "@1", "kick@1,", "kick@beat"])
def test_what_does_not_look_like_events_is_refused_with_an_example(text):
    with pytest.raises(ModelError, match=r"kick@\d"):
        asked_events(text, None)


def test_beats_need_a_sound_that_has_them():
    for events in ("kick@beats", "a@1, kick@beats:0.2"):
        assert wants_beats(events)
        with pytest.raises(ModelError, match="(?=.*kick@beats)(?=.*sound)"):
            asked_events(events, None)
    for events in (None, Path("kick@beats"), "beats@1"):
        assert not wants_beats(events)
    silence = af.Wave(np.zeros(32_000, np.float32), 16_000, "still.wav")
    with pytest.raises(ModelError, match=r"(?=.*beat)(?=.*still\.wav)"):
        asked_events("kick@beats", silence)
