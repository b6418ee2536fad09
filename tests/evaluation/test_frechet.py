"""Fréchet distances against closed forms, and clip features against their definitions."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from rigs import without_joints
from scipy.linalg import sqrtm
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from gesturekit.errors import EvaluationError, MotionError
from gesturekit.evaluation import (
    clip_diversity,
    fid,
    frechet_distance,
    frechet_result,
    geometric_features,
    kinetic_features,
    raw_fgd,
)
from gesturekit.motion import Motion
from gesturekit.motion.parts import body_joints


def test_small_cases_by_hand():
    # Means 0 and 2, variances 2 and 8 (divided by n - 1): 2² + 2 + 8 - 2 √(2 · 8) = 6.
    assert frechet_distance([[-1.0], [1.0]], [[0.0], [4.0]]) == pytest.approx(6.0)
    # Each varies along an axis of its own: nothing overlaps, 2 + 8 remain, and |(0, 0) - (1, 0)|².
    ours, theirs = [[-1.0, 0.0], [1.0, 0.0]], [[1.0, -2.0], [1.0, 2.0]]
    assert frechet_distance(ours, theirs) == pytest.approx(11.0)


def test_the_textbook_formula_where_it_can_be_computed():
    rng = np.random.default_rng(0)
    ours = rng.normal(size=(90, 12)) @ rng.normal(size=(12, 12))
    theirs = rng.normal(size=(70, 12)) @ rng.normal(size=(12, 12)) + rng.normal(size=12)
    covariances = np.cov(ours, rowvar=False), np.cov(theirs, rowvar=False)
    root = sqrtm(covariances[0] @ covariances[1]).real
    apart = ours.mean(axis=0) - theirs.mean(axis=0)
    expected = apart @ apart + np.trace(covariances[0] + covariances[1] - 2 * root)
    assert frechet_distance(ours, theirs) == pytest.approx(expected, rel=1e-9)


def test_fewer_samples_than_dimensions():
    rng = np.random.default_rng(1)
    few, others = rng.normal(size=(5, 3)), rng.normal(size=(9, 3))
    # Turned into 200 dimensions, which changes no distance.
    turn = np.linalg.qr(rng.normal(size=(200, 3)))[0].T
    expected = frechet_distance(few, others)
    assert frechet_distance(few @ turn, others @ turn) == pytest.approx(expected, rel=1e-9)


def motions_of(rng, n_motions, each, shift=0.0):
    """Features of motions that differ from each other more than their own windows do."""
    return [shift + rng.normal(size=4) + 0.5 * rng.normal(size=(each, 4)) for _ in range(n_motions)]


def test_small_samples_are_reported():
    rng = np.random.default_rng(4)
    enough = frechet_result(motions_of(rng, 20, 5), motions_of(rng, 20, 5))
    assert enough.note == "" and enough.low < enough.value < enough.high
    few = frechet_result(motions_of(rng, 3, 9), motions_of(rng, 30, 9), resamples=20)
    assert "40" in few.note and "10" in few.note
    assert few.note in str(few) and np.isnan(few.low)
    plain = frechet_result(motions_of(rng, 3, 9), motions_of(rng, 30, 9), resamples=0)
    assert np.isnan(plain.low) and plain.note != few.note and "nan" not in str(plain)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: frechet_distance([[1.0, 2.0]], np.ones((3, 2))), "(?=.*generated).*1 sample"),
        (lambda: frechet_distance(np.ones((3, 2)), np.ones((3, 3))), r"\b2 .*\b3\b"),
        (lambda: frechet_distance(np.full((3, 2), np.nan), np.ones((3, 2))), "(?=.*NaN).*sample 0"),
        (lambda: frechet_result([], [np.ones((3, 2))]), "empty"),
        (lambda: frechet_result([np.ones((3, 2))], [np.ones((3, 1))]), r"\b2 .*\b1\b"),
    ],
)
def test_bad_input_gets_one_clear_error(call, message):
    with pytest.raises(EvaluationError, match=message):
        call()


def kinetic_by_definition(places: np.ndarray, dt: float, slip: bool = False) -> np.ndarray:
    """Three energies of one joint at places (T, 3), written as fairmotion's loops.

    With its slip, the earlier velocity of an acceleration is p(t) - p(t - 1) / dt.
    """
    n = len(places)
    horizontal, vertical, expenditure = [], [], []
    for i in range(1, n):
        steps = [
            places[i + j] - places[i + j - 1] for j in range(-2, 3) if i + j - 1 >= 0 and i + j < n
        ]
        velocity = np.sum(steps, axis=0) / (len(steps) * dt)
        horizontal.append(velocity[0] ** 2 + velocity[2] ** 2)
        vertical.append(velocity[1] ** 2)
        turns = [
            (places[i + j + 1] - places[i + j]) / dt**2
            - (places[i + j] / (dt if slip else dt**2) - places[i + j - 1] / dt**2)
            for j in range(-2, 3)
            if i + j - 1 >= 0 and i + j + 1 < n
        ]
        expenditure.append(np.linalg.norm(np.mean(turns, axis=0)))
    return np.array([np.mean(horizontal), np.mean(vertical), np.mean(expenditure)])


@pytest.mark.parametrize("n_frames", [4, 5, 23])
def test_kinetic_features_equal_their_definition(gesture, skeleton, n_frames):
    motion = gesture(1.0)[:n_frames]
    joints = body_joints(skeleton)
    features = kinetic_features(motion).reshape(len(joints), 3)
    positions = motion.positions()
    for name, found in zip(joints, features):
        expected = kinetic_by_definition(positions[:, skeleton.index(name)], 1 / 30)
        assert found == pytest.approx(expected, rel=1e-9, abs=1e-12)
    # Bailando's code: frames of 1/60 s at any rate, positions from where the root begins.
    released = kinetic_features(motion, variant="released").reshape(len(joints), 3)
    for name, found in zip(joints, released):
        places = positions[:, skeleton.index(name)] - positions[0, skeleton.index("Hips")]
        assert found == pytest.approx(kinetic_by_definition(places, 1 / 60, slip=True), rel=1e-9)
    with pytest.raises(EvaluationError, match="'bailando'.*released"):
        kinetic_features(motion, variant="bailando")


@pytest.fixture(scope="module")
def wild(skeleton) -> Motion:
    """Limbs, and the whole body, turn and fly in all directions for ten seconds."""
    rng, n = np.random.default_rng(0), 300
    turns = gaussian_filter1d(rng.standard_normal((n, skeleton.n_joints, 3)), 6.0, axis=0)
    turns *= np.where(np.array(skeleton.names) == "Hips", 3.0, 4.0)[:, None]
    path = 2.0 * gaussian_filter1d(rng.standard_normal((n, 3)), 6.0, axis=0) + [0.0, 1.0, 0.0]
    rotations = Rotation.from_rotvec(turns.reshape(-1, 3)).as_quat().reshape(n, -1, 4)
    return Motion(skeleton, rotations, path, 30.0)


def geometric_by_definition(motion: Motion) -> list[float]:
    """The list of fairmotion's manual features, on this rig, written out frame by frame."""
    index, places = motion.skeleton.index, motion.positions()
    ends = motion.end_positions()
    joint = {
        "root": "Hips", "belly": "Spine", "chest": "Chest", "neck": "Neck",
        **{f"{s[0].lower()}{part}": f"{s}{name}" for s in ("Left", "Right") for part, name in (
            ("shoulder", "Arm"), ("elbow", "ForeArm"), ("wrist", "Hand"), ("hip", "UpLeg"),
            ("knee", "Leg"), ("ankle", "Foot"))},
    }  # fmt: skip

    def at(name: str, t: int) -> np.ndarray:
        if name == "zero":
            return np.zeros(3)
        if name in ("up", "down"):
            return np.array([0.0, 1.0 if name == "up" else -1.0, 0.0])
        if name in ("ltoes", "rtoes"):
            return ends["LeftFoot" if name[0] == "l" else "RightFoot"][t, 0]
        if name == "lowest":
            toes = [at(f"{side}toes", t)[1] for side in "lr"]
            return np.array([0.0, min(*places[t, :, 1], *toes), 0.0])
        return places[t, index(joint[name])]

    def unit(vector: np.ndarray) -> np.ndarray:
        return vector / np.linalg.norm(vector)

    def step(a: str, t: int) -> np.ndarray:
        return (at(a, t) - at(a, t - 1)) * 30

    def fast(t, a, theta):
        return np.linalg.norm(step(a, t)) > theta

    def move(t, a, b, c, theta):  # c moves, seen from a, in the direction from a to b
        return (step(c, t) - step(a, t)) @ unit(at(b, t) - at(a, t)) > theta

    def normal(t, a, b, c):
        return unit(np.cross(at(c, t) - at(a, t), at(b, t) - at(a, t)))

    def nmove(t, a, b, c, d, theta):
        return (step(d, t) - step(a, t)) @ normal(t, a, b, c) > theta

    def plane(t, a, b, c, d, theta):
        return (at(d, t) - at(a, t)) @ normal(t, a, b, c) > theta

    def nplane(t, a, b, c, d, theta):
        return (at(d, t) - at(c, t)) @ unit(at(b, t) - at(a, t)) > theta

    def angle(t, a, b, c, d, low, high):
        cosine = unit(at(b, t) - at(a, t)) @ unit(at(d, t) - at(c, t))
        return low < np.degrees(np.arccos(np.clip(cosine, -1, 1))) < high

    arm, hips = 0.28, 0.2  # metres on this rig, on which the shoulders move
    across = places[1:, index("LeftArm")] - places[1:, index("RightArm")]
    shoulders = np.median(np.linalg.norm(across, axis=-1))
    relations = [
        (nmove, "neck", "rhip", "lhip", "rwrist", 1.8 * arm),
        (nmove, "neck", "lhip", "rhip", "lwrist", 1.8 * arm),
        (nplane, "chest", "neck", "neck", "rwrist", 0.2 * arm),
        (nplane, "chest", "neck", "neck", "lwrist", 0.2 * arm),
        # As released, it takes the chest, which cannot move along its own bone, for the wrist.
        (move, "belly", "chest", "chest", 1.8 * arm),
        (move, "belly", "chest", "chest", 1.8 * arm),
        (angle, "relbow", "rshoulder", "relbow", "rwrist", 0, 110),
        (angle, "lelbow", "lshoulder", "lelbow", "lwrist", 0, 110),
        (nplane, "lshoulder", "rshoulder", "lwrist", "rwrist", 2.5 * shoulders),
        (move, "lwrist", "rwrist", "rwrist", 1.4 * arm),
        (move, "rwrist", "root", "lwrist", 1.4 * arm),
        (move, "lwrist", "root", "rwrist", 1.4 * arm),
        (fast, "rwrist", 2.5 * arm),
        (fast, "lwrist", 2.5 * arm),
        (plane, "root", "lhip", "ltoes", "rankle", 0.38 * arm),
        (plane, "root", "rhip", "rtoes", "lankle", 0.38 * arm),
        (nplane, "zero", "up", "lowest", "rankle", 1.2 * arm),
        (nplane, "zero", "up", "lowest", "lankle", 1.2 * arm),
        (nplane, "lhip", "rhip", "lankle", "rankle", 2.1 * hips),
        (angle, "rknee", "rhip", "rknee", "rankle", 0, 110),
        (angle, "lknee", "lhip", "lknee", "lankle", 0, 110),
        (fast, "rankle", 2.5 * arm),
        (fast, "lankle", 2.5 * arm),
        (angle, "neck", "root", "rshoulder", "relbow", 25, 180),
        (angle, "neck", "root", "lshoulder", "lelbow", 25, 180),
        (angle, "neck", "root", "rhip", "rknee", 50, 180),
        (angle, "neck", "root", "lhip", "lknee", 50, 180),
        (plane, "rankle", "neck", "lankle", "root", 0.5 * arm),
        (angle, "neck", "root", "zero", "up", 70, 110),
        (nplane, "zero", "down", "lowest", "rwrist", -1.2 * arm),
        (nplane, "zero", "down", "lowest", "lwrist", -1.2 * arm),
        (fast, "root", 2.3 * arm),
    ]
    frames = range(1, motion.n_frames)
    return [np.mean([one(t, *rest) for t in frames]) for one, *rest in relations]


