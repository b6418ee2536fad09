"""Motions of other rigs, put on a model's own."""

from dataclasses import replace

import numpy as np
import pytest
from rigs import prefixed

from gesturekit.diffusion import DeltaRepresentation
from gesturekit.errors import ModelError
from gesturekit.training.clips import on_rig, pose_on_rig


def test_a_pose_of_another_rig_keeps_its_place_and_names_its_floor(gesture):
    """Half as tall, on a floor at 1 m, 3 m to the side; hands are not driven by the model."""
    own = gesture(8.0, seed=3)
    place = own.translation + np.linspace(0, 1, 240)[:, None] * [3.0, 0.0, -1.0]
    half = replace(own, translation=place).scaled(0.5)
    other = prefixed(replace(half, translation=half.translation + [3.0, 1.0, 0.0]))
    joints = [name for name in own.skeleton.names if "Hand" not in name]
    model = DeltaRepresentation.fit([own], joints)
    pose = pose_on_rig(model, lambda default: (other, 120), 0)
    assert pose.n_frames == 1 and pose.skeleton.names == own.skeleton.names
    np.testing.assert_allclose(
        pose.positions()[0, 0, [0, 2]], other.positions()[120, 0, [0, 2]], atol=1e-6
    )
    whole = on_rig(model, other)
    lowest = whole.positions()[..., 1].min(axis=1)
    assert pose.info["floor"] == pytest.approx(np.median(lowest), abs=0.05)
    driven = list(model.indices)
    np.testing.assert_allclose(pose.rotations[0, driven], whole.rotations[120, driven], atol=1e-9)
    hand = own.skeleton.index("LeftHand")
    np.testing.assert_array_equal(pose.rotations[0, hand], model.fixed_rotations[hand])
    assert np.abs(whole.rotations[120, hand] - pose.rotations[0, hand]).max() > 1e-3


def test_a_motion_that_cannot_be_retargeted_is_refused(gesture):
    model = DeltaRepresentation.fit([gesture(1.0)])
    stick = gesture(1.0).keep(["Hips", "Spine"])
    with pytest.raises(ModelError, match="retargeted"):
        on_rig(model, stick)
