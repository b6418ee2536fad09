"""Faces: what their channels may be, and what carries them."""

from dataclasses import replace

import numpy as np
import pytest

import gesturekit as gk
from gesturekit.errors import MotionError
from gesturekit.motion.face import ARKIT, is_smplx, smplx_face


def test_the_names_of_arkit():
    assert len(set(ARKIT)) == 52
    for name in ("jawOpen", "eyeBlinkLeft", "mouthRollLower", "noseSneerRight", "tongueOut"):
        assert name in ARKIT


@pytest.mark.parametrize(
    "names, values, says",
    [
        (("jawOpen", "jawOpen"), np.zeros((4, 2)), "differ"),
        (("jawOpen", ""), np.zeros((4, 2)), "empty"),
        (("jawOpen",), np.zeros((4, 2)), r"\(4, 2\)"),
        (("jawOpen",), np.full((4, 1), np.nan), "nan"),
        (tuple(map(str, range(1001))), np.zeros((1, 1001)), "1001.*1000"),
    ],
)
def test_invalid_faces_are_refused(names, values, says):
    with pytest.raises(MotionError, match=says):
        gk.FaceTrack(names, values)
    with pytest.raises(MotionError, match="guess"):
        gk.FaceTrack(("jawOpen",), np.zeros((4, 1)), origin="guess")


def test_values_of_arkit_are_limited_and_others_are_not():
    face = gk.FaceTrack(("jawOpen", "smile"), [[1.2, 1.2], [-0.1, -0.1]])
    assert face.values.tolist() == [[1, 1.2], [0, -0.1]]
    assert face.channel("smile").tolist() == [1.2, -0.1]
    with pytest.raises(MotionError, match=r"'grin'.*jawOpen, smile"):
        face.channel("grin")


def test_a_mirrored_motion_winks_with_the_other_eye(moving_person):
    values = np.random.default_rng(0).random((60, 4))
    names = ("eyeBlinkLeft", "jawOpen", "eyeBlinkRight", "mouthLeft")
    winking = replace(moving_person, face=gk.FaceTrack(names, values, "rules"))
    mirrored = winking.mirror().face
    np.testing.assert_array_equal(mirrored.values, values[:, [2, 1, 0, 3]])
    assert mirrored.names == names and mirrored.origin == "rules"
    smiling = replace(moving_person, face=smplx_face(values))
    np.testing.assert_array_equal(smiling.mirror().face.values, values)


def test_a_face_is_cut_and_resampled_with_its_motion(moving_person):
    ramp = gk.FaceTrack(("jawOpen",), np.linspace(0, 0.59, 60)[:, None])
    motion = replace(moving_person, face=ramp)
    np.testing.assert_allclose(motion[10:20].face.channel("jawOpen"), np.arange(10, 20) / 100)
    faster = motion.resample(60.0).face.channel("jawOpen")
    np.testing.assert_allclose(faster[:3], [0, 0.005, 0.01])
    assert len(faster) == 120


@pytest.mark.parametrize("origin", ["recorded", "rules"])
def test_npz_keeps_any_face(moving_person, tmp_path, origin):
    values = np.random.default_rng(0).random((60, 2))
    for face in (gk.FaceTrack(("jawOpen", "aa"), values, origin), smplx_face(values)):
        replace(moving_person, face=face).save(tmp_path / "a.npz")
        again = gk.Motion.load(tmp_path / "a.npz").face
        np.testing.assert_array_equal(again.values, values)
        assert (again.names, again.origin) == (face.names, face.origin)
        assert is_smplx(again) is is_smplx(face)


def test_joined_motions_keep_faces_of_the_same_channels(moving_person):
    def faced(name: str, origin: str = "recorded") -> gk.Motion:
        return replace(moving_person, face=gk.FaceTrack((name,), np.ones((60, 1)), origin))

    joined = gk.concatenate([faced("jawOpen"), faced("jawOpen", "rules")]).face
    assert len(joined) == 120 and joined.origin == "rules"
    assert gk.concatenate([faced("jawOpen"), faced("aa")]).face is None
    assert gk.concatenate([faced("jawOpen"), moving_person]).face is None
