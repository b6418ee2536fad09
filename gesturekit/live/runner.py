"""The loop of live generation: sound from a source, through the stream, to the sinks."""

from __future__ import annotations

import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Protocol

import numpy as np

from gesturekit.live.sources import Intake, Source, put_newest
from gesturekit.live.timeline import Block, Timeline
from gesturekit.motion import Motion, Skeleton
from gesturekit.wording import counted

_SINK_STEPS = 250
"""Steps that may wait for a slow sink, about ten seconds; of more, the oldest is dropped."""
_PATIENCE = 5.0
"""Seconds that a sink gets to take what waits for it at the end."""
_POLL = 0.05
_KEPT = 100_000
"""Measurements kept for quantiles: those of the last hour or so."""


class MotionStream(Protocol):
    """Motion that is generated while sound comes in, as `Model.stream` returns it.

    Attributes:
        sample_rate: of the sound, Hz.
        fps: frames per second.
        skeleton: rig of the motion.
        n_frames: number of frames returned so far; frame k belongs to k / fps s of the sound.
        latency: seconds from a sound to the return of the frame that belongs to it, without the
            length of a block and the time of computing.
    """

    sample_rate: int
    fps: float
    skeleton: Skeleton
    n_frames: int
    latency: float

    def step(self, samples: np.ndarray) -> Motion | None:
        """Take samples (N,) float32 and return the frames that became final, if any did."""

    def finish(self) -> Motion | None:
        """Return the remaining frames: floor(duration fps + 1/2) in all."""


@dataclass(frozen=True)
class Step:
    """Result of one step of the stream.

    Attributes:
        samples: (N,) float32, the sound that the stream got.
        motion: frames that became final; None if none did.
        time: seconds of the sound to which the first of the frames belongs.
        lag: seconds from that sound's capture until now; None without a clock.
    """

    samples: np.ndarray
    motion: Motion | None
    time: float
    lag: float | None


class Sink(Protocol):
    """Receiver of the steps of a stream, with a thread of its own."""

    def put(self, step: Step) -> None:
        """Take a step."""

    def close(self) -> None:
        """End; called once, after the last step."""


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
    sound: Mapping[str, float] = field(default_factory=dict)
    missed: int = 0
    failures: list[str] = field(default_factory=list)

    def figures(self) -> dict[str, float | None]:
        """Return all figures by name; seconds, if the name says no other unit."""
        found: dict[str, float | None] = {
            "sound": self.seconds,
            "frames": self.frames,
            "algorithmic_latency": self.latency,
            "load_to_first_pose": self.first_pose,
            "real_time_factor": self.computed / self.seconds if self.seconds else None,
        }
        for name, values in (("step", self.steps), ("lag", self.lags)):
            for label, share in (("p50", 0.5), ("p95", 0.95), ("max", 1.0)):
                value = float(np.quantile(values, share)) if values else None
                found[f"{name}_{label}"] = value
        jitter = np.quantile(self.lags, [0.05, 0.95]) if self.lags else None
        found["arrival_jitter"] = None if jitter is None else float(jitter[1] - jitter[0])
        return found | dict(self.sound) | {"missed_by_sinks_steps": self.missed}

    def line(self) -> str:
        """Return a summary of one line."""
        lag = f", worst lag {max(self.lags):.2f} s" if self.lags else ""
        sound = ", ".join(f"{value:.2f} s {name}" for name, value in self.sound.items() if value)
        missed = f", {counted(self.missed, 'step')} missed by a slow sink" if self.missed else ""
        frames = counted(self.frames, "frame")
        return f"{self.seconds:.1f} s, {frames}{lag}{f', {sound}' if sound else ''}{missed}"


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
    block: float,
    fast: bool,
    report: Report,
    stopped: threading.Event,
    warn: Callable[[str], None],
) -> None:
    """Generate motion until the sound ends.

    Args:
        stream: at the rate of `source`.
        source: where the sound comes from.
        sinks: where the motion goes; they are closed at the end.
        block: seconds of a block of sound.
        fast: nothing waits for real time, and nothing is dropped.
        report: figures to fill in.
        stopped: ends the run when it is set.
        warn: called with a line when something goes wrong that does not end the run.
    """
    loop = _Loop(stream, source, Timeline(source.rate, source.tolerance), report)
    intake = Intake(source, block, fast)
    try:
        loop.feeds += [_Feed(sink, fast, warn) for sink in sinks]
        with intake:
            while not stopped.is_set():
                try:
                    if (taken := intake.get(_POLL)) is None:
                        break
                except queue.Empty:
                    loop.idle(fast)
                else:
                    loop.take(taken)
        loop.deliver(np.zeros(0, np.float32), stream.finish)
    finally:
        loop.close(intake.dropped)


@dataclass
class _Loop:
    """State of a run, and the work of a block."""

    stream: MotionStream
    source: Source
    timeline: Timeline
    report: Report
    feeds: list[_Feed] = field(default_factory=list)

    def take(self, block: Block) -> None:
        samples = self.timeline.place(block, time.monotonic())
        self.deliver(samples, partial(self.stream.step, samples))

    def idle(self, fast: bool) -> None:
        if not fast and len(samples := self.timeline.idle(time.monotonic())):
            self.deliver(samples, partial(self.stream.step, samples))

    def deliver(self, samples: np.ndarray, work: Callable[[], Motion | None]) -> None:
        """Do a step of work and hand its result to all sinks."""
        report, first = self.report, self.stream.n_frames / self.stream.fps
        begun = time.perf_counter()
        motion = work()
        ended = time.perf_counter()
        report.steps.append(ended - begun)
        report.computed += ended - begun
        lag = None
        if motion is not None:
            report.frames += motion.n_frames
            report.first_pose = report.first_pose or ended - report.begun
            if (captured := self.timeline.moment(first)) is not None:
                lag = time.monotonic() - captured
                report.lags.append(lag)
        for feed in self.feeds:
            feed.put(Step(samples, motion, first, lag))

    def close(self, dropped: float) -> None:
        for feed in self.feeds:
            feed.close()
        line, report = self.timeline, self.report
        report.seconds = line.seconds
        report.missed = sum(feed.missed for feed in self.feeds)
        report.failures = [feed.failure for feed in self.feeds if feed.failure]
        names = ("bridged", "silent", "dropped", "skipped")
        sound = (line.bridged, line.silent, line.dropped + dropped, line.skipped)
        report.sound = dict(zip(names, sound))
