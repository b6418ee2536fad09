"""Published feature extractors read from their weight files, against independent networks."""

import json
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from scipy.spatial.transform import Rotation
from torch import nn

from gesturekit.errors import EvaluationError
from gesturekit.evaluation import FeatureModel, fgd, load_extractor
from gesturekit.formats.smpl import smpl_skeleton
from gesturekit.motion import Motion

# Joints before and after the pool of each layer, and channels of a joint before and after.
LAYERS = ((55, 55, 6, 6), (55, 20, 6, 6), (20, 10, 6, 12), (10, 5, 12, 12))


def masked(
    rng: torch.Generator, joints: int, width: int, wide: int, kernel: int
) -> tuple[nn.Conv1d, torch.Tensor]:
    """Return a convolution, and a mask by which a joint takes itself and the next one alone."""
    layer = nn.Conv1d(joints * width, joints * wide, kernel, stride=2, padding=(kernel - 1) // 2)
    near = torch.eye(joints) + torch.diag(torch.ones(joints - 1), 1)
    mask = near.repeat_interleave(wide, 0).repeat_interleave(width, 1)[:, :, None]
    for values in layer.parameters():
        values.data = 0.3 * torch.randn(values.shape, generator=rng)
    return layer, mask.expand_as(layer.weight)


@pytest.fixture(scope="module")
def network() -> tuple[dict[str, torch.Tensor], list[tuple]]:
    """A state dict in BEAT2's layout, and the modules that it was taken from."""
    rng, modules = torch.Generator().manual_seed(0), []
    tensors: dict[str, torch.Tensor] = {}
    for number, (joints, fewer, width, wide) in enumerate(LAYERS):
        convolutions = [masked(rng, joints, width, wide, kernel) for kernel in (4, 1)]
        norm = nn.GroupNorm(10, joints * wide)
        norm.weight.data = torch.rand(norm.weight.shape, generator=rng)
        start = f"module.encoder.layers.{number}.0."
        for name, (layer, mask) in zip(("residual.0.", "shortcut."), convolutions, strict=True):
            tensors |= {start + name + k: v.data.clone() for k, v in layer.named_parameters()}
            tensors[start + name + "mask"] = mask.clone()
            layer.weight.data *= mask
        for name, values in norm.named_parameters():
            tensors[f"{start}residual.1.{name}"] = values.data
        pairs = [[k] if k >= joints - fewer else [k, joints - 1 - k] for k in range(fewer)]
        if fewer < joints:
            pool = torch.zeros(fewer * wide, joints * wide)
            for k, pair in enumerate(pairs):
                for j in pair:
                    pool[k * wide : (k + 1) * wide, j * wide : (j + 1) * wide] = torch.eye(wide)
                pool[k * wide : (k + 1) * wide] /= len(pair)
            tensors[start + "common.0.weight"] = pool
        modules.append((*(layer for layer, _ in convolutions), norm, pairs, wide))
    tensors["module.decoder.main.0.weight"] = torch.ones(2)
    return tensors, modules


def features_of(motion: Motion, modules: list[tuple]) -> np.ndarray:
    """Return features by torch's modules, with means over joints in place of a matrix."""
    n = motion.n_frames - motion.n_frames % 32
    turns = Rotation.from_quat(motion.rotations[:n].reshape(-1, 4)).as_matrix()
    x = torch.from_numpy(turns[:, :2].reshape(1, n, 330).astype(np.float32)).transpose(1, 2)
    with torch.no_grad():
        for main, short, norm, pairs, wide in modules:
            x = norm(main(x)) + short(x)
            joints = x.unflatten(1, (-1, wide))
            x = torch.stack([joints[:, pair].mean(dim=1) for pair in pairs], dim=1).flatten(1, 2)
            x = torch.tanh(x)
    return x[0].T.numpy()


def smplx_motion(seconds: float, seed: int) -> Motion:
    rng, rig = np.random.default_rng(seed), smpl_skeleton(55)
    vectors = 0.3 * np.cumsum(rng.normal(size=(round(30 * seconds), 55, 3)), axis=0) / 10
    turns = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_quat().reshape(len(vectors), 55, 4)
    return Motion(rig, turns, np.zeros((len(vectors), 3)), 30.0)


def test_beat2s_encoder_gives_the_features_of_its_network(network, tmp_path):
    tensors, modules = network
    torch.save({"model_state": tensors}, tmp_path / "AESKConv.bin")
    save_file(tensors, tmp_path / "plain.safetensors")
    ours, plain = (load_extractor(tmp_path / n) for n in ("AESKConv.bin", "plain.safetensors"))
    assert ours.fingerprint == plain.fingerprint
    motions = [smplx_motion(seconds, seed) for seed, seconds in enumerate((4.0, 3.0, 0.5))]
    made = ours.encode(motions)
    assert [len(features) for features in made] == [96 // 16, 64 // 16], "0.5 s is too short"
    for features, motion in zip(made, motions):
        assert features == pytest.approx(features_of(motion, modules), abs=1e-5)
    assert fgd(motions, motions, ours).value == pytest.approx(0.0, abs=1e-9)
    tensors = dict(tensors) | {"module.encoder.layers.0.0.residual.0.bias": torch.zeros(330)}
    save_file(tensors, tmp_path / "other.safetensors")
    assert load_extractor(tmp_path / "other.safetensors").fingerprint != ours.fingerprint


def test_weights_that_do_not_fit_are_one_clear_error(network, gesture, tmp_path):
    tensors, _ = network
    few = {name: tensor for name, tensor in tensors.items() if "layers.3" not in name}
    save_file(few, tmp_path / "few.safetensors")
    (tmp_path / "object.bin").write_bytes(pickle.dumps({"a": Path("x")}, protocol=2))
    (tmp_path / "text.bin").write_text("Dear diary")
    save_file(
        {"pose_encoder.net.0.0.weight": torch.ones(32, 27, 3)}, tmp_path / "genea.safetensors"
    )
    for name, message in (
        ("few.safetensors", "BEAT2"),
        ("object.bin", "Python object"),
        ("text.bin", "cannot be read"),
        ("genea.safetensors", "fit-features RECORDINGS --weights"),
    ):
        with pytest.raises(EvaluationError, match=message) as refused:
            load_extractor(tmp_path / name)
        assert name in str(refused.value)
        with pytest.raises(EvaluationError, match=name):
            FeatureModel.of_weights([gesture(3.0)], tmp_path / name)
    torch.save({"model_state": tensors}, tmp_path / "beat2.bin")
    with pytest.raises(EvaluationError, match="SMPL-X"):
        load_extractor(tmp_path / "beat2.bin").encode([gesture(3.0)])
    with pytest.raises(EvaluationError, match="32 frames"):
        load_extractor(tmp_path / "beat2.bin").encode([smplx_motion(1.0, 0)])


# Layers of the published files: net of convolution and normalisation, then linear.
GENEA = {
    *(f"pose_encoder.net.{n}" for n in ("0.0", "0.1", "1.0", "1.1", "2.0", "2.1", "3")),
    *(f"pose_encoder.out_net.{n}" for n in (0, 1, 3, 4, 6)),
    *(f"decoder.pre_net.{n}" for n in (0, 1, 3)),
    *(f"decoder.net.{n}" for n in (0, 1, 3, 4, 6, 7)),
}


@pytest.mark.parametrize("variant", ["genea", "yoon"])
def test_weights_of_geneas_layout_are_taken_instead_of_training(
    variant, gesture, tmp_path, gesturekit
):
    clips = [gesture(6.0, seed=k) for k in range(2)]
    model = FeatureModel.fit(clips, variant, n_frames=34, steps=3)
    named = model.network.state_dict()
    published = GENEA | ({"pose_encoder.fc_mu"} if variant == "yoon" else set())
    assert {name.rpartition(".")[0] for name in named} == published
    named["pose_encoder.fc_logvar.weight"] = torch.ones(32, 32)  # of Yoon's file, not used
    content = {"pose_dim": model.windows.n_features, "n_frames": 34, "gen_dict": named}
    torch.save(content, tmp_path / "model_checkpoint_34.bin")
    for k, clip in enumerate(clips):
        clip.save(tmp_path / "recorded" / f"{k}.npz")
    fit = ("fit-features", tmp_path / "recorded", "--weights", tmp_path / "model_checkpoint_34.bin")
    done = gesturekit(*fit, "--out", tmp_path / "features").ok()
    taken = load_extractor(tmp_path / "features")
    assert taken.fingerprint in done.out and taken.training["weights"].endswith("34.bin")
    for one, other in zip(taken.encode(clips), model.encode(clips), strict=True):
        assert one == pytest.approx(other, abs=1e-5)
    gesturekit(*fit, "--joints", "LeftHand,RightHand", "--out", tmp_path / "x").fails(2, "joints")
    gesturekit(*fit, "--frames", 60, "--out", tmp_path / "x").fails(2, "--frames")


def test_evaluate_takes_beat2s_weights_and_states_their_fingerprint(network, tmp_path, gesturekit):
    torch.save({"model_state": network[0]}, tmp_path / "beat2.bin")
    for k in range(2):
        smplx_motion(4.0, k).save(tmp_path / "recorded" / f"{k}.npz")
        smplx_motion(4.0, 9 + k).save(tmp_path / "made" / f"{k}.npz")
    out = tmp_path / "found.json"
    gesturekit("evaluate", tmp_path / "made", tmp_path / "recorded", "--json", out, "--features",
               tmp_path / "beat2.bin", "--workers", 1).ok()  # fmt: skip
    found = json.loads(out.read_text())
    extractor = load_extractor(tmp_path / "beat2.bin")
    assert found["settings"]["features"] == extractor.fingerprint
    sets = [[smplx_motion(4.0, seed + k) for k in range(2)] for seed in (9, 0)]
    assert found["models"][0]["figures"]["fgd"]["value"] == pytest.approx(
        fgd(*sets, extractor).value, rel=1e-3
    )
