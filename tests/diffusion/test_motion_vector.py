"""Motion vectors of the diffusion model: what goes in comes out, on rigs of every kind."""

import json
from dataclasses import replace

import numpy as np
import pytest

import gesturekit as gk
from gesturekit.diffusion import DeltaRepresentation
from gesturekit.diffusion.motion_vector import continuous_maps
from gesturekit.motion import Motion
from gesturekit.motion.root_path import RootPath
from gesturekit.motion.rotations import (
    multiply_quaternions,
    quaternion_from_rotation_vector,
    rotate_vectors,
    rotation_angles,
    rotation_vector_from_quaternion,
)
from gesturekit.multires.motion_vector import MultiresRepresentation

REAL = (
    "paired/zeggs_067_Speech_2/067_Speech_2_x_1_0.bvh",
    "motion/aitviewer/sample.bvh",
    "motion/bandai/dataset-1_bye_happy_001.bvh",
    "motion/bandai/dataset-2_wave-left-hand_normal_001.bvh",
    "motion/reactidle/003_genuine.bvh",
    "smpl/glamr_running_smpl.npz",
)


def errors(representation: DeltaRepresentation, motion: Motion) -> tuple[float, float]:
    """Largest error of a modelled joint's rotation (rad) and of the root's place (m), put back
    where the motion began."""
    path = representation.path_of(motion)
    values = representation.encode(motion)
    start = (*path.positions[0], path.headings[0])
    made = representation.decode(values, motion.fps, start=start)
    index = representation.indices
    turned = [m.global_rotations()[:, index[0]] for m in (made, motion)]
    rotations = rotation_angles(made.rotations[:, index[1:]], motion.rotations[:, index[1:]])
    places = np.abs((made.positions() - motion.positions())[:, index[0]])
    worst = max(rotations.max(initial=0.0), rotation_angles(*turned).max())
    return float(worst), float(places.max())


@pytest.mark.parametrize(
    ("file", "fps"), [*((file, None) for file in REAL), (REAL[2], 12.5), (REAL[2], 60.0)]
)
def test_a_round_trip_of_real_rigs_is_exact(shared_data, file, fps):
    motion = gk.Motion.load(shared_data / file)
    motion = motion.resample(fps) if fps else motion[:600]
    representation = DeltaRepresentation.fit([motion])
    rotation, place = errors(representation, motion)
    assert rotation < 1e-6
    assert place < 1e-6, f"over {motion.n_frames} frames"
    assert representation.joints[0] != "joint_Root"


@pytest.mark.parametrize("axis", [(0.6, 0.0, 0.8), (0.48, 0.6, 0.64)])
def test_an_exponential_map_is_continuous_where_its_angle_passes_pi(axis):
    angles = np.concatenate([np.linspace(0, 9, 90), np.linspace(9, -5, 140)])
    wobble = 0.05 * np.sin(np.arange(230))[:, None] * [0.0, 1.0, 0.0]
    vectors = (np.outer(angles, axis) + wobble)[:, None]
    rotations = quaternion_from_rotation_vector(vectors)
    wrapped = rotation_vector_from_quaternion(rotations)
    assert np.abs(np.diff(wrapped, axis=0)).max() > 2, "the principal maps jump"
    made = continuous_maps(wrapped)
    assert np.linalg.norm(np.diff(made, axis=0), axis=-1).max() < 0.3
    assert rotation_angles(quaternion_from_rotation_vector(made), rotations).max() < 1e-6


def test_vectors_do_not_depend_on_position_and_heading(gesture):
    motion = gesture(2.0)
    motion.translation[:, 2] += motion.times
    turn = quaternion_from_rotation_vector(np.array([0.0, 2.0, 0.0]))
    rotations = motion.rotations.copy()
    rotations[:, 0] = multiply_quaternions(turn, rotations[:, 0])
    places = rotate_vectors(turn, motion.translation) + [3.0, 0.0, -7.0]
    elsewhere = replace(motion, rotations=rotations, translation=places)
    representation = DeltaRepresentation.fit([motion])
    assert representation.encode(elsewhere) == pytest.approx(representation.encode(motion))


