"""Parts of a motion that are given, and a pyramid that fills the time between and around them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gesturekit.errors import ModelError
from gesturekit.motion.heading import heading
from gesturekit.motion.motion import Motion
from gesturekit.motion.rotations import slerp
from gesturekit.multires.constraints.constraint import (
    believable_steps,
    normalised,
    plain_values,
    turned,
    turned_plane,
)
from gesturekit.multires.constraints.keyframes import ground_places, moved
from gesturekit.multires.motion_vector import MultiresRepresentation
from gesturekit.multires.network.resampling import resample
from gesturekit.multires.training.data import Normaliser
from gesturekit.training.data.own_rig import on_rig

_BLEND = 0.4
"""Seconds over which what was made is drawn to where a given part ends."""


class KeptParts:
    """Motions with places in time. A hold (see `holding`), and what puts them back in the end.

    The parts keep their places and facings in the world; where two are apart, the body travels.

    Args:
        parts: motions by the second at which each begins; of the model's rig, or of another one
            that moves like it.
        representation: of the vectors.
        fps: frames per second.

    Raises:
        ModelError: no parts, parts that overlap, or one that cannot be put on the rig.
    """

    def __init__(
        self,
        parts: Mapping[float, Motion | str | Path],
        representation: MultiresRepresentation,
        fps: float,
    ) -> None:
        if not parts:
            raise ModelError("keep names no motion")
        self.representation, self.fps = representation, fps
        self.parts: list[tuple[int, Motion]] = []
        for second, part in sorted(parts.items()):
            if not (math.isfinite(second) and second >= 0):
                raise ModelError(f"a part to keep begins at {second:g} s; expected 0 or later")
            motion = part if isinstance(part, Motion) else Motion.load(part)
            begin = math.floor(second * fps + 0.5)
            if begin < self.end:
                raise ModelError(
                    f"the part at {second:g} s begins before the one before it ends "
                    f"({self.end / fps:g} s)"
                )
            self.parts.append((begin, on_rig(representation, motion).resample(fps)))
        # All are turned together: what they have in common faces +Z, as recordings in training.
        faces = [heading(part) for _, part in self.parts]
        weight = [part.n_frames for _, part in self.parts]
        self.facing = float(
            np.arctan2(
                np.average(np.sin(faces), weights=weight), np.cos(faces) @ weight / sum(weight)
            )
        )

    @property
    def end(self) -> int:
        """The frame after the last part."""
        return self.parts[-1][0] + self.parts[-1][1].n_frames if self.parts else 0

    def fastest_gap(self) -> float:
        """m/s that the body must travel over the ground between two parts, at the most."""
        speeds = [0.0]
        for (begin, part), (after, other) in zip(self.parts, self.parts[1:], strict=False):
            way = (
                ground_places(self.representation, other)[0]
                - ground_places(self.representation, part)[-1]
            )
            frames = after - begin - part.n_frames + 1
            speeds.append(float(np.linalg.norm(way)) * self.fps / frames)
        return max(speeds)

    def hold(self, normaliser: Normaliser, lengths: list[int], margin: int) -> PartsHold:
        """What holds each level to the parts; `lengths` include a margin before and after."""
        return PartsHold(self, normaliser, lengths, margin)

    def given(self, n_frames: int) -> np.ndarray:
        """(T,) 1 in the parts, falling to 0 beside them, over `_BLEND`."""
        share = np.zeros(n_frames)
        beside = max(1, round(_BLEND * self.fps))
        fall = _ease(1 - np.arange(1, beside) / beside)
        for begin, part in self.parts:
            stop = begin + part.n_frames
            share[begin:stop] = 1
            after, before = share[stop : stop + len(fall)], share[max(0, begin - len(fall)) : begin]
            np.maximum(after, fall[: len(after)], out=after)
            np.maximum(before, fall[::-1][len(fall) - len(before) :], out=before)
        return share

    def placed(self, values: np.ndarray) -> Motion:
        """What the last level made (T, D) as a motion, in the parts' world."""
        motion = self.representation.decode(turned(values, self.facing), self.fps)
        begin, part = self.parts[0]
        missing = (
            ground_places(self.representation, part)[0]
            - ground_places(self.representation, motion)[begin]
        )
        return moved(self.representation, motion, missing)

    def restored(self, motion: Motion) -> Motion:
        """With the parts as they were given, all joints of them.

        Joints that the model does not know come to where it holds them, over `_BLEND`.
        """
        rotations, translation = motion.rotations.copy(), motion.translation.copy()
        moving = {name: places.copy() for name, places in motion.joint_translations.items()}
        skeleton = motion.skeleton
        known = {*self.representation.indices, *skeleton.ancestors(self.representation.root)}
        others = [j for j in range(skeleton.n_joints) if j not in known]
        beside = round(_BLEND * self.fps)
        for begin, part in self.parts:
            stop = begin + part.n_frames
            rotations[begin:stop], translation[begin:stop] = part.rotations, part.translation
            for name, places in moving.items():
                still = part.skeleton.offsets[skeleton.index(name)]
                places[begin:stop] = part.joint_translations.get(name, still)
            for edge, step in ((begin, -1), (stop - 1, 1)):
                for k in range(1, beside):
                    frame = edge + step * k
                    if not others or not self._is_free(frame, motion.n_frames):
                        break
                    rotations[frame, others] = slerp(
                        rotations[frame, others],
                        rotations[edge, others],
                        np.full(len(others), _ease(1 - k / beside)),
                    )
        return replace(
            motion, rotations=rotations, translation=translation, joint_translations=moving
        )

    def _is_free(self, frame: int, n_frames: int) -> bool:
        inside = any(begin <= frame < begin + part.n_frames for begin, part in self.parts)
        return 0 <= frame < n_frames and not inside


