"""Motion vectors: what goes in comes out, on rigs of every kind."""

import numpy as np
import pytest

import gesturekit as gk
from gesturekit.errors import MotionError
from gesturekit.motion.root_path import heading
from gesturekit.multires import MultiresRepresentation


@pytest.fixture
def walk(gesture):
    """A second in which the body moves 0.5 m to its left."""
    motion = gesture(1.0)
    motion.translation[:, 0] += 0.5 * motion.times
    return motion


def body_error(representation, motion) -> float:
    """Largest distance (m) of a modelled joint after a round trip, the start moved back."""
    made = representation.decode(representation.encode(motion), motion.fps)
    joints = [motion.skeleton.index(name) for name in representation.joints]
    one, other = (m.positions()[:, joints] for m in (made, motion))
    start = other[0, 0] * [1, 0, 1]
    return float(np.linalg.norm(one + start - other, axis=-1).max())


def test_a_round_trip_keeps_every_modelled_joint(gesture):
    motion = gesture(3.0)
    motion.translation[:, 0] += 0.1 * np.sin(motion.times)
    representation = MultiresRepresentation.fit([motion])
    assert representation.encode(motion).shape == (90, representation.n_features)
    assert body_error(representation, motion) < 1e-6


@pytest.mark.parametrize(
    ("file", "root", "tolerance"),
    [
        ("paired/zeggs_067_Speech_2/067_Speech_2_x_1_0.bvh", "Hips", 1e-6),
        ("motion/aitviewer/sample.bvh", "Hips", 1e-6),
        # Hips moves under a joint_Root that stands still.
        ("motion/bandai/dataset-1_bye_happy_001.bvh", "Hips", 1e-6),
        # The thighs slide in their sockets by a centimetre; the model holds them at their mean.
        ("motion/reactidle/003_genuine.bvh", "pelvis", 0.02),
    ],
)
def test_real_rigs_survive_a_round_trip(shared_data, file, root, tolerance):
    motion = gk.Motion.load(shared_data / file)
    motion = motion[:200]
    representation = MultiresRepresentation.fit([motion])
    assert representation.joints[0] == root
    assert body_error(representation, motion) < tolerance


def test_another_rig_is_refused(gesture, skeleton):
    representation = MultiresRepresentation.fit([gesture(1.0)])
    names = tuple("Pelvis" if name == "Hips" else name for name in skeleton.names)
    other = gk.Skeleton(names, skeleton.parents, skeleton.offsets)
    motion = gk.Motion(other, gesture(1.0).rotations, gesture(1.0).translation, 30.0)
    with pytest.raises(MotionError, match="Pelvis"):
        representation.encode(motion)
    with pytest.raises(MotionError, match="LeftHand"):
        MultiresRepresentation.fit([gesture(1.0)], ["Hips", "LeftHnd"])


@pytest.mark.parametrize("angle", [-2.0, 0.3, 1.5])
def test_a_motion_is_turned_as_it_is_encoded(gesture, angle):
    motion = gesture(2.0)
    motion.translation[:, 2] += 0.3 * motion.times
    representation = MultiresRepresentation.fit([motion])
    plain = representation.decode(representation.encode(motion), motion.fps)
    turned = representation.decode(representation.encode(motion, turn=angle), motion.fps)
    assert heading(turned) - heading(plain) == pytest.approx(angle)
    walked = turned.translation[-1] - turned.translation[0]
    assert np.arctan2(walked[0], walked[2]) == pytest.approx(angle, abs=1e-6)


def test_the_contact_threshold_is_stored_with_the_model(gesture):
    motion = gesture(2.0)
    motion.rotations[:] = motion.rotations[:1]
    motion.translation[:, 0] += 0.4 * motion.times  # a stiff body that slides at 0.4 m/s
    usual = MultiresRepresentation.fit([motion])
    ganimator = MultiresRepresentation.fit([motion], contact_speed=0.54)
    kept = MultiresRepresentation.from_json(ganimator.skeleton, ganimator.to_json())
    for representation, stands in ((usual, 0.0), (ganimator, 1.0), (kept, 1.0)):
        labels = representation.encode(motion)[:, representation.layout.contacts]
        assert labels.mean() == pytest.approx(stands, abs=0.05)


def test_a_performer_of_twice_the_size_steps_twice_as_far(walk):
    representation = MultiresRepresentation.fit([walk])
    values = representation.encode(walk)
    own, large = (
        representation.decode(values, walk.fps, skeleton=skeleton).translation
        for skeleton in (None, walk.skeleton.scaled(2.0))
    )
    np.testing.assert_allclose(large, 2 * own, atol=1e-9)


def test_the_first_frame_has_the_displacement_of_the_second(walk):
    representation = MultiresRepresentation.fit([walk])
    two, one = (representation.encode(walk[k:5])[:, representation.layout.root_xz] for k in (3, 4))
    np.testing.assert_allclose(
        two, np.tile([0.5 / 30 / representation.scale, 0], (2, 1)), atol=1e-9
    )
    np.testing.assert_array_equal(one, [[0.0, 0.0]])
