"""A trained diffusion model: load it and generate motion from speech, a style, a path or events."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, Unpack

import numpy as np
import torch
from torch import Tensor

from audio_features.weight_files import WeightPlaces
from gesturekit.corpus.speech import Speech, as_speech, to_output_rate
from gesturekit.diffusion.conditions import Conditions
from gesturekit.diffusion.config import NetworkConfig, NoiseConfig
from gesturekit.diffusion.controls import DiffusionControls
from gesturekit.diffusion.motion_vector import DeltaRepresentation, Normaliser
from gesturekit.diffusion.network.denoiser import Denoiser
from gesturekit.diffusion.sampling.request import Request
from gesturekit.diffusion.sampling.sampler import Sampler, check_controls
from gesturekit.diffusion.state import measured
from gesturekit.diffusion.trained_model import TrainedModel
from gesturekit.errors import ModelError, gesturekit_errors
from gesturekit.model import MotionStream, build_controls, document_controls
from gesturekit.motion.motion import Motion
from gesturekit.motion.skeleton import Skeleton
from gesturekit.state.channels import StateChannels
from gesturekit.state.files import load_state, state_tensors, state_values
from gesturekit.training.config import build, to_dict
from gesturekit.training.data.own_rig import on_rig
from gesturekit.training.model_folder import (
    ModelParts,
    common_arguments,
    load_model,
    model_digest,
    model_readme,
    rig_values,
    save_model,
)
from gesturekit.training.run.device import prepare_device, warn_of_slow_bfloat16
from gesturekit.training.seeds import checked_item, checked_seed

_DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16}


class DiffusionModel(TrainedModel):
    """Model that generates motion by denoising diffusion, from speech or music, a style, a path,
    events, or nothing."""

    @document_controls(DiffusionControls)
    @gesturekit_errors()
    def generate(
        self,
        speech: Speech | None = None,
        sample_rate: int | None = None,
        *,
        seconds: float | None = None,
        samples: int = 1,
        seed: int = 0,
        item: str = "",
        **controls: Unpack[DiffusionControls],
    ) -> Motion | list[Motion]:
        """Generate motion as long as the speech, the path or `seconds`; frame k is at k / fps.

        Args:
            speech: an audio file, a `Wave`, or an array of samples (see `Wave.from_array`), of
                speech or music, for a model with speech input. Without it, such a model gets
                silence for `seconds`.
            sample_rate: of an array, in Hz.
            seconds: length without speech, in s.
            samples: number of different motions; more than one gives a list.
            seed: the same seed, item, request and sample number give the same motion.
            item: name of the utterance. Motions of different items are different draws.
            controls: the fields of `DiffusionControls`.

        Raises:
            ModelError: a control, style, event or speaker that this model does not have, experts
                that cannot be combined, an item that is not text, or no length.
            AudioError, FormatError: a file cannot be read, or an array is not audio.
        """
        asked = build_controls(DiffusionControls, controls, self.kind)
        seed, item = checked_seed(seed), checked_item(item)
        speech = as_speech(speech, sample_rate)
        rate = self.recorded_fps if asked["fps"] is None else asked["fps"]
        product = check_controls(self, asked, samples)
        request = Request.build(product.models, asked, speech, seconds)
        motions = [
            to_output_rate(request.placement.applied(motion), rate, request.wave, request.seconds)
            for motion in Sampler(self, product, request).motions(seed, item, samples)
        ]
        return motions[0] if samples == 1 else motions

    def check_controls(
        self, *, samples: int = 1, seed: int = 0, **controls: Unpack[DiffusionControls]
    ) -> DiffusionControls:
        """Return the controls of `generate`, after the checks that do not depend on the speech.

        Raises:
            ModelError: a control, style, event or speaker that this model does not have, or
                experts that cannot be combined.
            FormatError: a table of events that cannot be read.
        """
        checked_seed(seed)
        asked = build_controls(DiffusionControls, controls, self.kind)
        check_controls(self, asked, samples)
        return asked

    def stream(
        self,
        sample_rate: int,
        look_ahead: float = 0.2,
        seed: int = 0,
        item: str = "",
        **controls: Unpack[DiffusionControls],
    ) -> MotionStream:
        """Raise ModelError: the model cannot stream."""
        raise ModelError(
            f"a {self.kind} model generates whole motions only: multires models with acoustic "
            "features and a state of movement can stream, such as own_corpus"
        )

    @gesturekit_errors()
    def state(self, motion: str | Path | Motion) -> np.ndarray:
        """Measure the state of movement of a motion: what `generate` takes as `state`.

        Args:
            motion: a motion or its file; one on another rig is retargeted.

        Returns:
            (T, C) at the model's frame rate; `state_process.channels.names` names the channels.

        Raises:
            ModelError: a model without a state of movement.
            FormatError: the file cannot be read.
            MotionError: a rig that cannot be retargeted.
        """
        if self.state_process is None:
            raise ModelError("state: this model was trained without the state of movement")
        motion = motion if isinstance(motion, Motion) else Motion.load(motion)
        vectors = self.representation.encode(on_rig(self.representation, motion.resample(self.fps)))
        channels = self.state_process.channels
        return measured(vectors, self.representation, channels, self.fps).T

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
    ) -> DiffusionModel:
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

        def assemble(parts: ModelParts) -> DiffusionModel:
            model = cls(**_arguments(parts, weights, str(place)))
            model.network.to(place, _DTYPES[dtype])
            return model

        return load_model(folder, cls.kind, assemble)


def _parts(
    model: TrainedModel,
) -> tuple[dict[str, Any], dict[str, Any], dict[str, Tensor]]:
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
    tensors |= {"motion.mean": model.normaliser.mean, "motion.scale": model.normaliser.scale}
    tensors |= model.conditions.to_tensors()
    tensors |= {} if process is None else state_tensors(process)
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


def _arguments(parts: ModelParts, weights: WeightPlaces | None, device: str) -> dict[str, Any]:
    """Return the fields of `TrainedModel` from a model folder; see `DiffusionModel.load`.

    Raises KeyError, TypeError, ValueError or RuntimeError for a damaged folder.
    """
    config, rig, tensors = parts.config, parts.rig, parts.tensors
    where = str(parts.folder / "config.yaml")
    fps = float(config["fps"])
    representation = DeltaRepresentation.from_json(
        Skeleton.from_json(rig["skeleton"]), rig["motion"]
    )
    channels = StateChannels.find(representation.skeleton, representation.joints)
    known = None if config["state"] is None else channels
    conditions = Conditions.from_values(config, tensors, fps, weights, device, known)
    n_speech = conditions.columns["speech"].stop
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
        "state_process": load_state(config["state"], tensors, channels, fps, n_speech),
        "droppable": tuple(map(str, config["droppable"])),
        "window": int(config["window"]),
        "clip_denoised": bool(config["clip_denoised"]),
    }
