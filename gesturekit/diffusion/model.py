"""A trained diffusion model: load it and generate motion from speech, a style, a path or events."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Literal, Unpack

import numpy as np
import torch
from torch import Tensor

from audio_features.weight_files import WeightPlaces
from gesturekit.corpus.speech import Speech, as_speech, to_output_rate
from gesturekit.diffusion.controls import DiffusionControlArguments, DiffusionControls
from gesturekit.diffusion.model_format import model_arguments, model_parts, readme
from gesturekit.diffusion.sampling.experts import clip_denoised
from gesturekit.diffusion.sampling.product import ModelProduct, Term, product_of
from gesturekit.diffusion.sampling.request import Request, SDEditStart, check_events
from gesturekit.diffusion.sampling.solvers import SOLVERS, Predict, chosen_steps, sample
from gesturekit.diffusion.sampling.tiling import tiled
from gesturekit.diffusion.trained_model import TrainedModel
from gesturekit.errors import ModelError, MotionError, gesturekit_errors
from gesturekit.motion.motion import Motion
from gesturekit.motion.resampling import checked_fps
from gesturekit.postprocess import lock_feet, smooth_motion
from gesturekit.progress import Progress
from gesturekit.training.model_folder import ModelParts, load_model, model_digest, save_model
from gesturekit.training.run.device import prepare_device, warn_of_slow_bfloat16
from gesturekit.training.seeds import checked_seed, rng_for

_DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16}


class DiffusionModel(TrainedModel):
    """Model that generates motion by denoising diffusion, from speech or music, a style, a path,
    events, or nothing."""

    @gesturekit_errors()
    def generate(
        self,
        speech: Speech | None = None,
        sample_rate: int | None = None,
        *,
        seconds: float | None = None,
        samples: int = 1,
        seed: int = 0,
        **controls: Unpack[DiffusionControlArguments],
    ) -> Motion | list[Motion]:
        """Generate motion as long as the speech, the path or `seconds`; frame k is at k / fps.

        Args:
            speech: an audio file, a `Wave`, or an array of samples (see `Wave.from_array`), of
                speech or music, for a model with speech input. Without it, such a model gets
                silence for `seconds`.
            sample_rate: of an array, in Hz.
            seconds: length without speech, in s.
            samples: number of different motions; more than one gives a list.
            seed: the same seed, request and sample number give the same motion.
            controls: the fields of `DiffusionControls`.

        Raises:
            ModelError: a control, style, event or speaker that this model does not have, experts
                that cannot be combined, or no length.
            AudioError, FormatError: a file cannot be read, or an array is not audio.
        """
        asked = DiffusionControls.build(controls, self.kind)
        seed, speech = checked_seed(seed), as_speech(speech, sample_rate)
        rate = self.recorded_fps if asked.fps is None else checked_fps(asked.fps)
        self._check(asked, samples)
        product = ModelProduct.build(self, asked)
        start = None if asked.like is None else SDEditStart.build(self, asked.like, asked.change)
        if start is not None and self.conditions.path and asked.path is None:
            asked = replace(asked, path=start.path)
        if start is not None and speech is None and seconds is None and asked.path is None:
            seconds = start.motion.duration
        request = Request.build(
            [model.conditions for model in product.models],
            self.fps,
            self.representation.scale,
            speech,
            seconds,
            asked,
        )
        smooth = self.smooth if asked.smooth is None else asked.smooth
        motions = []
        sampled = self._sampled(product.terms(request), request, asked, start, samples, seed)
        with closing(sampled) as batches:
            for motion in self._decoded(batches, request, asked, start):
                motion = smooth_motion(motion, smooth) if smooth else motion
                if asked.foot_lock:
                    motion = lock_feet(motion, keep_path=request.path is not None)
                motions.append(to_output_rate(motion, rate, request.wave, seconds))
        return motions[0] if samples == 1 else motions

    def check_controls(
        self, *, samples: int = 1, seed: int = 0, **controls: Unpack[DiffusionControlArguments]
    ) -> DiffusionControls:
        """Return the controls of `generate`, after the checks that do not depend on the speech.

        Raises:
            ModelError: a control, style, event or speaker that this model does not have, or
                experts that cannot be combined.
            FormatError: a table of events that cannot be read.
        """
        checked_seed(seed)
        asked = DiffusionControls.build(controls, self.kind)
        self._check(asked, samples)
        return asked

    def _check(self, controls: DiffusionControls, samples: int) -> None:
        speaker, solver = controls.speaker, controls.solver
        if speaker is not None and speaker not in self.speakers:
            known = ", ".join(sorted(self.speakers)) or "its corpus named none"
            raise ModelError(f"speaker={speaker!r}: the model does not know them ({known})")
        for name, value in {"samples": samples, "batch": controls.batch}.items():
            if value < 1:
                raise ModelError(f"{name}={value}: ask for at least 1")
        ModelProduct.build(self, controls).check_styles()
        if controls.events is not None:
            models = [self, *(expert[0] for expert in controls.experts)]
            check_events(controls.events, [model.conditions for model in models])
        if solver is not None and solver not in SOLVERS:
            raise ModelError(f"solver: {solver!r} is unknown; choose one of {', '.join(SOLVERS)}")
        if controls.like is None:
            chosen_steps(self.schedule, controls.steps)

    def _sampled(
        self,
        terms: Sequence[Term],
        request: Request,
        controls: DiffusionControls,
        start: SDEditStart | None,
        samples: int,
        seed: int,
    ) -> Generator[Tensor]:
        """Yield normalised motion vectors (B, T, X), batch by batch."""
        solver, steps, begin = controls.solver, controls.steps, None
        if solver is None:
            solver = "ancestral" if steps is None else "dpm"
        if start is not None:
            begin = (start.clean(request.n_frames), start.step)
            steps = None if steps is None else min(steps, start.step + 1)
        visited = len(chosen_steps(self.schedule, steps, None if start is None else start.step))
        clip = self.clip_denoised if controls.clip_denoised is None else controls.clip_denoised
        # One at a time by default: batching changes the order of sums, and the last digits of a
        # sample would depend on the number of samples.
        size = controls.batch
        batches = [range(k, min(k + size, samples)) for k in range(0, samples, size)]
        with Progress(total=len(batches) * visited, desc="Denoising", unit="step") as progress:
            for numbers in batches:
                predict = tiled(product_of(terms, seed, numbers), self.window)
                predict = clip_denoised(predict, self.schedule) if clip else predict
                predict = _counted(predict, progress)
                shape = (request.n_frames, self.network.n_motion)
                noise = _noise(seed, numbers, shape, self.device)
                yield sample(predict, noise, self.schedule, solver=solver, steps=steps, start=begin)

    def _decoded(
        self,
        batches: Iterable[Tensor],
        request: Request,
        controls: DiffusionControls,
        start: SDEditStart | None,
    ) -> Iterator[Motion]:
        """Yield a motion for each normalised motion vector in batches of (B, T, X)."""
        body = None if controls.speaker is None else self.speakers[controls.speaker]
        place = (0.0, 0.0, 0.0) if start is None else start.place
        for own in (vector for vectors in batches for vector in vectors.cpu()):
            values = self.normaliser.inverse(own).double().numpy()
            if not np.isfinite(values).all():
                raise ModelError(
                    "the model gave NaN; its weights are damaged or its training diverged"
                )
            try:
                yield self.representation.decode(
                    values, self.fps, skeleton=body, path=request.path, start=place
                )
            except MotionError as error:
                raise ModelError(
                    f"the generated motion is out of range ({error}); the model was trained too "
                    "little, or the expert weights are too extreme"
                ) from None

    def fingerprint(self) -> str:
        """Return the SHA-256 of what `save` writes, its README apart."""
        return model_digest(*model_parts(self))

    def save(self, folder: str | Path, *, notes: Mapping[str, str] | None = None) -> None:
        """Write the model folder: config.yaml, skeleton.json, model.safetensors, README.md."""
        save_model(folder, *model_parts(self), readme(self, notes or {}))

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
            model = cls(**model_arguments(parts, weights, str(place)))
            model.network.to(place, _DTYPES[dtype])
            return model

        return load_model(folder, cls.kind, assemble)


def _counted(predict: Predict, progress: Progress) -> Predict:
    """Return `predict` with an update of the progress bar before each call."""

    def counted(noisy: Tensor, step: int) -> Tensor:
        progress.update()
        return predict(noisy, step)

    return counted


def _noise(
    seed: int, numbers: Sequence[int], shape: tuple[int, int], device: torch.device
) -> Callable[[int], Tensor]:
    """Return the noise (B, T, X) of each step, keyed by seed, sample and step, from the CPU."""

    def noise_at(step: int) -> Tensor:
        rngs = (rng_for(seed, "sample", number, "noise", step) for number in numbers)
        return torch.stack([torch.randn(shape, generator=rng) for rng in rngs]).to(device)

    return noise_at
