"""The process of the state of movement: fitted to recordings, calibrated for a trained model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gesturekit.corpus.item import Item
from gesturekit.diffusion.conditions import Conditions
from gesturekit.diffusion.motion_vector import DeltaRepresentation, measured_state
from gesturekit.diffusion.trained_model import TrainedModel
from gesturekit.diffusion.training.data import Cut, TrainingData, TrainingSequence
from gesturekit.diffusion.training.quick import quick_vectors
from gesturekit.errors import MotionError
from gesturekit.postprocess import smooth_motion
from gesturekit.state.channels import StateChannels
from gesturekit.state.process import RecordedState, StateProcess
from gesturekit.training.seeds import rng_for

_MOST_CLIPS, _CLIP_SECONDS = 8, 60.0
"""Recordings and variants of them that calibrate, and their greatest length."""


def fit_state(
    recordings: Sequence[TrainingSequence],
    parts: Sequence[tuple[Item, Cut]],
    conditions: Conditions,
    representation: DeltaRepresentation,
    fps: float,
) -> StateProcess:
    """Return the process of the state in these parts of recordings, with the items they are of.

    The conditions of the recordings have no state yet.
    """
    channels = StateChannels.find(representation.skeleton, representation.joints)
    found = []
    for item, (i, start, stop) in parts:
        values = measured_state(recordings[i].motion[start:stop], representation, channels, fps)
        speech = recordings[i].condition[start:stop][:, conditions.columns["speech"]]
        style = conditions.styles.index(item.style or "") if conditions.styles else None
        found.append(RecordedState(values, speech.T, item.take, (item.speaker, style)))
    return StateProcess.fit(channels, found, fps, conditions.conditioner)


def calibrated(model: TrainedModel, data: TrainingData, seed: int) -> StateProcess | None:
    """Return the process for a trained model, see `StateProcess.calibrated`; None without a state.

    The model moves, in a few steps, to the speech of recordings with a state that is drawn.
    """
    process, pairs = model.state_process, []
    if process is None:
        return None
    columns = data.conditions.columns
    paired = [recording for recording in data.recordings if recording.is_paired]
    for k, recording in enumerate(paired[:_MOST_CLIPS]):
        rng = rng_for(seed, "calibration", k)
        condition = recording.condition[: round(_CLIP_SECONDS * process.fps)].copy()
        style = int(condition[0, columns["styles"]].argmax()) if model.styles else None
        speech = condition[:, columns["speech"]].T
        wanted = process.draw(rng.initial_seed() >> 1, speech, (None, style))
        condition[:, columns["state"]] = process.given(wanted).T
        vectors = quick_vectors(model.network, model.schedule, condition, rng)
        values = model.normaliser.inverse(vectors.cpu()).double().numpy()
        try:
            motion = data.decode(values, condition, model.fps)
        except MotionError:  # of a model that was trained too little
            return process
        motion = smooth_motion(motion, model.smooth) if model.smooth else motion
        vectors = model.representation.encode(motion)
        pairs.append(
            (wanted, measured_state(vectors, model.representation, process.channels, model.fps))
        )
    asked, shown = (np.concatenate(rows, axis=1) for rows in zip(*pairs, strict=True))
    return process.calibrated(asked, shown)
