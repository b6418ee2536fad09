"""A trained diffusion model: load it, tell it speech, a style, a path, events, get motion."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from gesturekit.corpus.speech import Speech, as_speech, at_rate
from gesturekit.diffusion.composition.experts import bounded
from gesturekit.diffusion.composition.product import Product
from gesturekit.diffusion.conditions import Conditions
from gesturekit.diffusion.config import NetworkConfig, NoiseConfig
from gesturekit.diffusion.motion_vector import DeltaRepresentation
from gesturekit.diffusion.network.denoiser import Denoiser
from gesturekit.diffusion.sampling.noise_schedule import NoiseSchedule
from gesturekit.diffusion.sampling.request import Request, check_events
from gesturekit.diffusion.sampling.sdedit import CHANGE, Start
from gesturekit.diffusion.sampling.solvers import SOLVERS, Predict, Solver, chosen_steps, sample
from gesturekit.diffusion.sampling.tiling import LONGEST, windowed
from gesturekit.diffusion.standardiser import Standardiser
from gesturekit.errors import ModelError, MotionError, gesturekit_errors
from gesturekit.model import Inputs
from gesturekit.motion.motion import Motion
from gesturekit.motion.resampling import checked_fps
from gesturekit.motion.root_path import RootPath
from gesturekit.motion.skeleton import Skeleton
from gesturekit.postprocess import lock_feet, smooth_motion
from gesturekit.progress import Progress
from gesturekit.training.config import build, to_dict
from gesturekit.training.model_folder import (
    ModelParts,
    load_model,
    model_readme,
    rates,
    save_model,
)
from gesturekit.training.run.device import prepare_device, warn_of_slow_bfloat16
from gesturekit.training.seeds import checked_seed, rng_for

_DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16}


class DiffusionModel:
    """Motion by denoising diffusion: for speech or music, a style, a path, events, or nothing.

    Args:
        fps: frames per second at which the network works.
        representation: the rig and its modelled joints.
        conditions: what the model can be told.
        standardiser: of motion vectors.
        network_config: how the network is built.
        noise_config: how noise was added in training.
        network: the denoiser.
        speakers: a reference skeleton for each speaker that the corpus named.
        droppable: what the model was trained to do without at times: "styles", or "all" that it
            is told. Guidance leads away from that.
        window: frames of the longest motion that is made as a whole.
        smooth: seconds, of `smooth_motion` on what is generated; None for none.
        recorded_fps: the recordings' rate, which generated motion gets; None for `fps`.
    """

    kind = "diffusion"
    folder: Path | None = None

    def __init__(
        self,
        *,
        fps: float,
        representation: DeltaRepresentation,
        conditions: Conditions,
        standardiser: Standardiser,
        network_config: NetworkConfig,
        noise_config: NoiseConfig,
        network: Denoiser,
        speakers: Mapping[str, Skeleton],
        droppable: Collection[str] = (),
        window: int = LONGEST,
        smooth: float | None = None,
        recorded_fps: float | None = None,
    ) -> None:
        self.fps = fps
        self.representation = representation
        self.conditions = conditions
        self.standardiser = standardiser
        self.network_config = network_config
        self.noise_config = noise_config
        self.schedule = NoiseSchedule.of(noise_config)
        self.network = network.eval()
        self.speakers = dict(speakers)
        self.droppable = tuple(droppable)
        self.window = window
        self.smooth = smooth
        self.recorded_fps = fps if recorded_fps is None else recorded_fps

    @property
    def skeleton(self) -> Skeleton:
        """The rig, with all the joints of the training files."""
        return self.representation.skeleton

    @property
    def styles(self) -> tuple[str, ...]:
        """Names of the styles it knows; empty for a model that was told none."""
        return self.conditions.styles

    @property
    def inputs(self) -> Inputs:
        """Inputs besides style and speaker."""
        conditions = self.conditions
        has_speech = conditions.conditioner is not None
        return Inputs(speech=has_speech, path=conditions.path, events=conditions.events)

    @gesturekit_errors()
    def generate(
        self,
        speech: Speech | None = None,
        sample_rate: int | None = None,
        *,
        style: str | None = None,
        path: str | Path | RootPath | Motion | None = None,
        events: str | Path | None = None,
        seconds: float | None = None,
        samples: int = 1,
        seed: int = 0,
        guidance: float | None = None,
        unconditional: DiffusionModel | None = None,
        experts: Sequence[tuple] = (),
        like: str | Path | Motion | None = None,
        change: float = CHANGE,
        speaker: str | None = None,
        foot_lock: bool = True,
        smooth: float | None = None,
        solver: Solver | None = None,
        steps: int | None = None,
        batch: int = 1,
        fps: float | None = None,
    ) -> Motion | list[Motion]:
        """Motion, as long as the speech, the path or `seconds`; frame k is at k / fps.

        Args:
            speech: an audio file, a `Wave`, or an array of samples (see `Wave.from_array`), speech
                or music, for a model that hears. Without it, such a model moves to silence for
                `seconds`.
            sample_rate: Hz, of an array.
            style: one of `styles`, weights of several, or either over time; see `style_weights`.
                Styles are mixed as products of experts: each is predicted by itself. None draws
                one for each sample.
            path: what the root follows, for a model of that kind: a table or motion file, see
                `load_root_path`. It is smoothed over a third of a second.
            events: what happens when, for a model that knows events; see `asked_events`.
            seconds: length without speech, s.
            samples: how many different motions to make; more than one gives a list.
            seed: the same seed, request and sample number give the same motion.
            guidance: gamma of classifier-free guidance (eq. 6): 1 is the model as it is, above 1
                exaggerates, 0 leaves the style out. For a model without styles, all that it is
                told takes the style's place.
            unconditional: the model that guidance leads away from; by default this one, told less.
            experts: further models of a product: (model, weight), (model, weight, style); see
                `Product`. This model's own weight is what is left of 1.
            like: a motion, of any rig of a person, to begin from in place of noise: done in the
                manner of the model, where it was. It gives the length where nothing else does, and
                the path, for a model that follows one.
            change: how much of it may change, from just above 0 (all but nothing) to 1 (all of
                it): how far it is noised before the model goes on from it, see `Start`.
            speaker: whose body to move: one of `speakers`; None takes the reference skeleton.
            foot_lock: keep feet where they stand; see `gesturekit.postprocess`. False gives the
                motion as it comes out of the network.
            smooth: seconds; movements of the upper body that are shorter are smoothed away, but for
                its beats, see `gesturekit.postprocess.smooth_motion`. None takes what the model was
                trained to be given (its `smooth`), 0 smooths nothing.
            solver: "ancestral" as published, "ddim", or "dpm"; None takes "ancestral" for all
                steps and "dpm" for fewer.
            steps: how many denoising steps; None for all that the model was trained with.
            batch: how many samples to make at once. More are faster on a GPU. Motions then differ
                in their last digits from those that are made one by one.
            fps: frames per second of the motion, made at the model's own rate and resampled; None
                takes the recordings' rate.

        Raises:
            ModelError: a control, style, event or speaker this model does not have, experts that
                do not go together, or no length.
            AudioError, FormatError: a file cannot be read, or an array is no sound.
        """
        seed = checked_seed(seed)
        speech = as_speech(speech, sample_rate)
        rate = self.recorded_fps if fps is None else checked_fps(fps)
        self.check_controls(
            samples=samples,
            speaker=speaker,
            batch=batch,
            style=style,
            guidance=guidance,
            unconditional=unconditional,
            experts=experts,
            events=events,
            solver=solver,
            steps=steps if like is None else None,
        )
        product = Product.of(self, style, guidance, unconditional, experts)
        start = None if like is None else Start.of(self, like, change)
        if start is not None and self.conditions.path and path is None:
            path = start.path
        if start is not None and speech is None and seconds is None and path is None:
            seconds = start.motion.duration
        request = Request.of(
            [model.conditions for model in product.models],
            self.fps,
            scale=self.representation.scale,
            speech=speech,
            seconds=seconds,
            path=path,
            events=events,
        )
        if solver is None:
            solver = "ancestral" if steps is None else "dpm"
        told = product.told(request)
        begin, place = None, (0.0, 0.0, 0.0)
        if start is not None:
            begin, place = (start.clean(request.n_frames), start.step), start.place
            steps = None if steps is None else min(steps, start.step + 1)
        visited = len(chosen_steps(self.schedule, steps, None if start is None else start.step))

        def finished(motion: Motion) -> Motion:
            if seconds_smoothed := self.smooth if smooth is None else smooth:
                motion = smooth_motion(motion, seconds_smoothed)
            if foot_lock:
                motion = lock_feet(motion, keep_path=request.path is not None)
            return at_rate(motion, rate, request.wave, seconds)

        motions: list[Motion] = []
        # One at a time unless asked otherwise: in a batch, sums are made in another order, and a
        # motion would depend on how many were asked for.
        batches = [range(k, min(k + batch, samples)) for k in range(0, samples, batch)]
        with Progress(total=len(batches) * visited, desc="Denoising", unit="step") as progress:
            for numbers in batches:
                predict = windowed(told.mixture(seed, numbers), self.window)
                predict = _counted(bounded(predict, self.schedule), progress)
                shape = (request.n_frames, self.network.n_motion)
                noise = _Noise(seed, numbers, shape, self.device)
                vectors = sample(
                    predict, noise, self.schedule, solver=solver, steps=steps, start=begin
                )
                motions += map(finished, self._motions(vectors, request.path, place, speaker))
        return motions[0] if samples == 1 else motions

    def check_controls(
        self,
        *,
        samples: int = 1,
        seed: int = 0,
        speaker: str | None = None,
        batch: int = 1,
        style: str | None = None,
        guidance: float | None = None,
        unconditional: DiffusionModel | None = None,
        experts: Sequence[tuple] = (),
        events: str | Path | None = None,
        solver: Solver | None = None,
        steps: int | None = None,
        **others: object,
    ) -> None:
        """Check the controls of `generate` that do not depend on the speech.

        Raises:
            ModelError: a control, style, event or speaker that this model does not have, or
                experts that do not go together.
            FormatError: a table of events that cannot be read.
        """
        checked_seed(seed)
        if speaker is not None and speaker not in self.speakers:
            known = ", ".join(sorted(self.speakers)) or "its corpus named none"
            raise ModelError(f"speaker={speaker!r}: the model does not know them ({known})")
        for name, value in {"samples": samples, "batch": batch}.items():
            if value < 1:
                raise ModelError(f"{name}={value}: ask for at least 1")
        Product.of(self, style, guidance, unconditional, experts).check_styles()
        if events is not None:
            models = [self, *(expert[0] for expert in experts)]
            check_events(events, [model.conditions for model in models])
        if solver is not None and solver not in SOLVERS:
            raise ModelError(f"solver: {solver!r} is unknown; choose one of {', '.join(SOLVERS)}")
        if others.get("like") is None:
            chosen_steps(self.schedule, steps)

    @property
    def device(self) -> torch.device:
        """Where the network is."""
        return next(self.network.parameters()).device

    def _motions(
        self,
        vectors: Tensor,
        path: RootPath | None,
        place: tuple[float, float, float],
        speaker: str | None,
    ) -> Iterator[Motion]:
        """Motions of standardised vectors (B, T, X), that begin at a place or follow a path."""
        body = None if speaker is None else self.speakers[speaker]
        for own in vectors.cpu():
            values = self.standardiser.inverse(own).double().numpy()
            if not np.isfinite(values).all():
                raise ModelError(
                    "the model gave NaN; its weights are damaged or it was trained badly"
                )
            try:
                yield self.representation.decode(
                    values, self.fps, skeleton=body, path=path, start=place
                )
            except MotionError as error:
                raise ModelError(
                    f"the model left the world ({error}); it was trained too little, or the "
                    "product's weights are too extreme"
                ) from None

    def save(self, folder: str | Path, *, notes: Mapping[str, str] | None = None) -> None:
        """Write the model folder: config.yaml, skeleton.json, model.safetensors, README.md."""
        config = {
            "kind": self.kind,
            "fps": self.fps,
            "recorded_fps": self.recorded_fps,
            "joints": list(self.representation.joints),
            **self.conditions.to_values(),
            "droppable": list(self.droppable),
            "window": self.window,
            "smooth": self.smooth,
            "noise": to_dict(self.noise_config),
            "network": to_dict(self.network_config),
        }
        rig = {
            "skeleton": self.skeleton.to_json(),
            "motion": self.representation.to_json(),
            "speakers": {name: body.to_json() for name, body in self.speakers.items()},
        }
        tensors = {f"network.{name}": value for name, value in self.network.state_dict().items()}
        tensors |= {"motion.mean": self.standardiser.mean, "motion.scale": self.standardiser.scale}
        tensors |= self.conditions.to_tensors()
        save_model(folder, config, rig, tensors, self._readme(notes or {}))

    def _readme(self, notes: Mapping[str, str]) -> str:
        network, told = self.network_config, self.conditions
        layers = f" of {network.layers} layers" if network.architecture == "conformer" else ""
        rows = {
            "Kind": f"diffusion, {network.architecture}, {network.blocks} blocks{layers}, "
            f"{self.noise_config.steps} steps",
            "Motion": f"{rates(self.fps, self.recorded_fps)}, {len(self.representation.joints)} of "
            f"{self.skeleton.n_joints} joints modelled",
        }
        call = []
        if told.conditioner is not None:
            rows["Hears"] = json.dumps(told.conditioner.extractor.spec)
            call.append('"speech.wav"')
        if told.path:
            rows["Path"] = "the root follows a path that is given"
            call.append('path="path.csv"')
        if not call:
            call.append("seconds=10")
        if told.events:
            rows["Events"] = ", ".join(told.events)
            call.append(f'events="{told.events[0]}@1.0"')
        if told.styles:
            rows["Styles"] = ", ".join(told.styles)
            call.append(f'style="{told.styles[0]}"')
        if self.droppable:
            dropped = {"styles": "its style", "all": "anything that it is told"}
            parts = " or ".join(dropped[name] for name in self.droppable)
            rows["Guidance"] = f"trained without {parts} at times"
            call.append("guidance=1.5")
        return model_readme(rows | notes, ", ".join(call))

    @classmethod
    def load(
        cls,
        folder: str | Path,
        *,
        weights: str | Path | None = None,
        device: str = "cpu",
        dtype: Literal["fp32", "bf16"] = "fp32",
    ) -> DiffusionModel:
        """Read a model folder.

        Args:
            folder: as written by `save`.
            weights: the WavLM weights it was trained with, where it hears by WavLM.
            device: where the denoiser and WavLM compute: auto, cpu, cuda, cuda:1 ...
            dtype: the denoiser's arithmetic; `bf16` is faster and takes half the memory on
                processors that have it, and a network's prediction is then about 1 % off.

        Raises:
            ModelError: a part is missing, damaged, or of a newer format; an unknown dtype.
            WeightsError: weights are asked for, or are not those of training.
            ConfigError: there is no such device.
        """
        if dtype not in _DTYPES:
            raise ModelError(f"dtype={dtype!r}: choose one of {', '.join(_DTYPES)}")
        place = prepare_device(device)
        if dtype == "bf16":
            warn_of_slow_bfloat16(place)
        model = load_model(
            folder, cls.kind, lambda parts: cls._assemble(parts, weights, str(place))
        )
        model.network.to(place, _DTYPES[dtype])
        return model

    @classmethod
    def _assemble(
        cls, parts: ModelParts, weights: str | Path | None, device: str
    ) -> DiffusionModel:
        config, rig, tensors = parts.config, parts.rig, parts.tensors
        where = str(parts.folder / "config.yaml")
        fps, recorded_fps = float(config["fps"]), config.get("recorded_fps")
        skeleton = Skeleton.from_json(rig["skeleton"])
        representation = DeltaRepresentation.from_json(skeleton, rig["motion"])
        conditions = Conditions.from_values(config, tensors, fps, weights, device)
        network_config = build(NetworkConfig, config["network"], where=where)
        n_motion = representation.n_features
        standardiser = Standardiser(tensors["motion.mean"], tensors["motion.scale"])
        for name, values in vars(standardiser).items():
            if values.shape != (n_motion,) or not torch.isfinite(values).all():
                raise ValueError(f"motion.{name} is not {n_motion} finite numbers")
        if representation.makes_root == conditions.path:
            raise ValueError("config.yaml and skeleton.json differ in whether there is a path")
        network = Denoiser(n_motion, conditions.width, network_config)
        network.load_state_dict(
            {k.removeprefix("network."): v for k, v in tensors.items() if k.startswith("network.")}
        )
        return cls(
            fps=fps,
            representation=representation,
            conditions=conditions,
            standardiser=standardiser,
            network_config=network_config,
            noise_config=build(NoiseConfig, config["noise"], where=where),
            network=network,
            speakers={name: Skeleton.from_json(body) for name, body in rig["speakers"].items()},
            droppable=tuple(map(str, config["droppable"])),
            window=int(config["window"]),
            smooth=None if config.get("smooth") is None else float(config["smooth"]),
            recorded_fps=None if recorded_fps is None else checked_fps(recorded_fps),
        )


def _counted(predict: Predict, progress: Progress) -> Predict:
    """The same prediction, each of them a step of the progress bar."""

    def counted(noisy: Tensor, step: int) -> Tensor:
        progress.update()
        return predict(noisy, step)

    return counted


class _Noise:
    """Standard normal noise, keyed by seed, sample number and step, drawn on the CPU."""

    def __init__(
        self, seed: int, numbers: Sequence[int], shape: tuple[int, int], device: torch.device
    ) -> None:
        self.seed, self.numbers, self.shape, self.device = seed, numbers, shape, device

    def __call__(self, step: int) -> Tensor:
        """(B, T, X)."""
        drawn = [
            torch.randn(self.shape, generator=rng_for(self.seed, "sample", n, "noise", step))
            for n in self.numbers
        ]
        return torch.stack(drawn).to(self.device)
