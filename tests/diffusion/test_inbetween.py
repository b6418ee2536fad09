"""Given frames of a motion stay exactly, and the motion around them continues from them."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from rigs import at_rest, turned_at_root

from gesturekit import Motion
from gesturekit.diffusion import NoiseConfig
from gesturekit.diffusion.sampler import InbetweenConstraint, settled
from gesturekit.errors import ModelError
from gesturekit.motion.root_path import RootPath
from gesturekit.motion.rotations import quaternion_from_rotation_vector, rotation_angles
from gesturekit.training.clips import InbetweenClips
from gesturekit.training.seeds import rng_for

FAST = {"solver": "ddim", "steps": 8}


@pytest.fixture(scope="module")
def model(untrained):
    return untrained()


@pytest.fixture(scope="module")
def clips(gesture) -> dict[float, Motion]:
    """Two clips, of which the second is elsewhere and faces elsewhere."""
    first, last = gesture(1.0, seed=1), gesture(1.5, seed=2)
    last = turned_at_root(last, quaternion_from_rotation_vector(np.array([0.0, 0.8, 0.0])))
    return {0.5: first, 4.0: replace(last, translation=last.translation + [0.3, 0.0, 0.4])}


def jerk(motion: Motion) -> np.ndarray:
    """Change of acceleration from frame to frame, mean over joints, m/s³."""
    return np.linalg.norm(np.diff(motion.positions(), 3, axis=0), axis=-1).mean(axis=1) * 30**3


@pytest.mark.parametrize("foot_lock", [True, False])
def test_given_frames_stay_exactly_where_and_as_they_are(model, clips, foot_lock):
    made = model.generate(keep=clips, seconds=6.0, seed=1, foot_lock=foot_lock, **FAST)
    assert made.n_frames == 180
    for second, clip in clips.items():
        kept = made[round(30 * second) : round(30 * second) + clip.n_frames]
        np.testing.assert_allclose(kept.rotations, clip.rotations, rtol=0, atol=1e-12)
        np.testing.assert_allclose(kept.translation, clip.translation, rtol=0, atol=1e-12)
    # The rest is another motion for each seed.
    other = model.generate(keep=clips, seconds=6.0, seed=2, foot_lock=foot_lock, **FAST)
    assert rotation_angles(made.rotations[80], other.rotations[80]).max() > 0.05


def test_a_model_that_stands_still_is_eased_out_of_a_clip_and_into_the_next(model, clips):
    """Its clean motion is the mean: without blending it would leap there within a frame."""
    torch.nn.init.zeros_((network := copy.deepcopy(model.network)).leave.weight)
    still = replace(model, network=network, noise_config=NoiseConfig(predict="clean"))
    made = still.generate(keep=clips, seconds=6.0, seed=1, foot_lock=False, **FAST)
    joins = [k for frame in (15, 45, 120, 165) for k in range(frame - 3, frame)]
    assert jerk(made)[joins].max() < 150, "m/s³; leaps have 1400 and more"
    # In the middle of the gap it stands, and the root is on its way: 0.5 m and 0.8 radians.
    middle = made.rotations[[65, 75, 85, 100]][:, 1:]
    assert rotation_angles(middle[1:], middle[:1]).max() < 1e-3
    path = RootPath.of(made)
    steps = np.linalg.norm(np.diff(path.positions, axis=0), axis=1)
    assert steps[45:119].max() < 3 * 0.5 / 75 and np.abs(np.diff(path.headings)).max() < 0.05


def walking(model, n_frames, place, angle, speed):
    """A body at rest that goes straight ahead by so many metres a frame."""
    motion = at_rest(model.representation.skeleton, n_frames, (place[0], 1.0, place[1]))
    ahead = np.array([np.sin(angle), 0.0, np.cos(angle)])
    motion = turned_at_root(motion, quaternion_from_rotation_vector(np.array([0.0, angle, 0.0])))
    ways = speed * np.arange(n_frames)[:, None] * ahead
    return replace(motion, translation=motion.translation + ways)


def blended_path(model, clips, free):
    given = InbetweenClips(clips, model.representation, 30.0)
    blended = InbetweenConstraint(model, given, free.n_frames).blended(free)
    return blended, model.representation.path_of(blended)


def test_between_two_places_the_body_takes_the_short_turn(model):
    """Nothing moves but the root, in a gap of 3 frames: shares 5/32, 1/2 and 27/32."""
    clips = {0.2: walking(model, 5, (1.0, 0.0), 3.0, 0.0)}  # frames 6 to 10, and from 14 on
    clips[14 / 30] = walking(model, 4, (1.4, 0.8), 3.2 - 2 * np.pi, 0.0)
    blended, path = blended_path(model, clips, walking(model, 20, (7.0, 7.0), -1.0, 0.0))
    share = np.array([0.0] * 11 + [5 / 32, 0.5, 27 / 32] + [1.0] * 6)
    np.testing.assert_allclose(path.headings % (2 * np.pi), 3 + 0.2 * share, atol=1e-9)
    np.testing.assert_allclose(path.positions[:, 0], 1 + 0.4 * share, atol=1e-9)
    np.testing.assert_allclose(path.positions[:, 1], 0.8 * share, atol=1e-9)


def test_a_walk_before_and_after_clips_leads_to_them_and_on(model):
    """Everything goes at 2 cm a frame; outside of the clips, the free walk is turned and moved."""
    clips = {0.5: walking(model, 5, (3.0, -1.0), np.pi / 2, 0.02)}  # frames 15 to 19
    clips[1.5] = walking(model, 5, (3.5, -1.6), np.pi, 0.02)  # frames 45 to 49
    blended, path = blended_path(model, clips, walking(model, 60, (0.0, 0.0), 0.3, 0.02))
    ahead = 0.02 * np.arange(-15, 5)
    before = np.stack([3 + ahead, np.full(20, -1.0)], axis=1)
    np.testing.assert_allclose(path.positions[:20], before, atol=1e-9)
    after = np.stack([np.full(15, 3.5), -1.6 - 0.02 * np.arange(15)], axis=1)
    np.testing.assert_allclose(path.positions[45:], after, atol=1e-9)
    np.testing.assert_allclose(path.headings[[0, 19, 45, 59]], np.pi / 2 * np.array([1, 1, 2, 2]))
    assert (np.diff(path.headings[19:46]) > 0).all(), "through the quarter turn"
    steps = np.diff(path.positions[19:46], axis=0)
    assert np.linalg.norm(steps, axis=1).max() < 0.05
    np.testing.assert_allclose(blended.positions()[:, 0, 1], 1.0, atol=1e-9)


def test_beside_kept_frames_third_differences_are_small():
    """A parabola has none: it stays. A leap and noise are smoothed near the kept frames alone."""
    frames = np.arange(60.0)
    parabola, kept = (frames**2 / 100)[:, None], (frames < 10) | (frames >= 50)
    np.testing.assert_allclose(settled(parabola, kept, 12, 20.0), parabola, atol=1e-9)
    noisy = parabola + np.where(kept, 0.0, 2 + np.sin(9 * frames))[:, None]
    made = settled(noisy, kept, 12, 20.0)
    np.testing.assert_array_equal(made[kept], parabola[kept])
    np.testing.assert_allclose(made[25:35], noisy[25:35], atol=1e-9)
    size = np.abs(np.diff(np.stack([made, noisy]), 3, axis=1))
    for beside in (slice(7, 12), slice(45, 50)):
        assert size[0, beside].max() < 0.1 * size[1, beside].max()


def test_the_network_sees_the_clips_at_every_step(model, clips):
    """The predicted clean motion in their frames is theirs; elsewhere it is the network's."""
    given = InbetweenClips(clips, model.representation, 30.0)
    constraint = InbetweenConstraint(model, given, 180)
    noisy = torch.randn((2, 180, model.network.n_motion), generator=rng_for("noisy"))
    for step in (40, 5, 0):
        noise = constraint.held(lambda x, _: 0.5 * x, model.schedule)(noisy, step)
        signal, spread = model.schedule.scales(step, noisy)
        clean = model.normaliser.inverse((noisy - spread * noise) / signal)
        vectors = model.representation.encode(clips[4.0])
        np.testing.assert_allclose(clean[1, 121:165], vectors[1:], rtol=1e-3, atol=1e-3)
        np.testing.assert_array_equal(noise[:, 45:120], 0.5 * noisy[:, 45:120])


def test_without_seconds_the_motion_ends_with_the_last_clip(model, clips):
    assert model.generate(keep=clips, seed=1, **FAST).n_frames == 165


def test_clips_that_do_not_fit_are_errors(model, untrained, clips):
    with pytest.raises(ModelError, match="5.5 s.*after"):
        model.generate(keep=clips, seconds=5.0, **FAST)
    with pytest.raises(ModelError, match="like.*keep"):
        model.generate(keep=clips, like=clips[0.5], **FAST)
    with pytest.raises(ModelError, match="keep: .*follows a path"):
        untrained(path=True).generate(keep=clips, **FAST)
