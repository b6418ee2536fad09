"""Where sound comes from: when each block comes, what is dropped, and how a source ends."""

from __future__ import annotations

import io
import queue
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
import soundfile

from gesturekit.live import sources
from gesturekit.live.sources import FileSource, Intake, PipeSource, put_newest
from gesturekit.live.timeline import Block


class Clock:
    """Stands in for the module `time`: nothing takes time but sleep."""

    def __init__(self) -> None:
        self.now = 50.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds >= 0
        self.now += seconds


@pytest.fixture
def wav(tmp_path):
    soundfile.write(tmp_path / "a.wav", np.arange(1600) / 3200, 16_000, subtype="FLOAT")
    return tmp_path / "a.wav"


def delivered(source, busy: float = 0.0, most: int = 9999) -> list[tuple[float, Block]]:
    """The time at which each block comes; taking the first one takes `busy` seconds."""
    taken, stopped = [], threading.Event()

    def put(block: Block) -> None:
        taken.append((sources.time.monotonic() - 50, block))
        if len(taken) == 1:
            sources.time.sleep(busy)
        if len(taken) == most:
            stopped.set()

    source.run(put, stopped)
    return taken


def test_blocks_of_a_file_come_when_they_would_have_been_spoken(wav, monkeypatch):
    monkeypatch.setattr(sources, "time", Clock())
    source = FileSource(wav, 0.04, False)
    assert (source.rate, source.block, source.fast, source.is_live) == (16_000, 0.04, False, False)
    taken = delivered(source)
    assert [len(block.samples) for _, block in taken] == [640, 640, 320]
    sound = np.concatenate([block.samples for _, block in taken])
    np.testing.assert_allclose(sound, np.arange(1600) / 3200, atol=1e-6)
    assert [at for at, _ in taken] == pytest.approx([0.04, 0.08, 0.1])
    assert [block.time - 50 for _, block in taken] == pytest.approx([0, 0.04, 0.08])
    # While the computer is busy, the others wait for nothing.
    monkeypatch.setattr(sources, "time", Clock())
    assert [at for at, _ in delivered(source, busy=1.0)] == pytest.approx([0.04, 1.04, 1.04])
    monkeypatch.setattr(sources, "time", Clock())
    fast = delivered(FileSource(wav, 0.04, True))
    assert [(at, block.time) for at, block in fast] == [(0, None)] * 3


def test_a_source_that_is_stopped_delivers_no_more(wav, monkeypatch):
    monkeypatch.setattr(sources, "time", Clock())
    assert len(delivered(FileSource(wav, 0.04, False), most=2)) == 2
    pipe = PipeSource(io.BytesIO(bytes(12_800)), 16_000, 0.04, False)
    assert len(delivered(pipe, most=2)) == 2


def test_a_block_has_at_least_a_sample(wav):
    assert len(delivered(FileSource(wav, 1e-9, True))) == 1600
    assert len(delivered(PipeSource(io.BytesIO(bytes(200)), 16_000, 1e-9, True))) == 100


class Blocks:
    """Ten blocks of 0.04 s at once, and then an end, perhaps by an error."""

    rate, tolerance, is_live, overflows = 100, 0.02, True, 0

    def __init__(self, block: float, fast: bool, error: Exception | None = None) -> None:
        self.block, self.fast, self.error = block, fast, error

    def run(self, put, stopped) -> None:
        for k in range(10):
            put(Block(np.full(4, k, np.float32), None))
        if self.error is not None:
            raise self.error


def test_half_a_second_of_sound_may_wait_and_the_oldest_goes(monkeypatch):
    """Two blocks of 0.25 s are half a second; the end waits until there is a place for it."""
    for block, fast, kept in ((0.25, False, [8, 9]), (2.0, False, [8, 9]), (0.25, True, range(10))):
        got, limit = [], time.monotonic() + 10
        with Intake(Blocks(block, fast)) as intake:
            while not fast and intake.dropped < 0.3 and time.monotonic() < limit:
                time.sleep(0.001)
            while (one := intake.get(5)) is not None:
                got.append(one.samples[0])
        assert got == list(kept)
        assert intake.dropped == pytest.approx(0.04 * (10 - len(kept)))


def test_the_error_of_a_source_comes_after_its_sound():
    with Intake(Blocks(0.04, False, OSError("unplugged"))) as intake:
        assert [intake.get(5).samples[0] for _ in range(10)] == list(range(10))
        with pytest.raises(OSError, match="unplugged"):
            intake.get(5)
        with pytest.raises(queue.Empty):
            intake.get(0.01)


def test_a_full_queue_loses_its_oldest_or_is_waited_for():
    full = queue.Queue(2)
    assert [put_newest(full, item, None) for item in "abcd"] == [[], [], ["a"], ["b"]]
    never, ended = threading.Event(), threading.Event()
    ended.set()
    assert put_newest(full, "e", ended) == [] and list(full.queue) == ["c", "d"]
    threading.Timer(0.15, full.get).start()
    assert put_newest(full, "f", never) == [] and list(full.queue) == ["d", "f"]
    threading.Timer(0.05, never.set).start()
    assert put_newest(full, "g", never) == [] and list(full.queue) == ["d", "f"]


def test_a_microphone_waits_until_it_is_stopped(monkeypatch):
    events, card = [], SimpleNamespace(PortAudioError=OSError)
    card.query_devices = lambda *_: {"default_samplerate": 44_100.0}
    monkeypatch.setattr(sources, "_portaudio", lambda: card)

    class Stream:
        def __init__(self, **settings) -> None:
            del settings["callback"]
            events.append(settings)

        def __enter__(self) -> None:
            events.append("begun")

        def __exit__(self, *_) -> None:
            events.append("ended")

    card.InputStream = Stream
    stopped = threading.Event()
    microphone = sources.Microphone("USB", 1e-9, print)
    thread = threading.Thread(target=microphone.run, args=(print, stopped))
    thread.start()
    thread.join(0.1)
    assert thread.is_alive() and events[1:] == ["begun"]
    stopped.set()
    thread.join(5)
    assert events[1:] == ["begun", "ended"]
    settings = {"samplerate": 44_100, "blocksize": 1, "device": "USB"}
    assert events[0] == {**settings, "channels": 1, "dtype": "float32"}
