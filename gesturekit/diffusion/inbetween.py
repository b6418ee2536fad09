"""Constraint of in-betweening: given frames of a motion stay, and the model makes the rest."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from gesturekit.diffusion.noise_schedule import NoiseSchedule, Predict
from gesturekit.motion.root_path import RootPath
from gesturekit.training.clips import BLEND, InbetweenClips, continued, ease

if TYPE_CHECKING:
    from gesturekit.diffusion.model import DiffusionModel


class InbetweenConstraint:
    """Given clips in a motion that is sampled.

    At every step the predicted clean motion is replaced by the clips where there are any
    (imputation, as in section 4.2 of Tevet et al. 2023): the network sees them with the noise of
    the step, and fits the other frames to them. At the end the frames beside a clip are moved to
    its pose and velocity, and the root on to the place and heading of the next clip.

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

    def blended(self, values: np.ndarray, number: int) -> tuple[np.ndarray, RootPath]:
        """Return a sampled motion that continues from the clips, and its path.

        Args:
            values: (T, X) vectors in their own units.
            number: of the motion in its batch.
        """
        assert self._free is not None
        free = self.normaliser.inverse(self._free[number].cpu()).double().numpy()
        values, rig = values.copy(), self.representation
        still = np.ones(values.shape[1], bool)
        still[rig.root_columns] = False  # steps are velocities
        edges = [0, *(edge for span in self.spans for edge in span), len(values)]
        for k, (begin, end) in enumerate(zip(edges[::2], edges[1::2], strict=True)):
            count, has_both = end - begin, 0 < k < len(self.spans)
            reach = max(1, round(BLEND * self.clips.fps))
            reach = min(reach, count + 1) if has_both else reach
            for side in ("after", "before"):
                if (k == 0) if side == "after" else (k == len(self.spans)):
                    continue
                span = slice(*self.spans[k - 1 if side == "after" else k])
                order = 1 if side == "after" else -1
                ends = self.values[span][::order], free[span][::order]
                added = continued(*ends, count, reach, still)[::order]
                values[begin:end] += added
        for begin, end in self.spans:
            steps = values[begin, rig.root_columns].copy()
            values[begin:end] = self.values[begin:end]
            values[begin, rig.root_columns] = steps
        deltas = values[:, rig.root_columns] * [1.0, rig.scale, rig.scale]
        path = RootPath.from_deltas(deltas, self.clips.fps, turn_first=rig.turn_first)
        path = self._through_clips(path)
        values[:, rig.root_columns] = path.scaled(1 / rig.scale).deltas(turn_first=rig.turn_first)
        return values, path

    def _through_clips(self, path: RootPath) -> RootPath:
        """Return the path with the first clip in its place, and bent between the clips."""
        frames, before = np.arange(path.n_frames), None
        for (begin, end), (_, clip) in zip(self.spans, self.clips.clips, strict=True):
            wanted = self.representation.path_of(clip)
            share = np.ones(path.n_frames)
            if before is not None:
                share = ease(((frames - before + 1) / (begin - before + 1)).clip(0, 1))
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
