"""Settings that all training runs share, and checks of numbers in a configuration."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from gesturekit.motion.parts import KNOWN_PARTS
from gesturekit.training.config import Limits, Positive, Settings

UNIDENTIFIED = (
    "%s of the rig cannot be identified: %s. If it has them, name them by hand "
    "(parts: {left_knee: JOINT, ...})."
)
"""Log message for a rig without some parts: their names, and the consequences."""

LEGLESS = "The rig has no legs: no contact labels or loss, and no feet to lock."
"""Log message for a rig of an upper body alone."""

MOST_SMOOTH = 2.0
"""Seconds up to which motion is smoothed, as by the control `smooth`."""


@dataclass(frozen=True, kw_only=True)
class RunConfig(Settings):
    """Settings that both systems share; each system adds its own and may change defaults."""

    noun = "iteration"
    """Name of a training step in the log."""
    corpus: Path
    """Manifest written by `gesturekit prepare`."""
    out: Path
    """Run folder."""
    longer: Positive[float] = 1.0
    """Factor on the length of the training: 2 doubles the iterations of every stage (multires) or
    the updates (diffusion)."""
    seed: int = 0
    """Seed of initial weights, noise and batches; the same seed gives the same model."""
    fps: Positive[float]
    """Frame rate of the model; recordings are resampled to it."""
    joints: Literal["body", "all"] | tuple[str, ...] = "body"
    """Joints that are modelled: the body without fingers and end joints, all, or a list of joint
    names. Other joints stay at their mean rotation."""
    start_from: Path | None = None
    """Model or run folder of a model to fine-tune: its weights, rig, modelled joints, features and
    normalisation are kept. Null starts from random weights."""
    parts: dict[str, str] = field(default_factory=dict)
    """Joints of body parts, such as {left_elbow: Joint12}, for rigs whose body parts cannot be
    identified by joint names and shape."""
    in_memory: Positive[float] = 60.0
    """Minutes of recordings and unpaired speech up to which a corpus is held in memory. Of a longer
    one, training reads windows from arrays on disk, and statistics are those of a sample of this
    length, spread over speakers, styles and takes."""
    arrays: Path | None = None
    """Folder of the arrays of a long corpus, which runs share; null for CORPUS.arrays beside the
    manifest."""
    workers: Positive[int] = 1
    """Processes that make arrays (`--workers`)."""
    smooth: Annotated[float | None, Limits(MOST_SMOOTH, is_above=True)] = None
    """Smooth generated movements of the upper body that are shorter than this many seconds, except
    beats (`gesturekit.postprocess.smooth_motion`); null for none. Applied in generation, and stored
    with the model; it does not affect training."""
    checkpoint_every: Positive[int]
    """Steps between checkpoints."""
    log_every: Positive[int] = 10
    """Steps between log lines."""
    eval_every: int = 0
    """Steps between cheap evaluations (`quick_metrics`) on the training recordings, written to
    metrics.jsonl with `kind: evaluation`; 0 for none. Evaluations do not change the training."""
    measure: bool = True
    """Evaluate the model on held-out recordings (`kind: held_out`), or on those of the training if
    none are held out: every few minutes without `eval_every`, and at the end, as
    `gesturekit evaluate` does it."""
    threads: Positive[int | None] = None
    """CPU threads; null leaves the choice to torch."""
    device: str = "auto"
    """cpu, cuda, cuda:1 ..., or auto, which uses a GPU if there is one."""
    notes: dict[str, Any] = field(default_factory=dict)
    """Free text for the model's README, such as data and licence."""

    @property
    def arrays_folder(self) -> Path:
        """Return the folder of the arrays."""
        return self.arrays or self.corpus.with_suffix(".arrays")

    def lengthened(self, steps: int) -> int:
        """Return a number of training steps times `longer`, at least 1."""
        return max(1, round(steps * self.longer))

    def problems(self) -> Iterator[str]:
        """Yield what is wrong with the settings, beside numbers out of their limits."""
        for part, joint in self.parts.items():
            if part not in KNOWN_PARTS:
                yield f"parts: {part!r} is none of {', '.join(KNOWN_PARTS)}"
            if not isinstance(joint, str):
                yield f"parts.{part}: {joint!r} is not a joint name"
