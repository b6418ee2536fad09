"""Sampling of a request: denoise, in tiles and around given clips, decode, smooth and lock feet.

The network's cost and memory are linear in the length: minutes are predicted at once, hours tile by
tile. Where two tiles overlap, their predictions are cross-faded at every denoising step: both tiles
continue from the same noisy motion, so there are no seams.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy import sparse
from scipy.sparse.linalg import spsolve
from torch import Tensor

from gesturekit.diffusion.experts import Expert, experts_of, predicted_noise, product
from gesturekit.diffusion.noise_schedule import (
    NoiseSchedule,
    Predict,
    chosen_steps,
    clip_denoised,
    sample,
)
from gesturekit.diffusion.request import Request
from gesturekit.errors import ModelError, MotionError
from gesturekit.motion.motion import Motion
from gesturekit.motion.resampling import smoothstep
from gesturekit.motion.root_path import RootPath
from gesturekit.postprocess import lock_feet, smooth_motion
from gesturekit.progress import Progress
from gesturekit.training.clips import InbetweenClips, mixed_motions
from gesturekit.training.seeds import rng_for

if TYPE_CHECKING:
    from gesturekit.diffusion.model import DiffusionModel

OVERLAP = 150
"""Least overlap of neighbouring tiles in frames, or a quarter of a tile if that is less. Tiles are
cross-faded over the middle third of the overlap; each outer third belongs to the tile whose border
is farther away."""
SETTLED = 0.6
"""Seconds beside a clip in which the made motion is moved to it and smoothed."""
STIFFNESS = 20.0
"""Weight of squared third differences beside a clip, relative to squared changes of the motion, at
30 fps."""


def sampled_motions(request: Request, samples: int) -> list[Motion]:
    """Generate the samples of a request with the numbers 0 to `samples` - 1."""
    model, controls, clips = request.model, request.controls, request.clips
    smooth = model.smooth if controls["smooth"] is None else controls["smooth"]
    clip = model.clip_denoised if controls["clip_denoised"] is None else controls["clip_denoised"]
    steps, last = controls["steps"], None if request.start is None else request.start[1]
    solver = controls["solver"] or ("ancestral" if steps is None else "dpm")
    if steps is not None and last is not None:
        steps = min(steps, last + 1)
    between = None if clips is None else InbetweenConstraint(model, clips, request.n_frames)
    # One at a time by default: batching changes the order of sums, and the last digits of a
    # sample would depend on the number of samples.
    size, motions = controls["batch"], []
    batches = [range(k, min(k + size, samples)) for k in range(0, samples, size)]
    total = len(batches) * len(chosen_steps(model.schedule, steps, last))
    with Progress(total=total, desc="Denoising", unit="step") as progress:
        for numbers in batches:
            experts = product(experts_of(request, numbers))
            predict = tiled(experts, request.n_frames, model.window)
            predict = clip_denoised(predict, model.schedule) if clip else predict
            if between is not None:
                predict = between.held(predict, model.schedule)
            vectors = sample(
                _counted(predict, progress),
                partial(_noise, request, numbers),
                model.schedule,
                solver=solver,
                steps=steps,
                start=request.start,
            )
            for vector in (vectors if between is None else between.free).cpu():
                motion = _decoded(request, vector)
                motion = smooth_motion(motion, smooth) if smooth else motion
                motions.append(_finished(request, motion, between))
    return motions


def _finished(request: Request, motion: Motion, between: InbetweenConstraint | None) -> Motion:
    """Return the motion with locked feet, unless that is off, and with its given clips."""
    locks = request.controls["foot_lock"]
    if between is None:
        return lock_feet(motion, keep_path=request.path is not None) if locks else motion
    motion, clips = between.blended(motion), between.clips
    if locks:
        locked = lock_feet(motion, keep_path=True)
        motion = mixed_motions(locked, motion, clips.given(motion.n_frames))
    return clips.restored(motion)


def _decoded(request: Request, vector: Tensor) -> Motion:
    """Return the motion of a normalised motion vector (T, X)."""
    model, speaker = request.model, request.controls["speaker"]
    values = model.normaliser.inverse(vector).double().numpy()
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
        why = "the model was trained too little, or the expert weights are too extreme"
        raise ModelError(f"the generated motion is out of range ({error}); {why}") from None


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


def tiles_of(n_frames: int, size: int) -> list[tuple[slice, np.ndarray]]:
    """Return evenly spaced tiles of at most `size` frames, with weights (N,) float32 of theirs.

    Weights add up to 1 at each frame.

    Raises:
        ModelError: tiles of less than four frames.
    """
    if size < 4:
        raise ModelError(f"window: {size} frames; give at least 4")
    overlap = min(OVERLAP, size // 4)
    count = max(1, -(-(n_frames - overlap) // (size - overlap)))
    size = -(-(n_frames + (count - 1) * overlap) // count)
    starts = [round(k * (n_frames - size) / max(count - 1, 1)) for k in range(count)]
    weights = np.ones((count, size))
    for k, (start, after) in enumerate(pairwise(starts)):
        shared = start + size - after
        rising = np.clip((np.arange(size) + 0.5 - shared / 3) / (shared / 3), 0.0, 1.0)
        weights[k, after - start :] -= rising[:shared]
        weights[k + 1] = rising
    frames = [slice(start, start + size) for start in starts]
    return list(zip(frames, weights.astype(np.float32), strict=True))


def tiled(experts: Sequence[Expert], n_frames: int, size: int) -> Predict:
    """Return the prediction of a product, in tiles of `size` frames if the motion is longer.

    In each tile, only experts with a weight there are run. No state that grows with the length is
    kept between two calls.
    """
    tiles = tiles_of(n_frames, size)
    if len(tiles) == 1:
        return partial(predicted_noise, experts)

    def predict(noisy: Tensor, step: int) -> Tensor:
        total = torch.zeros_like(noisy)
        for frames, weights in tiles:
            weight = torch.from_numpy(weights).to(noisy.device, noisy.dtype)
            predicted = predicted_noise(_within(experts, frames), noisy[:, frames], step)
            total[:, frames] += weight[:, None] * predicted
        return total

    return predict


def _within(experts: Sequence[Expert], frames: slice) -> list[Expert]:
    """Return the experts with a weight in these frames, cut to them."""
    cut = []
    for expert in experts:
        weight = expert.weight[frames] if expert.weight.size > 1 else expert.weight
        if np.abs(weight).max() > 0:
            cut.append(replace(expert, condition=expert.condition[:, frames], weight=weight))
    return cut


class InbetweenConstraint:
    """Given clips in a motion that is sampled.

    At every step the predicted clean motion is replaced by the clips where there are any
    (imputation, as in section 4.2 of Tevet et al. 2023): the network sees them with the noise of
    the step, and fits the other frames to them. At the end the frames beside a clip are moved to
    its pose and smoothed into it, and the root on to the place and heading of the next clip.

    Args:
        model: the model that generates.
        clips: the given clips.
        n_frames: T.

    Attributes:
        free: (B, T, X) normalised motion that the network made at last, in place of clips too.
    """

    free: Tensor

    def __init__(self, model: DiffusionModel, clips: InbetweenClips, n_frames: int) -> None:
        self.representation, self.normaliser = model.representation, model.normaliser
        self.clips = clips
        self.spans = [(begin, begin + clip.n_frames) for begin, clip in clips.clips]
        self.values = np.zeros((n_frames, self.representation.n_features))
        given = np.zeros(self.values.shape, bool)
        for (begin, end), (_, clip) in zip(self.spans, clips.clips, strict=True):
            self.values[begin:end] = self.representation.encode(clip)
            given[begin:end] = True
            # The step into a clip is part of the motion before it.
            given[begin, self.representation.root_columns] = False
        self._given = torch.from_numpy(given).to(model.device)
        clean = self.normaliser.forward(torch.from_numpy(self.values).float())
        self._clean = clean.to(model.device)

    def held(self, predict: Predict, schedule: NoiseSchedule) -> Predict:
        """Return noise predictions whose clean motion is that of the clips."""

        def constrained(noisy: Tensor, step: int) -> Tensor:
            signal, spread = schedule.scales(step, noisy)
            noise = predict(noisy, step)
            if step == 0:  # the last one
                self.free = (noisy - spread * noise) / signal
            return torch.where(self._given, (noisy - signal * self._clean) / spread, noise)

        return constrained

    def blended(self, motion: Motion) -> Motion:
        """Return a motion that continues from the clips and contains them, from a free one."""
        free, rig = self.representation.encode(motion), self.representation
        values = free.copy()
        edges = [0, *(edge for span in self.spans for edge in span), len(values)]
        reach = max(1, round(SETTLED * self.clips.fps))
        for begin, end in zip(edges[::2], edges[1::2], strict=True):
            after = np.arange(1, end - begin + 1)[:, None]
            share = smoothstep(np.clip(1 - after / min(reach, len(after) + 1), 0, 1))
            if begin:
                values[begin:end] += share * (self.values - free)[begin - 1]
            if end < len(values):
                values[begin:end] += share[::-1] * (self.values - free)[end]
        given = self._given.cpu().numpy()
        values = np.where(given, self.values, values)
        kept = np.asarray(given.any(axis=1))
        values = settled(values, kept, reach, STIFFNESS * (self.clips.fps / 30) ** 6)
        deltas = values[:, rig.root_columns] * [1.0, rig.scale, rig.scale]
        path = RootPath.from_deltas(deltas, self.clips.fps, turn_first=rig.turn_first)
        path = self._through_clips(path)
        values[:, rig.root_columns] = path.scaled(1 / rig.scale).deltas(turn_first=rig.turn_first)
        start = (*path.positions[0], path.headings[0])
        return rig.decode(values, self.clips.fps, start=start)

    def _through_clips(self, path: RootPath) -> RootPath:
        """Return the path with the first clip in its place, and bent between the clips."""
        frames, before = np.arange(path.n_frames), None
        for (begin, end), (_, clip) in zip(self.spans, self.clips.clips, strict=True):
            wanted = self.representation.path_of(clip)
            share = np.ones(path.n_frames)
            if before is not None:
                share = smoothstep(((frames - before + 1) / (begin - before + 1)).clip(0, 1))
            turn = wanted.headings[0] - path.headings[begin]
            turn = share * ((turn + np.pi) % (2 * np.pi) - np.pi)
            between = (turn[1:] + turn[:-1]) / 2
            dx, dz = np.diff(path.positions, axis=0).T
            sine, cosine = np.sin(between), np.cos(between)
            steps = np.stack([dx * cosine + dz * sine, dz * cosine - dx * sine], axis=1)
            positions = np.concatenate([path.positions[:1], steps]).cumsum(axis=0)
            positions += share[:, None] * (wanted.positions[0] - positions[begin])
            path = RootPath(positions, path.headings + turn, path.fps)
            before = end
        return path


def settled(values: np.ndarray, kept: np.ndarray, reach: int, stiffness: float) -> np.ndarray:
    """Return motion whose third differences are small beside kept frames (Whittaker smoothing).

    Minimises the sum of w (x - values)^2 + m (third difference of x)^2 with kept frames fixed. m
    falls from `stiffness` to 0 over `reach` frames, and w rises to 1.

    Args:
        values: (T, X).
        kept: (T,) bool, true for at least one frame.
        reach: frames beside kept ones that may change.
        stiffness: m beside a kept frame.
    """
    count, frames = len(values), np.arange(len(values))
    if count < 4 or kept.all():
        return values
    places = np.flatnonzero(kept)
    right = places[np.searchsorted(places, frames).clip(max=len(places) - 1)]
    left = places[(np.searchsorted(places, frames, side="right") - 1).clip(0)]
    away = np.minimum(np.abs(frames - left), np.abs(frames - right)) / reach
    near = np.lib.stride_tricks.sliding_window_view(np.clip(1 - away, 0, 1), 4).max(axis=1)
    third = sparse.diags_array(
        [-1.0, 3.0, -3.0, 1.0], offsets=[0, 1, 2, 3], shape=(count - 3, count)
    )
    smooth = third.T @ sparse.diags_array(stiffness * near**2) @ third
    weight = sparse.diags_array(np.clip(away, 0.02, 1))
    whole, free = (weight + smooth).tocsr(), ~kept
    wanted = (weight @ values)[free] - whole[free][:, kept] @ values[kept]
    result = values.copy()
    result[free] = spsolve(whole[free][:, free].tocsc(), wanted).reshape(wanted.shape)
    return result
