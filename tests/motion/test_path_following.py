"""Recordings on smooth paths: the root is there, and feet do not slide for it."""

from dataclasses import replace

import numpy as np
import pytest

import gesturekit as gk
from gesturekit.diffusion import DeltaRepresentation
from gesturekit.evaluation import foot_skate
from gesturekit.motion.contacts import foot_positions
from gesturekit.motion.root_path import follow_path


@pytest.mark.parametrize("name", ["bow_active_001", "bye_feminine_001"])
def test_feet_stay_where_they_stood(shared_data, name):
    motion = gk.Motion.load(shared_data / f"motion/bandai/dataset-1_{name}.bvh")
    representation = DeltaRepresentation.fit([motion], root=False)
    path = representation.path_of(motion).smoothed()
    made = follow_path(motion, path, representation.root)
    root = representation.root
    assert np.abs(made.positions()[:, root][:, [0, 2]] - path.positions).max() < 1e-9
    apart = np.linalg.norm(foot_positions(made) - foot_positions(motion), axis=-1)
    assert np.quantile(apart, 0.95) < 1e-3
    carried = representation.decode(representation.encode(motion, path), motion.fps, path=path)
    driven = representation.decode(representation.encode(made, path), motion.fps, path=path)
    assert foot_skate(driven) < 1.25 * foot_skate(motion)
    assert foot_skate(driven) < foot_skate(carried)


@pytest.mark.parametrize("aside", [0.0, 0.1])
def test_a_motion_comes_onto_its_path_and_stays_as_it_is_on_its_own(gesture, aside):
    motion = gesture(2.0)
    path = DeltaRepresentation.fit([motion]).path_of(motion)
    made = follow_path(motion, replace(path, positions=path.positions + [aside, 0.0]))
    np.testing.assert_allclose(made.translation, motion.translation + [aside, 0, 0], atol=1e-6)
