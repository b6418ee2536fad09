"""A run of live generation, from the words of a command: which sound, which model, which sinks."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gesturekit.errors import ConfigError
from gesturekit.live.runner import Report, run
from gesturekit.live.sinks import PORT, Recording, Sink, VmcSender
from gesturekit.live.sources import FileSource, Microphone, PipeSource, Source
from gesturekit.model import MotionStream
from gesturekit.motion import Motion
from gesturekit.viewer.human import Fitting, Human

if TYPE_CHECKING:
    from gesturekit.model import Model

SINKS = "page, vmc:HOST:PORT or record:FILE"
_EXAMPLE_SECONDS = 2.0
_PAGE_SECONDS, _POLL = 10, 0.02
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
        example = cache(lambda: model.generate(seconds=_EXAMPLE_SECONDS, seed=self.seed))
        try:
            opened = [self._opened(sink, source, example) for sink in self.sinks]
        except ImportError as error:
            raise ConfigError(
                f"{error.name} is not installed; run: pip install 'gesturekit[live]'"
            ) from None
        report.latency = stream.latency + self.block
        latest = time.monotonic() + (0 if source.is_live else _PAGE_SECONDS)
        while not all(getattr(sink, "is_open", True) for sink in opened):
            if time.monotonic() >= latest or stopped.wait(_POLL):
                break
        run(stream, source, opened, report=report, stopped=stopped, warn=self._warn)

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
            return VmcSender(host.strip("[]"), int(port), Fitting(Human.load(), example()))
        if kind != "record" or not place:
            raise ConfigError(f"--to {sink}: no such sink; expected {SINKS}")
        return Recording(Path(place), source.rate if source.is_live else None)

    def _page(self, source: Source, example: Motion) -> Sink:
        from gesturekit.live.page import Page
        from gesturekit.serving.access import address_of, listening_socket, names_of, token_of

        token, hosts = token_of(self.host, self.token_file), names_of(self.host, self.names)
        listening = listening_socket(self.host, self.port)
        sound = source.path if isinstance(source, FileSource) and not self.fast else None
        shown: dict[str, Any] = {"body": self.body, "framing": self.framing, "token": token}
        page = Page(listening, hosts, example, sound=sound, **shown)
        start = "" if source.is_live else f"; starts when it is open, or in {_PAGE_SECONDS} s"
        start += "" if token is None else "; asks for the token, or takes it as /?token=TOKEN"
        self.say(f"Page at {address_of(listening, self.host)} (end with Ctrl-C){start}")
        return page
