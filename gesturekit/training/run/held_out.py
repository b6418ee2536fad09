"""Metrics of a model in training on held-out recordings: sync, coverage and speed."""

from __future__ import annotations

import logging
import time
from collections import defaultdict
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

import audio_features as af
from gesturekit.corpus.item import Item
from gesturekit.corpus.manifest import Manifest
from gesturekit.errors import GestureKitError
from gesturekit.evaluation.metrics.frame_rate import at_rate
from gesturekit.evaluation.metrics.patches import coverage, patch_features
from gesturekit.evaluation.metrics.physical import HARDLY_MOVING, arm_speed, joint_speed
from gesturekit.evaluation.metrics.sync import sync
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import body_joints
from gesturekit.training.run.folder import Run
from gesturekit.training.run_config import RunConfig
from gesturekit.wording import counted, roughly

log = logging.getLogger(__name__)

MOST_CLIPS = 4
MOST_SECONDS = 20.0
"""Largest number of measured clips, and of seconds of each. Fixed: they bound the time it takes."""
EVERY_SECONDS = 300.0
"""Seconds between measurements of a training without `eval_every`."""
MOST_SHARE = 0.05
"""Largest share of the training time spent on evaluations; they become less frequent if needed."""
_PATCH_FRAMES = 30


@dataclass(frozen=True, eq=False)
class _Clip:
    item: Item
    recording: Motion
    wave: af.Wave | None


class HeldOutMetrics:
    """Measurement of a model on the corpus's valid and test items, or on train without these.

    Items are read at the first measurement. The training goes on with a warning if the corpus
    cannot be read any more.

    Args:
        config: of the run.
        run: folder in which metrics are logged.
        speech: pass the items' audio to the model.
        styles: styles of the model.
        path: pass the recordings' root path to the model.
    """

    def __init__(
        self,
        config: RunConfig,
        run: Run,
        *,
        speech: bool,
        styles: Collection[str] = (),
        path: bool = False,
    ) -> None:
        self.config = config
        self.run = run
        self.speech = speech
        self.styles = styles
        self.path = path
        self._measured = time.monotonic()
        self._took = 0.0

    @cached_property
    def items(self) -> tuple[Item, ...]:
        """Return the items to measure; none if the corpus cannot be read."""
        try:
            fitting = [
                item
                for item in Manifest.load(self.config.corpus)
                if item.motion is not None and (item.audio is not None or not self.speech)
                if not self.styles or item.style in self.styles
            ]
        except GestureKitError as error:
            log.warning("No metrics on held-out recordings: %s", error)
            return ()
        kept = [item for item in fitting if item.split != "train"] or fitting
        return tuple(kept[:: -(-len(kept) // MOST_CLIPS) or 1])

    @property
    def is_held_out(self) -> bool:
        """Return True if no item is of split train."""
        return all(item.split != "train" for item in self.items)

    @property
    def what(self) -> str:
        """Return "2 held-out recordings (34 s)"."""
        seconds = sum(min(item.duration, MOST_SECONDS) for item in self.items)
        kind = "held-out" if self.is_held_out else "training"
        return f"{counted(len(self.items), f'{kind} recording')} ({roughly(seconds)})"

    def is_due(self) -> bool:
        """Return True if it is time to measure again."""
        return time.monotonic() - self._measured > max(EVERY_SECONDS, self._took / MOST_SHARE)

    def measure(
        self, step: int, generate: Callable[..., Motion], so_far: str = "", **controls: Any
    ) -> str:
        """Log the metrics of a model, to the run's metrics and as a sentence.

        Args:
            step: of the training.
            generate: method of the model.
            so_far: text after the step number.
            controls: further controls of `generate`.

        Returns:
            The sentence; empty if nothing could be measured.
        """
        if not self.items:
            return ""
        began = time.monotonic()
        try:
            figures = self._figures(generate, controls)
        except (GestureKitError, af.AudioFeaturesError, OSError) as error:
            log.warning("Step %d: no metrics on %s: %s", step, self.what, error)
            figures = {}
        self._measured = time.monotonic()
        self._took = self._measured - began
        if not figures:
            return ""
        said = f"on {self.what}: {sentence(figures)}"
        log.info("Step %d%s: %s.", step, so_far, said)
        kind = "held_out" if self.is_held_out else "recorded"
        if not self.run.has(step, kind):
            values = {f"{kind}/{key}": value for key, value in figures.items()}
            self.run.log(step, values, kind=kind)
        return said

    @cached_property
    def _clips(self) -> list[_Clip]:
        clips = []
        for item in self.items:
            motion = item.load_motion(self.config.parts)
            n_frames = min(motion.n_frames, round(MOST_SECONDS * motion.fps))
            wave = None
            if self.speech:
                wave = item.load_wave().slice(0.0, n_frames / motion.fps)
            clips.append(_Clip(item, motion.slice(0, n_frames), wave))
        return clips

    def _figures(
        self, generate: Callable[..., Motion], controls: Mapping[str, Any]
    ) -> dict[str, float]:
        every: dict[str, list[float]] = defaultdict(list)
        for clip in self._clips:
            asked: dict[str, Any] = {"seed": 0, **controls}
            if self.styles:
                asked["style"] = clip.item.style
            if self.path:
                asked["path"] = clip.recording
            if clip.wave is not None:
                asked["speech"] = clip.wave
            elif "path" not in asked:
                asked["seconds"] = clip.recording.duration
            made = generate(**asked)
            for key, value in _compared(made, at_rate(clip.recording, made.fps), clip.wave).items():
                every[key].append(value)
        return {key: float(np.mean(values)) for key, values in every.items()}


def sentence(figures: Mapping[str, float]) -> str:
    """Return the metrics in words, each beside its reference value."""
    parts = []
    if figures.get("arm_speed_ratio", 1.0) < HARDLY_MOVING and "sync" in figures:
        parts.append("the arms hardly move, so sync is not informative")
    elif "sync" in figures:
        own = figures.get("sync_recording")
        beside = "" if own is None else f", the recording's own {own:.2f}"
        parts.append(f"sync {figures['sync']:.2f} (chance {figures['sync_chance']:.2f}{beside})")
    if "coverage" in figures:
        parts.append(f"coverage {figures['coverage']:.0f} %")
    for key, name in (("arm_speed_ratio", "arm speed"), ("speed_ratio", "speed")):
        if key in figures:
            parts.append(f"{name} {figures[key]:.2f} of the recording's")
            break
    return ", ".join(parts)


def _compared(made: Motion, recording: Motion, wave: af.Wave | None) -> dict[str, float]:
    """Return the metrics of a motion, without those that its rig or length does not allow."""
    figures: dict[str, float] = {}
    joints = body_joints(recording.skeleton)
    for key, speed in (
        ("speed_ratio", lambda motion: joint_speed(motion, joints)),
        ("arm_speed_ratio", arm_speed),
    ):
        try:
            own = float(speed(recording).mean())
            if own > 0:
                figures[key] = float(speed(made).mean()) / own
        except GestureKitError:
            continue
    try:
        if wave is not None:
            ours, theirs = sync(made, wave), sync(recording, wave)
            figures |= {"sync": ours.r, "sync_chance": ours.chance_mean}
            figures["sync_recording"] = theirs.r
        elif min(made.n_frames, recording.n_frames) > _PATCH_FRAMES:
            features = [patch_features(m, "ganimator", joints=joints) for m in (made, recording)]
            figures["coverage"] = 100.0 * coverage(*features, _PATCH_FRAMES)
    except GestureKitError:
        pass  # no arms, no feet, or too short
    return figures
