"""Extraction of speech features into files, as a batch."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from audio_features.track import Method
from gesturekit.corpus.speech import one_blas_thread
from gesturekit.errors import SpeechError
from gesturekit.jobs.result import Processor, Result, Task, json_of, path_digest
from gesturekit.rendering.inputs import task_wave, task_words

if TYPE_CHECKING:
    from audio_features import Extractor, FeatureTrack, Wave

log = logging.getLogger(__name__)


@dataclass
class FeatureExtraction(Processor):
    """Extraction of the features of one sound, with all settings.

    Args:
        extractor: what is extracted.
        out: folder for the results, NAME.npz.
        fps: frames per second to resample to; None for the features' own rate.
        align: method of resampling; None for linear.
        picture: whether to draw NAME.png as well.
        channel: channel of each file to use, counted from 1; None for the mean of all.
        cache: whether slow features are read from the cache, see `audio_features.FeatureCache`.
        existing: "refuse", "skip" or "replace" files that were made with other settings.
    """

    extractor: Extractor
    out: Path
    fps: float | None
    align: Method | None
    picture: bool
    channel: int | None
    cache: bool
    existing: str

    def __post_init__(self) -> None:
        align = self.align or "linear"
        self.settings = json_of({"extractor": self.extractor.spec, "fps": self.fps, "align": align})
        self.written = {"npz": {}, "png": {}} if self.picture else {"npz": {}}

    def trial(self, out: Path) -> Self:
        """Return the same extraction into another folder, without a cache."""
        other = super().trial(out)
        other.cache = False
        return other

    def input_of(self, task: Task, digest: str | None = None) -> dict[str, Any]:
        """Return the digests of the sound and of its words, and which part of it is used."""
        from audio_features.files import own_files
        from audio_features.words import takes_words

        about = super().input_of(task, digest)
        if self.channel is not None:
            about["channel"] = self.channel
        used = {name: task.more.get(name) for name in ("start", "seconds", "channel")}
        about |= {name: value for name, value in used.items() if value is not None}
        if task.path is not None and takes_words(self.extractor):
            words = task_words(task)
            about["words"] = words and path_digest(words)
        if task.path is not None and (files := own_files(self.extractor, task.path)):
            about["features"] = [path and path_digest(path) for path in files]
        return about

    def make(self, result: Result) -> None:
        """Extract the features of a sound and write them."""
        task = result.task
        wave = task_wave(task, self.channel)
        if wave is None:
            raise SpeechError(f"{task.source}: no sound, so there are no features of it")
        for fault in (*wave.repairs, *wave.faults()):
            log.warning("%s: %s", task.source, fault)
        result.sound = wave.duration
        with one_blas_thread():
            track = self._extracted(wave)
        result.facts["shape"] = track.values.shape
        for file in self.missing(result, task.id):
            if file.suffix == ".npz":
                track.save(file)
            else:
                from gesturekit.viewer.pictures import draw_features

                draw_features(track, file, wave)

    def _extracted(self, wave: Wave) -> FeatureTrack:
        from audio_features import cache_from_environment

        if self.cache:
            track = cache_from_environment().extract(self.extractor, wave)
        else:
            track = self.extractor.extract(wave)
        if self.fps is None:
            return track
        n_frames = wave.n_frames(self.fps)
        return track.to_rate(self.fps, n_frames, method=self.align or "linear")