def test_geometric_features_equal_their_definition(wild):
    found, expected = geometric_features(wild), geometric_by_definition(wild)
    assert found == pytest.approx(expected, abs=1e-9)
    assert ((found > 0.01) & (found < 0.991)).sum() >= 28, "nearly all hold now and then"
    # The rig without hands: the wrist is the end of the forearm.
    bare = without_joints(wild, "Hand")
    tips = {
        f"{s}ForeArm": (np.array([x, 0.0, 0.0]),) for s, x in (("Left", 0.25), ("Right", -0.25))
    }
    ends = {k: v for k, v in wild.skeleton.end_sites.items() if "Hand" not in k}
    bare = replace(bare, skeleton=replace(bare.skeleton, end_sites={**ends, **tips}))
    # Without the hands another joint may be the lowest.
    found, kept = geometric_features(bare), np.setdiff1d(np.arange(32), [16, 17, 29, 30])
    assert found[kept] == pytest.approx(np.array(expected)[kept], abs=1e-9)


@pytest.mark.parametrize(
    ("fid", "div", "features", "joints"),
    [
        (fid, clip_diversity, kinetic_features, {"joints": ["LeftHand"]}),
        (
            partial(fid, kinetic="released"),
            partial(clip_diversity, kinetic="released"),
            partial(kinetic_features, variant="released"),
            {"joints": ["LeftHand"]},
        ),
        (
            partial(fid, kind="geometric"),
            partial(clip_diversity, kind="geometric"),
            geometric_features,
            {},
        ),
    ],
)
def test_features_are_in_units_of_the_references_spread(wild, gesture, fid, div, features, joints):
    ours, theirs = [wild[:150]], [wild[150:], gesture(2.0, seed=1)]
    a = np.array([features(wild[k : k + 60], **joints) for k in (0, 60)])
    b = [features(clip, **joints) for clip in (wild[150:210], wild[210:270], theirs[1])]
    spread = np.std(b, axis=0)
    spread[spread < 1e-9] = 1.0  # constant ones
    found = fid(ours, theirs, seconds=2.0, **joints)
    assert found.value == pytest.approx(frechet_distance(a / spread, b / spread))
    expected = np.linalg.norm((a[0] - a[1]) / spread)
    assert div(ours, theirs, seconds=2.0, **joints) == pytest.approx(expected)
    own = np.std(a, axis=0)
    own[own < 1e-9] = 1.0
    expected = np.linalg.norm((a[0] - a[1]) / own)
    assert div(ours, seconds=2.0, **joints) == pytest.approx(expected)


