"""Faces of generated motion, made from its speech by rules."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

import audio_features as af
from gesturekit.face import face_from_speech
from gesturekit.model import Controls
from gesturekit.motion.motion import Motion
from gesturekit.training.seeds import rng_for

log = logging.getLogger(__name__)

_RATE = 16_000


def with_faces(
    motions: Sequence[Motion], wave: af.Wave | None, controls: Controls, seed: int, item: str
) -> list[Motion]:
    """Return the samples of one request with faces by rules, unless `face` is off.

    Mouths are alike, as they follow the sound; blinks and eye movements are drawn for each sample.

    Args:
        motions: the samples 0, 1 ... of equal length, at the frame rate of the result.
        wave: the speech; None for silence, in which the mouth stays closed.
        controls: any system's.
        seed: with `item` and the number of a sample, it decides all random numbers.
        item: name of the utterance.

    Raises:
        GestureKitError: the face cannot be made, such as from phones without the extra `face`.
    """
    method, text = controls["face"], controls["transcript"]
    if method == "off":
        return [*motions]
    if wave is None:
        text = None
        log.warning("face=%r: there is no speech; the mouth stays closed", method)
        wave = af.Wave(np.zeros(int(_RATE * max(1.0, motions[0].duration)), np.float32), _RATE)
    made = []
    for number, motion in enumerate(motions):
        drawn = rng_for(seed, item, "sample", number, "face").initial_seed() >> 1
        face = face_from_speech(wave, motion.fps, motion.n_frames, method, text, drawn)
        made.append(replace(motion, face=face))
    return made
