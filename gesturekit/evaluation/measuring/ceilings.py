"""Ceilings of metrics that compare with recordings: the value of the speaker's other takes.

Each recording is compared with one of another take of the same speaker, as if it had been generated
for it. A single take is compared with itself, piece by piece or half by half, which flatters. A
model that moves like the speaker comes to about these values: it cannot know what was recorded.
Fréchet distances have none: they depend on the size of the sets, and disjoint sets of recordings as
large as the model's are not to be had.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import chain

import numpy as np

from gesturekit.errors import GestureKitError
from gesturekit.evaluation.definitions import DEFINITIONS, PATCHES, SIMILARITY
from gesturekit.evaluation.measuring.clip_metrics import ClipMetrics
from gesturekit.evaluation.measuring.clips import Clip, load_recording
from gesturekit.evaluation.measuring.samples import copied, evenly, halves
from gesturekit.evaluation.metrics import similarity
from gesturekit.evaluation.metrics.patches import inter_diversity, patch_features
from gesturekit.evaluation.metrics.physical import SpeedHistogram, hellinger, relative_speed
from gesturekit.evaluation.pairs import Pair
from gesturekit.evaluation.results import Interval
from gesturekit.evaluation.statistics.intervals import Takes, interval_of, whole_set
from gesturekit.motion import Motion
from gesturekit.motion.parts import body_joints

MOST, LONGEST = 30, 60.0
"""Recordings that are compared with each other, at most, and seconds of each."""
INTER = 20
"""Recordings that inter-diversity is taken of, at most."""
OTHERS, PIECES, HALVES = (
    "recording: against another take of the speaker",
    "recording: against another piece of the same take",
    "recording: one half against the other",
)

_OF_SPEECH = ("mouth", "mouth_lag", "mouth_chance", "mouth_z")
"""Metrics for which another take is no goal: a mouth follows the words."""

SECOND = ", second half"
"""Ending of the name of the second half of a single recording."""


def ceilings(
    sources: Mapping[str, Pair], fps: float, measure: ClipMetrics
) -> dict[str, tuple[Interval, str]]:
    """Return {key of `definitions`: (the recordings' own value, how it was taken)}.

    Args:
        sources: pairs of each recording with itself, which give takes and speakers; of one rig.
        fps: frame rate of the evaluation.
        measure: the metrics of clips, with their groups.
    """
    if not sources:  # all are too short to be compared
        return {}
    chosen = _chosen(sources, fps)
    own = {name: sources[name.removesuffix(SECOND)] for name in chosen}
    others, note = _others(own)
    note = note if len(sources) > 1 else HALVES
    joints = body_joints(next(iter(chosen.values())).skeleton)
    clips = [
        Clip(own[name], chosen[other], chosen[name], joints, None, ())
        for name, other in others.items()
    ]
    found: dict[str, tuple[Interval, str]] = {}
    values = [measure.against(clip) for clip in clips]
    for key in set(chain.from_iterable(values)) - {"hellinger", *_OF_SPEECH}:
        has = [(v[key], clip.pair) for v, clip in zip(values, clips) if key in v]
        takes = Takes.of([pair for _, pair in has])
        found[key] = interval_of([v for v, _ in has], takes, DEFINITIONS[key].within), note
    sides = halves(list(chosen.values()))
    speeds = ([relative_speed(motion, joints) for motion in side] for side in sides)
    sets = {"hellinger": hellinger(*map(SpeedHistogram.of, speeds))}
    try:
        if SIMILARITY in measure.groups:
            both = [similarity.pose_pair(c.generated, c.recording, joints) for c in clips]
            poses = (np.concatenate(side) for side in zip(*both, strict=True))
            sets["cca_global"] = similarity.cca(*poses)
        if PATCHES in measure.groups:
            variant, some = measure.variants.patches, list(chosen.values())[:INTER]
            features = [patch_features(motion, variant, joints=joints) for motion in some]
            sets["inter_diversity"] = inter_diversity(features)
    except GestureKitError:
        pass  # the model's own result says why it cannot be taken
    whole = {key: (whole_set(value, len(chosen)), HALVES) for key, value in sets.items()}
    return found | whole


def _chosen(sources: Mapping[str, Pair], fps: float) -> dict[str, Motion]:
    """Return at most `MOST` recordings, evenly chosen and cut; halves of a single one."""
    kept = evenly(list(sources), MOST)
    cut = {name: _cut(load_recording(sources[name].reference, fps)) for name in kept}
    if len(cut) > 1:
        return cut
    ((name, motion),) = cut.items()
    first, second = halves([motion])
    return {name: first[0], f"{name}{SECOND}": second[0]}


def _cut(motion: Motion) -> Motion:
    return copied(motion, 0, round(LONGEST * motion.fps))


def _others(recordings: Mapping[str, Pair]) -> tuple[dict[str, str], str]:
    """Return {recording: the one that is compared with it}, and how they were chosen.

    The next recording of another take of the same speaker, cyclically; for speakers with one take,
    the next recording of it, unless others have several takes.
    """
    names = list(recordings)
    takes, pieces = {}, {}
    for at, name in enumerate(names):
        after = names[at + 1 :] + names[:at]
        same = [o for o in after if recordings[o].speaker == recordings[name].speaker]
        other_takes = [o for o in same if recordings[o].take != recordings[name].take]
        if other_takes:
            takes[name] = other_takes[0]
        pieces[name] = (same or after)[0]
    return (takes, OTHERS) if takes else (pieces, PIECES)