def test_the_standard_error_is_that_of_resampled_motions():
    """Against a bootstrap of its own, of 1000 rounds; motions have 1 to 3 samples."""
    rng = np.random.default_rng(6)
    sets = [[shift + rng.normal(size=(1 + k % 3, 2)) for k in range(12)] for shift in (0.0, 3.0)]
    values = [
        frechet_distance(
            *(np.concatenate([one[k] for k in rng.integers(0, 12, 12)]) for one in sets)
        )
        for _ in range(1000)
    ]
    found = frechet_result(*sets, resamples=1000)
    error = 1.96 * np.std(values)
    assert found.high - found.value == pytest.approx(error, rel=0.1)
    assert found.value - found.low == pytest.approx(found.high - found.value)
    assert np.isfinite(frechet_result(*sets, resamples=2).low)
    assert np.isnan(frechet_result(*sets, resamples=1).low), "one resample has no spread"
    near = frechet_result(sets[0], [x + 0.01 for x in sets[0]])
    assert near.low == 0 < near.high
    # Ten motions are enough, nine of either set are not.
    assert np.isfinite(frechet_result(sets[0][:10], sets[1][:10], resamples=3).low)
    for few in ([sets[0][:9], sets[1]], [sets[0], sets[1][:9]]):
        found = frechet_result(*few, resamples=3)
        assert np.isnan(found.low) and "10" in found.note


def renamed(motion: Motion) -> Motion:
    names = tuple(name.replace("LeftArm", "Left_Arm") for name in motion.skeleton.names)
    return replace(motion, skeleton=replace(motion.skeleton, names=names))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda m: fid([m], [m]), r"\b10 s\b"),
        (lambda m: raw_fgd([m[:59]], [m]), r"\b2 s\b"),
        (lambda m: fid([renamed(m)], [m], seconds=4.0), "LeftArm"),
        (lambda m: clip_diversity([m], seconds=8.0), r"\b8 s\b"),
    ],
)
def test_motions_that_cannot_be_compared(gesture, call, message):
    with pytest.raises(EvaluationError, match=message):
        call(gesture(8.0))
    with pytest.raises(MotionError, match=r"\b1 frame"):
        kinetic_features(gesture(8.0)[:1])


def test_geometric_features_need_legs_and_wrists(gesture):
    motion = gesture(1.0)
    with pytest.raises(EvaluationError, match="legs"):
        geometric_features(without_joints(motion, "Leg", "Foot", "Toe"))
    with pytest.raises(MotionError, match="left wrist"):
        geometric_features(without_joints(motion, "Hand"))
