"""The pyramid's networks: what sees what, and what speech may touch."""

import math
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import yaml

import gesturekit as gk
from audio_features import level_lengths
from gesturekit.errors import ConfigError, ModelError
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.parts import upper_body
from gesturekit.multires import MultiresGenerator, MultiresRepresentation, NetworkConfig
from gesturekit.multires.networks import (
    Film,
    SkeletonConv1d,
    block_neighbours,
    modulated_blocks,
    n_weights,
)
from gesturekit.multires.resampling import reflect, resample
from gesturekit.systems import model_folder

CONFIG = NetworkConfig(levels=3, channels=(3, 3), embedding=8)


@pytest.fixture(scope="module")
def representation(gesture) -> MultiresRepresentation:
    return MultiresRepresentation.fit([gesture(2.0)])


def test_a_dense_kernel_that_memory_would_not_hold_is_refused(representation):
    """2^27 weights of 5 frames between blocks of as many channels each."""
    blocks = len(representation.block_sizes)
    most = math.isqrt((1 << 27) // 5) // blocks
    config = NetworkConfig(channels=(most, most))
    assert n_weights(representation, config, 0) > 1 << 24
    with pytest.raises(
        ConfigError, match=rf"channels: \[{most + 1}, {most + 1}\].* {blocks} blocks"
    ):
        n_weights(representation, replace(config, channels=(most + 1, most + 1)), 0)


@pytest.mark.parametrize("exact", [torch.float32, torch.float64])
def test_resampling_is_torchs_own_linear_interpolation(exact):
    rng = torch.Generator().manual_seed(0)
    x = torch.randn(2, 3, 50, dtype=exact, generator=rng)[..., 5:-5].requires_grad_(True)
    for n in (7, 30, 40, 53):
        want = torch.nn.functional.interpolate(x, size=n, mode="linear", align_corners=False)
        made, by = resample(x, n), torch.randn(want.shape, dtype=exact, generator=rng)
        # torch works its single-precision weights out in single precision, we do in double.
        error = 1e-12 if exact is torch.float64 else 1e-4
        close = {"rtol": error, "atol": error}
        torch.testing.assert_close(made, want, **close)
        gradients = [torch.autograd.grad(each, x, by)[0] for each in (made, want)]
        torch.testing.assert_close(*gradients, **close)
        if exact == torch.float32:
            part = resample(x.detach(), n, 2, n - 1)
            assert torch.equal(made[..., 2 : n - 1].detach(), part)


def test_reflection_equals_torchs_and_also_pads_short_signals():
    x = torch.randn(1, 2, 9)
    assert torch.equal(reflect(x, 2), torch.nn.functional.pad(x, (2, 2), mode="reflect"))
    assert reflect(x[..., :1], 2).shape[-1] == 5
    assert reflect(x[..., :2], 4)[0, 0].tolist() == (x[0, 0, :2].tolist() * 5)


@pytest.mark.parametrize(
    ("n_joints", "widths"),
    # Of GANimator's rigs: Mixamo's 24 joints and the crab's 56, with 4 and 6 contacts.
    [(24 + 4, (5, 9, 9)), (56 + 6, (3, 5, 5)), (2, (43, 86, 86))],
)
def test_widths_of_a_layer_are_split_over_the_blocks_of_the_rig(n_joints, widths):
    """GANimator's rule: 128, 256 and 256, each rounded up to a multiple of the blocks."""
    parents = (-1, *range(n_joints - 1))
    rig = Skeleton(tuple(f"j{i}" for i in range(n_joints)), parents, np.ones((n_joints, 3)))
    still = Motion(rig, np.tile([0.0, 0, 0, 1], (9, n_joints, 1)), np.zeros((9, 3)), 30.0)
    config = NetworkConfig(levels=1, channels=(128, 256, 256), channels_per="layer")
    representation = MultiresRepresentation.fit([still], "all")
    assert len(representation.block_sizes) == n_joints + 1  # no feet in a chain of joints
    layers = MultiresGenerator(representation, 0, config).levels[0].layers
    assert [layer.sizes[1] for layer in layers[:-1]] == [(w,) * (n_joints + 1) for w in widths]


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [("levels", 60, "model.safetensors"), ("channels", [64, 64, 64], "model.safetensors"),
     ("channels", [4096] * 3, "134217728"), ("levels", 10**9, "(?=.*levels)(?=.*1000000000)")],
)  # fmt: skip
def test_a_model_folder_makes_no_larger_network_than_it_has_weights(tmp_path, key, value, says):
    shutil.copytree(model_folder("demo"), tmp_path / "m")
    config = yaml.safe_load((tmp_path / "m" / "config.yaml").read_text())
    config["network"][key] = value
    (tmp_path / "m" / "config.yaml").write_text(yaml.safe_dump(config))
    with pytest.raises(ModelError, match=says):
        gk.load(tmp_path / "m")


