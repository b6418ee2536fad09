"""A microphone, by a stand-in of PortAudio that plays what a sound card would deliver."""

import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from gesturekit.errors import ConfigError
from gesturekit.live.sources import Block, Microphone


class SoundCard:
    """The parts of the module `sounddevice` that are used, of a card with one microphone.

    Args:
        captured: when the driver says that sound was captured, which comes at 7.5 s.
    """

    class PortAudioError(Exception):
        pass

    def __init__(self, captured: float = 7.4) -> None:
        self.captured = captured

    def query_devices(self, device=None, kind=None):
        if device not in (None, 1, "USB"):
            raise ValueError(f"No input device matching {device!r}")
        return {"default_samplerate": 48000.0} if kind else "  1 USB microphone"

    def InputStream(self, **settings):  # noqa: N802
        self.settings = settings
        return self

    def __enter__(self):
        for k in range(5):
            data = np.full((1920, 1), k / 10, np.float32)
            # Dated half a second after the stream began, by a clock of its own.
            times = SimpleNamespace(currentTime=7.5, inputBufferAdcTime=self.captured)
            status = SimpleNamespace(input_overflow=k in (1, 2, 3))
            self.settings["callback"](data, 1920, times, status)
            data[:] = 9.0  # PortAudio uses its buffer again

    def __exit__(self, *_):
        pass


@pytest.mark.parametrize(
    ("captured", "age"),
    # Some drivers date nothing, or by another clock: then a block is as old as it is long.
    [(7.4, 0.1), (0.0, 0.04), (7.6, 0.04), (-90.0, 0.04)],
)
def test_sound_of_a_microphone_is_dated_and_lost_sound_is_said_once(monkeypatch, captured, age):
    card, warnings, blocks = SoundCard(captured), [], []
    monkeypatch.setitem(sys.modules, "sounddevice", card)
    microphone = Microphone("1", 0.04, warnings.append)
    stopped, now = threading.Event(), time.monotonic()
    stopped.set()
    microphone.run(blocks.append, stopped)
    assert microphone.rate == 48000 and card.settings["blocksize"] == 1920
    assert card.settings["device"] == 1 and card.settings["channels"] == 1
    wanted = [np.full(1920, k / 10, np.float32) for k in range(5)]
    np.testing.assert_array_equal([block.samples for block in blocks], wanted)
    assert all(isinstance(b, Block) and abs(now - age - b.time) < 0.03 for b in blocks)
    assert len(warnings) == 1 and microphone.overflows == 3


def test_a_microphone_that_is_missing_is_one_clear_error(monkeypatch, gesturekit, tmp_path):
    monkeypatch.setitem(sys.modules, "sounddevice", SoundCard())
    assert "USB microphone" in gesturekit("live", "--list-devices").ok().out
    gesturekit("live", "--from", "mic:front").fails(2, "mic:front")
    monkeypatch.setitem(sys.modules, "sounddevice", None)
    with pytest.raises(ConfigError, match=r"pip install 'gesturekit\[live\]'"):
        Microphone(None, 0.04, print)
    # The package is there, and the library that it opens is not.
    (tmp_path / "sounddevice.py").write_text("raise OSError('PortAudio library not found')")
    monkeypatch.delitem(sys.modules, "sounddevice")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigError, match="(?=.*PortAudio)(?=.*apt install)"):
        Microphone(None, 0.04, print)
