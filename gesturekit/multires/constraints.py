"""Constraints on where the body goes: paths, and given clips (in-betweening).

They change the output of each level before the next one adds detail: inpainting in a coarse-to-fine
pyramid. Finer levels see the constrained part and fit the rest to it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from gesturekit.motion.motion import Motion
from gesturekit.motion.resampling import smoothstep
from gesturekit.motion.root_path import RootPath, headings, side_axis
from gesturekit.motion.rotations import quaternion_from_sixd
from gesturekit.multires.keyframes import moved
from gesturekit.multires.motion_vector import (
    MultiresRepresentation,
    Normaliser,
    clamped_steps,
    turned,
    turned_plane,
)
from gesturekit.multires.resampling import resample
from gesturekit.training.clips import BLEND, InbetweenClips, ground_positions

_SWAY = 0.03
"""Largest sway of the hips to either side of a path, metres of the reference body."""
_SWAY_SECONDS = 0.3
"""Standard deviation of the Gaussian that separates sway from progress along the path, and fast
turns of the body from its heading."""


class PathConstraint:
    """Constrain the root to a path, and turn the body to the path's headings.

    The network was trained on headings within the recordings' range. So each level gets the path's
    steps relative to the heading that it generated, and the finished motion is turned to face along
    the path. The hips keep the fast part of their sway, 3 cm at most.

    Args:
        path: T frames at the full rate, in metres of the reference body.
        representation: of the vectors.
        normaliser: of the vectors.
        lengths: frames of each level, margins included; the last is T + 2 `margin`.
        margin: frames before and after the path, with the steps of its first and last frame.
    """

    def __init__(
        self,
        path: RootPath,
        representation: MultiresRepresentation,
        normaliser: Normaliser,
        lengths: Sequence[int],
        margin: int = 0,
    ) -> None:
        path = path.smoothed()
        self.layout, self.normaliser, self.lengths = representation.layout, normaliser, lengths
        self.fps = path.fps
        mean = representation.decode(normaliser.mean[None].double().numpy(), self.fps)
        self.side = side_axis([mean], representation.root)
        steps = np.diff(path.positions, axis=0, prepend=path.positions[:1])
        steps[0] = steps[min(1, len(steps) - 1)]
        steps_and_heading = np.concatenate([steps, path.headings[:, None]], axis=1)
        padded = np.pad(steps_and_heading, ((margin, margin), (0, 0)), mode="edge")
        self._steps_and_heading = torch.from_numpy(padded.T)

    def __call__(self, level: int, output: Tensor) -> Tensor:
        """Return the output of a level, (1, D, T_i), with steps that follow the path."""
        values = self.normaliser.to_values(output)
        turn, steps = self._turn_and_steps(values)
        values[:, self.layout.root_xz] = turned_plane(steps, -turn)
        vectors = self.normaliser.from_values(values)
        is_finest = level + 1 == len(self.lengths)
        return vectors if is_finest else clamped_steps(vectors, self.layout)

    def placed(self, values: np.ndarray) -> np.ndarray:
        """Return the constrained output of the last level, (T, D), turned to lie along the path."""
        turn, _ = self._turn_and_steps(values)
        return turned(values, turn, self.layout)

    def _turn_and_steps(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return turns (T_i,) from the network's world to the path's, and its steps (T_i, 2) there.

        Radians, and metres per frame of the full rate; `values` (T_i, D) are in their own units.
        """
        n_frames = len(values)
        stride = self.lengths[-1] / n_frames
        spread = _SWAY_SECONDS * self.fps / stride
        wanted = resample(self._steps_and_heading, n_frames).T.numpy()
        root = quaternion_from_sixd(values[:, self.layout.root_rotation])
        heading = headings(root, self.side)
        turn = wanted[:, 2] - gaussian_filter1d(heading, spread, mode="nearest")
        position = np.cumsum(values[:, self.layout.root_xz] * stride, axis=0)
        sway = position - gaussian_filter1d(position, spread, axis=0, mode="nearest")
        distance = np.linalg.norm(sway, axis=1, keepdims=True)
        sway *= _SWAY * np.tanh(distance / _SWAY) / np.maximum(distance, 1e-9)
        sway = turned_plane(sway, turn)
        sway_steps = np.diff(sway, axis=0, prepend=sway[:1])
        return turn, wanted[:, :2] + sway_steps / stride


def placed_clips(
    clips: InbetweenClips, values: np.ndarray, representation: MultiresRepresentation
) -> Motion:
    """Return the output of the last level, (T, D), as a motion in the world of the clips."""
    values = turned(values, clips.heading, representation.layout)
    motion = representation.decode(values, clips.fps)
    begin, clip = clips.clips[0]
    at = ground_positions(representation, motion)[begin]
    return moved(representation, motion, ground_positions(representation, clip)[0] - at)


