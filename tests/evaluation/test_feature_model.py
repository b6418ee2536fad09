"""The feature extractor: what poses it sees, that it repeats itself, and what it refuses."""

from __future__ import annotations

import json
import logging
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import nn

from gesturekit.errors import EvaluationError, MotionError
from gesturekit.evaluation import FeatureModel, PoseWindows, fgd
from gesturekit.evaluation.metrics.frechet.feature_model import (
    PoseAutoencoder,
    reconstruction_loss,
)
from gesturekit.motion import Motion
from gesturekit.motion.rotations import (
    multiply_quaternions,
    quaternion_from_euler,
    rotate_vectors,
)


@pytest.fixture(scope="module")
def clips(gesture) -> list[Motion]:
    return [gesture(6.0, seed=number) for number in range(3)]


@pytest.fixture(scope="module")
def model(clips) -> FeatureModel:
    return FeatureModel.fit(clips, n_frames=30, steps=8, seed=1)


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
    assert beside.training["windows"] == alone.training["windows"] == 2 * 151


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
    more = FeatureModel.fit(clips, n_frames=30, joints="upper", steps=60)
    assert more.training["unexplained"] < 0.6 * little.training["unexplained"]
    assert 0 <= fgd(clips, clips[::-1], more).value < 1e-6


def test_steps_are_reported_and_small_sets_warned_about(clips, caplog):
    seen = []
    with caplog.at_level(logging.WARNING):
        FeatureModel.fit(clips, n_frames=30, steps=3, progress=lambda *told: seen.append(told))
    # Poses have the spread 1, and hardly change from frame to frame.
    assert [step for step, _ in seen] == [1, 2, 3] and all(0.5 < loss < 2 for _, loss in seen)
    assert "0.3 minutes of motion; below 10 its figures depend" in caplog.text


def test_ten_minutes_are_enough_and_what_was_fitted_is_kept(gesture, caplog):
    motions = [gesture(300.0, 30.0, seed=k) for k in range(2)]
    with caplog.at_level(logging.WARNING):
        model = FeatureModel.fit(motions, joints=["LeftHand"], steps=1, seed=4)
    assert not caplog.text
    cut = np.concatenate(model.windows.cut(motions))
    with torch.no_grad():
        made = model.network(torch.from_numpy(cut).float())[1].numpy()
    assert model.training == {
        "seed": 4, "steps": 1, "motions": 2, "seconds": 600.0, "windows": 2 * (9000 - 59),
        "unexplained": pytest.approx(np.abs(made - cut).sum() / np.abs(cut).sum(), abs=1e-4),
    }  # fmt: skip
    assert model.training["unexplained"] == round(model.training["unexplained"], 4)
    found = model.encode([motions[0]])[0]
    with torch.no_grad():
        one = model.network.encoder(torch.from_numpy(cut[:299]).float().transpose(1, 2))
    assert found == pytest.approx(one.numpy(), abs=1e-5) and found.dtype == np.float64


def test_the_loss_is_that_of_poses_and_of_their_steps():
    made = torch.tensor([[[1.0, 2.0], [3.0, 2.0], [3.0, 5.0]], [[0.0, 0.0]] * 3])
    windows = torch.tensor([[[0.0, 0.0], [0.0, 0.0], [0.0, 0.0]], [[4.0, 4.0]] * 3])
    # 16 / 6 and (2 + 3) / 4; 4 and 0.
    assert reconstruction_loss(made, windows).item() == pytest.approx(16 / 6 + 5 / 4 + 4)


@pytest.mark.parametrize(("n_frames", "variant"), [(12, "genea"), (34, "yoon"), (35, "genea")])
def test_the_network_is_the_published_one(n_frames, variant):
    network = PoseAutoencoder(27, n_frames, variant == "yoon").eval()
    features, made = network(torch.ones(2, n_frames, 27))
    assert features.shape == (2, 32) and made.shape == (2, n_frames, 27)
    layers = [*network.encoder, *network.decoder]
    slopes = [layer.negative_slope for layer in layers if isinstance(layer, nn.LeakyReLU)]
    assert slopes == [0.2] * 5
    widths = [(x.in_features, x.out_features) for x in layers if isinstance(x, nn.Linear)]
    last = [(32, 32)] if variant == "yoon" else []
    # The first convolutions lose two frames each, the third all but half less one, the last two.
    left = (n_frames - 4) // 2 - 1 - 2
    assert widths == [(32 * left, 256), (256, 128), (128, 32), *last, (32, 64), (64, 4 * n_frames)]
    convolutions = [x for x in layers if isinstance(x, nn.Conv1d | nn.ConvTranspose1d)]
    assert [(c.out_channels, c.kernel_size[0], c.stride[0]) for c in convolutions] == [
        (32, 3, 1), (64, 3, 1), (64, 4, 2), (32, 3, 1), (32, 3, 1), (32, 3, 1), (32, 3, 1),
        (27, 3, 1),
    ]  # fmt: skip


