"""Bounded work: one model in memory, a few threads, a short queue."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch
from threadpoolctl import threadpool_limits

import audio_features as af
from gesturekit.errors import GestureKitError
from gesturekit.model import Model
from gesturekit.serving.requests import Limits, MotionRequest
from gesturekit.systems import bundled_speech, drawing_options


class BusyError(Exception):
    """The queue is full."""


class Worker:
    """A model, and the threads that use it.

    Args:
        model: model with speech input.
        limits: number of threads, length of the queue, and longest sound.
    """

    def __init__(self, model: Model, limits: Limits) -> None:
        self.model, self._limits = model, limits
        self._threads = ThreadPoolExecutor(
            limits.workers,
            thread_name_prefix="motion",
            initializer=torch.set_num_threads,
            initargs=(1,),
        )
        self._admitted = 0
        self._lock = threading.Lock()

    @property
    def admitted(self) -> int:
        """Number of requests that are being received, queued or processed."""
        return self._admitted

    @contextlib.contextmanager
    def admit(self) -> Iterator[None]:
        """Hold a place in the queue.

        Raises:
            BusyError: there is none.
        """
        with self._lock:
            if self._admitted >= self._limits.workers + self._limits.queue:
                raise BusyError
            self._admitted += 1
        try:
            yield
        finally:
            with self._lock:
                self._admitted -= 1

    async def render(self, sound: Path, asked: MotionRequest) -> tuple[bytes, float]:
        """Generate the motion of a sound file in its folder, and return it and its seconds.

        Raises:
            GestureKitError, AudioFeaturesError: the sound or a setting cannot be used.
        """
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._threads, self._render, sound, asked)

    def _render(self, sound: Path, asked: MotionRequest) -> tuple[bytes, float]:
        wave = af.Wave.load(sound, max_seconds=self._limits.seconds)
        rate = asked.fps or self.model.recorded_fps
        if (n_frames := wave.n_frames(rate)) > self._limits.frames:
            raise GestureKitError(
                f"{wave.duration:g} s at {rate:g} frames per second are {n_frames} frames; this "
                f"service makes at most {self._limits.frames:g}: give a lower fps, or less sound"
            )
        # Those that were given: a default would count as given with `raw`.
        controls = asked.model_dump(exclude={"format"}, exclude_unset=True)
        motion = self.model.generate(wave, **controls)
        out = sound.with_name(f"motion.{asked.format}")
        extra = {"audio": sound, "title": "motion"} | drawing_options(self.model)
        motion.save(out, **(extra if asked.format == "html" else {}))
        return out.read_bytes(), wave.duration

    def warm_up(self) -> None:
        """Generate a short motion, so that the first request does not wait for compilation.

        From then on, matrix products of the whole process take one thread: their last bits depend
        on the number of threads, which motions made at once would change for each other.

        Raises:
            GestureKitError: the model cannot generate motion from sound.
        """
        if not self.model.inputs.speech:
            raise GestureKitError("this model has no speech input; serve one that has")
        if self.model.inputs.words or self.model.inputs.files:
            raise GestureKitError(
                "this model reads a file beside each sound (own features, or words), which a "
                "request does not bring: use gesturekit render, or compute the features by an "
                "installed extractor"
            )
        self.model.generate(af.Wave.load(bundled_speech(), duration=1.0))
        threadpool_limits(1, user_api="blas")  # now that all libraries are loaded
