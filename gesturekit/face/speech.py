"""Face from speech by rules: what `face_from_speech` makes of a sound."""

from __future__ import annotations

from audio_features import Wave
from gesturekit.errors import MotionError
from gesturekit.face.channels import NAMES
from gesturekit.face.energy import energy_values
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
    values = energy_values(speech, fps, n_frames, seed, item)
    return FaceTrack(NAMES, values, "rules")
