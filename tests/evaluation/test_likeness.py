"""Likeness as `evaluate` measures it, against nearest neighbours of scikit-learn."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from itertools import combinations, permutations
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sklearn.neighbors import NearestNeighbors

from gesturekit.corpus import Item, Manifest
from gesturekit.evaluation import (
    BareItem,
    Clip,
    ClipMetrics,
    Pair,
    Variants,
    evaluate,
    motion_windows,
)
from gesturekit.evaluation.definitions import MOVEMENT, POOLED
from gesturekit.evaluation.measuring.clip_metrics import ReferenceStatistics
from gesturekit.evaluation.measuring.clips import chosen_frames
from gesturekit.evaluation.measuring.made_motion import halved, held, turned
from gesturekit.evaluation.results import OTHER_SPEAKER, GroupLikeness, MetricResult
from gesturekit.evaluation.statistics.likeness import credits, relative
from gesturekit.evaluation.statistics.model_metrics import MEAN_POSE
from gesturekit.motion import Motion
from gesturekit.motion.parts import arm_joints, body_joints

FPS, SECONDS = 25.0, 7.0
TELLING = ("postures and movements", "direction of time", "reach")
MEASURE = ClipMetrics(ReferenceStatistics(), (MOVEMENT, POOLED), Variants())


@pytest.fixture
def talk(gesture) -> Callable[..., Motion]:
    """talk(seed, lean, seconds): a gesture with both arms leant to one side, rad."""

    def make(seed: int, lean: float = 0.0, seconds: float = SECONDS) -> Motion:
        motion = gesture(seconds, FPS, seed=seed)
        vectors = np.zeros((motion.n_frames, motion.skeleton.n_joints, 3))
        vectors[:, [motion.skeleton.index(f"{s}Arm") for s in ("Left", "Right")], 2] = lean
        return turned(motion, vectors)

    return make


def measured(
    folder: Path,
    real: Sequence[Motion],
    made: Sequence[Motion],
    others: Sequence[Motion] = (),
    takes: str = "",
) -> MetricResult:
    """Evaluate clips of the first takes of speaker a beside the rest, and beside speaker b."""
    items = []
    for speaker, motions in (("a", real), ("b", others)):
        for k, motion in enumerate(motions):
            motion.save(path := folder / f"{speaker}{k}.npz")
            take = takes[k] if takes else path.stem
            split = "test" if speaker == "a" and k < len(made) else "train"  # all splits count
            items.append(Item(id=path.stem, audio=None, motion=path, duration=motion.duration,
                              speaker=speaker, take=take, split=split))  # fmt: skip
    Manifest(items).save(folder / "corpus.jsonl")
    for k, motion in enumerate(made):
        motion.save(folder / "made" / f"a{k}.npz")
    (model,) = evaluate(folder / "made", folder / "corpus.jsonl", cheap=True, seed=1).models
    return model.metrics["likeness"]


def backwards(motion: Motion) -> Motion:
    return chosen_frames(motion, np.arange(motion.n_frames)[::-1])


@cache
def values_of(motion: Motion, recording: Motion) -> dict[str, float]:
    pair = Pair("", "", None, BareItem(id="a"), BareItem(id="b"))
    joints = body_joints(recording.skeleton)
    return MEASURE.generated(Clip(pair, motion, recording, joints, None, ())).values


def credits_of(
    ours: Sequence[Motion], recorded: Sequence[Motion], theirs: Sequence[Motion]
) -> dict[str, float]:
    """Credits of motions, made for recordings, that are compared with others; each is a take."""

    def means(motions: Sequence[Motion], on: Sequence[Motion]) -> dict[str, float]:
        found = list(map(values_of, motions, on))
        keys = set.intersection(*map(set, found))
        return {key: float(np.mean([values[key] for values in found])) for key in keys}

    rows, near = (motion_windows(list(motions)).values for motions in (ours, theirs))
    back = motion_windows(list(map(backwards, theirs))).values
    turn = motion_windows(list(theirs), mirrored=True).values

    def nearest(others: np.ndarray) -> np.ndarray:
        return NearestNeighbors(n_neighbors=1).fit(others).kneighbors(rows)[0][:, 0]

    def share(others: np.ndarray) -> float:
        gap = nearest(others) - nearest(near)
        return 100.0 * np.where(np.abs(gap) < 1e-9, 0.5, gap > 0).mean()

    labels = np.repeat([0, 1], [len(rows), len(near)])
    every = NearestNeighbors(n_neighbors=1).fit(np.r_[rows, near])
    right = labels[every.kneighbors()[1][:, 0]] == labels  # of each, without itself
    # Random subsets of the larger set do not matter where all are right.
    assert len(rows) == len(near) or right.all()
    windows = {"one_nn": right.mean(), "forward": share(back), "sided": share(turn)}
    return credits(means(ours, recorded) | windows, means(theirs, theirs))


def mean_of(
    made: Sequence[Motion], real: Sequence[Motion], size: int, left_out: int = -1
) -> GroupLikeness:
    """Likeness of clips of the first takes, over all choices of `size` of these."""
    found = []
    for chosen in combinations(range(len(made)), size):
        a = [i for i in chosen if i != left_out]
        b = [real[i] for i in range(len(real)) if i not in (*chosen, left_out)]
        if a and b:
            recorded = [real[i] for i in a]
            ours, own = (credits_of([s[i] for i in a], recorded, b) for s in (made, real))
            found.append(relative(ours, own))
    aspects = {k: float(np.mean([one.aspects[k] for one in found])) for k in found[0].aspects}
    value, own = np.mean([(one.value, one.own) for one in found], axis=0)
    return GroupLikeness("", (), value, own, aspects)


def test_clips_and_recordings_are_compared_with_the_same_other_takes(talk, tmp_path):
    """Clips of three of four takes: each two against the other two."""
    real = [talk(seed, 0.05 * k) for k, seed in enumerate((0, 1, 0, 2))]
    made = [halved(m, arm_joints(m.skeleton))
            for m in (backwards(real[3]), backwards(real[3]), talk(0, 0.4))]  # fmt: skip
    # Of a longer take, a piece as long as a clip counts.
    longer = talk(2, 0.15, seconds=2.4 * SECONDS)
    assert longer[:175].rotations == pytest.approx(real[3].rotations)
    result = measured(tmp_path, [*real[:3], longer], made)
    (group,) = result.groups
    expected = mean_of(made, real, 2)
    assert (group.value, group.own) == pytest.approx((expected.value, expected.own), rel=1e-6)
    assert group.aspects == pytest.approx(expected.aspects, rel=1e-6)
    assert all(0.0 < group.aspects[k] < 1.0 for k in TELLING)
    assert group.takes == ("a0", "a1", "a2") and group.name == "a" and not group.pieces
    assert result.ceiling.n == 4 and not result.tested_against_speaker


def test_takes_left_out_and_the_levels_of_likeness(talk, tmp_path):
    """Clips of two of three takes, so far apart that random subsets of windows do not matter."""
    real = [talk(k, 1.1 * k - 1.1) for k in range(3)]
    made, others = [talk(5, -0.6), talk(6, 0.3)], [talk(7, 1.7), talk(8, 1.9)]
    result = measured(tmp_path, real, made, others)
    (group,) = result.groups
    whole, *left = (mean_of(made, real, 1, i).value for i in (-1, 0, 1, 2))
    assert group.value == result.interval.value == pytest.approx(whole, rel=1e-6)
    assert group.without == pytest.approx({"a0": left[0], "a1": left[1]}, rel=1e-6)
    assert group.without_reference == pytest.approx(left[2:], rel=1e-6)

    def floor(takes: Sequence[Motion]) -> float:
        found = []
        for a in range(2):
            b = [real[i] for i in range(3) if i != a]
            ours, own = (credits_of(side, side, b) for side in (takes[:1], [real[a]]))
            found.append(relative(ours, own).value)
        return float(np.mean(found))

    floors = {level.name: level for level in result.floors}
    assert floors[OTHER_SPEAKER].value == pytest.approx(floor(others), rel=1e-6)
    joints = np.concatenate([motion.rotations for motion in real]).swapaxes(0, 1)
    mean = np.stack([Rotation.from_quat(joint).mean().as_quat() for joint in joints])[None]
    still = held(replace(real[0][:1], rotations=mean), len(real[0].rotations))
    assert floors[MEAN_POSE].value == pytest.approx(floor([still]), rel=1e-6)
    found = []
    for x, a, b in permutations(real):
        ours, own = (credits_of([side], [side], [b]) for side in (x, a))
        found.append(relative(ours, own).value)
    ceiling = (result.ceiling.value, result.ceiling.spread, result.ceiling.n)
    assert ceiling == pytest.approx((np.mean(found), np.std(found, ddof=1), 3), rel=1e-6)
    assert result.tested_against_speaker


@pytest.mark.parametrize(
    ("takes", "clips", "names", "count"),
    [
        ("a", 1, ["a0 0", "a0 1", "a0 2", "a0 3"], 4),
        ("aaa", 3, ["a0 0", "a1 1", "a2 2"], 3),
        ("aab", 2, ["a0 0", "a1 1"], 4),
    ],
)
def test_clips_stand_for_takes_where_these_are_few_and_pieces_of_a_single_clip(
    talk, tmp_path, takes, clips, names, count
):
    """Each take gives two pieces, the one without clips too."""
    real = [talk(k, seconds=24.0 if take == "b" else 12.0) for k, take in enumerate(takes)]
    result = measured(tmp_path, real, real[:clips], takes=takes)
    (group,) = result.groups
    assert group.pieces and list(group.takes) == names and group.value == 1.0
    assert result.ceiling.pieces and result.ceiling.n == count
    assert result.interval.units == 1 and result.interval.low is None


def test_a_mirrored_speaker_is_told_by_left_and_right(talk, tmp_path):
    """The speaker's left arm is raised."""
    real = []
    for seed in range(5):
        motion = talk(seed)
        vectors = np.zeros((motion.n_frames, motion.skeleton.n_joints, 3))
        vectors[:, motion.skeleton.index("LeftArm"), 2] = 0.9
        real.append(turned(motion, vectors))
    sides = {}
    for name, made in (("own", real[:3]), ("mirrored", [m.mirror() for m in real[:3]])):
        found = measured(tmp_path / name, real, made)
        sides[name] = found.groups[0].aspects["left and right"]
    assert sides["own"] == 1.0 and sides["mirrored"] < 0.2
