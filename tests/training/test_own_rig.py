"""Motions of other rigs, put on a model's own."""

from __future__ import annotations

import numpy as np

from gesturekit import Motion
from gesturekit.diffusion.motion_vector import DeltaRepresentation
from gesturekit.motion.retarget import retarget
from gesturekit.training.data.own_rig import on_rig


def test_its_own_rig_is_left_alone(gesture):
    motion = gesture(1.0)
    assert on_rig(DeltaRepresentation.fit([gesture(1.0, seed=1)]), motion) is motion


def test_a_rig_without_a_plausible_rest_pose_is_turned_as_its_recordings_are(shared_data):
    """Bandai-Namco's: where bones lie is told without a pose, how they turn is not."""
    folder = shared_data / "motion"
    model = DeltaRepresentation.fit([Motion.load(folder / "bandai/dataset-1_bye_normal_001.bvh")])
    idle = Motion.load(folder / "reactidle/003_genuine.bvh")[:48]
    moved = on_rig(model, idle)
    assert (moved.n_frames, moved.skeleton.names) == (48, model.skeleton.names)

    def turned(motion: Motion) -> float:
        """Radians that joints are away from the recordings' means."""
        maps = model.encode(motion)[:, : model.height_column].reshape(48, -1, 3)
        return float(np.linalg.norm(maps, axis=-1).mean())

    assert turned(moved) < 0.7 * turned(retarget(idle, model.skeleton))
