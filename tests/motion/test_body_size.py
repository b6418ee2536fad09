from dataclasses import replace

import numpy as np
import pytest

from gesturekit.errors import MotionError
from gesturekit.motion import Skeleton
from gesturekit.motion.parts.body_size import REFERENCE_SIZE, body_height, body_scale, body_size


def tree(parents, lengths):
    """A rig with bones of these lengths along x, the root's own offset included."""
    offsets = np.array([[length, 0.0, 0.0] for length in lengths])
    return Skeleton(tuple(f"j{i}" for i in range(len(parents))), tuple(parents), offsets)


def test_other_trees_are_measured_by_their_longest_chain_below_the_first_fork():
    # A mast of 9 m up to the fork; below it branches of 1 + 2 m, 4 m and 0.5 m.
    rig = tree([-1, 0, 1, 2, 1, 1], [5.0, 9.0, 1.0, 2.0, 4.0, 0.5])
    chain = tree([-1, 0, 1, 2], [5.0, 1.0, 1.0, 1.0])
    assert body_size(rig) / body_size(chain) == pytest.approx((1 + 2 + 4) / 3)
    assert body_size(tree([-1], [0.0])) == REFERENCE_SIZE


@pytest.mark.parametrize("factor", [0.1, 0.5, 2.0, 10.0])
def test_scale_grows_with_the_rig_and_is_one_at_the_reference_size(factor, skeleton):
    assert body_scale(skeleton.scaled(factor)) == pytest.approx(factor * body_scale(skeleton))
    assert body_scale(skeleton.scaled(REFERENCE_SIZE / body_size(skeleton))) == pytest.approx(1.0)


def test_height_is_sole_to_crown_of_a_body_and_the_extent_at_rest_of_anything_else(skeleton):
    assert 1.5 < body_height(skeleton) < 1.9
    assert body_height(skeleton.scaled(3)) == pytest.approx(3 * body_height(skeleton))
    assert body_height(tree([-1, 0, 1, 2], [5.0, 1.0, 1.0, 1.0])) == pytest.approx(3)
    with pytest.raises(MotionError, match="height"):
        body_height(tree([-1], [0.0]))


def test_a_motion_is_scaled_to_a_height_with_all_that_moves(gesture):
    motion = gesture(0.5)
    chest = np.tile([0.0, 0.2, 0.0], (motion.n_frames, 1))
    motion = replace(motion, joint_translations={"Chest": chest})
    doll = motion.with_height(0.34)
    assert body_height(doll.skeleton) == pytest.approx(0.34)
    np.testing.assert_allclose(doll.positions(), motion.positions() * doll.info["scale"])
    for name, ends in motion.end_positions().items():
        np.testing.assert_allclose(doll.end_positions()[name], ends * doll.info["scale"])
    for wrong in (0.0, -1.0, float("nan")):
        with pytest.raises(MotionError, match=f"height .*{wrong}"):
            motion.with_height(wrong)
