"""Opening of the mouth beside the recorded one."""

from dataclasses import replace

import numpy as np
import pytest

from gesturekit.evaluation import evaluate, mouth_agreement, mouth_opening
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.face import FaceTrack

FPS = 25.0
TIMES = np.arange(100) / FPS


def test_agreement_by_hand():
    """Two sines of 1 Hz in 4 s, one of them late by 0.12 s: r = cos(0.24 π) = 0.7290.

    Shifts of 1.04 to 2.96 s are two periods of r without one value of 0.7290: mean -0.7290 / 49.
    """
    recorded, late = np.sin(2 * np.pi * TIMES), np.sin(2 * np.pi * (TIMES - 0.12))
    found = mouth_agreement(3 * late + 1, recorded, FPS)
    assert found["mouth"] == pytest.approx(0.7290, abs=1e-4)
    assert found["mouth_lag"] == pytest.approx(0.12)
    assert found["mouth_chance"] == pytest.approx(-0.7290 / 49, abs=1e-5)
    # The mean square of a cosine is 1/2: the standard deviation of the 49 is near 0.71.
    assert found["mouth_z"] == pytest.approx((0.7290 + 0.0149) / 0.707, abs=0.02)
    assert mouth_agreement(recorded, late, FPS)["mouth_lag"] == pytest.approx(-0.12)


def test_three_seconds_are_enough_and_lags_end_at_three_tenths_of_a_second():
    """Nine frames of noise at 30 fps are 0.3 s; an opening of 1e-3 is movement."""
    noise = np.random.default_rng(0).random(99)
    for frames, lag in ((-9, -0.3), (0, 0.0), (9, 0.3)):
        late = 1e-3 * np.roll(noise, frames)
        assert mouth_agreement(late, noise, 30.0)["mouth_lag"] == pytest.approx(lag)
    assert abs(mouth_agreement(np.roll(noise, 10), noise, 30.0)["mouth_lag"]) <= 0.3
    assert mouth_agreement(noise[:90], noise, 30.0)["mouth"] == pytest.approx(1.0)


@pytest.mark.parametrize("frames", [slice(0, 74), slice(0, 100, 100)])
def test_what_is_short_or_still_has_no_agreement(frames):
    mouth = np.sin(TIMES)
    with pytest.raises(ValueError, match="at least 3 s"):
        mouth_agreement(mouth[frames], mouth, FPS)
    with pytest.raises(ValueError, match="does not move"):
        mouth_agreement(np.zeros(100), mouth, FPS)


@pytest.fixture
def speaker(skeleton) -> Motion:
    """A body that faces +X, so that its left is -Z, and whose jaw opens by up to 0.2 rad."""
    names, parents = (*skeleton.names, "rig:Jaw"), (*skeleton.parents, skeleton.index("Head"))
    x, y, z = np.array([*skeleton.offsets, [0.0, 0.05, 0.05]]).T
    rig = Skeleton(names, parents, np.stack([z, y, -x], axis=1))
    # In its rest pose the jaw's frame is turned by half a turn about its own axis.
    angle = np.pi + 0.2 * np.sin(2 * np.pi * TIMES)
    rotations = np.tile([0.0, 0.0, 0.0, 1.0], (len(TIMES), rig.n_joints, 1))
    rotations[:, -1, 2:] = np.stack([-np.sin(angle / 2), np.cos(angle / 2)], axis=1)
    return Motion(rig, rotations, np.zeros((len(TIMES), 3)), FPS)


def test_a_jaw_opens_downwards_and_a_face_comes_first(speaker):
    np.testing.assert_allclose(mouth_opening(speaker), 0.2 * np.sin(2 * np.pi * TIMES), atol=1e-6)
    for values, expected in ((TIMES / 4, TIMES / 4), (np.zeros(100), None)):
        face = FaceTrack(("jawLeft", "jawOpen"), np.stack([values, values], axis=1))
        np.testing.assert_array_equal(mouth_opening(replace(speaker, face=face)), expected)
    other = replace(speaker, face=FaceTrack(("expression0",), TIMES[:, None]))
    assert np.ptp(mouth_opening(other)) > 0.1
    assert (
        mouth_opening(speaker.keep([n for n in speaker.skeleton.names if "Jaw" not in n])) is None
    )


def test_evaluate_compares_mouths_where_both_have_one(speaker, gesture, tmp_path):
    """The recording has a jaw, one model a face at another rate, and another model neither."""
    body = gesture(4.0, 50.0)
    late = np.sin(2 * np.pi * (np.arange(200) / 50 - 0.12))[:, None]
    face = FaceTrack(("jawOpen",), 0.5 + 0.4 * late, "rules")
    made = {"recordings": speaker, "rules": replace(body, face=face), "none": body}
    for folder, motion in made.items():
        for name in ("a.npz", "b.npz"):
            motion.save(tmp_path / folder / name)
    models = {name: tmp_path / name for name in ("rules", "none")}
    rules, none = evaluate(models, tmp_path / "recordings").models
    assert rules.metrics["mouth"].interval.value == pytest.approx(0.729, abs=0.02)
    assert rules.metrics["mouth_lag"].interval.value == pytest.approx(0.12, abs=0.021)
    assert rules.metrics["mouth"].chance == pytest.approx(0.0, abs=0.03)
    assert rules.metrics["mouth"].recording is None
    assert not {"mouth", "mouth_lag", "mouth_z"} & {*none.metrics}
