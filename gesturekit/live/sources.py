"""Sound for a stream: a microphone, a file in real time, or a pipe.

Its blocks come late, in bursts, or not at all; `Timeline` makes one signal without holes of them.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, BinaryIO, Protocol

import numpy as np

from audio_features import Wave
from gesturekit.errors import ConfigError

QUEUE_SECONDS = 0.5
"""Sound that may wait while the model is busy; of more, the oldest is dropped."""
_AHEAD = 0.25
"""Seconds by which a pipe may be ahead of time, as programs write in bursts."""
_FASTER = 1.001
"""Speed at which a pipe is read, so that a fast sound card never has to wait."""
BRIDGE = 0.2
"""Longest gap that is filled by sound like the last one, seconds; after it there is silence."""
_DRIFT = 1e-3
"""Largest difference between the clocks of sound card and computer that is followed."""
_MOST_IDLE = 1.0
"""Most silence made at once, seconds; a computer that slept goes on with the present."""


@dataclass(frozen=True)
class Block:
    """Sound as a source delivers it.

    Attributes:
        samples: (N,) float32, mono.
        time: when its first sample was captured, seconds of `time.monotonic`; None for sound that
            is read as fast as possible.
    """

    samples: np.ndarray
    time: float | None = None


Put = Callable[[Block], None]


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
            about = self._portaudio.query_devices(self._device, "input")
        except (ValueError, self._portaudio.PortAudioError) as error:
            where = "mic" if device is None else f"mic:{device}"
            how = "gesturekit live --list-devices lists them"
            raise ConfigError(f"{where}: {error}; {how}") from None
        self.rate = int(about["default_samplerate"])

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
        stopped: ends the thread when it is set.
        dropped: seconds of sound that had to go.
        waits: whether the source waits, so that all of its sound is used.
    """

    def __init__(self, source: Source) -> None:
        self.source, size = source, max(round(QUEUE_SECONDS / source.block), 2)
        self._queue: queue.Queue[Block | None] = queue.Queue(size)
        self.waits = source.fast or not source.is_live
        self.stopped, self.dropped = threading.Event(), 0.0
        self._error: Exception | None = None
        threading.Thread(target=self._run, name="sound", daemon=True).start()

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
            self.source.run(self._put, self.stopped)
        except Exception as error:
            self._error = error
        self._put(None)

    def _put(self, block: Block | None) -> None:
        wait = self.stopped if self.waits or block is None else None
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


class Timeline:
    """Place of each block in the sound that the stream gets.

    Sound that is missing for up to `BRIDGE` is replaced by a mirror image of what came before,
    which fades. In a longer gap silence follows as the time passes. Sound that comes when its time
    was filled already is dropped. A gap that is found too late to be filled, as the computer was
    busy or slept, is skipped. The clock of the sound card is followed, so that its drift is no gap.

    Args:
        rate: samples per second.
        tolerance: seconds by which a block may come early or late without being taken for a gap.

    Attributes:
        counts: seconds of sound that were bridged, silent, dropped and skipped so far.
    """

    def __init__(self, rate: int, tolerance: float) -> None:
        self.counts = dict.fromkeys(("bridged", "silent", "dropped", "skipped"), 0.0)
        self._rate, self._tolerance = rate, tolerance
        self._given, self._missing = 0, 0
        self._origin: float | None = None
        self._last = np.zeros(round(BRIDGE * rate), np.float32)

    @property
    def seconds(self) -> float:
        """Length of the sound that the stream got."""
        return self._given / self._rate

    def moment(self, seconds: float) -> float | None:
        """Return the clock's time of a second of the stream's sound; None without a clock."""
        return None if self._origin is None else self._origin + seconds

    def place(self, block: Block, now: float) -> np.ndarray:
        """Return the samples that the stream gets for a block, which is taken at time `now`."""
        samples, filled = block.samples, np.empty(0, np.float32)
        if block.time is not None:
            origin = self._origin = block.time if self._origin is None else self._origin
            ahead = origin + self.seconds - block.time
            if ahead > self._tolerance:
                late = min(round(ahead * self._rate), len(samples))
                self.counts["dropped"] += late / self._rate
                samples = samples[late:]
            elif -ahead > self._tolerance:
                is_behind = now - block.time - len(samples) / self._rate > BRIDGE
                bridged = 0.0 if is_behind else min(-ahead, BRIDGE)
                filled = self._filled(round(bridged * self._rate))
                self._skip(origin, -ahead - bridged)
            else:
                drift = _DRIFT * len(samples) / self._rate
                self._origin = origin - float(np.clip(ahead, -drift, drift))
        if len(samples):
            self._given += len(samples)
            self._missing = 0
            self._last = np.concatenate([self._last, samples])[-len(self._last) :]
        return np.concatenate([filled, samples])

    def idle(self, now: float) -> np.ndarray:
        """Return the samples with which the stream goes on while no block comes."""
        origin = self._origin = now if self._origin is None else self._origin
        due = now - origin - self.seconds - self._tolerance - BRIDGE
        self._skip(origin, due - _MOST_IDLE)
        return self._filled(max(round(min(due, _MOST_IDLE) * self._rate), 0))

    def _skip(self, origin: float, seconds: float) -> None:
        self._origin = origin + max(seconds, 0.0)
        self.counts["skipped"] += max(seconds, 0.0)

    def _filled(self, count: int) -> np.ndarray:
        """Return `count` samples that go on from the last ones, mirrored and fading to silence."""
        places = self._missing + np.arange(count)
        kept = places[places < len(self._last)]
        filled = np.zeros(count, np.float32)
        filled[: len(kept)] = self._last[::-1][kept] * (1 - kept / len(self._last))
        self.counts["bridged"] += len(kept) / self._rate
        self.counts["silent"] += (count - len(kept)) / self._rate
        self._missing += count
        self._given += count
        return filled