def test_the_first_step_is_adams_and_other_random_numbers_stay(clips):
    before = torch.random.get_rng_state()
    model = FeatureModel.fit(clips, n_frames=30, steps=1, seed=3)
    assert torch.equal(before, torch.random.get_rng_state())
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        start = PoseAutoencoder(model.windows.n_features, 30, mean_layer=False)
    moved = [
        (a - b).abs().detach().numpy().ravel()
        for a, b in zip(model.network.parameters(), start.parameters(), strict=True)
    ]
    # Adam moves each weight by its rate at first, whatever the gradient.
    assert np.median(np.concatenate(moved)) == pytest.approx(5e-4, rel=1e-3)


def test_windows_are_drawn_in_batches(clips, monkeypatch):
    sizes = []
    forward = PoseAutoencoder.forward
    monkeypatch.setattr(
        PoseAutoencoder, "forward", lambda self, x: sizes.append(len(x)) or forward(self, x)
    )
    firsts = []
    for motions, options in ((clips, {}), (clips, {"variant": "yoon"}),
                             ([clips[0][:32]], {"n_frames": 30})):  # fmt: skip
        sizes.clear()
        FeatureModel.fit(motions, steps=1, **options)
        firsts.append(sizes[0])
    assert firsts == [64, 128, 3], "as published, or all three windows"
    with pytest.raises(EvaluationError, match="1 windows of 1 s in 1 motions"):
        FeatureModel.fit([clips[0][:30]], n_frames=30, steps=1)
    assert FeatureModel.fit([clips[0][:31]], n_frames=30, steps=1).training["windows"] == 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"n_frames": 11}, "windows of 11 frames; 12 to 1000"),
        ({"n_frames": 1001}, "windows of 1001 frames; 12 to 1000"),
        ({"fps": 0.99}, "windows at 0.99 fps"),
        ({"fps": 1000.1}, "windows at 1000.1 fps"),
        ({"stride": 0}, "every 0 frames"),
        ({"stride": 1001}, "every 1001 frames"),
        ({"mean": np.zeros(2)}, "mean of poses: expected 3 finite numbers"),
        ({"mean": np.array([0, np.nan, 0])}, "mean of poses: expected 3 finite"),
        ({"scale": np.array([1, np.inf, 1])}, "scale of poses: expected 3 finite"),
        ({"scale": np.array([1.0, 0.0, 1.0])}, "scales above 0"),
        ({"bones": (), "mean": np.zeros(0), "scale": np.zeros(0)}, "poses need bones"),
        ({"variant": "x"}, "variant 'x'; expected genea or yoon"),
    ],
)
def test_settings_of_windows_have_bounds(change, message):
    values = {
        "variant": "genea", "bones": (("Hips", "LeftHand"),), "fps": 30.0, "n_frames": 60,
        "stride": 30, "mean": np.zeros(3), "scale": np.ones(3),
    }  # fmt: skip
    for right in (
        {"n_frames": 12}, {"n_frames": 1000}, {"fps": 1.0}, {"fps": 1000}, {"stride": 1},
        {"stride": 1000}, {"scale": np.full(3, 1e-9)},
    ):  # fmt: skip
        PoseWindows(**(values | right))
    with pytest.raises(EvaluationError, match=message):
        PoseWindows(**(values | change))


def test_windows_of_other_lengths_start_every_half_and_take_the_named_joints(clips, skeleton):
    windows = PoseWindows.fit(clips, n_frames=31, joints=["RightHand", "Hips", "Head"])
    assert windows.stride == 15 and windows.bones == (("Hips", "Head"), ("Hips", "RightHand"))
    assert [len(clip) for clip in windows.cut([clips[0], clips[1][:31], clips[2][:46]])] == [
        10, 1, 2
    ]  # fmt: skip
    upper = PoseWindows.fit(clips, joints="upper")
    below = {name for _, name in upper.bones}
    assert below == {n for n in skeleton.names if "Leg" not in n and "Foot" not in n} - {"Hips"}
    # Each turned joint varies; what does not is divided by a millimetre.
    still = [replace(clip, rotations=clip.rotations[:1].repeat(180, 0)) for clip in clips[:1]]
    assert PoseWindows.fit(still).scale == pytest.approx(1e-3, rel=0.05)


def test_bones_without_length_have_no_direction(clips, skeleton):
    offsets = skeleton.offsets.copy()
    for side in ("Left", "Right"):
        offsets[skeleton.index(f"{side}ForeArm")] = 0.0
    flat = replace(clips[0], skeleton=replace(skeleton, offsets=offsets))
    windows = PoseWindows.fit([flat], "yoon")
    assert "LeftForeArm" not in {name for _, name in windows.bones}
    assert ("LeftForeArm", "LeftHand") in windows.bones
    with pytest.raises(
        EvaluationError, match="'LeftArm' and 'LeftForeArm' are at the same position"
    ):
        PoseWindows.fit([clips[0]], "yoon").frames(flat)


