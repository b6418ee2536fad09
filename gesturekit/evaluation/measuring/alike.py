"""Checks that models are compared on the same recordings, joints and lengths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from gesturekit.errors import EvaluationError, GestureKitError
from gesturekit.evaluation.measuring.clips import RETARGETED, load_clip, without_namespace
from gesturekit.evaluation.pairs import Excluded, Pairs, Window
from gesturekit.evaluation.results import ModelResult
from gesturekit.motion.parts import body_joints
from gesturekit.wording import counted, listed

SAME_LENGTH = 0.1
"""Largest relative difference of the clips of two models for one recording."""


def keep_common_recordings(found: Mapping[str, Pairs]) -> None:
    """Set clips apart that other models have no counterpart of, with a note and the reason.

    A mean over other recordings, or other windows of them, is not comparable.

    Raises:
        EvaluationError: no recording has clips of all models.
    """
    windows = {key: {pair.of for pair in pairs.pairs} for key, pairs in found.items()}
    common = set.intersection(*windows.values())
    if not common:
        counts = "; ".join(f"{key}: {_some(seen)}" for key, seen in windows.items())
        raise EvaluationError(
            f"no recording, or window of one, has clips of all models ({counts}), so they cannot "
            "be compared; evaluate each alone, or render the same files"
        )
    for label, pairs in found.items():
        apart = [pair for pair in pairs.pairs if pair.of not in common]
        if not apart:
            continue
        pairs.pairs = [pair for pair in pairs.pairs if pair.of in common]
        for pair in apart:
            lack = [key for key, seen in windows.items() if pair.of not in seen]
            reason = f"set apart: {listed(lack, 3)} has no clip of this recording"
            pairs.excluded.append(Excluded(pair.name, reason))
        pairs.notes.append(
            f"all models are compared on the {counted(len(common), 'recording')} that they share; "
            f"{counted(len(apart), 'clip')} of {label} set apart"
        )


def joints_to_leave_out(found: Mapping[str, Pairs], fps: float) -> frozenset[str]:
    """Return the bare names of body joints that the first clip of some model lacks.

    All models are measured without them; a note of each model that lacks some says so.
    """
    without: set[str] = set()
    for label, pairs in found.items():
        for pair in pairs.pairs:
            try:
                clip = load_clip(pair, fps)
            except GestureKitError:
                continue  # reported when it is measured
            lost = [n for n in body_joints(clip.recording.skeleton) if n not in clip.joints]
            without |= {without_namespace(name) for name in lost}
            if lost and len(found) > 1:
                pairs.notes.append(
                    f"{label} lacks {listed(lost, 5)} of the recordings' rig: all models are "
                    "measured without"
                )
            break
    return frozenset(without)


def mark_unlike(models: Sequence[ModelResult]) -> None:
    """Mark models whose clips were retargeted, or have another length than the first model's."""
    first = models[0]
    usual = _lengths(first)
    for model in models:
        changed = sum(RETARGETED in clip.notes for clip in model.clips)
        if changed:
            model.marks.append("retargeted")
            model.notes.append(
                f"{changed} of {counted(len(model.clips), 'clip')} are on another rig than their "
                "recording: they were retargeted to it before they were measured, and feet and "
                "reach are partly those of the retargeting"
            )
        own = _lengths(model)
        shared = [window for window in own if window in usual]
        other = [w for w in shared if abs(own[w] - usual[w]) > SAME_LENGTH * usual[w]]
        if len(other) > len(shared) / 2:
            lengths = [float(np.median([of[w] for w in other])) for of in (own, usual)]
            model.marks.append("other length")
            model.notes.append(
                f"clips of {lengths[0]:.3g} s where those of {first.label} have {lengths[1]:.3g} "
                "s: diversity, coverage, CCA and Fréchet distances depend on length, and do not "
                "rank these models"
            )


def _lengths(model: ModelResult) -> dict[Window, float]:
    """Return the mean length of a model's clips of each recording, seconds."""
    every: dict[Window, list[float]] = {}
    for clip in model.clips:
        every.setdefault(clip.pair.of, []).append(clip.seconds)
    return {window: float(np.mean(seconds)) for window, seconds in every.items()}


def _some(windows: set[Window]) -> str:
    names = sorted(stem if w is None else f"{stem}, window {w}" for stem, w in windows)
    return listed(names, 2)
