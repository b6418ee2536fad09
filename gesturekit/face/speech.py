"""Face from speech by rules: what `face_from_speech` makes of a sound."""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import maximum_filter1d

from audio_features import Wave
from gesturekit.errors import MotionError
from gesturekit.face.channels import NAMES, channels
from gesturekit.face.energy import AHEAD, Loudness, energy_values, sampled, smoothed
from gesturekit.face.eyes import RATE, Eyes
from gesturekit.face.phones import phones_of
from gesturekit.face.visemes import mouth_of
from gesturekit.motion.face import FaceTrack

METHODS = ("energy", "phones")


def face_from_speech(
    speech: Wave,
    fps: float,
    n_frames: int,
    method: str = "energy",
    transcript: str | None = None,
    seed: int = 0,
    item: str = "",
) -> FaceTrack:
    """Make a face that speaks a sound, blinks and looks around, by rules alone.

    It has no emotion, and is no recording of anybody's face: its origin is "rules".

    Args:
        speech: the sound; its level does not matter.
        fps: frames per second; frame k is at k / fps s.
        n_frames: T.
        method: "energy" opens the mouth by loudness and voicing, in any language; "phones" shapes
            it by English phones that PocketSphinx finds.
        transcript: English words that are spoken, for "phones".
        seed: of blinks and gaze.
        item: name of the utterance; other names blink at other times.

    Returns:
        T frames of ARKit's channels of mouth and eyes.

    Raises:
        MotionError: another method, or a transcript without phones.
    """
    if method not in METHODS:
        raise MotionError(f"method {method!r} of a face; expected {' or '.join(METHODS)}")
    speech = speech.resample(16_000).at_level()
    if method == "energy":
        values = energy_values(speech, fps, n_frames, seed, item)
    else:
        values = _phone_values(speech, fps, n_frames, transcript, Eyes(seed, item))
    return FaceTrack(NAMES, values, "rules")


def _phone_values(
    speech: Wave, fps: float, n_frames: int, transcript: str | None, eyes: Eyes
) -> np.ndarray:
    """Return the values (n_frames, E) of speech of 16 kHz at the standard level, by phones."""
    loudness = Loudness(speech.sample_rate)
    rest = np.zeros(round((loudness.delay + 0.1) * speech.sample_rate), np.float32)
    parts = [*loudness.step(speech.samples), *loudness.step(rest)]
    loud = np.concatenate([part for part, _ in parts])
    n = max(math.ceil(n_frames * RATE / fps) + 2, len(loud))
    loud = np.pad(loud, (0, n - len(loud)))
    phones = [] if speech.is_silent else phones_of(speech, loud, transcript)
    mouth = mouth_of(phones, n, hold=1.2 / fps)
    gate = maximum_filter1d((loud > 0).astype(float), 2 * AHEAD + 1)
    mouth = np.pad(mouth * gate[:, None], ((AHEAD, AHEAD), (0, 0)))
    at = np.arange(n_frames) * (RATE / fps)
    return channels(sampled(smoothed(mouth), at), sampled(eyes.step(loud > 0), at))
