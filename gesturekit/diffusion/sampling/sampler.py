"""Sampling of a request: check its controls, denoise, decode, smooth and lock feet."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import closing

import numpy as np
import torch
from torch import Tensor

from gesturekit.diffusion.controls import DiffusionControls
from gesturekit.diffusion.sampling.drawn_state import check_guidance
from gesturekit.diffusion.sampling.experts import clip_denoised
from gesturekit.diffusion.sampling.product import ModelProduct, product_of
from gesturekit.diffusion.sampling.request import Request, check_events
from gesturekit.diffusion.sampling.solvers import Predict, chosen_steps, sample
from gesturekit.diffusion.sampling.tiling import tiled
from gesturekit.diffusion.trained_model import TrainedModel
from gesturekit.errors import ModelError, MotionError
from gesturekit.motion.motion import Motion
from gesturekit.postprocess import lock_feet, smooth_motion
from gesturekit.progress import Progress
from gesturekit.state.files import check_drawn
from gesturekit.training.seeds import rng_for


def check_controls(model: TrainedModel, controls: DiffusionControls, samples: int) -> ModelProduct:
    """Check the controls that do not depend on the speech, and return the product of models.

    Raises:
        ModelError: a control, style, event or speaker that the model does not have, or experts that
            cannot be combined.
        FormatError: a table of events that cannot be read.
    """
    speaker = controls["speaker"]
    if speaker is not None and speaker not in model.speakers:
        known = ", ".join(sorted(model.speakers)) or "its corpus named none"
        raise ModelError(f"speaker={speaker!r}: the model does not know them ({known})")
    if samples < 1:
        raise ModelError(f"samples={samples}: ask for at least 1")
    if model.conditions.path:
        facing, in_place = controls["facing"], controls["in_place"]
        for name, value, unset in (("facing", facing, None), ("in_place", in_place, False)):
            if value != unset:
                raise ModelError(f"{name}={value}: the model follows a path, which places the body")
    check_drawn(controls, model.state_process)
    check_guidance(controls, model)
    product = ModelProduct.build(model, controls)
    product.check_styles()
    if controls["events"] is not None:
        models = [model, *(expert[0] for expert in controls["experts"])]
        check_events(controls["events"], [one.conditions for one in models])
    if controls["like"] is None:
        chosen_steps(model.schedule, controls["steps"])
    return product


class Sampler:
    """Generate the motions of a request.

    Args:
        model: the trained model.
        product: the models whose predictions are combined; the first is `model`.
        request: the request.
    """

    def __init__(self, model: TrainedModel, product: ModelProduct, request: Request) -> None:
        self.model, self.product, self.request = model, product, request

    def motions(self, seed: int, item: str, samples: int) -> list[Motion]:
        """Generate the samples of an item with the numbers 0 to `samples` - 1."""
        request, smooth = self.request, self.request.controls["smooth"]
        smooth = self.model.smooth if smooth is None else smooth
        motions = []
        with closing(self._vectors(seed, item, samples)) as batches:
            for vector in (vector for vectors in batches for vector in vectors.cpu()):
                motion = self._decoded(vector)
                motion = smooth_motion(motion, smooth) if smooth else motion
                if request.controls["foot_lock"]:
                    motion = lock_feet(motion, keep_path=request.path is not None)
                motions.append(motion)
        return motions

    def _vectors(self, seed: int, item: str, samples: int) -> Generator[Tensor]:
        """Yield normalised motion vectors (B, T, X), batch by batch."""
        model, request, start = self.model, self.request, self.request.start
        controls, terms, begin = request.controls, self.product.terms(request), None
        steps = controls["steps"]
        solver = controls["solver"] or ("ancestral" if steps is None else "dpm")
        if start is not None:
            begin = (start.clean(request.n_frames), start.step)
            steps = None if steps is None else min(steps, start.step + 1)
        visited = len(chosen_steps(model.schedule, steps, None if start is None else start.step))
        clip = controls["clip_denoised"]
        clip = model.clip_denoised if clip is None else clip
        # One at a time by default: batching changes the order of sums, and the last digits of a
        # sample would depend on the number of samples.
        size = controls["batch"]
        batches = [range(k, min(k + size, samples)) for k in range(0, samples, size)]
        with Progress(total=len(batches) * visited, desc="Denoising", unit="step") as progress:
            for numbers in batches:
                predict = tiled(product_of(terms, seed, item, numbers), model.window)
                predict = clip_denoised(predict, model.schedule) if clip else predict
                predict = _counted(predict, progress)
                shape = (request.n_frames, model.network.n_motion)
                noise = _noise(seed, item, numbers, shape, model.device)
                yield sample(
                    predict, noise, model.schedule, solver=solver, steps=steps, start=begin
                )

    def _decoded(self, vector: Tensor) -> Motion:
        """Return the motion of a normalised motion vector (T, X)."""
        model, request = self.model, self.request
        speaker, start = request.controls["speaker"], request.start
        values = model.normaliser.inverse(vector).double().numpy()
        if not np.isfinite(values).all():
            raise ModelError("the model gave NaN; its weights are damaged or its training diverged")
        try:
            return model.representation.decode(
                values,
                model.fps,
                skeleton=None if speaker is None else model.speakers[speaker],
                path=request.path,
                start=(0.0, 0.0, 0.0) if start is None else start.place,
            )
        except MotionError as error:
            raise ModelError(
                f"the generated motion is out of range ({error}); the model was trained too "
                "little, or the expert weights are too extreme"
            ) from None


def _counted(predict: Predict, progress: Progress) -> Predict:
    """Return `predict` with an update of the progress bar before each call."""

    def counted(noisy: Tensor, step: int) -> Tensor:
        progress.update()
        return predict(noisy, step)

    return counted


def _noise(
    seed: int, item: str, numbers: Sequence[int], shape: tuple[int, int], device: torch.device
) -> Callable[[int], Tensor]:
    """Return the noise (B, T, X) of each step, from (seed, item, sample, step), on the CPU."""

    def noise_at(step: int) -> Tensor:
        rngs = (rng_for(seed, item, "sample", number, "noise", step) for number in numbers)
        return torch.stack([torch.randn(shape, generator=rng) for rng in rngs]).to(device)

    return noise_at
