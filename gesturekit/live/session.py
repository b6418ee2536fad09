"""A run of live generation: its sound, model and sinks as a command names them, and its loop."""

from __future__ import annotations

import queue
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gesturekit.errors import ConfigError
from gesturekit.face import EnergyFace
from gesturekit.live.sinks import PORT, Recording, Sink, Step, VmcSender
from gesturekit.live.sources import (
    FileSource,
    Intake,
    Microphone,
    PipeSource,
    Source,
    Timeline,
    put_newest,
)
from gesturekit.model import MotionStream
from gesturekit.motion import Motion
from gesturekit.motion.face import FaceTrack
from gesturekit.viewer.human import Fitting, load_human
from gesturekit.wording import counted

if TYPE_CHECKING:
    from gesturekit.model import Model

_SINK_STEPS = 250
"""Steps that may wait for a slow sink, about ten seconds; of more, the oldest is dropped."""
_PATIENCE = 5.0
"""Seconds that a sink gets to take what waits for it at the end."""
_POLL = 0.05
_NOTHING = np.empty(0, np.float32)
_KEPT = 100_000
"""Measurements kept for quantiles: those of the last hour or so."""


@dataclass
class Report:
    """Figures of one run.

    Attributes:
        begun: `time.perf_counter` when the work began, loading included.
        latency: of the stream and a block, seconds.
        seconds: sound that the stream got.
        frames: frames that it returned.
        first_pose: seconds from `begun` to the first frame; None before it.
        steps: seconds of each step.
        lags: seconds from a sound's capture to its frame, for each step with frames.
        sound: seconds that were bridged, silent, dropped and skipped.
        overflows: times that the sound card lost sound.
        missed: steps that slow sinks missed.
        failures: one line for each sink that failed.
    """

    begun: float
    latency: float = 0.0
    seconds: float = 0.0
    frames: int = 0
    first_pose: float | None = None
    computed: float = 0.0
    steps: deque[float] = field(default_factory=lambda: deque(maxlen=_KEPT))
    lags: deque[float] = field(default_factory=lambda: deque(maxlen=_KEPT))
    sound: dict[str, float] = field(default_factory=dict)
    overflows: int = 0
    missed: int = 0
    failures: list[str] = field(default_factory=list)

    def add(self, motion: Motion | None, seconds: float, lag: float | None) -> None:
        """Count the frames of a step, the seconds that it took, and those since its sound came."""
        self.steps.append(seconds)
        self.computed += seconds
        if motion is not None:
            self.frames += motion.n_frames
            self.first_pose = self.first_pose or time.perf_counter() - self.begun
        if lag is not None:
            self.lags.append(lag)

    def figures(self) -> dict[str, float | None]:
        """Return all figures by name; seconds, if the name says no other unit."""
        shares = {"p50": 0.5, "p95": 0.95, "max": 1.0}
        late, early = _quantile(self.lags, 0.95), _quantile(self.lags, 0.05)
        return {
            "sound": self.seconds,
            "frames": self.frames,
            "algorithmic_latency": self.latency,
            "load_to_first_pose": self.first_pose,
            "real_time_factor": self.computed / self.seconds if self.seconds else None,
            **{f"step_{label}": _quantile(self.steps, share) for label, share in shares.items()},
            **{f"lag_{label}": _quantile(self.lags, share) for label, share in shares.items()},
            "arrival_jitter": None if late is None or early is None else late - early,
            **self.sound,
            "overflows": self.overflows,
            "steps_missed_by_sinks": self.missed,
        }

    def line(self) -> str:
        """Return a summary of one line."""
        parts = [f"{self.seconds:.1f} s", counted(self.frames, "frame")]
        parts += [f"worst lag {max(self.lags):.2f} s"] if self.lags else []
        parts += [f"{n:.2f} s of sound {name}" for name, n in self.sound.items() if n >= 0.005]
        parts += [counted(self.overflows, "overflow")] if self.overflows else []
        parts += [f"{counted(self.missed, 'step')} missed by a sink"] if self.missed else []
        return ", ".join(parts)


def _quantile(values: deque[float], share: float) -> float | None:
    return float(np.quantile(values, share)) if values else None


