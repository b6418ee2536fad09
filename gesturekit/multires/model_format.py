"""Multires model folders: a model as plain values and tensors, and back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from torch import Tensor

from audio_features.weight_files import WeightPlaces
from gesturekit.motion.skeleton import Skeleton
from gesturekit.multires.config import NetworkConfig
from gesturekit.multires.motion_vector import MultiresRepresentation, Normaliser
from gesturekit.multires.network.generator import MultiresGenerator
from gesturekit.multires.recall.library_format import (
    library_row,
    library_tensors,
    library_values,
    load_library,
)
from gesturekit.multires.sampling.conditions import Conditions
from gesturekit.multires.sampling.trained_model import TrainedModel, TrainedNoise, TrainedSequence
from gesturekit.training.config import build, to_dict
from gesturekit.training.data.features import (
    conditioner_tensors,
    conditioner_values,
    load_conditioner,
)
from gesturekit.training.model_folder import ModelParts, model_readme
from gesturekit.training.trained_model import common_arguments, rig_values


def model_parts(model: TrainedModel) -> tuple[dict[str, Any], dict[str, Any], dict[str, Tensor]]:
    """Return config.yaml, skeleton.json and model.safetensors of a model."""
    conditions, noise = model.conditions, model.noise
    conditioner = conditions.conditioner
    config = {
        **model.first_values(),
        "features": None
        if conditioner is None
        else {**conditioner_values(conditioner), "residual": conditions.residual},
        "styles": list(model.styles),
        "z_star_shuffle": noise.z_star_shuffle,
        "noise_levels": noise.noise_levels,
        "network": to_dict(model.network_config),
        "sequences": {name: asdict(sequence) for name, sequence in noise.sequences.items()},
        "recall": None if model.library is None else library_values(model.library),
        "fastest": model.fastest,
        "smooth": model.smooth,
    }
    tensors = {f"network.{k}": v.contiguous() for k, v in model.network.state_dict().items()}
    tensors |= {f"z_star.{name}": value for name, value in noise.z_star.items()}
    tensors |= {
        "sigma": noise.sigma,
        "motion.mean": model.normaliser.mean,
        "motion.scale": model.normaliser.scale,
        **conditioner_tensors(conditioner),
        **({} if model.library is None else library_tensors(model.library)),
    }
    return config, rig_values(model.representation, model.speakers), tensors


def model_arguments(parts: ModelParts, weights: WeightPlaces | None, device: str) -> dict[str, Any]:
    """Return the fields of `TrainedModel` from a model folder; see `MultiresModel.load`."""
    config, rig, tensors = parts.config, parts.rig, parts.tensors
    where = str(parts.folder / "config.yaml")
    fps = float(config["fps"])
    skeleton = Skeleton.from_json(rig["skeleton"])
    representation = MultiresRepresentation.from_json(skeleton, rig["motion"])
    features, conditioner = config["features"], None
    if features is not None:
        conditioner = load_conditioner(features, tensors, fps, weights, device)
    conditions = Conditions(
        conditioner,
        tuple(map(str, config.get("styles", ()))),
        bool(features and features["residual"]),
        bool(config.get("recall")),
    )
    speech_size = 0 if conditioner is None else conditioner.dim
    network_config = build(NetworkConfig, config["network"], where=where)
    network = MultiresGenerator(representation, conditions.width, network_config)
    network.load_state_dict(parts.tensors_under("network."))
    # Older folders lack some values: those models cannot reconstruct, or warn of no speed.
    noise = TrainedNoise(
        sigma=tensors["sigma"],
        z_star=parts.tensors_under("z_star."),
        sequences={
            name: build(TrainedSequence, values, where=where)
            for name, values in config.get("sequences", {}).items()
        },
        z_star_shuffle=int(config.get("z_star_shuffle", 0)),
        noise_levels=int(config.get("noise_levels", 1)),
    )
    fastest = config.get("fastest")
    return {
        **common_arguments(parts),
        "representation": representation,
        "normaliser": Normaliser(tensors["motion.mean"], tensors["motion.scale"]),
        "conditions": conditions,
        "network_config": network_config,
        "network": network.eval(),
        "noise": noise,
        "library": load_library(config, parts, representation, network_config.levels, speech_size),
        "fastest": None if fastest is None else float(fastest),
    }


def readme(model: TrainedModel, notes: Mapping[str, str]) -> str:
    """Return the text of the model folder's README.md, with `notes` as further lines."""
    lines = {
        "Kind": f"multires, {model.network_config.levels} levels",
        "Motion": model.motion_row(),
    }
    call = "seconds=10"
    if speech := model.speech_rows():
        lines |= speech
        call = '"speech.wav"'
    if model.library is not None:
        lines["Recalled motion"] = library_row(model.library)
    if model.styles:
        lines["Styles"] = ", ".join(model.styles)
        call += f', style="{model.styles[0]}"'
    return model_readme(lines | notes, call)
