"""A trained diffusion model: generate motion from speech, a style, a path or events."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Unpack

import numpy as np
import torch
from torch import Tensor

from audio_features.weight_files import WeightPlaces
from gesturekit.corpus.speech import Speech, as_speech, to_output_rate
from gesturekit.diffusion.conditions import Conditions
from gesturekit.diffusion.config import NetworkConfig, NoiseConfig
from gesturekit.diffusion.controls import DiffusionControls
from gesturekit.diffusion.motion_vector import DeltaRepresentation, Normaliser, measured_state
from gesturekit.diffusion.network import Denoiser
from gesturekit.diffusion.noise_schedule import NoiseSchedule
from gesturekit.diffusion.request import Request, check_controls
from gesturekit.diffusion.sampler import sampled_motions
from gesturekit.errors import ModelError, gesturekit_errors
from gesturekit.model import Inputs, MotionStream, build_controls, document_controls
from gesturekit.motion.motion import Motion
from gesturekit.motion.skeleton import Skeleton
from gesturekit.state.channels import StateChannels
from gesturekit.state.process import load_state, state_values
from gesturekit.training.config import build, to_dict
from gesturekit.training.model_folder import ModelParts, TrainedModel, with_faces
from gesturekit.training.seeds import checked_draw

MAX_FRAMES = 9000
"""Frames that are generated without tiling: five minutes at 30 fps. At gesture size, each thousand
frames take about 35 MB, one hour 4 GB; the time per frame does not depend on the length."""


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class DiffusionModel(TrainedModel):
    """Model that generates motion by denoising diffusion, from speech or music, a style, a path,
    events, or nothing.

    Attributes (beside those of `TrainedModel`):
        noise_config: settings of the noise schedule.
        droppable: conditions dropped in training, which guidance needs: "styles", "state", or "all"
            but the state.
        window: frames of the longest motion that is generated without tiling.
        clip_denoised: whether generation clips the predicted clean motion, see `DiffusionConfig`.
    """

    kind: ClassVar[str] = "diffusion"
    dtypes: ClassVar[tuple[str, ...]] = ("fp32", "bf16")

    representation: DeltaRepresentation
    conditions: Conditions
    normaliser: Normaliser
    noise_config: NoiseConfig
    network: Denoiser
    droppable: tuple[str, ...] = ()
    window: int = MAX_FRAMES
    clip_denoised: bool = True

    @cached_property
    def schedule(self) -> NoiseSchedule:
        """Variances of the steps of diffusion."""
        return NoiseSchedule.of(self.noise_config)

    @property
    def inputs(self) -> Inputs:
        """Inputs besides style and speaker."""
        return replace(super().inputs, path=self.conditions.path, events=self.conditions.events)

    @property
    def device(self) -> torch.device:
        """The device that holds the network."""
        return next(self.network.parameters()).device

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
        seed, item = checked_draw(seed, item)
        speech = as_speech(speech, sample_rate)
        rate = self.recorded_fps if asked["fps"] is None else asked["fps"]
        members = check_controls(self, asked, samples)
        request = Request(members, asked, speech, seconds, seed, item)
        motions = [
            to_output_rate(request.placement.applied(motion), rate, request.wave, request.seconds)
            for motion in sampled_motions(request, samples)
        ]
        motions = with_faces(motions, request.wave, asked, seed, item)
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
        checked_draw(seed)
        asked = build_controls(DiffusionControls, controls, self.kind)
        check_controls(self, asked, samples)
        return asked

    def stream(self, *args: Any, **keywords: Any) -> MotionStream:
        """Raise ModelError: the model cannot stream."""
        others = (
            "multires models with acoustic features and a state of movement, as own_corpus, can"
        )
        raise ModelError(f"a {self.kind} model makes whole motions and cannot stream: {others}")

    def _measured_state(self, vectors: np.ndarray) -> np.ndarray:
        """Return the state of movement (C, T) of motion vectors (T, X), in their own units."""
        assert self.state_process is not None
        channels = self.state_process.channels
        return measured_state(vectors, self.representation, channels, self.fps)

    def _contents(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """Return what a diffusion model adds to config.yaml and model.safetensors."""
        config = {
            **self.conditions.to_values(),
            "droppable": list(self.droppable),
            "window": self.window,
            "clip_denoised": self.clip_denoised,
            "smooth": self.smooth,
            "state": None if self.state_process is None else state_values(self.state_process),
            "noise": to_dict(self.noise_config),
            "network": to_dict(self.network.config),
        }
        return config, self.conditions.path_tensors()

    def _readme(self) -> tuple[dict[str, str], str]:
        """Return the facts of README.md, and the arguments of `generate` in its example."""
        network, given = self.network.config, self.conditions
        layers = f" of {network.layers} layers" if network.architecture == "conformer" else ""
        kind = f"diffusion, {network.architecture}, {network.blocks} blocks{layers}, "
        rows = {"Kind": f"{kind}{self.noise_config.steps} steps", **self._common_rows()}
        call = [] if given.conditioner is None else ['"speech.wav"']
        if given.path:
            rows["Path"] = "the root follows a given path"
            call.append('path="path.csv"')
        call = call or ["seconds=10"]
        if given.events:
            rows["Events"] = ", ".join(given.events)
            call.append(f'events="{given.events[0]}@1.0"')
        if given.styles:
            rows["Styles"] = ", ".join(given.styles)
            call.append(f'style="{given.styles[0]}"')
        rows |= self._state_rows()
        if self.droppable:
            names = {"styles": "style", "all": "all conditions", "state": "the state of movement"}
            dropped = " and ".join(names[name] for name in self.droppable)
            rows["Guidance"] = f"trained with dropout of {dropped}"
            call.append("guidance=1.5")
        return rows, ", ".join(call)

    @classmethod
    def _fields(
        cls,
        parts: ModelParts,
        weights: WeightPlaces | None,
        device: torch.device,
        dtype: torch.dtype,
    ) -> dict[str, Any]:
        """Return the fields of a folder that are a diffusion model's own; see `load`."""
        config, where = parts.config, str(parts.folder / "config.yaml")
        fitted = read_fitted({**config, **parts.rig}, parts.tensors, weights, str(device))
        representation, conditions = fitted["representation"], fitted["conditions"]
        if representation.makes_root == conditions.path:
            raise ValueError("config.yaml and skeleton.json differ in whether there is a path")
        network_config = build(NetworkConfig, config["network"], where=where)
        network = Denoiser(representation.n_features, conditions.width, network_config)
        network.load_state_dict(parts.tensors_under("network."))
        return {
            **fitted,
            "noise_config": build(NoiseConfig, config["noise"], where=where),
            "network": network.to(device, dtype),
            "droppable": tuple(map(str, config["droppable"])),
            "window": int(config["window"]),
            "clip_denoised": bool(config["clip_denoised"]),
        }


def read_fitted(
    values: Mapping[str, Any],
    tensors: Mapping[str, Tensor],
    weights: WeightPlaces | None,
    device: str,
) -> dict[str, Any]:
    """Return the fields of what training fits to its recordings.

    These are `representation`, `conditions`, `normaliser` and `state_process`.

    Args:
        values: with `rig_values`, `Conditions.to_values`, `fps`, and `state`: `state_values` or
            None.
        tensors: with those of `fitted_tensors` and `Conditions.path_tensors`.
        weights: see `DiffusionModel.load`.
        device: where encoders compute.

    Raises KeyError, TypeError, ValueError or RuntimeError for damaged values.
    """
    state, fps = values["state"], float(values["fps"])
    representation = DeltaRepresentation.from_json(
        Skeleton.from_json(values["skeleton"]), values["motion"]
    )
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
