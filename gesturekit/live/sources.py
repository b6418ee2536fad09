"""Sound for a stream: a microphone, a file in real time, or a pipe."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import ModuleType
from typing import Any, BinaryIO, Protocol

import numpy as np

from audio_features import Wave
from gesturekit.errors import ConfigError
from gesturekit.live.timeline import Block

Put = Callable[[Block], None]
QUEUE_SECONDS = 0.5
"""Sound that may wait while the model is busy; of more, the oldest is dropped."""
_AHEAD = 0.25
"""Seconds by which a pipe may be ahead of time, as programs write in bursts."""
_FASTER = 1.001
"""Speed at which a pipe is read, so that a fast sound card never has to wait."""


class Source(Protocol):
    """Origin of the sound of a stream.

    Attributes:
        rate: samples per second.
        block: seconds of a block.
        fast: whether blocks come as fast as they are taken, and have no time.
        tolerance: see `Timeline`.
        is_live: whether the sound is nowhere else, so that a recording has it too.
        overflows: times that the sound card lost sound.
    """

    rate: int
    block: float
    fast: bool
    tolerance: float
    is_live: bool
    overflows: int

    def run(self, put: Put, stopped: threading.Event) -> None:
        """Deliver blocks until the sound ends, or `stopped` is set."""


class FileSource:
    """A sound file in real time, or as fast as possible.

    Args:
        path: whatever `Wave.load` reads.
        block: seconds of a block.
        fast: do not wait between blocks.

    Raises:
        AudioError: no sound file.
    """

    tolerance, is_live, overflows = 0.02, False, 0

    def __init__(self, path: Path, block: float, fast: bool) -> None:
        self.path, self._wave, self.block, self.fast = path, Wave.load(path), block, fast
        self.rate = self._wave.sample_rate
        self._size = max(round(block * self.rate), 1)

    def run(self, put: Put, stopped: threading.Event) -> None:
        """Deliver the sound; a block comes when its last sample would have been recorded."""
        start, samples = time.monotonic(), self._wave.samples
        for at in range(0, len(samples), self._size):
            block = samples[at : at + self._size]
            begins = start + at / self.rate
            if not self.fast:
                time.sleep(max(begins + len(block) / self.rate - time.monotonic(), 0))
            if stopped.is_set():
                return
            put(Block(block, None if self.fast else begins))


class PipeSource:
    """Samples of 16 bits, little endian, mono, without a header, as `ffmpeg -f s16le` writes.

    Args:
        pipe: binary stream.
        rate: samples per second.
        block: seconds of a block.
        fast: read as fast as possible.
    """

    tolerance, is_live, overflows = _AHEAD, True, 0

    def __init__(self, pipe: BinaryIO, rate: int, block: float, fast: bool) -> None:
        self._pipe, self.rate, self.block, self.fast = pipe, rate, block, fast
        self._size = 2 * max(round(block * rate), 1)

    def run(self, put: Put, stopped: threading.Event) -> None:
        """Deliver the sound up to the end of the pipe, never much faster than it is spoken."""
        start, n_read = time.monotonic(), 0
        while not stopped.is_set() and (data := self._pipe.read(self._size)):
            samples = np.frombuffer(data[: len(data) // 2 * 2], "<i2") / np.float32(32768)
            n_read += len(samples)
            ahead = n_read / self.rate - _FASTER * (time.monotonic() - start)
            if not self.fast:
                time.sleep(max(ahead - _AHEAD, 0))
            begins = time.monotonic() - len(samples) / self.rate
            put(Block(samples, None if self.fast else begins))


class Microphone:
    """A microphone, by PortAudio.

    Args:
        device: number or part of the name of the device; None for the system's default.
        block: seconds of a block.
        warn: called once, with the text, if the sound card lost sound.

    Raises:
        ConfigError: sounddevice or PortAudio is not installed, or there is no such device.
    """

    tolerance, is_live, fast = 0.02, True, False

    def __init__(self, device: str | None, block: float, warn: Callable[[str], None]) -> None:
        self._portaudio, self.block, self._warn = _portaudio(), block, warn
        self._device = int(device) if device is not None and device.isdecimal() else device
        self.overflows = 0
        try:
            found = self._portaudio.query_devices(self._device, "input")
        except (ValueError, self._portaudio.PortAudioError) as error:
            raise ConfigError(
                f"mic{'' if device is None else f':{device}'}: {error}; gesturekit live "
                "--list-devices lists them"
            ) from None
        self.rate = int(found["default_samplerate"])

    def run(self, put: Put, stopped: threading.Event) -> None:
        """Deliver sound until `stopped` is set."""

        def take(data: np.ndarray, count: int, times: Any, status: Any) -> None:
            if status.input_overflow:
                self.overflows += 1
                if self.overflows == 1:
                    self._warn("the sound card lost sound: the computer is too busy")
            age = times.currentTime - times.inputBufferAdcTime
            # Some drivers do not date their sound.
            if not times.inputBufferAdcTime or not 0 <= age < 1:
                age = count / self.rate
            put(Block(data[:, 0].copy(), time.monotonic() - age))

        with self._portaudio.InputStream(
            samplerate=self.rate,
            blocksize=max(round(self.block * self.rate), 1),
            device=self._device,
            channels=1,
            dtype="float32",
            callback=take,
        ):
            stopped.wait()


def devices() -> str:
    """Return a list of the sound devices, as text.

    Raises:
        ConfigError: sounddevice or PortAudio is not installed.
    """
    return str(_portaudio().query_devices())


def _portaudio() -> ModuleType:
    try:
        import sounddevice
    except (ImportError, OSError) as error:  # OSError: without the library PortAudio
        what = "PortAudio (Debian: apt install libportaudio2)"
        if isinstance(error, ImportError):
            what = "sounddevice; run: pip install 'gesturekit[live]'"
        raise ConfigError(f"a microphone needs {what}") from None
    return sounddevice


class Intake:
    """A source in a thread of its own, and the bounded queue of its blocks.

    While the queue is full, a fast source or a file waits; any other loses the oldest block.

    Args:
        source: origin of the sound, of which `QUEUE_SECONDS` may wait.

    Attributes:
        dropped: seconds of sound that had to go.
        waits: whether the source waits, so that all of its sound is used.
    """

    def __init__(self, source: Source) -> None:
        self.source, size = source, max(round(QUEUE_SECONDS / source.block), 2)
        self._queue: queue.Queue[Block | None] = queue.Queue(size)
        self.waits = source.fast or not source.is_live
        self._stopped, self.dropped = threading.Event(), 0.0
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="sound", daemon=True)

    def __enter__(self) -> Intake:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()

    def get(self, seconds: float) -> Block | None:
        """Return the next block, or None if the sound has ended.

        Raises:
            queue.Empty: none came within `seconds`.
            Exception: whatever ended the source.
        """
        block = self._queue.get(timeout=seconds)
        if block is None and self._error is not None:
            raise self._error
        return block

    def _run(self) -> None:
        try:
            self.source.run(self._put, self._stopped)
        except Exception as error:
            self._error = error
        self._put(None)

    def _put(self, block: Block | None) -> None:
        wait = self._stopped if self.waits or block is None else None
        for gone in put_newest(self._queue, block, wait):
            self.dropped += len(gone.samples) / self.source.rate


def put_newest(full: queue.Queue[Any], item: Any, wait: threading.Event | None) -> list[Any]:
    """Put an item into a bounded queue; return the oldest ones, which had to go.

    Args:
        full: the queue.
        item: what to put.
        wait: wait for a free place until this is set, and drop nothing; None never waits.
    """
    gone: list[Any] = []
    while wait is None or not wait.is_set():
        with suppress(queue.Full):
            full.put(item, timeout=None if wait is None else 0.1, block=wait is not None)
            break
        if wait is None:
            with suppress(queue.Empty):
                gone.append(full.get_nowait())
    return gone
