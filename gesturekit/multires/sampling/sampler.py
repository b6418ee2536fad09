"""From a request to motions: made of noise or in the place of a level, then put in the world."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from gesturekit.motion.motion import Motion
from gesturekit.multires.constraints.constraint import KeyframeHold, PathHold, fastest_second
from gesturekit.multires.constraints.inbetweening import PartsHold
from gesturekit.multires.constraints.keyframes import (
    keep_unedited,
    level_motion,
    lock_feet_but,
    motion_level,
    moved,
    over_keyframes,
)
from gesturekit.multires.sampling.pyramid import Pyramid
from gesturekit.multires.sampling.request import Request
from gesturekit.multires.sampling.styles import asked_styles
from gesturekit.postprocess import smooth_motion
from gesturekit.training.seeds import rng_for

if TYPE_CHECKING:
    from gesturekit.multires.model import MultiresModel

_TOO_FAST = 1.25
_STROLL = 0.1
"""Times the fastest second in training, and m/s for the reference body: faster than both is worth
a warning."""

log = logging.getLogger(__name__)


class Generation:
    """Makes the motions of a request.

    Args:
        model: that was asked.
        request: what it was asked.
    """

    def __init__(self, model: MultiresModel, request: Request) -> None:
        self.model, self.request = model, request
        self.representation = model.representation
        self.hold = self._hold()

    def motions(self) -> list[Motion]:
        """All of them."""
        # One at a time: in a batch, sums would be made in another order, and a motion would
        # depend on how many were asked for.
        return [self._motion(number) for number in range(self.request.samples)]

    def _motion(self, number: int) -> Motion:
        """Motion `number`: from a level in whose place one is given, else from noise."""
        request = self.request
        pyramid = Pyramid(
            self.model,
            request.lengths,
            request.features,
            self._styles(number),
            lambda level: rng_for(request.seed, "sample", number, "level", level + 1),
        )
        if request.start is not None:
            return self._from_level(pyramid)
        if request.path is not None:
            return self._along_path(pyramid)
        if request.kept is not None:
            return self._around_parts(pyramid)
        values = self._cropped(pyramid.random(levels=request.levels))
        if request.levels < len(request.lengths):
            return level_motion(self.representation, values, self.model.fps, request.n_frames)
        return self._finished(self._decoded(values), values)

    def _hold(self) -> PathHold | PartsHold | None:
        """What the levels are held to, the same for all motions; a warning if it asks too much."""
        model, request = self.model, self.request
        if request.path is not None:
            own = request.path.scaled(1 / self.representation.size_of(request.skeleton))
            steps = np.diff(own.positions, axis=0)
            self._warn_of_speed("the path", fastest_second(steps, model.fps))
            return PathHold(
                own.scaled(1 / self.representation.scale),
                self.representation,
                model.normaliser,
                request.lengths,
                request.margin,
            )
        if request.kept is not None:
            self._warn_of_speed("between the kept parts the body", request.kept.fastest_gap())
            return request.kept.hold(model.normaliser, request.lengths, request.margin)
        return None

    def _warn_of_speed(self, what: str, speed: float) -> None:
        fastest = self.model.fastest
        stroll = _STROLL * self.representation.scale
        if fastest is not None and speed > max(_TOO_FAST * fastest, stroll):
            log.warning(
                "%s goes %.2f m/s; nothing in the training was faster than %.2f m/s, and feet will "
                "slide",
                what,
                speed,
                fastest,
            )

    def _styles(self, number: int) -> list[Tensor]:
        """(1, K, T_i) for each level; none for a model that knows no styles."""
        model, request = self.model, self.request
        if not model.styles:
            return []
        rng = rng_for(request.seed, "sample", number, "style")
        return asked_styles(
            model.styles,
            request.style,
            request.level_style,
            request.lengths,
            model.fps,
            rng,
            request.margin,
        )

    def _along_path(self, pyramid: Pyramid) -> Motion:
        values = self._cropped(self.hold.placed(pyramid.random(hold=self.hold)))
        motion = moved(self.representation, self._decoded(values), self.request.path.positions[0])
        return self._finished(motion, values, keep_path=True)

    def _around_parts(self, pyramid: Pyramid) -> Motion:
        kept = self.request.kept
        values = self._cropped(pyramid.random(hold=self.hold))
        given = kept.given(self.request.n_frames)
        return kept.restored(
            self._finished(kept.placed(values), values, given=given, keep_path=True)
        )

    def _from_level(self, pyramid: Pyramid) -> Motion:
        """What finer levels make of keyframes, or of a motion to be like."""
        request = self.request
        coarse, edited = self._start(pyramid)
        if not request.held_to_start:
            values = pyramid.above(request.start_level, coarse)
            return self._finished(self._decoded(values), values)
        hold = KeyframeHold(coarse, edited, self.representation, self.model.normaliser)
        values = pyramid.above(request.start_level, coarse, hold)
        given = hold.stepped(request.n_frames)
        free = self._smoothed(self._decoded(values))
        locked = self._locked(free, values, given=given)
        frames = edited.any(axis=1)
        if not frames.any():
            return locked
        # Only locked feet tell where they lead the root. They are locked anew on the way that meets
        # the keyframes: moved along as they are, they slide a fifth faster between two of them.
        put = level_motion(self.representation, coarse, self.model.fps, request.n_frames)
        over = over_keyframes(self.representation, free, locked, put, frames)
        return self._locked(over, values, given=given, keep_path=True)

    def _start(self, pyramid: Pyramid) -> tuple[np.ndarray, np.ndarray]:
        """(T_i, D) vectors in the place of a level, and which of them were edited."""
        representation, fps, request = self.representation, self.model.fps, self.request
        level, lengths = request.start_level, request.lengths
        values = motion_level(representation, request.start, fps, lengths, level)
        if request.start.n_frames != lengths[level]:
            return values, np.ones(values.shape, bool)
        # Perhaps an edit of what this seed made.
        made = pyramid.random(levels=level + 1)
        unedited = level_motion(representation, made, fps, lengths[-1])
        read = motion_level(representation, unedited, fps, lengths, level)
        return keep_unedited(values, made, read)

    def _cropped(self, values: np.ndarray) -> np.ndarray:
        """Without the margins."""
        return values[self.request.margin : len(values) - self.request.margin]

    def _decoded(self, values: np.ndarray) -> Motion:
        return self.representation.decode(values, self.model.fps, skeleton=self.request.skeleton)

    def _finished(
        self,
        motion: Motion,
        values: np.ndarray,
        *,
        given: np.ndarray | None = None,
        keep_path: bool = False,
    ) -> Motion:
        """Smoothed, and its feet locked; see `lock_feet_but`."""
        return self._locked(self._smoothed(motion), values, given=given, keep_path=keep_path)

    def _smoothed(self, motion: Motion) -> Motion:
        return smooth_motion(motion, self.request.smooth) if self.request.smooth else motion

    def _locked(
        self,
        motion: Motion,
        values: np.ndarray,
        *,
        given: np.ndarray | None = None,
        keep_path: bool = False,
    ) -> Motion:
        if not self.request.foot_lock:
            return motion
        labels = self.representation.contacts(values)
        return lock_feet_but(motion, labels, given, keep_path=keep_path)
