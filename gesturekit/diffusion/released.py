"""Models from checkpoints of the paper's released code (dance: LDA, LDA-U), for academic use only.

| released | here |
|---|---|
| `input_projection`, `skip_projection`, `output_projection` | `enter`, `gather`, `leave` |
| `diffusion_embedding.projection1`, `.projection2` | `embed_step.0`, `.2` |
| of a block: `diffusion_projection`, `local_cond_projection` | rows of `project_step`, and of |
|  | `project_condition` |
| of a block: `output_projection` | `split` |
| `attn.in_proj`: keys, values, queries | `attention.read`: queries, keys, values |
| `attn.position_scorer`: (kernels, heads) of | `attention.bias`: (heads, kernels) of |
| `amplitudes`, `offsets`, `sharpness`, `bias` | `amplitudes`, `offsets`, `widths`, `floors` |
| `norm_2`, `norm_1` | `norm_attention`, `norm` |
| motion: RightFoot ... Hips, height, | motion: Hips ..., height, |
| lateral and forward steps, turn | turn, forward and lateral steps |
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import audio_features as af
from audio_features.archive import read_bytes
from audio_features.weight_files import fitting_tensors
from gesturekit.corpus.speech import SpeechConditioner
from gesturekit.diffusion.conditions import Conditions
from gesturekit.diffusion.config import NetworkConfig, NoiseConfig
from gesturekit.diffusion.model import DiffusionModel
from gesturekit.diffusion.motion_vector import DeltaRepresentation, Normaliser
from gesturekit.diffusion.network import Denoiser
from gesturekit.diffusion.released_checkpoint import ReleasedCheckpoint, Scaler
from gesturekit.errors import ModelError
from gesturekit.motion.motion import Motion
from gesturekit.motion.rotations import IDENTITY

_LIMBS = [
    *(f"{side}{joint}" for side in ("Right", "Left") for joint in ("Foot", "Leg", "UpLeg")),
    *(
        f"{side}{joint}"
        for side in ("Right", "Left")
        for joint in ("Hand", "ForeArm", "Arm", "Shoulder")
    ),
]
_AXES = ("alpha", "beta", "gamma")
_STEPS = ("reference_dXposition", "reference_dZposition", "reference_dYrotation")
DANCE_COLUMNS = (
    *(
        f"{joint}_{axis}"
        for joint in (*_LIMBS, "Head", "Neck", "Spine1", "Spine", "Hips")
        for axis in _AXES
    ),
    *("Hips_Yposition", *_STEPS),
)
"""Names of the 61 columns of the released dance models."""

LICENCE = (
    "the weights are those of Listen, Denoise, Action!, for academic use only: no commercial use, "
    "no redistribution"
)
"""Licence of the weights, for the model card."""

_CENTIMETRE = 0.01
_MOST_NAMES = 1 << 20  # bytes of a list of names
_SAME_SLOPE = 1e-4
_FIXED = {"activation": "relu", "norm": "LN", "use_preln": False, "bias": False}
"""Settings of the network that has one value here."""


def convert_checkpoint(
    path: str | Path,
    rig: str | Path | Motion,
    styles: Sequence[str] = (),
    features: Sequence[str] = (),
    columns: Sequence[str] = DANCE_COLUMNS,
) -> DiffusionModel:
    """Return the model of a checkpoint of the released code of Alexanderson et al. 2023.

    Features come from files (`audio_features.Files`), as the released code has none that computes
    them; motion is that of the released sampler, without clipping.

    Args:
        path: .ckpt.
        rig: motion of the training corpus, or its file. Joints that are not modelled get their mean
            pose in it.
        styles: names of the styles, in the order of training (`dance_styles.txt`).
        features: names of the columns of the features, in the order of training.
        columns: names of the columns of the motion vector, in the order of training.

    Raises:
        ModelError: the file cannot be read, holds other Python objects, or another network; numbers
            of names that differ from the checkpoint's.
        WeightsError: tensors that do not fit the settings.
        FormatError: the rig cannot be read.
    """
    path = Path(path)
    checkpoint = ReleasedCheckpoint.load(path)
    motion = rig if isinstance(rig, Motion) else Motion.load(rig)
    motion_scaler = _scaler(checkpoint, "out", "columns of motion", columns)
    feature_scaler = _scaler(checkpoint, "in", "features", features)
    _scaler(checkpoint, "style", "styles", styles)
    assert motion_scaler is not None  # there are names of columns
    vector = ReleasedVector.on(motion, columns)
    fps = _frame_rate(checkpoint)
    conditions = Conditions(_conditioner(feature_scaler, fps), styles=tuple(styles))
    try:
        config, noise = network_config(checkpoint), noise_config(checkpoint)
        network = _network(checkpoint, config, vector.order, conditions.width)
    except (ModelError, af.WeightsError):
        raise
    except (KeyError, TypeError, ValueError) as error:
        raise ModelError(f"{path}: settings or tensors that do not fit: {error}") from error
    return DiffusionModel(
        fps=fps,
        recorded_fps=fps,
        representation=vector.representation,
        conditions=conditions,
        normaliser=vector.normaliser(motion_scaler),
        noise_config=noise,
        network=network,
        clip_denoised=False,
    )


def _scaler(
    checkpoint: ReleasedCheckpoint, which: str, what: str, names: Sequence[str]
) -> Scaler | None:
    """Return a scaler of a checkpoint; raise ModelError unless it has as many columns as names."""
    scaler = checkpoint.scalers.get(f"{which}_scaler")
    count = 0 if scaler is None else len(scaler.mean)
    if count != len(names) or len(set(names)) < count:
        raise ModelError(
            f"{checkpoint.path}: {count} {what}; {len(names)} names are given: they must be as "
            "many, and different"
        )
    return scaler


def read_names(path: str | Path | None) -> tuple[str, ...]:
    """Return the names in a text file, one a line; none for None.

    Raises:
        ModelError: the file cannot be read.
    """
    if path is None:
        return ()
    content = read_bytes(Path(path), _MOST_NAMES, ModelError)
    try:
        return tuple(filter(None, map(str.strip, content.decode("utf-8-sig").splitlines())))
    except UnicodeDecodeError as error:
        raise ModelError(f"{path}: no list of names: {error}") from error


@dataclass(frozen=True)
class ReleasedVector:
    """The released motion vector of a rig, as ours in another order and other units.

    Its exponential maps are relative to the rest pose, which is the T-pose of the corpus; lengths
    are centimetres, and displacements relative to the heading of their frame.

    Attributes:
        representation: of the same rig, joints and definitions.
        order: column of the released vector for each of ours.
        units: value of ours for 1 in that column.
    """

    representation: DeltaRepresentation
    order: list[int]
    units: np.ndarray

    @classmethod
    def on(cls, rig: Motion, columns: Sequence[str] = DANCE_COLUMNS) -> ReleasedVector:
        """Return the vector of a rig.

        Raises:
            ModelError: the rig lacks a joint, or the columns are not those of such a vector.
        """
        joints = [name.removesuffix("_alpha") for name in columns if name.endswith("_alpha")]
        if missing := [name for name in joints if name not in rig.skeleton.names]:
            raise ModelError(f"the rig has no joint {', '.join(missing)}; give one of the corpus")
        fields = DeltaRepresentation.fit_fields([rig], joints)
        root = fields["joints"][0]
        maps = [f"{joint}_{axis}" for joint in fields["joints"] for axis in _AXES]
        ours = [*maps, f"{root}_Yposition", *reversed(_STEPS)]
        if unknown := sorted(set(ours) ^ set(columns)):
            raise ModelError(
                f"columns of motion: {', '.join(unknown[:6])}: expected {', '.join(_AXES)} of each "
                f"joint, {root}_Yposition, {', '.join(_STEPS)}, each once"
            )
        length = _CENTIMETRE / fields["scale"]
        return cls(
            DeltaRepresentation(
                **fields,
                makes_root=True,
                side=np.eye(3)[0],
                references=np.tile(IDENTITY, (len(fields["joints"]), 1)),
                turn_first=True,
            ),
            [list(columns).index(name) for name in ours],
            np.array([1.0] * len(maps) + [length, 1.0, length, length]),
        )

    def normaliser(self, scaler: Scaler) -> Normaliser:
        """Return mean and scale of our vector, from those of the released one."""
        mean, scale = (values[self.order] * self.units for values in (scaler.mean, scaler.scale))
        return Normaliser(torch.from_numpy(mean).float(), torch.from_numpy(scale).float())


def network_config(checkpoint: ReleasedCheckpoint) -> NetworkConfig:
    """Return the sizes of a released network.

    Raises:
        ModelError: a network that does not exist here.
        ConfigError, KeyError, TypeError, ValueError: damaged settings.
    """
    settings = checkpoint.diffusion
    name = settings["name"]
    sizes: dict[str, Any] = {
        "blocks": settings["residual_layers"],
        "channels": settings["residual_channels"],
        "embedding": settings["embedding_dim"],
        "step_angles": "float32",
    }
    if name == "conv":
        cycle = min(int(settings["args"]["conv"]["dilation_cycle_length"]), 32)
        return NetworkConfig(
            **sizes, architecture="diffwave", dilations=tuple(2**i for i in range(cycle))
        )
    if name != "tisa":
        raise ModelError(f"{checkpoint.path}: network {str(name)[:40]!r}; known: tisa, conv")
    network = settings["args"]["tisa"]
    for key, value in _FIXED.items():
        if network.get(key, value) != value:
            raise ModelError(f"{checkpoint.path}: {key} is {network[key]!r}; known: {value!r}")
    kernels = checkpoint.tensors[f"{_layer(0, 0)}.attn.position_scorer.offsets"].shape[1]
    return NetworkConfig(
        **sizes,
        layers=network["num_blocks"],
        heads=network["num_heads"],
        feedforward=network["d_ff"],
        dilations=tuple(network["dilation_cycle"]),
        kernels=kernels,
        farthest_view=network["seq_len"] // 2,
        dropout=network["dropout"],
    )


def noise_config(checkpoint: ReleasedCheckpoint) -> NoiseConfig:
    """Return the noise schedule of a checkpoint."""
    settings = checkpoint.diffusion
    return NoiseConfig(
        steps=settings["n_noise_schedule"],
        first_beta=settings["noise_schedule_start"],
        last_beta=settings["noise_schedule_end"],
    )


def _frame_rate(checkpoint: ReleasedCheckpoint) -> float:
    """Return the rate in the name of the motion's files, `expmap_30fps`; 30 without one."""
    rate = re.search(r"(\d{1,3})fps", str(checkpoint.data.get("output_modality")))
    return float(rate[1]) if rate and float(rate[1]) else 30.0