def test_a_joint_depends_only_on_its_neighbours(representation):
    near = block_neighbours(representation, distance=2)
    joints = list(representation.joints)
    hand = joints.index("LeftHand")
    sees = {joints[j] for j in np.flatnonzero(near[hand, : len(joints)])}
    assert sees == {"LeftHand", "LeftForeArm", "LeftArm"}
    conv = SkeletonConv1d(near, representation.block_sizes, representation.block_sizes, 5)
    x = torch.zeros(1, representation.n_features, 9)
    quiet = conv(x)
    x[:, representation.joint_columns("RightHand"), 4] = 1.0
    changed = (conv(x) - quiet).abs().amax(dim=(0, 2)) > 1e-9
    assert changed[representation.joint_columns("RightArm")].all()
    assert not changed[representation.joint_columns("LeftHand")].any()
    assert not changed[representation.layout.contacts].any()
    # Only weights between neighbours are stored.
    dense = conv.dense_weight()
    assert conv.weight.numel() == int((dense != 0).sum()) < 0.5 * dense.numel()


def test_contacts_reach_the_same_blocks_as_in_ganimators_code():
    # Numbers: `get_neighbor` of the released code (bvh/bvh_parser.py), for its Mixamo skeleton.
    listed = (
        "Hips LeftUpLeg LeftLeg LeftFoot LeftToeBase LeftToe_End RightUpLeg RightLeg RightFoot "
        "RightToeBase RightToe_End Spine Spine1 Spine2 Neck Head LeftShoulder LeftArm LeftForeArm "
        "LeftHand RightShoulder RightArm RightForeArm RightHand"
    )
    names = listed.split()
    parents = [-1, 0, 1, 2, 3, 4, 0, 6, 7, 8, 9, 0, 11, 12, 13, 14, 13, 16, 17, 18, 13, 20, 21, 22]
    feet = ("LeftToe_End", "RightToe_End", "LeftToeBase", "RightToeBase")
    feet = [SimpleNamespace(joint=name) for name in feet]
    skeleton = Skeleton(tuple(names), tuple(parents), np.ones((24, 3)))
    rig = SimpleNamespace(skeleton=skeleton, indices=[*range(24)], root=0, foot_points=feet)
    theirs, ours = block_neighbours(rig, 2, "foot"), block_neighbours(rig, 2)
    assert theirs.sum() == 167 < ours.sum()
    sources = {24: [3, 4, 5, 24, 28], 27: [7, 8, 9, 10, 27, 28], 4: [2, 3, 4, 5, 26]}
    sources[28] = [0, 1, 2, 6, 7, 11, 12, 24, 25, 26, 27, 28]
    for block, expected in sources.items():
        assert np.flatnonzero(theirs[block]).tolist() == expected


def test_speech_modulates_the_upper_body_alone(representation):
    blocks = modulated_blocks(representation, CONFIG)
    joints = [name for name, on in zip(representation.joints, blocks, strict=False) if on]
    assert set(joints) == set(upper_body(representation.skeleton)) & set(representation.joints)
    assert "LeftLeg" not in joints and "Hips" not in joints and "LeftArm" in joints
    assert not blocks[len(representation.joints) :].any(), "contacts and root displacement"
    every = modulated_blocks(representation, replace(CONFIG, modulate="all"))
    assert every.all() and len(every) == len(representation.block_sizes)
    named = modulated_blocks(representation, replace(CONFIG, modulate=("Head", "LeftLeg")))
    assert sorted(representation.joints[i] for i in np.flatnonzero(named)) == ["Head", "LeftLeg"]


@pytest.mark.parametrize(("film", "count"), [("input", 1), ("all", 3)])
def test_all_layers_or_the_input_are_modulated(representation, film, count):
    """Each of the modulations, as the only one that is not the identity, makes a difference."""
    speech = torch.randn(1, 2, 9, generator=torch.Generator().manual_seed(0))
    up = torch.randn(1, representation.n_features, 9, generator=torch.Generator().manual_seed(1))
    level = MultiresGenerator(representation, 2, replace(CONFIG, film=film)).levels[0]
    assert len(level.films) == count
    with torch.no_grad():
        still = level(up, torch.zeros(1, 1, 9), speech)
        for own in level.films:
            own.gain.weight.fill_(0.5)
            assert (level(up, torch.zeros(1, 1, 9), speech) - still).abs().max() > 1e-3
            own.gain.weight.zero_()


def test_gradients_stay_within_their_level(representation):
    network = MultiresGenerator(representation, n_condition=5, config=CONFIG)
    lengths = level_lengths(40, 3)
    noises, speech = ([torch.randn(1, width, n) for n in lengths] for width in (1, 5))
    made = network(noises, speech, lengths=lengths)
    made[1].sum().backward()
    assert all(p.grad is None for p in network.levels[0].parameters())
    assert network.levels[1].layers[0].weight.grad.abs().sum() > 0


def test_film_starts_as_the_identity_then_multiplies_by_one_plus_gamma_and_adds_delta():
    film = Film(1, np.array([False, True, False, True]))
    x, y = torch.full((1, 4, 1), 3.0), torch.tensor([[[0.5]]])
    assert torch.equal(film(x, y), x)
    film.gain.weight.data[:] = 2.0
    film.shift.weight.data[:] = 5.0
    # The first channel is not modulated; the second is (1 + 2 * 0.5) * 3 + 5 * 0.5.
    assert film(x, y).flatten().tolist() == [3.0, 8.5, 3.0, 8.5]


def test_the_margin_is_two_frames_of_the_coarsest_level():
    """Each of seven levels above has 4/3 of the frames: 2 · (4/3)^7 = 14.98."""
    assert [NetworkConfig(levels=n).margin for n in (1, 2, 8)] == [2, 3, 15]