class PartsHold:
    """Holds each level to the parts (see `holding`), and draws what is beside them to their ends.

    Args:
        kept: the parts.
        normaliser: of the vectors.
        lengths: frames of each level, margins included.
        margin: frames before the motion and after it.
    """

    def __init__(
        self, kept: KeptParts, normaliser: Normaliser, lengths: list[int], margin: int
    ) -> None:
        representation = kept.representation
        self.fps, self.lengths, self.normaliser = kept.fps, lengths, normaliser
        n_frames = lengths[-1]
        values = np.zeros((n_frames, representation.n_features))
        self.spans: list[tuple[int, int]] = []
        places = []
        for begin, part in kept.parts:
            span = begin + margin, begin + margin + part.n_frames
            values[slice(*span)] = representation.encode(part, turn=-kept.facing)
            self.spans.append(span)
            ground = ground_places(representation, part) / representation.scale
            places.append(turned_plane(ground, -kept.facing))
        # Metres (of the reference body) that the free frames between two parts must travel; a
        # part's first frame makes the step that leads into it.
        self.ways = [
            after[0] - before[-1] - values[span[0], [-3, -1]]
            for before, after, span in zip(places, places[1:], self.spans[1:], strict=False)
        ]
        at = np.concatenate([np.arange(*span) for span in self.spans])
        right = np.searchsorted(at, np.arange(n_frames)).clip(0, len(at) - 1)
        left = (right - 1).clip(0)
        nearer = np.where(
            np.abs(at[left] - np.arange(n_frames)) <= np.abs(at[right] - np.arange(n_frames)),
            at[left],
            at[right],
        )
        self.values = torch.from_numpy(values[nearer].T)
        # What goes on smoothly in its change too: all but labels and steps.
        self.smooth = np.ones(representation.n_features, bool)
        self.smooth[representation.layout.contacts] = False
        self.smooth[[-3, -1]] = False

    def __call__(self, level: int, made: Tensor) -> Tensor:
        """A level with the parts in it, and what is beside them drawn to their ends."""
        values = plain_values(self.normaliser, made)
        n_frames = len(values)
        stride = self.lengths[-1] / n_frames
        given = resample(self.values, n_frames).T.numpy()
        spans = self._spans(n_frames)
        gaps = [0, *(edge for span in spans for edge in span), n_frames]
        blend = max(1, round(_BLEND * self.fps / stride))
        result = values.copy()
        for number, (begin, end) in enumerate(zip(gaps[::2], gaps[1::2], strict=True)):
            if end <= begin:
                continue  # a part at the very beginning or end
            reach = min(blend, end - begin + 1) if begin and end < n_frames else blend
            if begin:
                before = np.arange(*spans[number - 1])
                result[begin:end] += self._drawn(given[before], values[before], end - begin, reach)
            if end < n_frames:
                after = np.arange(*spans[number])[::-1]
                drawn = self._drawn(given[after], values[after], end - begin, reach)
                result[begin:end] += drawn[::-1]
            if begin and end < n_frames:
                # The way between two parts is as long as it must be; more of it in the middle.
                share = np.sin(np.pi * (np.arange(end - begin) + 0.5) / (end - begin)) ** 2
                missing = self.ways[number - 1] / stride - result[begin:end, [-3, -1]].sum(axis=0)
                result[begin:end, [-3, -1]] += share[:, None] / share.sum() * missing
        for span in spans:
            result[slice(*span)] = given[slice(*span)]
        held = normalised(self.normaliser, result)
        return held if level + 1 == len(self.lengths) else believable_steps(held)

    def _drawn(self, given: np.ndarray, made: np.ndarray, count: int, reach: int) -> np.ndarray:
        """(count, D) to be added to the frames after a part, so that they go on from its end."""
        after = np.arange(1, count + 1)[:, None]
        share = _ease(np.clip(1 - after / reach, 0, 1))
        added = share * (given[-1] - made[-1])
        if len(given) > 1:
            change = (given[-1] - given[-2]) - (made[-1] - made[-2])
            added += after * share**2 * np.where(self.smooth, change, 0)
        return added

    def _spans(self, n_frames: int) -> list[tuple[int, int]]:
        """The frames of a level that lie in each part, one at least.

        Of parts so short and near that they fall on one frame, the later ones lose it.
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


def _ease(share: np.ndarray | float) -> np.ndarray | float:
    return share * share * (3 - 2 * share)