class LiveFace:
    """Face by rules for the motion of a stream; a recorded face that is played stays.

    A frame whose face is not final yet gets the newest one: with a `look_ahead` below the delay of
    `EnergyFace`, the mouth is late by the difference.

    Args:
        stream: the stream, before its first frame.
        seed: of blinks and gaze.
    """

    def __init__(self, stream: MotionStream, seed: int) -> None:
        self._rate = stream.sample_rate
        self._rules = EnergyFace(self._rate, stream.fps, seed)
        self._values = np.zeros((1, len(self._rules.names)))
        self._next = 1  # row of _values with the next frame

    def shown(self, motion: Motion) -> Motion:
        """Return an example for sinks: the motion with all channels of a face, or with its own."""
        return self._faced(motion, np.ones((motion.n_frames, len(self._rules.names))))

    def added(self, samples: np.ndarray, motion: Motion | None) -> Motion | None:
        """Return a step's motion with its face.

        Args:
            samples: (N,) of the step; none after the last sound.
            motion: frames that became final, if any did.
        """
        if not len(samples):
            silence = self._rules.delay + (0 if motion is None else motion.duration)
            samples = np.zeros(int(silence * self._rate) + 1, np.float32)
        self._values = np.concatenate([self._values, self._rules.step(samples)])
        if motion is None:
            return None
        last, stop = len(self._values) - 1, self._next + motion.n_frames
        faced = self._faced(motion, self._values[np.arange(self._next, stop).clip(0, last)])
        gone = min(stop, last)
        self._values, self._next = self._values[gone:], stop - gone
        return faced

    def _faced(self, motion: Motion, values: np.ndarray) -> Motion:
        face = motion.face or FaceTrack(self._rules.names, values, "rules")
        return replace(motion, face=face)


class _Feed:
    """A sink in a thread, so that one that blocks or fails never slows the stream."""

    def __init__(self, sink: Sink, fast: bool, warn: Callable[[str], None]) -> None:
        self._sink, self._warn, self._name = sink, warn, type(sink).__name__
        self._queue: queue.Queue[Step | None] = queue.Queue(_SINK_STEPS)
        self._ended = threading.Event()
        self._wait = self._ended if fast else None
        self.missed, self.failure = 0, ""
        self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
        self._thread.start()

    def put(self, step: Step) -> None:
        if not self._ended.is_set():
            self.missed += len(put_newest(self._queue, step, self._wait))

    def close(self) -> None:
        put_newest(self._queue, None, self._wait)
        self._thread.join(None if self._wait else _PATIENCE)
        if self._thread.is_alive():
            return self._fail("it does not take its frames")
        try:
            self._sink.close()
        except Exception as error:
            self._fail(error)

    def _run(self) -> None:
        try:
            while (step := self._queue.get()) is not None:
                self._sink.put(step)
        except Exception as error:
            self._fail(error)
        self._ended.set()

    def _fail(self, reason: object) -> None:
        self.failure = f"{self._name}: {reason}"
        self._warn(self.failure)


def run(
    stream: MotionStream,
    source: Source,
    sinks: list[Sink],
    *,
    report: Report,
    stopped: threading.Event,
    warn: Callable[[str], None],
    face: LiveFace | None = None,
) -> None:
    """Generate motion until the sound ends, or all sinks have failed.

    Args:
        stream: at the rate of `source`.
        source: origin of the sound. If it is fast, nothing is dropped, and it waits for the sinks.
        sinks: receivers of the motion; they are closed at the end.
        report: figures to fill in.
        stopped: ends the run when it is set.
        warn: called with a line when something goes wrong that does not end the run.
        face: face to add to the motion.
    """
    timeline, intake = Timeline(source.rate, source.tolerance), Intake(source)
    feeds = [_Feed(sink, source.fast, warn) for sink in sinks]

    def deliver(samples: np.ndarray) -> None:
        seconds, begun = stream.n_frames / stream.fps, time.perf_counter()
        motion = stream.step(samples) if len(samples) else stream.finish()
        if face is not None:
            motion = face.added(samples, motion)
        captured, taken = timeline.moment(seconds), time.perf_counter() - begun
        lag = None if motion is None or captured is None else time.monotonic() - captured
        report.add(motion, taken, lag)
        for feed in feeds:
            feed.put(Step(samples, motion, seconds, lag))

    try:
        while not stopped.is_set() and (samples := _next(intake, timeline)) is not None:
            if feeds and all(feed.failure for feed in feeds):
                break
            if len(samples):
                deliver(samples)
        intake.stopped.set()
        deliver(_NOTHING)
    finally:
        intake.stopped.set()
        for feed in feeds:
            feed.close()
        report.seconds, report.overflows = timeline.seconds, source.overflows
        report.sound = timeline.counts
        report.sound["dropped"] += intake.dropped
        report.missed = sum(feed.missed for feed in feeds)
        report.failures = [feed.failure for feed in feeds if feed.failure]


def _next(intake: Intake, timeline: Timeline) -> np.ndarray | None:
    """Return the samples that the stream gets next, which may be none yet; None at the end."""
    try:
        block = intake.get(_POLL)
    except queue.Empty:
        return _NOTHING if intake.waits else timeline.idle(time.monotonic())
    return None if block is None else timeline.place(block, time.monotonic())


SINKS = "page, vmc:HOST:PORT or record:FILE"
_EXAMPLE_SECONDS = 2.0
_PAGE_SECONDS, _PAGE_POLL = 10, 0.02
"""Seconds for which a file waits until a page is open, and between looks at it."""


