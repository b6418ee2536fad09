"""Checkpoints like those of the paper's released code, with every parameter drawn."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from rigs import PERSON, Bones, rig_of
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation
from sklearn.preprocessing import StandardScaler
from torch import Tensor

from gesturekit.motion import Motion

BLOCKS, LAYERS, CHANNELS, HEADS, HIDDEN, EMBEDDING = 3, 2, 32, 4, 48, 24
KERNELS, DILATIONS, SEGMENT, CYCLE = 21, (0, 1, 2), 150, 2
FEATURES = ("Chroma_0", "Spectralflux_0", "Beatactivation_0")
STYLES = ("gCA", "gCH", "gJZ", "gKR", "gLH", "gLO", "gPO", "gTP")

_NAMES = {"Chest": "Spine1"}
DANCER: Bones = {
    _NAMES.get(joint, joint): (parent and _NAMES.get(parent, parent), offset)
    for joint, (parent, offset) in PERSON.items()
}
for _side, _x in (("Left", 1.0), ("Right", -1.0)):
    DANCER[f"{_side}ToeBase"] = (f"{_side}Foot", (0.0, -0.06, 0.14))
    DANCER[f"{_side}HandIndex1"] = (f"{_side}Hand", (0.09 * _x, 0.0, 0.0))


def dance(n_frames: int = 90, seed: int = 0) -> Motion:
    """Return a motion of all joints on the joints of Motorica, which turns and walks."""
    rng, rig = np.random.default_rng(seed), rig_of(DANCER)
    drawn = gaussian_filter1d(rng.normal(size=(n_frames, rig.n_joints, 3)), 4, axis=0) * 2
    drawn[:, 0, 1] += np.linspace(0, 5, n_frames)
    turns = Rotation.from_rotvec(drawn.reshape(-1, 3)).as_quat()
    places = gaussian_filter1d(rng.normal(size=(n_frames, 3)), 6, axis=0) + [0, 0.95, 0]
    return Motion(rig, turns.reshape(n_frames, -1, 4), places, 30.0)


def weights(
    n_motion: int = 61, n_condition: int = 11, seed: int = 0, *, convolves: bool = False
) -> dict[str, Tensor]:
    """Return all tensors of a released network by name: of Conformers, or of convolutions."""
    rng = torch.Generator().manual_seed(seed)
    tensors: dict[str, Tensor] = {}

    def draw(name: str, *shape: int, scale: float | None = None) -> None:
        spread = max(1, int(np.prod(shape[1:]))) ** -0.5 if scale is None else scale
        tensors[name] = torch.randn(shape, generator=rng) * spread

    def linear(name: str, n_in: int, n_out: int, kernel: tuple[int, ...] = ()) -> None:
        draw(f"{name}.weight", n_out, n_in, *kernel)
        draw(f"{name}.bias", n_out, scale=0.1)

    linear("input_projection.conv1d", n_motion, CHANNELS, (1,))
    linear("diffusion_embedding.projection1", 128, EMBEDDING)
    linear("diffusion_embedding.projection2", EMBEDDING, EMBEDDING)
    linear("skip_projection.conv1d", CHANNELS, CHANNELS, (1,))
    linear("output_projection.conv1d", CHANNELS, n_motion, (1,))
    for b in range(BLOCKS):
        block = f"residual_layers.{b}"
        linear(f"{block}.diffusion_projection", EMBEDDING, CHANNELS)
        linear(f"{block}.local_cond_projection", n_condition, CHANNELS)
        linear(f"{block}.output_projection.conv1d", CHANNELS, 2 * CHANNELS, (1,))
        if convolves:
            linear(f"{block}.nn.conv1d", CHANNELS, 2 * CHANNELS, (3,))
            continue
        linear(f"{block}.nn.in_proj", CHANNELS, CHANNELS)
        linear(f"{block}.nn.out_proj", CHANNELS, 2 * CHANNELS)
        for k in range(LAYERS):
            layer = f"{block}.nn.attention_blocks.{k}"
            draw(f"{layer}.attn.in_proj.weight", 3 * CHANNELS, CHANNELS)
            linear(f"{layer}.attn.gate", CHANNELS, 2 * CHANNELS)
            if DILATIONS[b % 3]:
                draw(f"{layer}.ff.conv_1.weight", HIDDEN, CHANNELS, 3)
                draw(f"{layer}.ff.conv_2.weight", CHANNELS, HIDDEN, 3)
            else:
                draw(f"{layer}.ff.linear_1.weight", HIDDEN, CHANNELS)
                draw(f"{layer}.ff.linear_2.weight", CHANNELS, HIDDEN)
            for norm in ("norm_1", "norm_2"):
                draw(f"{layer}.{norm}.weight", CHANNELS, scale=1.0)
                draw(f"{layer}.{norm}.bias", CHANNELS, scale=0.1)
            scorer, shape = f"{layer}.attn.position_scorer", (1, KERNELS, HEADS, 1, 1)
            draw(f"{scorer}.offsets", *shape, scale=15.0)
            draw(f"{scorer}.amplitudes", *shape, scale=3.0)
            tensors[f"{scorer}.sharpness"] = 1 + 5 * torch.rand(shape, generator=rng)
            draw(f"{scorer}.bias", 1, HEADS, 1, 1, scale=1.0)
            # At half a view of 5 to 75 frames, attention has fallen by 8 powers of ten.
            views = 5 * (SEGMENT / 2 / 5) ** (torch.arange(HEADS) / (HEADS - 1))
            tensors[f"{scorer}.slopes"] = (8 * np.log(10) / (views / 2)).reshape(HEADS, 1, 1)
    return tensors


def noise_of(state: dict[str, Tensor], x: Tensor, condition: Tensor, step: int) -> Tensor:
    """Return the noise that a released network finds in x (B, T, X), from its formulas."""

    def linear(name: str, values: Tensor) -> Tensor:
        weight = state[f"{name}.weight"]
        weight = weight.squeeze(-1) if name.endswith("conv1d") else weight
        return values @ weight.T + state.get(f"{name}.bias", torch.zeros(()))

    frequency = torch.arange(64) * 4.0 / 63.0
    angle = step * 10.0**frequency
    embedded = torch.cat([angle.sin(), angle.cos()])
    for k in (1, 2):
        embedded = F.silu(linear(f"diffusion_embedding.projection{k}", embedded))
    x, skips = linear("input_projection.conv1d", x).relu(), torch.zeros(())
    for b in range(BLOCKS):
        block = f"residual_layers.{b}"
        y = x + linear(f"{block}.diffusion_projection", embedded)
        if condition.shape[-1]:
            y = y + linear(f"{block}.local_cond_projection", condition)
        if f"{block}.nn.conv1d.weight" in state:
            d = 2 ** (b % CYCLE)
            kernel, bias = (state[f"{block}.nn.conv1d.{kind}"] for kind in ("weight", "bias"))
            y = F.conv1d(y.mT, kernel, bias, padding=d, dilation=d).mT
        else:
            y = linear(f"{block}.nn.in_proj", y)
            for k in range(LAYERS):
                layer = f"{block}.nn.attention_blocks.{k}"
                y = _conformer(state, layer, y, DILATIONS[b % 3], linear)
            y = linear(f"{block}.nn.out_proj", y)
        gate, signal = y.chunk(2, -1)
        y = linear(f"{block}.output_projection.conv1d", gate.sigmoid() * signal.tanh())
        x, skips = (x + y[..., :CHANNELS]) / 2**0.5, skips + y[..., CHANNELS:]
    y = linear("skip_projection.conv1d", skips / BLOCKS**0.5).relu()
    return linear("output_projection.conv1d", y)


def _conformer(state: dict[str, Tensor], name: str, x: Tensor, dilation: int, linear: Any):
    def norm(which: str, values: Tensor) -> Tensor:
        pair = state[f"{name}.{which}.weight"], state[f"{name}.{which}.bias"]
        return F.layer_norm(values, (CHANNELS,), *pair)

    read = state[f"{name}.attn.in_proj.weight"]
    apart = torch.arange(x.shape[1])[:, None] - torch.arange(x.shape[1])  # query - key
    scorer = f"{name}.attn.position_scorer"
    k, v, q = (x @ rows.T for rows in read.split(CHANNELS))
    k, v, q = (part.unflatten(-1, (HEADS, -1)).movedim(-2, 1) for part in (k, v, q))
    a, o, s = (state[f"{scorer}.{part}"][0] for part in ("amplitudes", "offsets", "sharpness"))
    kernels = a.abs() * torch.sigmoid(a.sign() * (apart - o) / s)  # (kernels, heads, T, T)
    bias = torch.log(kernels.sum(0) + state[f"{scorer}.bias"][0].abs() + 1e-8)
    bias = bias - apart.abs() * state[f"{scorer}.slopes"]
    heads = ((q @ k.mT) / (CHANNELS // HEADS) ** 0.5 + bias).softmax(-1) @ v
    gated, gate = linear(f"{name}.attn.gate", heads.movedim(1, -2).flatten(-2)).chunk(2, -1)
    x = norm("norm_2", x + gated * gate.sigmoid())
    if dilation:
        how = {"padding": dilation, "dilation": dilation}
        hidden = F.conv1d(x.mT, state[f"{name}.ff.conv_1.weight"], **how).relu()
        made = F.conv1d(hidden, state[f"{name}.ff.conv_2.weight"], **how).mT
    else:
        made = linear(f"{name}.ff.linear_2", linear(f"{name}.ff.linear_1", x).relu())
    return norm("norm_1", x + made)


def settings(scalers: dict[str, Any], steps: int, convolves: bool) -> dict[str, Any]:
    """Return the hyperparameters of a checkpoint."""
    network = {"num_blocks": LAYERS, "num_heads": HEADS, "activation": "relu", "dropout": 0.15}
    network |= {"norm": "LN", "d_ff": HIDDEN, "seq_len": SEGMENT, "use_preln": False}
    network |= {"bias": False, "dilation_cycle": list(DILATIONS)}
    name = "conv" if convolves else "tisa"
    diffusion = {"name": name, "residual_layers": BLOCKS, "residual_channels": CHANNELS}
    diffusion |= {"embedding_dim": EMBEDDING, "n_noise_schedule": steps}
    diffusion |= {"noise_schedule_start": 0.01, "noise_schedule_end": 0.7}
    diffusion |= {"args": {"tisa": network, "conv": {"dilation_cycle_length": CYCLE}}}
    data = {"segment_length": SEGMENT, "output_modality": "expmap_30fps", "scalers": scalers}
    return {"Data": data, "Diffusion": diffusion, "lr": 0.0006}


def write_checkpoint(
    path: Path,
    motion: np.ndarray,
    features: np.ndarray | None,
    *,
    styles: bool = True,
    steps: int = 150,
    convolves: bool = False,
    **more: Any,
) -> dict[str, Tensor]:
    """Write a checkpoint of released vectors (T, 61) and features (T, 3); return its tensors."""
    scalers: dict[str, Any] = {"out_scaler": StandardScaler().fit(motion)}
    scalers["in_scaler"] = None if features is None else StandardScaler().fit(features)
    scalers["style_scaler"] = StandardScaler() if styles else None
    if styles:
        scalers["style_scaler"].mean_ = np.zeros(len(STYLES))
        scalers["style_scaler"].scale_ = np.ones(len(STYLES))
    width = (0 if features is None else len(FEATURES)) + styles * len(STYLES)
    tensors = weights(motion.shape[1], width, convolves=convolves)
    state = {f"diffusion_model.{name}": value for name, value in tensors.items()}
    about = {
        "epoch": 3,
        "state_dict": state,
        "hyper_parameters": settings(scalers, steps, convolves),
    }
    torch.save({**about, "loops": {}, "pytorch-lightning_version": "1.8.3", **more}, path)
    return tensors