class InbetweenConstraint:
    """Put the clips into the output of each level, and blend the frames beside them to their ends.

    Args:
        clips: the given clips.
        representation: of the vectors.
        normaliser: of the vectors.
        lengths: frames of each level, margins included.
        margin: frames before the motion and after it.
    """

    def __init__(
        self,
        clips: InbetweenClips,
        representation: MultiresRepresentation,
        normaliser: Normaliser,
        lengths: Sequence[int],
        margin: int,
    ) -> None:
        self.layout = representation.layout
        self.fps, self.lengths, self.normaliser = clips.fps, lengths, normaliser
        n_frames = lengths[-1]
        values = np.zeros((n_frames, representation.n_features))
        self.spans: list[tuple[int, int]] = []
        positions = []
        for begin, clip in clips.clips:
            span = begin + margin, begin + margin + clip.n_frames
            values[slice(*span)] = representation.encode(clip, turn=-clips.heading)
            self.spans.append(span)
            ground = ground_positions(representation, clip) / representation.scale
            positions.append(turned_plane(ground, -clips.heading))
        # (2,) metres of the reference body that the root must move in the free frames of each gap;
        # the step into a clip belongs to its first frame.
        self.displacements = [
            after[0] - before[-1] - values[span[0], self.layout.root_xz]
            for before, after, span in zip(positions, positions[1:], self.spans[1:], strict=False)
        ]
        at = np.concatenate([np.arange(*span) for span in self.spans])
        frames = np.arange(n_frames)
        right = np.searchsorted(at, frames).clip(0, len(at) - 1)
        left = (right - 1).clip(0)
        is_left = np.abs(at[left] - frames) <= np.abs(at[right] - frames)
        self.values = torch.from_numpy(values[np.where(is_left, at[left], at[right])].T)
        # Columns whose velocity is continuous too: all but contact labels and root steps.
        self.continuous = np.ones(representation.n_features, bool)
        self.continuous[np.r_[self.layout.contacts, self.layout.root_xz]] = False

    def __call__(self, level: int, output: Tensor) -> Tensor:
        """Return the output of a level, (1, D, T_i), with the clips in it and blended to them."""
        values = self.normaliser.to_values(output)
        result, n_frames, xz = values.copy(), len(values), self.layout.root_xz
        stride = self.lengths[-1] / n_frames
        given = resample(self.values, n_frames).T.numpy()
        spans = self._spans(n_frames)
        edges = [0, *(edge for span in spans for edge in span), n_frames]
        for number, (begin, end) in enumerate(zip(edges[::2], edges[1::2], strict=True)):
            count = end - begin
            if count <= 0:  # a clip is at the very beginning or end
                continue
            between = begin > 0 and end < n_frames
            reach = max(1, round(BLEND * self.fps / stride))
            reach = min(reach, count + 1) if between else reach
            if begin:
                before = np.arange(*spans[number - 1])
                result[begin:end] += self._correction(given[before], values[before], count, reach)
            if end < n_frames:
                after = np.arange(*spans[number])[::-1]
                added = self._correction(given[after], values[after], count, reach)
                result[begin:end] += added[::-1]
            if between:
                share = np.sin(np.pi * (np.arange(count) + 0.5) / count) ** 2  # most in the middle
                missing = self.displacements[number - 1] / stride
                missing -= result[begin:end, xz].sum(axis=0)
                result[begin:end, xz] += share[:, None] / share.sum() * missing
        for span in spans:
            result[slice(*span)] = given[slice(*span)]
        vectors = self.normaliser.from_values(result)
        is_finest = level + 1 == len(self.lengths)
        return vectors if is_finest else clamped_steps(vectors, self.layout)

    def _correction(
        self, given: np.ndarray, output: np.ndarray, count: int, reach: int
    ) -> np.ndarray:
        """Return (count, D) to add to the frames after a clip so that they continue from its end.

        `given` (T_k, D) is the clip and `output` (T_k, D) what the level generated in its place;
        the correction is 0 after `reach` frames.
        """
        after = np.arange(1, count + 1)[:, None]
        share = smoothstep(np.clip(1 - after / reach, 0, 1))
        added = share * (given[-1] - output[-1])
        if len(given) > 1:
            change = (given[-1] - given[-2]) - (output[-1] - output[-2])
            added += after * share**2 * np.where(self.continuous, change, 0)
        return added

    def _spans(self, n_frames: int) -> list[tuple[int, int]]:
        """Return the first frame of each clip at a level, and the frame after its last one.

        Each clip has at least one frame, unless an earlier clip takes it.
        """
        stride = self.lengths[-1] / n_frames
        centres = (np.arange(n_frames) + 0.5) * stride - 0.5
        spans: list[tuple[int, int]] = []
        for begin, end in self.spans:
            first, last = np.searchsorted(centres, [begin - 0.5, end - 0.5])
            if last == first:
                first = min(int(np.abs(centres - (begin + end - 1) / 2).argmin()), n_frames - 1)
                last = first + 1
            first = max(first, spans[-1][1]) if spans else first
            spans.append((int(first), max(int(first), int(last))))
        return spans
