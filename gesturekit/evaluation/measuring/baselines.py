"""Baselines: motion made from recordings alone, which a model is compared with.

Each is an ordinary model of the report. A model that is not better than `other_utterance` does not
listen to the speech.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from gesturekit.errors import EvaluationError, MotionError
from gesturekit.evaluation.made_motion import held, mean_pose
from gesturekit.evaluation.measuring.clips import load_recording
from gesturekit.evaluation.measuring.samples import MotionSample
from gesturekit.evaluation.pairs import (
    WINDOW_SECONDS,
    BareItem,
    ItemInterval,
    Items,
    Pair,
    Pairs,
    recordings,
)
from gesturekit.motion import Motion

_Recordings = Mapping[str, Path | ItemInterval]
MakeMotion = Callable[[Pair, int], Motion]
"""Makes the motion for a recording, of a number of frames; it can be handed to other processes."""


def baseline_pairs(
    names: Sequence[str], models: Mapping[str, Pairs], reference: Path | Items, fps: float
) -> dict[str, Pairs]:
    """Return {name: a clip of the baseline for each recording of the first model}.

    Args:
        names: names of `BASELINES`; labels of models that are baselines add nothing.
        models: clips of each model by label.
        reference: the recordings; a manifest with a training split gives the baselines' motion.
        fps: frame rate of the motion.

    Raises:
        EvaluationError: an unknown name or a model's label, or recordings from which a baseline
            cannot be made.
        CorpusError: a recording cannot be read.
    """
    unknown = [name for name in names if name not in BASELINES and name not in models]
    if unknown:
        raise EvaluationError(f"baseline {unknown[0]!r}; expected one of {', '.join(BASELINES)}")
    taken = [name for name in names if name in BASELINES and name in models]
    if taken:
        raise EvaluationError(f"baseline {taken[0]!r} has the label of a model; rename its folder")
    every = recordings(reference)
    training = reference.training if isinstance(reference, Items) else ()
    source = {item.id: ItemInterval(item) for item in training} or every
    first = next(iter(models.values()))
    windows = {pair.of: pair for pair in first.pairs}
    made = {}
    for name in (name for name in names if name in BASELINES):
        make = BASELINES[name](every, source, fps)
        made[name] = Pairs([_pair(pair, fps, make) for pair in windows.values()])
    return made


def _pair(pair: Pair, fps: float, make: MakeMotion) -> Pair:
    """Return the pair with the baseline's motion instead of the model's."""
    name = pair.stem if pair.window is None else f"{pair.stem}_w{pair.window:03d}"
    item = _BaselineItem(id=name, pair=pair, fps=fps, make=make)
    return replace(pair, name=name, generated=ItemInterval(item))


@dataclass(frozen=True, kw_only=True, eq=False)
class _BaselineItem(BareItem):
    """A baseline's clip, made when it is needed."""

    pair: Pair
    fps: float
    make: MakeMotion

    def load_motion(self) -> Motion:
        pair = self.pair
        n_frames = load_recording(pair.reference, self.fps).n_frames
        if pair.window is not None:
            start = round(pair.window * WINDOW_SECONDS * self.fps)
            n_frames = min(round(WINDOW_SECONDS * self.fps), n_frames - start)
        if n_frames < 1:
            raise MotionError(f"{pair.stem} ends before its window {pair.window} begins")
        return self.make(pair, n_frames)


def _mean_pose(every: _Recordings, source: _Recordings, fps: float) -> MakeMotion:
    """Return a maker of the mean pose of the recordings in `source`, held still."""
    sample, rigs = MotionSample(seed=0), set()
    for path in source.values():
        sample.add(motion := load_recording(path, fps))
        rigs.add(motion.skeleton.names)
    if len(rigs) > 1:
        raise EvaluationError("baseline mean_pose needs recordings of one rig")
    return partial(_held_pose, mean_pose(sample.motions))


def _held_pose(pose: Motion, pair: Pair, n_frames: int) -> Motion:
    rig = load_recording(pair.reference, pose.fps).skeleton
    if rig.names != pose.skeleton.names:
        raise MotionError(f"{pair.stem}: its rig differs from that of the mean pose")
    return replace(held(pose, n_frames), skeleton=rig)


def _other_utterance(every: _Recordings, source: _Recordings, fps: float) -> MakeMotion:
    """Return a maker of the next recording, from its start; of `source` if there is only one."""
    if len({*every, *source}) < 2:
        raise EvaluationError(
            "baseline other_utterance needs a second recording; there is only "
            f"{next(iter(every))!r}"
        )
    return partial(_next_recording, every if len(every) > 1 else source, fps)


def _next_recording(others: _Recordings, fps: float, pair: Pair, n_frames: int) -> Motion:
    keys = list(others)
    after = (keys.index(pair.stem) + 1) % len(keys) if pair.stem in others else 0
    return load_recording(others[keys[after]], fps)[:n_frames]


BASELINES: Mapping[str, Callable[[_Recordings, _Recordings, float], MakeMotion]] = {
    "mean_pose": _mean_pose,
    "other_utterance": _other_utterance,
}
"""Baselines by name."""