@dataclass(frozen=True)
class Session:
    """Settings of a run.

    Attributes:
        source: "mic", "mic:DEVICE", "-" for standard input, or a sound file.
        sinks: each as in `SINKS`.
        look_ahead: seconds of sound that the model knows beyond a frame.
        seed: of the stream.
        fast: do not wait for real time.
        block: seconds of sound of each step.
        rate: samples per second of standard input.
        host: address of the page.
        port: of the page; 0 takes a free one.
        names: additional host names of the page.
        token_file: file with the token of the page; None for that of the environment.
        say: called with lines for the user.
        body: body on the page.
        framing: first view of the page.
        face: "energy" for a face by rules, unless the model plays recorded ones, or "off".
        controls: of the stream: style, speaker and liveliness.
    """

    source: str
    sinks: tuple[str, ...]
    look_ahead: float
    seed: int
    fast: bool
    block: float
    rate: int
    host: str
    port: int
    say: Callable[[str], None]
    body: str = "human"
    framing: str = "whole"
    face: str = "energy"
    names: tuple[str, ...] = ()
    token_file: Path | None = None
    controls: Mapping[str, Any] = field(default_factory=dict)

    def run(self, load: Callable[[], Model], report: Report, stopped: threading.Event) -> None:
        """Generate motion until the sound ends or `stopped` is set.

        Args:
            load: function that returns the model; called when the source has been checked.
            report: figures to fill in.
            stopped: ends the run.

        Raises:
            ConfigError: a source or sink that there is not.
            ModelError: the model cannot stream.
        """
        source = self._source()
        model = load()
        # A first step compiles and fills caches, for which no microphone waits.
        self._stream(model, source).step(np.zeros(source.rate, np.float32))
        stream = self._stream(model, source)
        face = LiveFace(stream, self.seed) if self.face == "energy" else None

        @cache
        def example() -> Motion:
            motion = model.generate(seconds=_EXAMPLE_SECONDS)
            return motion if face is None else face.shown(motion)

        try:
            opened = [self._opened(sink, source, example) for sink in self.sinks]
        except ImportError as error:
            how = "pip install 'gesturekit[live]'"
            raise ConfigError(f"{error.name} is not installed; run: {how}") from None
        report.latency = stream.latency + self.block
        latest = time.monotonic() + (0 if source.is_live else _PAGE_SECONDS)
        while not all(getattr(sink, "is_open", True) for sink in opened):
            if time.monotonic() >= latest or stopped.wait(_PAGE_POLL):
                break
        run(stream, source, opened, report=report, stopped=stopped, warn=self._warn, face=face)

    def _stream(self, model: Model, source: Source) -> MotionStream:
        return model.stream(source.rate, self.look_ahead, self.seed, **self.controls)

    def _warn(self, text: str) -> None:
        self.say(f"Warning: {text}")

    def _source(self) -> Source:
        kind, _, device = self.source.partition(":")
        if kind == "mic" and self.fast:
            raise ConfigError("--fast is for files and pipes: a microphone is as fast as it is")
        if kind == "mic":
            return Microphone(device or None, self.block, self._warn)
        if self.source == "-":
            return PipeSource(sys.stdin.buffer, self.rate, self.block, self.fast)
        return FileSource(Path(self.source), self.block, self.fast)

    def _opened(self, sink: str, source: Source, example: Callable[[], Motion]) -> Sink:
        """Open a sink of the motion of which there is an example.

        Raises:
            ConfigError: no such sink.
            ImportError: a package for it is not installed.
        """
        kind, _, place = sink.partition(":")
        if sink == "page":
            return self._page(source, example())
        if kind == "vmc":
            host, _, port = (place or f"127.0.0.1:{PORT}").rpartition(":")
            if not host or not port.isdecimal() or not 0 < int(port) < 1 << 16:
                raise ConfigError(f"--to {sink}: expected vmc:HOST:PORT, as vmc:127.0.0.1:39539")
            return VmcSender(host.strip("[]"), int(port), Fitting(load_human()[0], example()))
        if kind != "record" or not place:
            raise ConfigError(f"--to {sink}: no such sink; expected {SINKS}")
        return Recording(Path(place), source.rate if source.is_live else None)

    def _page(self, source: Source, example: Motion) -> Sink:
        from gesturekit.live.page import Page
        from gesturekit.serving.access import listen

        listening, url, hosts, token = listen(self.host, self.port, self.names, self.token_file)
        sound = source.path if isinstance(source, FileSource) and not self.fast else None
        shown: dict[str, Any] = {"body": self.body, "framing": self.framing, "token": token}
        page = Page(listening, hosts, example, sound=sound, **shown)
        start = "" if source.is_live else f"; starts when it is open, or in {_PAGE_SECONDS} s"
        start += "" if token is None else "; asks for the token, or takes it as /?token=TOKEN"
        self.say(f"Page at {url} (end with Ctrl-C){start}")
        return page
