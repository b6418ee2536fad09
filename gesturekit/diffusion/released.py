"""Models from checkpoints of the paper's released code (dance: LDA, LDA-U), for academic use only.

Their columns of motion are RightFoot ... Hips, height, lateral and forward steps, and turn; ours
are Hips ..., height, turn, forward and lateral steps. `_RENAMED` has the names of the weights.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
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
from gesturekit.diffusion.released_checkpoint import ReleasedCheckpoint, read_checkpoint
from gesturekit.errors import ModelError
from gesturekit.motion.motion import Motion
from gesturekit.motion.rotations import IDENTITY

_JOINTS = (
    "RightFoot RightLeg RightUpLeg LeftFoot LeftLeg LeftUpLeg RightHand RightForeArm RightArm "
    "RightShoulder LeftHand LeftForeArm LeftArm LeftShoulder Head Neck Spine1 Spine Hips"
)
_AXES = ("alpha", "beta", "gamma")
_STEPS = ("reference_dXposition", "reference_dZposition", "reference_dYrotation")
_MAPS = (f"{joint}_{axis}" for joint in _JOINTS.split() for axis in _AXES)
DANCE_COLUMNS = (*_MAPS, "Hips_Yposition", *_STEPS)
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
    checkpoint = read_checkpoint(path)
    motion = rig if isinstance(rig, Motion) else Motion.load(rig)
    wanted = {"columns of motion": ("out_scaler", columns), "features": ("in_scaler", features)}
    for what, (name, names) in (wanted | {"styles": ("style_scaler", styles)}).items():
        scaler = checkpoint.scalers.get(name)
        count = 0 if scaler is None else len(scaler[0])
        if count != len(names) or len(set(names)) < count:
            wrong = f"{len(names)} names are given: they must be as many, and different"
            raise ModelError(f"{path}: {count} {what}; {wrong}")
    vector = ReleasedVector.on(motion, columns)
    fps = _frame_rate(checkpoint)
    conditions = Conditions(_conditioner(checkpoint, fps), styles=tuple(styles))
    try:
        config, noise = network_config(checkpoint), noise_config(checkpoint)
        network = _network(checkpoint, config, vector.order, conditions.width)
    except (ModelError, af.WeightsError):
        raise
    except (LookupError, TypeError, ValueError, RuntimeError) as error:
        raise ModelError(f"{path}: settings or tensors that do not fit: {error}") from error
    return DiffusionModel(
        fps=fps,
        recorded_fps=fps,
        representation=vector.representation,
        conditions=conditions,
        normaliser=vector.normaliser(*checkpoint.scalers["out_scaler"]),
        noise_config=noise,
        network=network,
        clip_denoised=False,
    )


def _frame_rate(checkpoint: ReleasedCheckpoint) -> float:
    """Return the rate in the name of the motion's files, `expmap_30fps`; 30 without one."""
    rate = re.search(r"(\d{1,3})fps", str(checkpoint.data.get("output_modality")))
    return float(rate[1]) if rate and float(rate[1]) else 30.0


