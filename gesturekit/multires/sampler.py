"""Sampling of a request: generate each motion, apply its constraints, smooth it and lock feet."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from gesturekit.motion.motion import Motion
from gesturekit.multires.conditions import requested_styles
from gesturekit.multires.constraints import InbetweenConstraint, PathConstraint, placed_clips
from gesturekit.multires.keyframes import (
    KeyframeConstraint,
    keep_unedited,
    level_motion,
    motion_level,
    moved,
    root_through_keyframes,
)
from gesturekit.multires.motion_vector import fastest_second
from gesturekit.multires.pyramid import Pyramid
from gesturekit.multires.request import Request
from gesturekit.multires.retrieval import PieceSequence, played_passive, played_pieces
from gesturekit.postprocess import lock_feet, smooth_motion
from gesturekit.state.process import mood_seed
from gesturekit.training.clips import mixed_motions
from gesturekit.training.seeds import rng_for

if TYPE_CHECKING:
    from gesturekit.multires.model import MultiresModel

_TOO_FAST = 1.25
"""A speed this many times the fastest second in training is worth a warning ..."""
_STROLL = 0.1
"""... if it is also above this many m/s on the reference body."""

log = logging.getLogger(__name__)


class Sampler:
    """Generate the motions of a request.

    Args:
        model: the trained model.
        request: the request.
    """

    def __init__(self, model: MultiresModel, request: Request) -> None:
        self.model, self.request = model, request
        self.noise = model.noise.random(model.styles)
        representation, lengths, margin = model.representation, request.lengths, request.margin
        self.path: PathConstraint | None = None
        self.between: InbetweenConstraint | None = None
        if request.path is not None:
            path = request.path.scaled(1 / representation.size_of(request.skeleton))
            steps = np.diff(path.positions, axis=0)
            self._warn_of_speed("the path", fastest_second(steps, model.fps))
            path = path.scaled(1 / representation.scale)
            self.path = PathConstraint(path, representation, model.normaliser, lengths, margin)
        if request.clips is not None:
            self._warn_of_speed("between the clips the body", request.clips.fastest_gap())
            self.between = InbetweenConstraint(
                request.clips, representation, model.normaliser, lengths, margin
            )

    def motion(self, seed: int, item: str, number: int) -> Motion:
        """Generate the sample of an item with this number."""
        request, model = self.request, self.model

        def rng_of(*purpose: int | str) -> torch.Generator:
            return rng_for(seed, item, "sample", number, *purpose)

        styles = self._styles(rng_of("style"))
        mood = rng_for(mood_seed(seed, request.controls), item, "sample", number, "mood")
        channels = self._channels(mood, styles)
        state = None
        if channels is not None and model.state_process is not None:
            carriers = rng_of("carriers").initial_seed() >> 1
            state = model.state_process.condition(carriers, channels)
        condition = model.conditions.of_motion(
            request.features, request.lengths, styles, request.level_speech, state
        )
        pyramid = Pyramid(
            model,
            request.lengths,
            condition,
            self.noise,
            lambda level: rng_of("level", level + 1),
            state,
        )
        played = self._played(channels, rng_of, styles)
        motion = self._generated(pyramid, played)
        if played is not None and model.library is not None:
            motion = played_passive(model.library, played, motion, request.margin)
        return motion if request.clips is None else request.clips.restored(motion)

    def _generated(self, pyramid: Pyramid, played: PieceSequence | None) -> Motion:
        """Generate the motion of the modelled joints, as the request's constraints say."""
        request, model = self.request, self.model
        if request.start is not None:
            return self._from_level(pyramid)
        if request.is_coarse:
            values = pyramid.random(levels=request.controls["levels"])
            return level_motion(model.representation, values, model.fps, request.n_frames)
        if request.clips is not None:
            values = self._cropped(pyramid.random(constraint=self.between))
            given = request.clips.given(request.n_frames)
            motion = self._smoothed(placed_clips(request.clips, values, model.representation))
            return self._locked(motion, values, given, keep_path=True)
        if self.path is not None and request.path is not None:
            values = self._cropped(self.path.placed(pyramid.random(constraint=self.path)))
            start = request.path.positions[0]
            motion = moved(model.representation, self._decoded(values), start)
            return self._locked(self._smoothed(motion), values, keep_path=True)
        if model.retrieves and played is not None:
            vectors = played.values(np.arange(request.lengths[-1]))
            motion_vectors = vectors[:, : model.representation.n_features]
            values = model.normaliser.to_values(torch.from_numpy(motion_vectors.T[None]))
        else:
            values = pyramid.random()
        values = self._cropped(values)
        return self._locked(self._smoothed(self._decoded(values)), values)

    def _warn_of_speed(self, what: str, speed: float) -> None:
        fastest, stroll = self.model.fastest, _STROLL * self.model.representation.scale
        if speed > max(_TOO_FAST * fastest, stroll):
            log.warning(
                "%s goes %.2f m/s; nothing in the training was faster than %.2f m/s, and feet will "
                "slide",
                what,
                speed,
                fastest,
            )

    def _styles(self, rng: torch.Generator) -> list[Tensor]:
        """Return (1, K, T_i) for each level; empty for a model without styles."""
        request, names, fps = self.request, self.model.styles, self.model.fps
        if not names:
            return []
        return requested_styles(
            names, request.controls, request.lengths, fps=fps, rng=rng, margin=request.margin
        )

    def _channels(self, rng: torch.Generator, styles: list[Tensor]) -> np.ndarray | None:
        """Return the channels (C, T + 2 margin) of the state, given or drawn; None without."""
        process, request = self.model.state_process, self.request
        if process is None:
            return None
        controls, margin = request.controls, request.margin
        if request.state is not None:
            return np.pad(request.state.T, ((0, 0), (margin, margin)), mode="edge")
        return process.draw(
            rng.initial_seed() >> 1,
            request.features.T,
            (controls["speaker"], int(styles[0][0].mean(dim=-1).argmax()) if styles else None),
            first=-margin,
            liveliness=controls["liveliness"],
        )

    def _played(
        self,
        channels: np.ndarray | None,
        rng_of: Callable[..., torch.Generator],
        styles: list[Tensor],
    ) -> PieceSequence | None:
        """Return the recorded motion for channels (C, T + 2 margin); None if there is none."""
        library, process = self.model.library, self.model.state_process
        if library is None or process is None or channels is None or self.request.is_coarse:
            return None
        return played_pieces(
            library,
            process.with_voice(channels, self.request.features.T),
            lambda piece: rng_of("piece", piece),
            self.request.controls["speaker"],
            styles[-1][0].argmax(dim=0).numpy() if styles else None,
        )

    def _from_level(self, pyramid: Pyramid) -> Motion:
        """Generate the levels above keyframes, or above a motion to redo (`like`)."""
        controls, n_frames = self.request.controls, self.request.n_frames
        level = controls["keyframe_level"] - 1
        coarse, edited = self._start(pyramid, level)
        if controls["like"] is not None:
            values = pyramid.above(level, coarse)
            return self._locked(self._smoothed(self._decoded(values)), values)
        representation = self.model.representation
        constraint = KeyframeConstraint(coarse, edited, representation, self.model.normaliser)
        values = pyramid.above(level, coarse, constraint)
        given = constraint.edited_feet(n_frames)
        free = self._smoothed(self._decoded(values))
        locked = self._locked(free, values, given)
        frames = np.asarray(edited.any(axis=1))
        if not frames.any():
            return locked
        # Foot locking moves the root, so its drift is known only now. Feet are locked again on the
        # path through the keyframes: merely moved along, they slide a fifth faster there.
        wanted = level_motion(representation, coarse, self.model.fps, n_frames)
        motion = root_through_keyframes(representation, free, locked, wanted, frames)
        return self._locked(motion, values, given, keep_path=True)

    def _start(self, pyramid: Pyramid, level: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the vectors (T_i, D) that replace a level, and (T_i, D) bool where edited."""
        representation, fps = self.model.representation, self.model.fps
        start, lengths = self.request.start, pyramid.lengths
        assert start is not None
        values = motion_level(representation, start, fps, lengths, level)
        if start.n_frames != lengths[level]:
            return values, np.ones(values.shape, bool)
        # It may be an edit of what this seed generates.
        generated = pyramid.random(levels=level + 1)
        unedited = level_motion(representation, generated, fps, lengths[-1])
        read = motion_level(representation, unedited, fps, lengths, level)
        return keep_unedited(values, generated, read, representation)

    def _cropped(self, values: np.ndarray) -> np.ndarray:
        """Return (T, D) without the margins."""
        return values[self.request.margin : len(values) - self.request.margin]

    def _decoded(self, values: np.ndarray) -> Motion:
        """Return the motion of vectors (T, D)."""
        return self.model.representation.decode(
            values, self.model.fps, skeleton=self.request.skeleton
        )

    def _smoothed(self, motion: Motion) -> Motion:
        smooth = self.request.controls["smooth"]
        smooth = self.model.smooth if smooth is None else smooth
        return smooth_motion(motion, smooth) if smooth else motion

    def _locked(
        self,
        motion: Motion,
        values: np.ndarray,
        given: np.ndarray | None = None,
        *,
        keep_path: bool = False,
    ) -> Motion:
        """Return the motion with locked feet, unless foot locking is off.

        Args:
            motion: T frames.
            values: (T, D) vectors with the contact labels.
            given: (T,) 1 where the motion stays as it is, 0 where feet are locked, with smooth
                transitions; None locks them everywhere.
            keep_path: see `lock_feet`.
        """
        if not self.request.controls["foot_lock"]:
            return motion
        labels = values[:, self.model.representation.layout.contacts]
        locked = lock_feet(motion, labels, keep_path=keep_path)
        return locked if given is None or not given.any() else mixed_motions(locked, motion, given)
