"""A trained diffusion model: generate motion from speech, a style, a path or events."""

from __future__ import annotations

from pathlib import Path
from typing import Unpack

import numpy as np

from gesturekit.corpus.speech import Speech, as_speech, to_output_rate
from gesturekit.diffusion.controls import DiffusionControls
from gesturekit.diffusion.motion_vector import measured_state
from gesturekit.diffusion.sampling.request import Request
from gesturekit.diffusion.sampling.sampler import check_controls, sampled_motions
from gesturekit.diffusion.trained_model import TrainedModel
from gesturekit.errors import ModelError, gesturekit_errors
from gesturekit.model import MotionStream, build_controls, document_controls
from gesturekit.motion.motion import Motion
from gesturekit.training.data.own_rig import on_rig
from gesturekit.training.seeds import checked_item, checked_seed


class DiffusionModel(TrainedModel):
    """Model that generates motion by denoising diffusion, from speech or music, a style, a path,
    events, or nothing."""

    @document_controls(DiffusionControls)
    @gesturekit_errors()
    def generate(
        self,
        speech: Speech | None = None,
        sample_rate: int | None = None,
        *,
        seconds: float | None = None,
        samples: int = 1,
        seed: int = 0,
        item: str = "",
        **controls: Unpack[DiffusionControls],
    ) -> Motion | list[Motion]:
        """Generate motion as long as the speech, the path or `seconds`; frame k is at k / fps.

        Args:
            speech: an audio file, a `Wave`, or an array of samples (see `Wave.from_array`), of
                speech or music, for a model with speech input. Without it, such a model gets
                silence for `seconds`.
            sample_rate: of an array, in Hz.
            seconds: length without speech, in s.
            samples: number of different motions; more than one gives a list.
            seed: the same seed, item, request and sample number give the same motion.
            item: name of the utterance. Motions of different items are different draws.
            controls: the fields of `DiffusionControls`.

        Raises:
            ModelError: a control, style, event or speaker that this model does not have, experts
                that cannot be combined, an item that is not text, or no length.
            AudioError, FormatError: a file cannot be read, or an array is not audio.
        """
        asked = build_controls(DiffusionControls, controls, self.kind)
        seed, item = checked_seed(seed), checked_item(item)
        speech = as_speech(speech, sample_rate)
        rate = self.recorded_fps if asked["fps"] is None else asked["fps"]
        members = check_controls(self, asked, samples)
        request = Request(members, asked, speech, seconds, seed, item)
        motions = [
            to_output_rate(request.placement.applied(motion), rate, request.wave, request.seconds)
            for motion in sampled_motions(request, samples)
        ]
        return motions[0] if samples == 1 else motions

    def check_controls(
        self, *, samples: int = 1, seed: int = 0, **controls: Unpack[DiffusionControls]
    ) -> DiffusionControls:
        """Return the controls of `generate`, after the checks that do not depend on the speech.

        Raises:
            ModelError: a control, style, event or speaker that this model does not have, or
                experts that cannot be combined.
            FormatError: a table of events that cannot be read.
        """
        checked_seed(seed)
        asked = build_controls(DiffusionControls, controls, self.kind)
        check_controls(self, asked, samples)
        return asked

    def stream(
        self,
        sample_rate: int,
        look_ahead: float = 0.2,
        seed: int = 0,
        item: str = "",
        **controls: Unpack[DiffusionControls],
    ) -> MotionStream:
        """Raise ModelError: the model cannot stream."""
        raise ModelError(
            f"a {self.kind} model generates whole motions only: multires models with acoustic "
            "features and a state of movement can stream, such as own_corpus"
        )

    @gesturekit_errors()
    def state(self, motion: str | Path | Motion) -> np.ndarray:
        """Measure the state of movement of a motion: what `generate` takes as `state`.

        Args:
            motion: a motion or its file; one on another rig is retargeted.

        Returns:
            (T, C) at the model's frame rate; `state_process.channels.names` names the channels.

        Raises:
            ModelError: a model without a state of movement.
            FormatError: the file cannot be read.
            MotionError: a rig that cannot be retargeted.
        """
        if self.state_process is None:
            raise ModelError("state: this model was trained without the state of movement")
        motion = motion if isinstance(motion, Motion) else Motion.load(motion)
        vectors = self.representation.encode(on_rig(self.representation, motion.resample(self.fps)))
        channels = self.state_process.channels
        return measured_state(vectors, self.representation, channels, self.fps).T