def _conditioner(checkpoint: ReleasedCheckpoint, fps: float) -> SpeechConditioner | None:
    if (scales := checkpoint.scalers.get("in_scaler")) is None:
        return None
    centre, scale = scales
    extractor = af.Files(len(centre))
    return SpeechConditioner(extractor, fps, "linear", centre, scale, "corpus", vad=False)


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
        turns, side = np.tile(IDENTITY, (len(fields["joints"]), 1)), np.eye(3)[0]
        own = {"makes_root": True, "side": side, "references": turns, "turn_first": True}
        order = [list(columns).index(name) for name in ours]
        units = np.array([1.0] * len(maps) + [length, 1.0, length, length])
        return cls(DeltaRepresentation(**fields, **own), order, units)

    def normaliser(self, *scales: np.ndarray) -> Normaliser:
        """Return mean and scale of our vector, from those of the released one."""
        ours = (torch.from_numpy(values[self.order] * self.units).float() for values in scales)
        return Normaliser(*ours)


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
    first = "residual_layers.0.nn.attention_blocks.0.attn.position_scorer"
    return NetworkConfig(
        **sizes,
        layers=network["num_blocks"],
        heads=network["num_heads"],
        feedforward=network["d_ff"],
        dilations=tuple(network["dilation_cycle"]),
        kernels=checkpoint.tensors[f"{first}.offsets"].shape[1],
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


_RENAMED = (
    (r"residual_layers\.(\d+)\.output_projection\.conv1d", r"split.\1"),
    (r"residual_layers\.(\d+)\.diffusion_projection", r"project_step.\1"),
    (r"residual_layers\.(\d+)\.local_cond_projection", r"project_condition.\1"),
    (r"residual_layers\.(\d+)\.nn\.in_proj", r"stacks.\1.enter"),
    (r"residual_layers\.(\d+)\.nn\.out_proj", r"stacks.\1.leave"),
    (r"residual_layers\.(\d+)\.nn\.conv1d", r"stacks.\1"),
    (r"residual_layers\.(\d+)\.nn\.attention_blocks\.(\d+)", r"stacks.\1.layers.\2"),
    (r"attn\.in_proj", "attention.read"),
    (r"attn\.gate", "attention.write"),
    (r"attn\.position_scorer\.sharpness", "attention.bias.widths"),
    (r"attn\.position_scorer\.bias", "attention.bias.floors"),
    (r"attn\.position_scorer", "attention.bias"),
    (r"norm_2", "norm_attention"),
    (r"norm_1", "norm"),
    (r"ff\.(conv|linear)_1", "widen"),
    (r"ff\.(conv|linear)_2", "narrow"),
    (r"input_projection\.conv1d", "enter"),
    (r"skip_projection\.conv1d", "gather"),
    (r"output_projection\.conv1d", "leave"),
    (r"diffusion_embedding\.projection1", "embed_step.0"),
    (r"diffusion_embedding\.projection2", "embed_step.2"),
)
"""Patterns of released names of weights, and ours; the number of a block, and of a layer in it."""


def _converted(name: str, value: Tensor) -> Tensor:
    """Return the weight with this name of ours in our layout."""
    if name.endswith("attention.read.weight"):
        keys, values, queries = value.chunk(3)
        return torch.cat([queries, keys, values])
    if name.endswith(("bias.amplitudes", "bias.offsets", "bias.widths")):  # (heads, kernels)
        return value[0, :, :, 0, 0].T
    if name.endswith(("bias.floors", "bias.slopes")):
        return value.flatten()
    if value.ndim < 3:
        return value
    if value.shape[-1] == 1:  # a 1x1 convolution is a linear layer
        return value.squeeze(-1)
    if name.endswith("narrow.weight"):
        return value.permute(2, 0, 1).reshape(-1, value.shape[1])
    return value.permute(0, 2, 1).reshape(len(value), -1)  # (O, I, 3) as (O, 3 I)


def _network(
    checkpoint: ReleasedCheckpoint, config: NetworkConfig, order: list[int], n_condition: int
) -> Denoiser:
    """Return our network with the weights of a released one.

    Raises WeightsError if a tensor is missing or of another shape, KeyError if there is none of a
    name, and ValueError for tensors that are left over or other slopes of attention.
    """
    if config.blocks * config.layers > len(checkpoint.tensors):
        raise ValueError(f"{config.blocks} blocks in {len(checkpoint.tensors)} tensors")
    tensors = {}
    for name, value in checkpoint.tensors.items():
        for theirs, ours in _RENAMED:
            name = re.sub(theirs, ours, name)
        tensors[name] = _converted(name, value)
    tensors["enter.weight"] = tensors["enter.weight"][:, order]
    tensors |= {name: tensors[name][order] for name in ("leave.weight", "leave.bias")}
    for part, kind in product(("step", "condition"), ("weight", "bias")):
        rows = [tensors.pop(f"project_{part}.{b}.{kind}") for b in range(config.blocks)]
        if n_condition or part == "step":  # without a condition, theirs has no columns
            tensors[f"project_{part}.{kind}"] = torch.cat(rows)
    slopes = {name: tensors.pop(name) for name in [*tensors] if name.endswith("bias.slopes")}
    with torch.device("meta"):  # without memory, until all sizes were found right
        expected = Denoiser(len(order), n_condition, config).state_dict()
    if unknown := tensors.keys() - expected:
        raise ValueError(f"unknown tensors, such as {min(unknown)}")
    shapes = {name: tuple(value.shape) for name, value in expected.items()}
    fitting = fitting_tensors(checkpoint.path, tensors, shapes)
    network = Denoiser(len(order), n_condition, config)
    network.load_state_dict(fitting)
    for name, slope in network.named_buffers():
        if not torch.allclose(slopes[name].float(), slope, rtol=_SAME_SLOPE):
            raise ValueError("slopes of attention other than those of seq_len and heads")
    return network