def _conditioner(scaler: Scaler | None, fps: float) -> SpeechConditioner | None:
    if scaler is None:
        return None
    extractor = af.Files(len(scaler.mean))
    scales = scaler.mean, scaler.scale
    return SpeechConditioner(extractor, fps, "linear", *scales, "corpus", vad=False)


def _layer(block: int, layer: int) -> str:
    return f"residual_layers.{block}.nn.attention_blocks.{layer}"


def _network(
    checkpoint: ReleasedCheckpoint, config: NetworkConfig, order: list[int], n_condition: int
) -> Denoiser:
    """Return our network with the weights of a released one.

    Raises WeightsError if a tensor is missing or of another shape, KeyError if there is none of a
    name, and ValueError for tensors that are left over or other slopes of attention.
    """
    if config.blocks * config.layers > len(checkpoint.tensors):
        raise ValueError(f"{config.blocks} blocks in {len(checkpoint.tensors)} tensors")
    left = dict(checkpoint.tensors)
    tensors, slopes = _renamed(left, config, order, n_condition)
    if left:
        raise ValueError(f"unknown tensors, such as {min(left)}")
    with torch.device("meta"):  # without memory, until all sizes were found right
        expected = Denoiser(len(order), n_condition, config).state_dict()
    shapes = {name: tuple(value.shape) for name, value in expected.items()}
    fitting = fitting_tensors(checkpoint.path, tensors, shapes)
    network = Denoiser(len(order), n_condition, config)
    network.load_state_dict(fitting)
    ours = [value for name, value in network.named_buffers() if name.endswith("slopes")]
    for theirs, slope in zip(slopes, ours, strict=True):
        if not torch.allclose(theirs.flatten().float(), slope, rtol=_SAME_SLOPE):
            raise ValueError("slopes of attention other than those of seq_len and heads")
    return network


