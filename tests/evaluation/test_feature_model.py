"""The feature extractor: what poses it sees, that it repeats itself, and what it refuses."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from rigs import numbered
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import nn

from gesturekit.errors import EvaluationError, MotionError
from gesturekit.evaluation import FeatureModel, PoseWindows, evaluate, fgd, raw_fgd
from gesturekit.evaluation.metrics.frechet.feature_model import (
    PoseAutoencoder,
    reconstruction_loss,
)
from gesturekit.motion import Motion
from gesturekit.motion.rotations import multiply_quaternions, quaternion_from_euler, rotate_vectors


@pytest.fixture(scope="module")
def clips(gesture) -> list[Motion]:
    return [gesture(6.0, seed=number) for number in range(3)]


@pytest.fixture(scope="module")
def model(clips) -> FeatureModel:
    return FeatureModel.fit(clips, n_frames=30, steps=8, seed=1)


def test_the_reconstruction_counts_values_and_their_steps():
    """Errors 1, 1, 4 (mean 2), steps 2 and 3 against 2 and 0 (mean 1.5); twice for two windows."""
    windows = torch.tensor([1.0, 3.0, 3.0]).reshape(1, 3, 1).repeat(2, 1, 1)
    made = torch.tensor([2.0, 4.0, 7.0]).reshape(1, 3, 1).repeat(2, 1, 1)
    assert reconstruction_loss(made, windows).item() == pytest.approx(2 * (2.0 + 1.5))


def test_a_report_compares_raw_windows_with_those_of_the_extractor(gesture, clips, tmp_path):
    model = FeatureModel.fit(clips, n_frames=20, steps=1)
    for k, motion in enumerate(clips):
        motion.save(tmp_path / "recorded" / f"c{k}.npz")
        gesture(6.0, seed=10 + k).save(tmp_path / "made" / f"c{k}.npz")
    made, recorded = (
        [Motion.load(path) for path in sorted((tmp_path / name).iterdir())]
        for name in ("made", "recorded")
    )
    (found,) = evaluate(
        tmp_path / "made", tmp_path / "recorded", features=model, protocol="lda"
    ).models
    expected = raw_fgd(made, recorded, model.windows).value
    assert found.metrics["raw_fgd"].interval.value == pytest.approx(expected)
    assert found.metrics["fgd"].interval.value == pytest.approx(fgd(made, recorded, model).value)


@pytest.mark.parametrize("variant", ["genea", "yoon"])
def test_poses_do_not_depend_on_position_and_heading(clips, variant):
    windows = PoseWindows.fit(clips, variant)
    motion = clips[0]
    yaw = np.linspace(0.0, 200.0, motion.n_frames)  # turns while it talks
    turn = quaternion_from_euler(np.stack([0 * yaw, yaw, 0 * yaw], axis=-1), "XYZ")
    rotations = motion.rotations.copy()
    rotations[:, 0] = multiply_quaternions(turn, rotations[:, 0])
    walk = np.outer(motion.times, [1.0, 0.0, 0.5])
    moved = replace(motion, rotations=rotations, translation=motion.translation + walk)
    fps = windows.fps
    assert windows.frames(moved.resample(30.0)) == pytest.approx(
        windows.frames(motion), abs=1e-6 if fps == 30 else 1e-2
    )


def test_genea_poses_are_positions_in_units_of_their_spread(clips, skeleton):
    windows = PoseWindows.fit(clips)
    frames = np.concatenate([windows.frames(motion) for motion in clips])
    assert frames.mean(axis=0) == pytest.approx(np.zeros(windows.n_features), abs=1e-9)
    wrist = [bone for _, bone in windows.bones].index("LeftHand")
    assert frames[:, 3 * wrist : 3 * wrist + 3].std(axis=0) == pytest.approx(np.ones(3))
    # In metres, a body that faces +z: the left hand is where forward kinematics puts it.
    motion = clips[0]
    positions = motion.positions()[5]
    left, right = (positions[skeleton.index(f"{side}UpLeg")] for side in ("Left", "Right"))
    yaw = np.degrees(np.arctan2((left - right)[2], (left - right)[0]))
    seen = rotate_vectors(
        quaternion_from_euler(np.array([0.0, yaw, 0.0]), "XYZ"),
        positions[skeleton.index("LeftHand")] - positions[0],
    )
    found = (windows.frames(motion) * windows.scale + windows.mean)[5, 3 * wrist : 3 * wrist + 3]
    assert found == pytest.approx(seen, abs=1e-9)


def test_yoon_poses_are_directions_of_the_upper_body(clips):
    windows = PoseWindows.fit(clips, "yoon")
    assert {bone for _, bone in windows.bones}.isdisjoint({"LeftLeg", "RightFoot", "LeftUpLeg"})
    assert ("LeftArm", "LeftForeArm") in windows.bones
    vectors = windows.frames(clips[0]) + windows.mean
    lengths = np.linalg.norm(vectors.reshape(len(vectors), -1, 3), axis=-1)
    assert lengths == pytest.approx(np.ones_like(lengths))
    assert (windows.fps, windows.n_frames, windows.stride) == (15.0, 34, 10)


def test_a_motion_whose_hips_are_not_identified_faces_nowhere(clips):
    """Its joints are numbered, and all at one place, as in a BVH whose joints move."""
    rig = numbered(clips[0].skeleton)
    rig = replace(rig, offsets=np.zeros_like(rig.offsets))
    bones, windows = ((rig.names[0], rig.names[1]),), PoseWindows.fit(clips)
    windows = replace(windows, bones=bones, mean=np.zeros(3), scale=np.ones(3))
    with pytest.raises(EvaluationError, match="no hips or shoulders"):
        windows.frames(replace(clips[0], skeleton=rig))


def test_windows_start_every_half_window(clips):
    windows = PoseWindows.fit(clips)
    frames = windows.frames(clips[0])
    (cut,) = windows.cut([clips[0], clips[1][:59]])  # one is too short
    assert cut.shape == (5, 60, windows.n_features)  # 180 frames: 0, 30, ..., 120
    assert np.array_equal(cut[4], frames[120:180])


def test_no_window_reaches_from_one_motion_into_the_next(clips):
    short = clips[1][:20]
    alone = FeatureModel.fit([clips[0], clips[2]], n_frames=30, steps=1)
    beside = FeatureModel.fit([clips[0], short, clips[2]], n_frames=30, steps=1)
    assert beside.training["windows"] == alone.training["windows"] == 2 * (180 - 30 + 1)


def test_a_seed_gives_the_same_numbers(clips, model):
    again = FeatureModel.fit(clips, n_frames=30, steps=8, seed=1)
    assert again.fingerprint == model.fingerprint
    for one, other in zip(model.encode(clips), again.encode(clips)):
        assert np.array_equal(one, other)
    assert FeatureModel.fit(clips, n_frames=30, steps=8, seed=2).fingerprint != model.fingerprint
    # A motion's features do not depend on what else is encoded.
    assert np.array_equal(model.encode(clips[1:2])[0], model.encode(clips)[1])
    assert model.encode(clips)[0].shape == (11, 32)


def test_it_learns(clips):
    little = FeatureModel.fit(clips, n_frames=30, joints="upper", steps=1)
    more = FeatureModel.fit(clips, n_frames=30, joints="upper", steps=40)
    assert more.training["unexplained"] < 0.7 * little.training["unexplained"]
    assert 0 <= fgd(clips, clips[::-1], more).value < 1e-6


@pytest.mark.parametrize(
    ("n_frames", "variant", "size"),
    [(12, "genea", 92_747), (34, "yoon", 189_635), (35, "genea", 188_839)],
)
def test_the_network_is_as_large_as_the_published_one(n_frames, variant, size):
    network = PoseAutoencoder(27, n_frames, variant == "yoon").eval()
    features, made = network(torch.ones(2, n_frames, 27))
    assert features.shape == (2, 32) and made.shape == (2, n_frames, 27)
    # Weights and biases of the published layers, with their batch normalisations, by hand.
    assert sum(parameter.numel() for parameter in network.parameters()) == size
    slopes = {x.negative_slope for x in network.modules() if isinstance(x, nn.LeakyReLU)}
    assert slopes == {0.2}


@pytest.mark.parametrize("variant", ["genea", "yoon"])
def test_a_saved_model_gives_the_same_figures(clips, variant, tmp_path):
    model = FeatureModel.fit(clips, variant, n_frames=34, steps=3)
    model.save(tmp_path)
    again = FeatureModel.load(tmp_path)
    assert again.fingerprint == model.fingerprint and again.training == model.training
    assert np.array_equal(again.encode(clips)[0], model.encode(clips)[0])


def test_a_damaged_model_is_refused(model, tmp_path):
    with pytest.raises(EvaluationError, match="gesturekit fit-features"):
        FeatureModel.load(tmp_path)
    model.save(tmp_path)
    path = tmp_path / "feature_model.safetensors"
    content, tensors = path.read_bytes(), load_file(path)
    with safe_open(path, "pt") as file:
        text = file.metadata()["feature_model"]

    def with_windows(**values) -> str:
        record = json.loads(text)
        record["windows"] |= values
        return json.dumps(record)

    for settings, message in (
        ("{", "damaged"),
        ("[1]", "damaged"),
        ("[" * 100_000, "damaged"),
        (text.replace('"format": 1', '"format": 2'), "format 2"),
        (with_windows(n_frames=10**12), r"\b12\b"),
        (with_windows(n_frames=40), "damaged"),
        (with_windows(variant="x"), "'x'"),
        (with_windows(bones=[]), "damaged"),
        (text.replace('"windows": {', '"other": {'), "windows"),
    ):
        save_file(tensors, path, {"feature_model": settings})
        with pytest.raises(EvaluationError, match=message) as refused:
            FeatureModel.load(tmp_path)
        assert str(path) in str(refused.value)
    save_file(tensors | {"windows.mean": tensors["windows.mean"] + 1e-9}, path,
              {"feature_model": text})  # fmt: skip
    with pytest.raises(EvaluationError, match="changed since"):
        FeatureModel.load(tmp_path)
    path.write_bytes(content[:1000])
    with pytest.raises(EvaluationError, match="feature_model.safetensors"):
        FeatureModel.load(tmp_path)
    path.write_bytes(content)
    assert FeatureModel.load(tmp_path).fingerprint == model.fingerprint


def test_bad_input_gets_one_clear_error(clips, model, skeleton):
    names = tuple("Left_Arm" if name == "LeftArm" else name for name in skeleton.names)
    other = replace(clips[0], skeleton=replace(skeleton, names=names))
    with pytest.raises(EvaluationError, match="LeftArm"):
        fgd([other], clips, model)
    with pytest.raises(EvaluationError, match=r"\b1 s\b"):
        fgd([clips[0][:1]], clips, model)
    for options, message in (
        ({"variant": "fgd"}, "'fgd'.*genea"),
        ({"n_frames": 5}, "5 frames"),
        ({"n_frames": 500}, "0 windows"),
        ({"joints": "legs"}, "'legs'.*upper"),
        ({"steps": 0}, "steps.* 0"),
    ):
        with pytest.raises(EvaluationError, match=message):
            FeatureModel.fit(clips, **({"steps": 1} | options))
    with pytest.raises(MotionError, match="'LeftWing'"):
        FeatureModel.fit(clips, joints=["LeftWing"], steps=1)
    with pytest.raises(EvaluationError, match="motion"):
        FeatureModel.fit([])
