"""Evaluation of a model in training on held-out recordings, as `gesturekit evaluate` does it."""

from __future__ import annotations

import logging
import shlex
import shutil
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from gesturekit.corpus.manifest import Item, Manifest
from gesturekit.corpus.takes import neighbours
from gesturekit.errors import GestureKitError
from gesturekit.evaluation import evaluate
from gesturekit.evaluation.measuring.clips import forget_files
from gesturekit.evaluation.results import ModelResult
from gesturekit.training.run_config import RunConfig
from gesturekit.training.run_folder import Run
from gesturekit.wording import counted, roughly

log = logging.getLogger(__name__)

MOST_SECONDS = 120.0
MOST_CLIPS = 6
"""Items of at most so many seconds together are all measured, and whole. Of more, at most so many
items are measured and cut to that total. Fixed: they bound the time it takes."""
EVERY_SECONDS = 300.0
"""Seconds between measurements of a training without `eval_every`."""
MOST_SHARE = 0.05
"""Largest share of the training time spent on evaluations; they become less frequent if needed."""
NO_VERDICT = "No verdict: the clips are too short, or the rig's arms and legs are not known."


@dataclass(eq=False)
class HeldOutMetrics:
    """Evaluation of a model on the corpus's test items, else its valid, else its training items.

    Clips are generated as `gesturekit render --corpus` generates them with seed 0, and evaluated by
    `gesturekit.evaluation.evaluate`, so that both say the same of the same clips. Those of the last
    measurement are kept in the run, with a manifest of the measured intervals and of the items of
    other splits. Items are read at the first measurement. Training goes on with a warning where
    nothing can be measured.

    Attributes:
        config: of the run.
        run: folder in which clips are written and metrics are logged.
        speech: measure the items with sound alone, and pass it to the model.
        styles: styles of the model; items of other styles are not measured.
    """

    config: RunConfig
    run: Run
    speech: bool
    styles: Collection[str] = ()

    def __post_init__(self) -> None:
        self._measured, self._took = time.monotonic(), 0.0

    @cached_property
    def items(self) -> tuple[Item, ...]:
        """Return the items to measure; none if the corpus cannot be read, or without `measure`."""
        chosen, longest = self._fitting if self.config.measure else [], MOST_SECONDS
        if _seconds(chosen) > MOST_SECONDS:
            chosen = chosen[:: -(-len(chosen) // MOST_CLIPS)]
            longest = MOST_SECONDS / len(chosen)
        return tuple(
            replace(
                item,
                duration=min(item.duration, longest),
                split="train" if item.split == "train" else "test",
            )
            for item in chosen
        )

    @property
    def seconds(self) -> float:
        """Return the total length of the items to measure."""
        return _seconds(self.items)

    @cached_property
    def _fitting(self) -> list[Item]:
        """Return the items of the measured split that the model has the inputs for."""
        fitting = [
            item
            for item in self._corpus
            if item.audio is not None or not self.speech
            if not self.styles or item.style in self.styles
        ]
        by_split = ([i for i in fitting if i.split == name] for name in ("test", "valid", "train"))
        return next(filter(None, by_split), [])

    @cached_property
    def _corpus(self) -> list[Item]:
        """Return the corpus's items with motion, with the body parts of the run's settings."""
        try:
            items = [item for item in Manifest.load(self.config.corpus) if item.motion]
        except GestureKitError as error:
            log.warning("No metrics on held-out recordings: %s", error)
            return []
        parts = self.config.parts
        if not parts:
            return items
        readings = [{**i.reading, "parts": i.reading.get("parts", {}) | parts} for i in items]
        return [replace(i, reading=reading) for i, reading in zip(items, readings, strict=True)]

    @property
    def is_held_out(self) -> bool:
        """Return True if no item is of split train."""
        return all(item.split != "train" for item in self.items)

    @property
    def what(self) -> str:
        """Return "1 held-out recording (34 s)", "6 of 9 held-out recordings (2 min of 5 min)"."""
        kind = "held-out" if self.is_held_out else "training"
        text = counted(len(self._fitting), f"{kind} recording")
        if len(self.items) < len(self._fitting):
            text = f"{len(self.items)} of {text}"
        measured, total = _seconds(self.items), _seconds(self._fitting)
        of = "" if measured == total else f" of {roughly(total)}"
        return f"{text} ({roughly(measured)}{of})"

    @property
    def folder(self) -> Path:
        """Folder of the clips of the last measurement, and of their manifest."""
        return self.run.folder / ("held_out" if self.is_held_out else "recorded")

    def is_due(self) -> bool:
        """Return True if it is time to measure again."""
        return time.monotonic() - self._measured > max(EVERY_SECONDS, self._took / MOST_SHARE)

    def measure(
        self, step: int, model: Any, so_far: str = "", *, keep: bool = False, **controls: Any
    ) -> str:
        """Evaluate a model; log the metrics to the run, and the verdict unless it is the last.

        Args:
            step: of the training.
            model: a `gesturekit.Model`.
            so_far: text after the step number.
            keep: keep the clips in `folder`: those of the last measurement.
            controls: controls of `generate` in addition to those of each item.

        Returns:
            Measured recordings and verdict in words; empty if nothing could be measured.
        """
        if not self.items:
            return ""
        began = time.monotonic()
        try:
            result = self._evaluated(model, controls, keep=keep)
        except Exception as error:  # a measurement is not worth ending a training for
            log.warning("Step %d: no metrics on %s: %s", step, self.what, error)
            result = None
        self._measured = time.monotonic()
        self._took = self._measured - began
        if result is None:
            return ""
        said = f"on {self.what}: {result.verdict or NO_VERDICT}"
        if keep:  # the training ends with the verdict, in the model's README
            beside = neighbours(self._corpus, self._fitting[0].split)
            said += f" Warning: {beside}." if beside else ""
            given = ["evaluate", str(self.folder), "--corpus", str(self.folder / "corpus.jsonl")]
            given += [] if self.is_held_out else ["--split", "train"]
            log.info("All metrics on %s: %s", self.what, shlex.join(["gesturekit", *given]))
        else:
            log.info("Step %d%s: %s", step, so_far, said)
        kind = self.folder.name
        if not self.run.has(step, kind):
            values: dict[str, float] = {}
            for key, found in result.metrics.items():
                of = {"": found.interval.value, "_recording": found.recording}
                of["_chance"] = found.chance
                values |= {f"{kind}/{key}{own}": v for own, v in of.items() if v is not None}
            self.run.log(step, values, kind=kind, verdict=said)
        return said

    def _evaluated(self, model: Any, controls: dict[str, Any], *, keep: bool) -> ModelResult:
        """Return the evaluation of a model's clips, which are written to a folder beside."""
        folder = self.run.folder / ".held_out"
        shutil.rmtree(folder, ignore_errors=True)
        try:
            for item in self.items:
                speech = item.load_wave() if self.speech else None
                seconds = None if self.speech else item.duration
                asked = item.controls(model) | controls
                motion = model.generate(speech, seconds=seconds, seed=0, item=item.id, **asked)
                motion.save(folder / f"{item.id}.npz")
            others = [item for item in self._corpus if item.split != self._fitting[0].split]
            manifest = Manifest([*self.items, *(others if self.is_held_out else ())])
            manifest.save(folder / "corpus.jsonl")
            split = self.items[0].split
            result = evaluate(folder, folder / "corpus.jsonl", split=split, cheap=True)
            if keep:
                shutil.rmtree(self.folder, ignore_errors=True)
                folder.rename(self.folder)
        finally:
            shutil.rmtree(folder, ignore_errors=True)
            forget_files()
        return result.models[0]


def _seconds(items: Sequence[Item]) -> float:
    """Return the length of items together, seconds."""
    return sum(item.duration for item in items)
