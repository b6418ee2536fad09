"""Rule-based face motion of a whole sound."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from audio_features import Wave
from audio_features.acoustic import SAMPLE_RATE
from gesturekit.errors import MotionError
from gesturekit.face.energy import energy_mouth, mouth_of_sound, sampled
from gesturekit.face.eyes import RATE, Eyes
from gesturekit.face.phones import phones_of
from gesturekit.face.visemes import NAMES, channels, mouth_of_phones
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
        method: "energy" opens the mouth by the energy of the voice, in any language; "phones"
            shapes it by English phones that PocketSphinx finds.
        transcript: English words that are spoken, for "phones"; a warning says what of it is no
            help, such as words that are not in the dictionary.
        seed: of blinks and gaze.
        item: name of the utterance; other names blink at other times.

    Returns:
        T frames of ARKit's channels of mouth and eyes.

    Raises:
        MotionError: another method, or phones without PocketSphinx.
    """
    return faces_from_speech(speech, fps, n_frames, method, transcript, [Eyes(seed, item)])[0]


def faces_from_speech(
    speech: Wave,
    fps: float,
    n_frames: int,
    method: str,
    transcript: str | None,
    eyes: Sequence[Eyes],
) -> list[FaceTrack]:
    """Return a face for each of `eyes`, all with the same mouth; see `face_from_speech`."""
    if method not in METHODS:
        raise MotionError(f"method {method!r} of a face; expected {' or '.join(METHODS)}")
    speech = speech.resample(SAMPLE_RATE).at_level()
    openness, mouth = mouth_of_sound(speech)
    n = max(len(openness), math.ceil(n_frames * RATE / fps) + 1)
    openness = np.pad(openness, (0, n - len(openness)))
    at = np.arange(n_frames) * (RATE / fps)
    if method == "energy":
        mouth = energy_mouth(np.pad(mouth, ((0, n - len(mouth)), (0, 0))), at)
    else:
        phones = [] if speech.is_silent else phones_of(speech, openness, transcript)
        mouth = sampled(mouth_of_phones(phones, openness, hold=1.2 / fps), at)
    looks = (sampled(each.step(openness > 0), at) for each in eyes)
    return [FaceTrack(NAMES, channels(mouth, look), "rules") for look in looks]
