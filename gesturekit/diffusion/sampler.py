"""Sampling of a request: check its controls, denoise, decode, smooth and lock feet.

The network's cost and memory are linear in the length: minutes are predicted at once, hours tile by
tile. Where two tiles overlap, their predictions are cross-faded at every denoising step: both tiles
continue from the same noisy motion, so there are no seams.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from gesturekit.diffusion.controls import DiffusionControls
from gesturekit.diffusion.experts import (
    Expert,
    Member,
    experts_of,
    predicted_noise,
    product,
    product_members,
)
from gesturekit.diffusion.noise_schedule import Predict, chosen_steps, clip_denoised, sample
from gesturekit.diffusion.request import Request, check_events
from gesturekit.errors import ModelError, MotionError
from gesturekit.motion.motion import Motion
from gesturekit.postprocess import lock_feet, smooth_motion
from gesturekit.progress import Progress
from gesturekit.training.clips import mixed_motions
from gesturekit.training.seeds import rng_for

if TYPE_CHECKING:
    from gesturekit.diffusion.model import DiffusionModel

OVERLAP = 150
"""Least overlap of neighbouring tiles in frames, or a quarter of a tile if that is less. Tiles are
cross-faded over the middle third of the overlap; each outer third belongs to the tile whose border
is farther away."""


def check_controls(
    model: DiffusionModel, controls: DiffusionControls, samples: int
) -> list[Member]:
    """Check the controls that do not depend on the speech, and return the models of the product.

    Raises:
        ModelError: a control, style, event or speaker that the model does not have, or experts that
            cannot be combined.
        FormatError: a table of events that cannot be read.
    """
    problems = [*model.problems(controls, samples)]
    if model.conditions.path:
        facing, in_place = controls["facing"], controls["in_place"]
        for name, value, unset in (("facing", facing, None), ("in_place", in_place, False)):
            if value != unset:
                problems.append(f"{name}={value}: the model follows a path, which places the body")
        if controls["keep"] is not None:
            problems.append("keep: this model follows a path, which moves the body")
    if problems:
        raise ModelError(problems[0])
    members = product_members(model, controls)
    if controls["events"] is not None:
        check_events(controls["events"], [member.model.conditions for member in members])
    if controls["like"] is None:
        chosen_steps(model.schedule, controls["steps"])
    return members


def sampled_motions(request: Request, samples: int) -> list[Motion]:
    """Generate the samples of a request with the numbers 0 to `samples` - 1."""
    model, controls, motions = request.model, request.controls, []
    smooth = model.smooth if controls["smooth"] is None else controls["smooth"]
    clip = model.clip_denoised if controls["clip_denoised"] is None else controls["clip_denoised"]
    steps, last = controls["steps"], None if request.start is None else request.start[1]
    solver = controls["solver"] or ("ancestral" if steps is None else "dpm")
    if steps is not None and last is not None:
        steps = min(steps, last + 1)
    visited = len(chosen_steps(model.schedule, steps, last))
    # One at a time by default: batching changes the order of sums, and the last digits of a
    # sample would depend on the number of samples.
    size = controls["batch"]
    batches = [range(k, min(k + size, samples)) for k in range(0, samples, size)]
    with Progress(total=len(batches) * visited, desc="Denoising", unit="step") as progress:
        for numbers in batches:
            experts = product(experts_of(request, numbers))
            predict = tiled(experts, request.n_frames, model.window)
            predict = clip_denoised(predict, model.schedule) if clip else predict
            if request.between is not None:
                predict = request.between.held(predict, model.schedule)
            vectors = sample(
                _counted(predict, progress),
                partial(_noise, request, numbers),
                model.schedule,
                solver=solver,
                steps=steps,
                start=request.start,
            )
            for number, vector in enumerate(vectors.cpu()):
                motion = _decoded(request, vector, number)
                motion = smooth_motion(motion, smooth) if smooth else motion
                if request.between is not None:
                    motion = request.between.blended(motion)
                motions.append(_finished(request, motion))
    return motions


def _finished(request: Request, motion: Motion) -> Motion:
    """Return the motion with locked feet, unless that is off, and with its given clips."""
    clips = None if request.between is None else request.between.clips
    if request.controls["foot_lock"]:
        keeps_path = request.path is not None or clips is not None
        locked = lock_feet(motion, keep_path=keeps_path)
        given = None if clips is None else clips.given(motion.n_frames)
        motion = locked if given is None else mixed_motions(locked, motion, given)
    return motion if clips is None else clips.restored(motion)


def _decoded(request: Request, vector: Tensor, number: int) -> Motion:
    """Return the motion of a normalised motion vector (T, X), with this number in its batch."""
    model, speaker = request.model, request.controls["speaker"]
    values = model.normaliser.inverse(vector).double().numpy()
    if request.between is not None:
        values = request.between.free(number)
    if not np.isfinite(values).all():
        raise ModelError("the model gave NaN; its weights are damaged or its training diverged")
    try:
        return model.representation.decode(
            values,
            model.fps,
            skeleton=None if speaker is None else model.speakers[speaker],
            path=request.path,
            start=request.place,
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


def _noise(request: Request, numbers: Sequence[int], step: int) -> Tensor:
    """Return the noise (B, T, X) of a step, from (seed, item, sample, step), on the CPU."""
    seed, item, model = request.seed, request.item, request.model
    rngs = (rng_for(seed, item, "sample", number, "noise", step) for number in numbers)
    shape = (request.n_frames, model.network.n_motion)
    return torch.stack([torch.randn(shape, generator=rng) for rng in rngs]).to(model.device)


@dataclass(frozen=True, eq=False)
class Tile:
    """Frames first (included) to last (excluded), with weights (last - first,) float32."""

    first: int
    last: int
    weights: np.ndarray


def tiles_of(n_frames: int, size: int) -> list[Tile]:
    """Return evenly spaced tiles of at most `size` frames; weights add up to 1 at each frame.

    Raises:
        ModelError: tiles of less than four frames.
    """
    if size < 4:
        raise ModelError(f"window: {size} frames; give at least 4")
    if n_frames <= size:
        return [Tile(0, n_frames, np.ones(n_frames, np.float32))]
    overlap = min(OVERLAP, size // 4)
    count = -(-(n_frames - overlap) // (size - overlap))
    size = -(-(n_frames + (count - 1) * overlap) // count)
    starts = [round(k * (n_frames - size) / (count - 1)) for k in range(count)]
    rising = [np.ones(size)]
    for before, start in zip(starts, starts[1:], strict=False):
        shared = before + size - start
        third = shared / 3
        rising.append(np.clip((np.arange(size) + 0.5 - third) / third, 0.0, 1.0))
    tiles = []
    for k, start in enumerate(starts):
        weights = rising[k].copy()
        if k + 1 < count:
            shared = starts[k + 1] - start
            weights[shared:] -= rising[k + 1][: size - shared]
        tiles.append(Tile(start, start + size, weights.astype(np.float32)))
    return tiles


def tiled(experts: Sequence[Expert], n_frames: int, size: int) -> Predict:
    """Return the prediction of a product, in tiles of `size` frames if the motion is longer.

    In each tile, only experts with a weight there are run. No state that grows with the length is
    kept between two calls.
    """
    tiles = tiles_of(n_frames, size)
    if len(tiles) == 1:
        return lambda noisy, step: predicted_noise(experts, noisy, step)

    def predict(noisy: Tensor, step: int) -> Tensor:
        total = torch.zeros_like(noisy)
        for tile in tiles:
            frames = slice(tile.first, tile.last)
            weights = torch.from_numpy(tile.weights).to(noisy.device, noisy.dtype)
            predicted = predicted_noise(_within(experts, frames), noisy[:, frames], step)
            total[:, frames] += weights[:, None] * predicted
        return total

    return predict


def _within(experts: Sequence[Expert], frames: slice) -> list[Expert]:
    """Return the experts with a weight in these frames, cut to them."""
    cut = [
        replace(
            expert,
            condition=expert.condition[:, frames],
            weight=expert.weight[frames] if expert.weight.size > 1 else expert.weight,
        )
        for expert in experts
    ]
    return [expert for expert in cut if np.abs(expert.weight).max() > 0]
