"""Contents of a diffusion model folder: conversion of a model to files, and back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from audio_features.weight_files import WeightPlaces
from gesturekit.diffusion.conditions import Conditions
from gesturekit.diffusion.config import NetworkConfig, NoiseConfig
from gesturekit.diffusion.motion_vector import DeltaRepresentation, Normaliser
from gesturekit.diffusion.network.denoiser import Denoiser
from gesturekit.diffusion.trained_model import TrainedModel
from gesturekit.motion.skeleton import Skeleton
from gesturekit.training.config import build, to_dict
from gesturekit.training.model_folder import ModelParts, model_readme
from gesturekit.training.trained_model import common_arguments, rig_values


def model_parts(
    model: TrainedModel,
) -> tuple[dict[str, Any], dict[str, Any], dict[str, Tensor]]:
    """Return the contents of config.yaml, skeleton.json and model.safetensors."""
    config = {
        **model.first_values(),
        **model.conditions.to_values(),
        "droppable": list(model.droppable),
        "window": model.window,
        "clip_denoised": model.clip_denoised,
        "smooth": model.smooth,
        "noise": to_dict(model.noise_config),
        "network": to_dict(model.network.config),
    }
    tensors = {f"network.{name}": value for name, value in model.network.state_dict().items()}
    tensors |= {"motion.mean": model.normaliser.mean, "motion.scale": model.normaliser.scale}
    tensors |= model.conditions.to_tensors()
    return config, rig_values(model.representation, model.speakers), tensors


def readme(model: TrainedModel, notes: Mapping[str, str]) -> str:
    """Return the text of the model folder's README.md, with `notes` as further lines."""
    network, conditions = model.network.config, model.conditions
    layers = f" of {network.layers} layers" if network.architecture == "conformer" else ""
    rows = {
        "Kind": f"diffusion, {network.architecture}, {network.blocks} blocks{layers}, "
        f"{model.noise_config.steps} steps",
        "Motion": model.motion_row(),
    }
    call = []
    if speech := model.speech_rows():
        rows |= speech
        call.append('"speech.wav"')
    if conditions.path:
        rows["Path"] = "the root follows a given path"
        call.append('path="path.csv"')
    if not call:
        call.append("seconds=10")
    if conditions.events:
        rows["Events"] = ", ".join(conditions.events)
        call.append(f'events="{conditions.events[0]}@1.0"')
    if conditions.styles:
        rows["Styles"] = ", ".join(conditions.styles)
        call.append(f'style="{conditions.styles[0]}"')
    if model.droppable:
        names = {"styles": "style", "all": "all conditions"}
        parts = " and ".join(names[name] for name in model.droppable)
        rows["Guidance"] = f"trained with dropout of {parts}"
        call.append("guidance=1.5")
    return model_readme(rows | notes, ", ".join(call))


def model_arguments(parts: ModelParts, weights: WeightPlaces | None, device: str) -> dict[str, Any]:
    """Return the fields of `TrainedModel` from a model folder; see `DiffusionModel.load`.

    Raises KeyError, TypeError, ValueError or RuntimeError for a damaged folder.
    """
    config, rig, tensors = parts.config, parts.rig, parts.tensors
    where = str(parts.folder / "config.yaml")
    fps = float(config["fps"])
    representation = DeltaRepresentation.from_json(
        Skeleton.from_json(rig["skeleton"]), rig["motion"]
    )
    conditions = Conditions.from_values(config, tensors, fps, weights, device)
    network_config = build(NetworkConfig, config["network"], where=where)
    n_motion = representation.n_features
    normaliser = Normaliser(tensors["motion.mean"], tensors["motion.scale"])
    for name, values in vars(normaliser).items():
        if values.shape != (n_motion,) or not torch.isfinite(values).all():
            raise ValueError(f"motion.{name} is not {n_motion} finite numbers")
    if representation.makes_root == conditions.path:
        raise ValueError("config.yaml and skeleton.json differ in whether there is a path")
    network = Denoiser(n_motion, conditions.width, network_config)
    network.load_state_dict(parts.tensors_under("network."))
    return {
        **common_arguments(parts),
        "representation": representation,
        "conditions": conditions,
        "normaliser": normaliser,
        "noise_config": build(NoiseConfig, config["noise"], where=where),
        "network": network,
        "droppable": tuple(map(str, config["droppable"])),
        "window": int(config["window"]),
        "clip_denoised": bool(config["clip_denoised"]),
    }
