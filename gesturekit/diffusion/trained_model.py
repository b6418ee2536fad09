"""A trained denoiser with its conversions between tensors, motion and conditions, on disk too."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

import torch
from torch import Tensor

from audio_features.weight_files import WeightPlaces
from gesturekit.diffusion.conditions import Conditions
from gesturekit.diffusion.config import NetworkConfig, NoiseConfig
from gesturekit.diffusion.motion_vector import DeltaRepresentation, Normaliser
from gesturekit.diffusion.network import Denoiser
from gesturekit.diffusion.noise_schedule import NoiseSchedule
from gesturekit.errors import ModelError
from gesturekit.model import BaseModel, Inputs
from gesturekit.motion.skeleton import Skeleton
from gesturekit.state.channels import StateChannels
from gesturekit.state.files import load_state, state_tensors, state_values
from gesturekit.state.process import StateProcess
from gesturekit.training.config import build, to_dict
from gesturekit.training.model_folder import (
    ModelParts,
    common_arguments,
    load_model,
    model_digest,
    model_readme,
    rig_values,
    save_model,
)
from gesturekit.training.run.session import prepare_device, warn_of_slow_bfloat16

_DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16}

MAX_FRAMES = 9000
"""Frames that are generated without tiling: five minutes at 30 fps. At gesture size, each thousand
frames take about 35 MB, one hour 4 GB; the time per frame does not depend on the length."""


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class TrainedModel(BaseModel):
    """Contents of a model folder, read and written; `DiffusionModel` adds generation.

    Attributes:
        normaliser: mean and scale of motion vectors.
        noise_config: settings of the noise schedule.
        network: the denoiser.
        state_process: from which the state of movement is drawn; None for a model without it.
        droppable: conditions dropped in training, which guidance needs: "styles", "state", or "all"
            but the state.
        window: frames of the longest motion that is generated without tiling.
        clip_denoised: whether generation clips the predicted clean motion, see `DiffusionConfig`.
    """

    kind: ClassVar[str] = "diffusion"

    representation: DeltaRepresentation
    conditions: Conditions
    normaliser: Normaliser
    noise_config: NoiseConfig
    network: Denoiser
    state_process: StateProcess | None = None
    droppable: tuple[str, ...] = ()
    window: int = MAX_FRAMES
    clip_denoised: bool = True

    def __post_init__(self) -> None:
        self.network.eval()

    @cached_property
    def schedule(self) -> NoiseSchedule:
        """Variances of the steps of diffusion."""
        return NoiseSchedule.of(self.noise_config)

    @property
    def inputs(self) -> Inputs:
        """Inputs besides style and speaker."""
        conditions = self.conditions
        speech = conditions.conditioner
        return Inputs(
            speech=speech is not None,
            words=speech is not None and speech.takes_words,
            files=() if speech is None else speech.files,
            path=conditions.path,
            events=conditions.events,
        )

    @property
    def device(self) -> torch.device:
        """The device that holds the network."""
        return next(self.network.parameters()).device

    def fingerprint(self) -> str:
        """Return the SHA-256 of what `save` writes, its README apart."""
        return model_digest(*_parts(self))

    def save(self, folder: str | Path, *, notes: Mapping[str, str] | None = None) -> None:
        """Write the model folder: config.yaml, skeleton.json, model.safetensors, README.md."""
        save_model(folder, *_parts(self), _readme(self, notes or {}))

    @classmethod
    def load(
        cls,
        folder: str | Path,
        *,
        weights: WeightPlaces | None = None,
        device: str = "cpu",
        dtype: Literal["fp32", "bf16"] = "fp32",
    ) -> Self:
        """Read a model folder.

        Args:
            folder: as written by `save`.
            weights: path of the encoder weights used in training; {kind: path} for several
                encoders.
            device: where the denoiser and WavLM compute: auto, cpu, cuda, cuda:1 ...
            dtype: precision of the denoiser. `bf16` halves memory and is faster on processors
                that support it; predictions then differ by about 1 %.

        Raises:
            ModelError: a part is missing, damaged, or of a newer format; an unknown dtype; a GPU's
                memory ran out.
            WeightsError: weights are missing, or differ from those used in training.
            ConfigError: there is no such device.
        """
        if dtype not in _DTYPES:
            raise ModelError(f"dtype={dtype!r}: choose one of {', '.join(_DTYPES)}")
        place = prepare_device(device)
        if dtype == "bf16":
            warn_of_slow_bfloat16(place)

        def assemble(parts: ModelParts) -> Any:
            model = cls(**_arguments(parts, weights, str(place)))
            model.network.to(place, _DTYPES[dtype])
            return model

        return load_model(folder, cls.kind, assemble)


def _parts(model: TrainedModel) -> tuple[dict[str, Any], dict[str, Any], dict[str, Tensor]]:
    """Return the contents of config.yaml, skeleton.json and model.safetensors."""
    process = model.state_process
    config = {
        **model.first_values(),
        **model.conditions.to_values(),
        "droppable": list(model.droppable),
        "window": model.window,
        "clip_denoised": model.clip_denoised,
        "smooth": model.smooth,
        "state": None if process is None else state_values(process),
        "noise": to_dict(model.noise_config),
        "network": to_dict(model.network.config),
    }
    tensors = {f"network.{name}": value for name, value in model.network.state_dict().items()}
    tensors |= learnt_tensors(model.normaliser, model.conditions, process)
    return config, rig_values(model.representation, model.speakers), tensors


def _readme(model: TrainedModel, notes: Mapping[str, str]) -> str:
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
    if (process := model.state_process) is not None:
        rows["State of movement"] = ", ".join(process.channels.names)
        if process.wanted is not None:
            rows["Hand movement from speech"] = process.wanted.summary()
    if model.droppable:
        names = {"styles": "style", "all": "all conditions", "state": "the state of movement"}
        parts = " and ".join(names[name] for name in model.droppable)
        rows["Guidance"] = f"trained with dropout of {parts}"
        call.append("guidance=1.5")
    return model_readme({**rows, **notes}, ", ".join(call))


def learnt_tensors(
    normaliser: Normaliser, conditions: Conditions, process: StateProcess | None
) -> dict[str, Tensor]:
    """Return the tensors of what training fits to its recordings, before the network."""
    return {
        "motion.mean": normaliser.mean,
        "motion.scale": normaliser.scale,
        **conditions.to_tensors(),
        **({} if process is None else state_tensors(process)),
    }


def read_learnt(
    values: Mapping[str, Any],
    tensors: Mapping[str, Tensor],
    fps: float,
    weights: WeightPlaces | None,
    device: str,
) -> dict[str, Any]:
    """Return the fields of what training fits to its recordings.

    These are `representation`, `conditions`, `normaliser` and `state_process`.

    Args:
        values: with `rig_values`, `Conditions.to_values`, and `state`: `state_values` or None.
        tensors: with those of `learnt_tensors`.
        fps: frames per second.
        weights: see `TrainedModel.load`.
        device: where encoders compute.

    Raises KeyError, TypeError, ValueError or RuntimeError for damaged values.
    """
    skeleton, state = Skeleton.from_json(values["skeleton"]), values["state"]
    representation = DeltaRepresentation.from_json(skeleton, values["motion"])
    channels = StateChannels.find(representation.skeleton, representation.joints)
    known = None if state is None else channels
    conditions = Conditions.from_values(values, tensors, fps, weights, device, known)
    normaliser = Normaliser(tensors["motion.mean"], tensors["motion.scale"])
    n_motion, n_speech = representation.n_features, conditions.columns["speech"].stop
    for name, numbers in vars(normaliser).items():
        if numbers.shape != (n_motion,) or not torch.isfinite(numbers).all():
            raise ValueError(f"motion.{name} is not {n_motion} finite numbers")
    return {
        "representation": representation,
        "conditions": conditions,
        "normaliser": normaliser,
        "state_process": load_state(state, tensors, channels, fps, n_speech),
    }


def _arguments(parts: ModelParts, weights: WeightPlaces | None, device: str) -> dict[str, Any]:
    """Return the fields of `TrainedModel` from a model folder; see `TrainedModel.load`.

    Raises KeyError, TypeError, ValueError or RuntimeError for a damaged folder.
    """
    config, where = parts.config, str(parts.folder / "config.yaml")
    fps, values = float(config["fps"]), {**config, **parts.rig}
    learnt = read_learnt(values, parts.tensors, fps, weights, device)
    representation, conditions = learnt["representation"], learnt["conditions"]
    if representation.makes_root == conditions.path:
        raise ValueError("config.yaml and skeleton.json differ in whether there is a path")
    network_config = build(NetworkConfig, config["network"], where=where)
    network = Denoiser(representation.n_features, conditions.width, network_config)
    network.load_state_dict(parts.tensors_under("network."))
    return {
        **common_arguments(parts),
        **learnt,
        "noise_config": build(NoiseConfig, config["noise"], where=where),
        "network": network,
        "droppable": tuple(map(str, config["droppable"])),
        "window": int(config["window"]),
        "clip_denoised": bool(config["clip_denoised"]),
    }
