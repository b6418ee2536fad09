"""Constraint of in-betweening: given frames of a motion stay, and the model makes the rest."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy import sparse
from scipy.sparse.linalg import spsolve
from torch import Tensor

from gesturekit.diffusion.noise_schedule import NoiseSchedule, Predict
from gesturekit.motion.motion import Motion
from gesturekit.motion.resampling import smoothstep
from gesturekit.motion.root_path import RootPath
from gesturekit.training.clips import InbetweenClips

if TYPE_CHECKING:
    from gesturekit.diffusion.model import DiffusionModel

SETTLED = 0.6
"""Seconds beside a clip in which the made motion is moved to it and smoothed."""
STIFFNESS = 20.0
"""Weight of squared third differences beside a clip, relative to squared changes of the motion, at
30 fps."""


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
    """

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
        self._free: Tensor | None = None

    def held(self, predict: Predict, schedule: NoiseSchedule) -> Predict:
        """Return noise predictions whose clean motion is that of the clips."""

        def constrained(noisy: Tensor, step: int) -> Tensor:
            signal, spread = schedule.scales(step, noisy)
            noise = predict(noisy, step)
            if step == 0:  # the last one
                self._free = (noisy - spread * noise) / signal
            return torch.where(self._given, (noisy - signal * self._clean) / spread, noise)

        return constrained

    def free(self, number: int) -> np.ndarray:
        """Return what the network made at last, (T, X) in its own units, in place of clips too.

        Args:
            number: of the motion in its batch.
        """
        assert self._free is not None
        return self.normaliser.inverse(self._free[number].cpu()).double().numpy()

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