def test_the_first_joints_that_a_motion_lacks_are_named(clips, skeleton):
    windows = PoseWindows.fit(clips)
    names = tuple(f"x{k}" if k > 12 else name for k, name in enumerate(skeleton.names))
    with pytest.raises(EvaluationError) as refused:
        windows.frames(replace(clips[0], skeleton=replace(skeleton, names=names, end_sites={})))
    lacks = sorted(skeleton.names[13:])
    assert f"has no joint {', '.join(lacks[:5])}, ..., which" in str(refused.value)
    names = tuple(f"x{k}" if k > 13 else name for k, name in enumerate(skeleton.names))
    with pytest.raises(EvaluationError) as refused:
        windows.frames(replace(clips[0], skeleton=replace(skeleton, names=names, end_sites={})))
    assert f"has no joint {', '.join(sorted(skeleton.names[14:]))}, which" in str(refused.value)


def test_a_file_too_large_for_a_feature_model_is_refused(model, tmp_path):
    model.save(tmp_path)
    path = tmp_path / "feature_model.json"
    text = path.read_text(encoding="utf-8")
    assert '\n "format": 1,\n' in text and text.endswith("}\n")
    path.write_text(text + " " * (1_000_000 - len(text)), encoding="utf-8")
    assert FeatureModel.load(tmp_path).fingerprint == model.fingerprint
    path.write_text(text + " " * (1_000_001 - len(text)), encoding="utf-8")
    with pytest.raises(EvaluationError, match="1000001 bytes; too large for a feature model"):
        FeatureModel.load(tmp_path)


@pytest.mark.parametrize("variant", ["genea", "yoon"])
def test_a_saved_model_gives_the_same_figures(clips, variant, tmp_path):
    model = FeatureModel.fit(clips, variant, n_frames=34, steps=3)
    model.save(tmp_path)
    names = ["feature_model.json", "feature_model.safetensors"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    again = FeatureModel.load(tmp_path)
    assert again.fingerprint == model.fingerprint and again.training == model.training
    assert np.array_equal(again.encode(clips)[0], model.encode(clips)[0])


def test_a_damaged_model_is_refused(model, tmp_path):
    with pytest.raises(EvaluationError, match=r"made by gesturekit fit-features"):
        FeatureModel.load(tmp_path)
    model.save(tmp_path)
    tensors_file = tmp_path / "feature_model.safetensors"
    json_file = tmp_path / "feature_model.json"
    tensors, text = load_file(tensors_file), json_file.read_text(encoding="utf-8")

    changed = dict(tensors)
    changed["windows.mean"] = tensors["windows.mean"] + 1e-9
    save_file(changed, tensors_file)
    with pytest.raises(EvaluationError, match="does not belong to feature_model.json"):
        FeatureModel.load(tmp_path)
    tensors_file.write_bytes(tensors_file.read_bytes()[:1000])
    with pytest.raises(EvaluationError, match="feature_model.safetensors: cannot be read"):
        FeatureModel.load(tmp_path)
    save_file(tensors, tensors_file)

    def with_windows(**values):
        record = json.loads(text)
        record["windows"] |= values
        return json.dumps(record)

    for damaged, message in (
        ("{", "cannot be read"),
        ("[]", "not a feature model"),
        (text.replace('"format": 1', '"format": 2'), "a newer gesturekit"),
        (with_windows(n_frames=10**12), "12 to 1000 can be"),
        (with_windows(n_frames=40), "damaged"),
        (with_windows(variant="x"), "'x'"),
        (with_windows(fps=0), "at 0"),
        (with_windows(bones=[]), "damaged|expected 0"),
        (with_windows(bones=3), "damaged"),
        (text.replace('"windows": {', '"other": {'), "damaged"),
    ):
        json_file.write_text(damaged, encoding="utf-8")
        with pytest.raises(EvaluationError, match=message):
            FeatureModel.load(tmp_path)
    json_file.write_text(text, encoding="utf-8")
    assert FeatureModel.load(tmp_path).fingerprint == model.fingerprint


def test_bad_input_gets_one_clear_error(clips, model, skeleton):
    names = tuple("Left_Arm" if name == "LeftArm" else name for name in skeleton.names)
    other = replace(clips[0], skeleton=replace(skeleton, names=names))
    with pytest.raises(EvaluationError, match="has no joint LeftArm, which the other motions"):
        fgd([other], clips, model)
    with pytest.raises(EvaluationError, match="none of 1 motions is as long as a window of 1 s"):
        fgd([clips[0][:1]], clips, model)
    for options, message in (
        ({"variant": "fgd"}, "'fgd'; expected genea or yoon"),
        ({"n_frames": 5}, "windows of 5 frames"),
        ({"n_frames": 500}, "0 windows"),
        ({"joints": "legs"}, "'legs'; expected body, upper"),
        ({"steps": 0}, "steps is 0"),
    ):
        with pytest.raises(EvaluationError, match=message):
            FeatureModel.fit(clips, **({"steps": 1} | options))
    with pytest.raises(MotionError, match="no joint 'LeftWing'"):
        FeatureModel.fit(clips, joints=["LeftWing"], steps=1)
    with pytest.raises(EvaluationError, match="there is no motion"):
        FeatureModel.fit([])
