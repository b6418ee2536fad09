import numpy as np
import pytest

from audio_features import FeatureTrack
from gesturekit.errors import EvaluationError, FormatError, MotionError
from gesturekit.evaluation import (
    SpeedHistogram,
    cca,
    hellinger,
    l1_diversity,
    pose_rmse,
    read_semantic,
    root_relative,
    srgr,
    vertex_lvd,
    vertex_mse,
)
from gesturekit.evaluation.metrics.similarity import pose_pair
from gesturekit.motion import Motion, Skeleton


def test_hellinger_by_hand():
    # Bins of 1 cm/s. Shares (3/4, 1/4) and (1/4, 3/4): Σ sqrt(h1 h2) = 2 sqrt(3/16) = 0.866025,
    # sqrt(1 - 0.866025) = 0.366025.
    one = SpeedHistogram.of([np.array([0.005, 0.005, 0.005]), np.array([0.015])])
    other = SpeedHistogram.of([np.array([0.005, 0.015, 0.015, 0.015])])
    assert hellinger(one, other) == pytest.approx(0.366025, abs=1e-6)
    assert hellinger(one, one) == 0.0
    apart = SpeedHistogram.of([np.array([0.305, 0.9])])
    assert hellinger(one, apart) == 1.0
    assert apart.beyond == 1  # 90 cm/s lies beyond the last bin


def test_a_histogram_without_counted_speeds_cannot_be_compared():
    one = SpeedHistogram.of([np.array([0.005])])
    with pytest.raises(MotionError, match=r"0\.49 m/s"):
        hellinger(one, SpeedHistogram.of([np.array([2.0])]))


def test_cca_by_hand():
    # With one column a side the canonical pair is those columns, and r is Pearson's:
    # x - 2.5 = (-1.5, -.5, .5, 1.5), y - 2.5 = (-1.5, .5, -.5, 1.5): 4 / 5 = 0.8.
    x, y = np.array([[1.0], [2], [3], [4]]), np.array([[1.0], [3], [2], [4]])
    assert cca(x, y) == pytest.approx(0.8)
    # A column that stands still, and the sign and unit of one that moves, are no matter.
    assert cca(np.hstack([x, np.full((4, 1), 7.0)]), -100.0 * y) == pytest.approx(0.8)
    assert cca(1e-7 * x, 1e7 * y) == pytest.approx(0.8)


def test_cca_finds_what_two_sequences_share():
    rng = np.random.default_rng(0)
    shared = rng.normal(size=(400, 1))
    ours = rng.normal(size=(400, 5)) + shared * [3.0, 0, 0, -2.0, 0]
    theirs = rng.normal(size=(400, 4)) + shared * [0, 2.0, 0, 0]
    # The exact first canonical correlation: largest singular value of the whitened bases' product.
    bases = [np.linalg.qr(side - side.mean(axis=0))[0] for side in (ours, theirs)]
    exact = np.linalg.svd(bases[0].T @ bases[1], compute_uv=False)[0]
    assert cca(ours, theirs) == pytest.approx(exact, abs=1e-4)
    assert cca(ours, rng.normal(size=(400, 4))) < 0.3


def test_cca_refuses_other_lengths_and_motion_that_does_not_move():
    moving = np.random.default_rng(0).normal(size=(9, 2))
    with pytest.raises(EvaluationError, match=r"\b9\b.*\b8\b"):
        cca(moving, moving[:8])
    with pytest.raises(EvaluationError, match="generated"):
        cca(np.ones((9, 2)), moving)
    with pytest.raises(EvaluationError, match=r"3 frames.*\b2\b"):
        cca(moving[:2], moving[:2])


def test_rmse_of_a_pose_by_hand():
    """One of two joints is 5 cm too high in one of two frames: sqrt(0.05² / 4) = 0.025 m."""
    offsets = [[0, 0, 0], [0, 0.5, 0], [0.3, 0, 0.4]]
    rig = Skeleton(("hips", "head", "hand"), (-1, 0, 0), offsets)
    still = np.tile([0.0, 0, 0, 1], (2, 3, 1))
    recording = Motion(rig, still, np.zeros((2, 3)), 30.0)
    high = {"head": [(0, 0.55, 0), (0, 0.5, 0)]}
    # Somewhere else, facing another way, and longer by a frame.
    turn = np.array([0.0, np.sin(0.4), 0, np.cos(0.4)])
    turned = np.concatenate([still, still[:1]])
    turned[:, 0] = turn
    high["head"].append((9.0, 9.0, 9.0))
    made = Motion(rig, turned, np.ones((3, 3)), 30.0, high)
    assert pose_rmse(made, recording, rig.names) == pytest.approx(0.025)
    # A turn in the second half alone is an error: the hand, 0.5 m from the axis, is off by
    # 2 · 0.5 · sin(0.2) = 0.19867 m in both halves of the least one.
    late = np.concatenate([still, still])
    late[2:, 0] = turn
    halves = [Motion(rig, rotations, np.zeros((4, 3)), 30.0) for rotations in (late, [*still] * 2)]
    assert pose_rmse(*halves, rig.names) == pytest.approx(0.19867 / 2**0.5, abs=1e-5)
    # A joint on the floor that never moves, from which the hips go away, is no part of the pose.
    floor = Skeleton(("floor", "hips", "head"), (-1, 0, 1), [[0, 0, 0], [0, 1, 0], [0, 0.5, 0]])
    walks = {"hips": [(0, 1, 0), (2, 1, 0)]}
    pair = [Motion(floor, still, np.zeros((2, 3)), 30.0, moved) for moved in ({}, walks)]
    assert pose_rmse(*pair, floor.names) == pytest.approx(0.0)