def _renamed(
    left: dict[str, Tensor], config: NetworkConfig, order: list[int], n_condition: int
) -> tuple[dict[str, Tensor], list[Tensor]]:
    """Pop the tensors of a released network; return them as ours, and its slopes of attention."""
    tensors: dict[str, Tensor] = {}
    slopes = []

    def move(ours: str, theirs: str, kinds: Sequence[str] = ("weight", "bias")) -> None:
        for kind in kinds:
            value = left.pop(f"{theirs}.{kind}")
            is_point = kind == "weight" and theirs.endswith("conv1d") and value.shape[-1:] == (1,)
            tensors[f"{ours}.{kind}"] = value.squeeze(-1) if is_point else value

    move("enter", "input_projection.conv1d")
    move("gather", "skip_projection.conv1d")
    move("leave", "output_projection.conv1d")
    tensors["enter.weight"] = tensors["enter.weight"][:, order]
    tensors |= {name: tensors[name][order] for name in ("leave.weight", "leave.bias")}
    for ours, theirs in ((0, 1), (2, 2)):
        move(f"embed_step.{ours}", f"diffusion_embedding.projection{theirs}")
    blocks = range(config.blocks)
    for ours, theirs in (("step", "diffusion"), ("condition", "local_cond")):
        for kind in ("weight", "bias"):
            rows = [left.pop(f"residual_layers.{b}.{theirs}_projection.{kind}") for b in blocks]
            if ours == "step" or n_condition:  # without a condition, theirs has no columns
                tensors[f"project_{ours}.{kind}"] = torch.cat(rows)
    for b in blocks:
        move(f"split.{b}", f"residual_layers.{b}.output_projection.conv1d")
        inner = f"residual_layers.{b}.nn"
        if config.architecture == "diffwave":
            move(f"stacks.{b}", f"{inner}.conv1d")
            tensors[f"stacks.{b}.weight"] = _gathered(tensors[f"stacks.{b}.weight"])
            continue
        move(f"stacks.{b}.enter", f"{inner}.in_proj")
        move(f"stacks.{b}.leave", f"{inner}.out_proj")
        for layer in range(config.layers):
            conformer, slope = _conformer(left, _layer(b, layer))
            tensors |= {f"stacks.{b}.layers.{layer}.{k}": v for k, v in conformer.items()}
            slopes.append(slope)
    return tensors, slopes


