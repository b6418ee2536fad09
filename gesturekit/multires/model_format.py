"""What a multires model folder holds: a model as plain values and tensors, and back."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torch import Tensor

from gesturekit.motion.resampling import checked_fps
from gesturekit.motion.skeleton import Skeleton
from gesturekit.multires.config import NetworkConfig
from gesturekit.multires.motion_vector import MultiresRepresentation
from gesturekit.multires.network.generator import MultiresGenerator
from gesturekit.multires.training.data import Normaliser
from gesturekit.training.config import build, to_dict
from gesturekit.training.data.features import (
    conditioner_tensors,
    conditioner_values,
    load_conditioner,
)
from gesturekit.training.model_folder import ModelParts

if TYPE_CHECKING:
    from gesturekit.multires.model import MultiresModel


@dataclass(frozen=True)
class TrainedSequence:
    """A training sequence, as far as its reconstruction needs it: frames, and its style."""

    frames: int
    style: str | None = None


def model_parts(
    model: MultiresModel,
) -> tuple[dict[str, Any], dict[str, Any], dict[str, Tensor]]:
    """config.yaml, skeleton.json and model.safetensors of a model."""
    config = {
        "kind": model.kind,
        "fps": model.fps,
        "recorded_fps": model.recorded_fps,
        "joints": list(model.representation.joints),
        "features": None
        if model.conditioner is None
        else {**conditioner_values(model.conditioner), "residual": model.residual},
        "styles": list(model.styles),
        "z_star_shuffle": model.z_star_shuffle,
        "noise_levels": model.noise_levels,
        "network": to_dict(model.network_config),
        "sequences": {name: asdict(about) for name, about in model.sequences.items()},
        "fastest": model.fastest,
        "smooth": model.smooth,
    }
    rig = {
        "skeleton": model.skeleton.to_json(),
        "motion": model.representation.to_json(),
        "speakers": {name: body.to_json() for name, body in model.speakers.items()},
    }
    tensors = {f"network.{k}": v.contiguous() for k, v in model.network.state_dict().items()}
    tensors |= {f"z_star.{name}": value for name, value in model.z_star.items()}
    tensors |= {
        "sigma": model.sigma,
        "motion.mean": model.normaliser.mean,
        "motion.scale": model.normaliser.scale,
        **conditioner_tensors(model.conditioner),
    }
    return config, rig, tensors


def model_arguments(parts: ModelParts, weights: str | Path | None, device: str) -> dict[str, Any]:
    """What `MultiresModel` is made from, of what `model_parts` gave.

    Args:
        parts: as read from a folder.
        weights: the WavLM weights it was trained with, where it hears by WavLM.
        device: where WavLM computes.
    """
    config, rig, tensors = parts.config, parts.rig, parts.tensors
    where = str(parts.folder / "config.yaml")
    fps = float(config["fps"])
    skeleton = Skeleton.from_json(rig["skeleton"])
    representation = MultiresRepresentation.from_json(skeleton, rig["motion"])
    features, conditioner = config["features"], None
    if features is not None:
        conditioner = load_conditioner(features, tensors, fps, weights, device)
    styles = tuple(map(str, config.get("styles", ())))
    n_condition = len(styles) + (0 if conditioner is None else conditioner.dim)
    network_config = build(NetworkConfig, config["network"], where=where)
    network = MultiresGenerator(representation, n_condition, network_config)
    network.load_state_dict(
        {k.removeprefix("network."): v for k, v in tensors.items() if k.startswith("network.")}
    )
    # Models of before these were kept can do all but reconstruct, and warn of no speed.
    sequences = {
        name: build(TrainedSequence, about, where=where)
        for name, about in config.get("sequences", {}).items()
    }
    fastest, smooth = config.get("fastest"), config.get("smooth")
    recorded_fps = config.get("recorded_fps")
    return {
        "fps": fps,
        "representation": representation,
        "conditioner": conditioner,
        "styles": styles,
        "normaliser": Normaliser(tensors["motion.mean"], tensors["motion.scale"]),
        "network_config": network_config,
        "residual": bool(features and features["residual"]),
        "z_star_shuffle": int(config.get("z_star_shuffle", 0)),
        "noise_levels": int(config.get("noise_levels", 1)),
        "network": network.eval(),
        "sigma": tensors["sigma"],
        "z_star": {
            k.removeprefix("z_star."): v for k, v in tensors.items() if k.startswith("z_star.")
        },
        "sequences": sequences,
        "speakers": {name: Skeleton.from_json(body) for name, body in rig["speakers"].items()},
        "fastest": None if fastest is None else float(fastest),
        "smooth": None if smooth is None else float(smooth),
        "recorded_fps": None if recorded_fps is None else checked_fps(recorded_fps),
    }