def test_poses_are_relative_to_the_pelvis_where_the_first_joint_lies_on_the_floor(gesture):
    motion = gesture(2.0, 15.0)
    rig, n = motion.skeleton, motion.n_frames
    floor = Skeleton(
        ("floor", *rig.names), (-1, *(p + 1 for p in rig.parents)), np.r_[[[0, 0, 0]], rig.offsets]
    )
    still = np.tile([0.0, 0.0, 0.0, 1.0], (n, 1, 1))
    walk = motion.translation + np.arange(n)[:, None] * [0.05, 0.0, 0.0]
    moved = Motion(floor, np.concatenate([still, motion.rotations], axis=1), np.zeros((n, 3)), 15.0,
                   joint_translations={rig.names[0]: walk})  # fmt: skip
    ours, theirs = pose_pair(moved, moved, floor.names)
    assert ours == pytest.approx(root_relative(motion, rig.names).reshape(n, -1))


def test_srgr_by_hand():
    # Two frames of two joints, semantic 0.5 and 1. Distances: 0.05, 0.2 | 0, 0.099: hits 1, 0 | 1,
    # 1. Mean of (0.5, 0, 1, 1) = 0.625, over 0.165.
    reference = np.zeros((2, 2, 3))
    generated = reference.copy()
    generated[0, 0, 0], generated[0, 1, 1] = 0.05, 0.2
    generated[1, 1] = (0.07, 0.07, 0.0)
    semantic = np.array([0.5, 1.0])
    assert srgr(generated, reference, semantic) == pytest.approx(0.625 / 0.165)
    # By the L1 distance of 2022 the last one, 0.14, is a miss: mean of (0.5, 0, 1, 0).
    assert srgr(generated, reference, semantic, variant="beat") == pytest.approx(0.375 / 0.165)
    with pytest.raises(EvaluationError, match=r"(?=.*\(1, 2, 3\)).*\(2, 2, 3\)"):
        srgr(generated[:1], reference, semantic)
    with pytest.raises(EvaluationError, match="'pck'.*emage"):
        srgr(generated, reference, semantic, variant="pck")


def test_l1_diversity_by_hand(turning):
    # Half a turn about z between two frames: the hand, 0.25 m from the elbow, goes from +0.25 to
    # -0.25 along x and the fore arm's other end stays: Σ|x - mean| / 2 = (0.25 + 0.25) / 2.
    motion = turning({"LeftForeArm": np.array([np.pi, 0.0])}, 1.0)
    joints = ("Hips", "LeftForeArm", "LeftHand")
    assert l1_diversity(motion, joints) == pytest.approx(0.25)
    assert l1_diversity(turning({"LeftArm": np.zeros(5)})) == 0.0


def test_semantic_tracks_are_read_from_beats_tables(tmp_path):
    table = tmp_path / "a.txt"
    table.write_text("01_beat_align\t0.5\t1.0\t0.5\t0.1\t\n04_deictic\t1.5\t2.0\t0.5\t0.9\tthere\n")
    values = read_semantic(table).to_rate(10.0, 25).values[:, 0]
    assert values[[0, 5, 7, 12, 15, 17, 24]] == pytest.approx([0, 0.1, 0.1, 0, 0.9, 0.9, 0])
    table.write_text("01_beat_align\t0.5\t1.0\n")
    with pytest.raises(FormatError, match=r"a\.txt.*line 1\b"):
        read_semantic(table)
    table.write_text("")
    with pytest.raises(FormatError, match=r"a\.txt"):
        read_semantic(table)


def test_vertices_are_compared_as_beat2s_papers_do():
    rng = np.random.default_rng(0)
    generated, reference = rng.normal(size=(2, 4, 3, 3))
    assert vertex_mse(generated, reference) == pytest.approx(((generated - reference) ** 2).mean())
    # Two frames of one vertex: x goes from 1 to 4, y stays, z from 0 to -1; that of the recording
    # goes on by 1 in x. |3 - 1| + 0 + |-1| over 2 frames of 3 coordinates.
    made, recorded = np.array([[[1.0, 2, 0]], [[4, 2, -1]]]), np.array([[[0.0, 0, 0]], [[1, 0, 0]]])
    assert vertex_lvd(made, recorded) == pytest.approx(3 / 6)
    # (1 + 4 + 0 + 9 + 4 + 1) / 6
    assert vertex_mse(made, recorded) == pytest.approx(19 / 6)
    for compare in (vertex_mse, vertex_lvd):
        with pytest.raises(EvaluationError, match=r"(?=.*2, 1, 3).*4, 3, 3"):
            compare(made, generated)
        with pytest.raises(EvaluationError, match="0, 1, 3"):
            compare(made[:0], recorded[:0])


def test_a_semantic_track_in_a_feature_file_has_one_column(tmp_path):
    times = np.array([0.0, 0.5])
    for columns in (1, 2):
        names = tuple("ab"[:columns])
        track = FeatureTrack(np.ones((2, columns), np.float32), times, {"kind": "x"}, names)
        track.save(tmp_path / f"{columns}.npz")
    assert read_semantic(tmp_path / "1.npz").values.tolist() == [[1.0], [1.0]]
    with pytest.raises(FormatError, match=r"2\.npz: 2 columns"):
        read_semantic(tmp_path / "2.npz")