def _conformer(left: dict[str, Tensor], layer: str) -> tuple[dict[str, Tensor], Tensor]:
    """Pop the tensors of a released Conformer; return them as ours, and its slopes."""

    def pop(name: str) -> Tensor:
        return left.pop(f"{layer}.{name}")

    keys, values, queries = pop("attn.in_proj.weight").chunk(3)
    tensors = {"attention.read.weight": torch.cat([queries, keys, values])}
    named = {"attention.write": "attn.gate", "norm_attention": "norm_2", "norm": "norm_1"}
    for ours, theirs in named.items():
        tensors |= {f"{ours}.{kind}": pop(f"{theirs}.{kind}") for kind in ("weight", "bias")}
    scorer = "attn.position_scorer"
    kernels = {"amplitudes": "amplitudes", "offsets": "offsets", "widths": "sharpness"}
    for ours, theirs in kernels.items():
        tensors[f"attention.bias.{ours}"] = pop(f"{scorer}.{theirs}")[0, :, :, 0, 0].T
    tensors["attention.bias.floors"] = pop(f"{scorer}.bias").flatten()
    if f"{layer}.ff.conv_1.weight" in left:
        tensors["widen.weight"] = _gathered(pop("ff.conv_1.weight"))
        narrow = pop("ff.conv_2.weight")
        tensors["narrow.weight"] = narrow.permute(2, 0, 1).reshape(-1, narrow.shape[1])
    else:
        tensors |= {"widen.weight": pop("ff.linear_1.weight")}
        tensors |= {"narrow.weight": pop("ff.linear_2.weight")}
    return tensors, pop(f"{scorer}.slopes")


def _gathered(weight: Tensor) -> Tensor:
    """Return the kernel (O, I, 3) of a convolution as that of `DilatedConv`, (O, 3 I)."""
    return weight.permute(0, 2, 1).reshape(len(weight), -1)