def test_the_root_goes_forward_and_turns_left(gesture):
    motion = gesture(2.0)
    angle = 0.5 * motion.times
    motion.rotations[:, 0] = quaternion_from_rotation_vector(np.outer(angle, [0.0, 1.0, 0.0]))
    motion.translation[:, 0] = 2 * (1 - np.cos(angle))
    motion.translation[:, 2] = 2 * np.sin(angle)
    representation = DeltaRepresentation.fit([motion])
    values = representation.encode(motion)
    turn, forward, lateral = values[:, representation.root_columns].T
    assert turn == pytest.approx(0.5 / 30)
    assert forward * representation.scale == pytest.approx(1.0 / 30, rel=1e-4)
    assert np.abs(lateral).max() < 1e-6
    height = values[:, representation.height_column] * representation.scale
    assert height == pytest.approx(0.9)
    # Decoded, it begins at the origin and faces +Z, or where and as it is asked to.
    for start, more in (((0.0, 0.0, 0.0), {}), ((3.0, -1.0, 0.4), {"start": (3.0, -1.0, 0.4)})):
        path = representation.path_of(representation.decode(values, 30.0, **more))
        assert (*path.positions[0], path.headings[0]) == pytest.approx(start, abs=1e-9)
        assert path.headings[-1] - start[2] == pytest.approx(0.5 * 59 / 30)


@pytest.mark.parametrize("kind", [DeltaRepresentation, MultiresRepresentation])
def test_joints_that_are_not_modelled_are_written_at_their_mean(shared_data, kind):
    motion = gk.Motion.load(shared_data / REAL[0])[300:400]
    representation = kind.fit([motion])
    assert not any("Thumb" in name for name in representation.joints)
    made = representation.decode(representation.encode(motion), motion.fps)
    assert made.skeleton.names == motion.skeleton.names
    thumb = motion.skeleton.index("LeftHandThumb2")
    assert np.ptp(made.rotations[:, thumb], axis=0).max() == 0.0
    assert np.abs(made.rotations[0, thumb] - [0, 0, 0, 1]).max() > 0.01, "the mean, not the rest"


@pytest.mark.parametrize("file", [None, *REAL[2:]])
def test_on_a_path_the_root_is_where_the_path_is(shared_data, gesture, file):
    if file is None:
        motion = gesture(4.0)
        motion.translation[:, 0] += 0.1 * np.sin(5 * motion.times)
    else:
        motion = gk.Motion.load(shared_data / file)
    representation = DeltaRepresentation.fit([motion], root=False)
    values = representation.encode(motion)
    assert values.shape[1] == representation.n_features
    path = representation.path_of(motion).smoothed()
    made = representation.decode(values, motion.fps, path=path)
    root = representation.root
    assert np.abs(made.positions()[:, root][:, [0, 2]] - path.positions).max() < 1e-6
    assert made.positions()[:, root, 1] == pytest.approx(motion.positions()[:, root, 1])
    # The swing of the hips about the smooth path is kept: rotations are the recording's.
    turned = [m.global_rotations()[:, representation.indices] for m in (made, motion)]
    assert rotation_angles(*turned)[:, 0].max() < 1e-6
    elsewhere = RootPath(path.positions[::-1] + 5.0, path.headings + 1.0, path.fps)
    moved = representation.decode(values, motion.fps, path=elsewhere)
    assert np.abs(moved.positions()[:, root][:, [0, 2]] - elsewhere.positions).max() < 1e-6


def test_a_representation_survives_json(gesture):
    motion = gesture(2.0)
    for root in (True, False):
        representation = DeltaRepresentation.fit([motion], root=root)
        values = json.loads(json.dumps(representation.to_json()))
        again = DeltaRepresentation.from_json(motion.skeleton, values)
        assert (again.encode(motion) == representation.encode(motion)).all()
        assert again.makes_root is root
