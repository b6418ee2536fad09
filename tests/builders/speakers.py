"""Two speakers whose arms, fingers and faces move, and settings of a small model of them."""

from pathlib import Path
from typing import Any

import numpy as np
import soundfile

import audio_features as af
from gesturekit.corpus import Item, Manifest
from gesturekit.formats.smpl import smpl_skeleton
from gesturekit.motion import Motion
from gesturekit.motion.face import smplx_face
from gesturekit.motion.rotations import quaternion_from_rotation_vector

RATE = 16_000
FPS = 30.0
FINGERS = ("left_index1", "right_thumb2")
SETTINGS: dict[str, Any] = {
    "fps": FPS,
    "state": True,
    "features": {"extractors": [{"kind": "prosody"}, {"kind": "effort", "seconds": 2.0}]},
    "network": {"channels": [2, 2]},
    "losses": {"state": 100.0, "arm_speed": 0.0},
    "training": {"first_stage": 3, "further_stages": 3, "window": 2.0, "renew_every": 2},
}


def recording(seconds: float, seed: int, mark: float = 0.0) -> Motion:
    """Arms swing; fingers and two coefficients of the face go round once in two seconds.

    A third coefficient is the mark of the recording.
    """
    skeleton, n = smpl_skeleton(55), round(seconds * FPS)
    time, phase = np.arange(n)[:, None] / FPS, np.random.default_rng(seed).uniform(0, 6, 3)
    lively = 0.5 - 0.4 * np.cos(2 * np.pi * time / 8)
    wave = np.sin(2 * np.pi * 0.9 * time + phase) * lively
    turns = np.zeros((n, 55, 3))
    turns[:, skeleton.index("left_shoulder")] = [0.0, 0.0, -1.2] + 0.5 * wave
    turns[:, skeleton.index("right_shoulder")] = [0.0, 0.0, 1.2] + 0.5 * wave[:, ::-1]
    for joint in ("left_elbow", "right_elbow", "spine2", "head"):
        turns[:, skeleton.index(joint)] = 0.2 * wave
    turn = np.pi * time[:, 0] + phase[0]
    for finger in FINGERS:
        turns[:, skeleton.index(finger), 2] = 0.4 + 0.4 * np.sin(turn)
    face = np.zeros((n, 100))
    face[:, 3], face[:, 4], face[:, 5] = np.sin(turn), np.cos(turn), mark
    rotations = quaternion_from_rotation_vector(turns)
    return Motion(skeleton, rotations, np.tile([0, 0.93, 0], (n, 1)), FPS, face=smplx_face(face))


def assert_played(motion: Motion, frames: slice = slice(None)) -> None:
    """Fingers and the face move, and together, as in recordings and in cross-fades of them."""
    face = motion.face.values[frames, :5]
    assert np.ptp(face[:, 3]) > 0.5
    for finger in FINGERS:
        _, _, z, w = motion.rotations[frames, motion.skeleton.index(finger)].T
        np.testing.assert_allclose(2 * np.arctan2(z, w), 0.4 + 0.4 * face[:, 3], atol=0.05)
    radius = np.hypot(face[:, 3], face[:, 4])
    assert radius.max() < 1 + 1e-5 and np.mean(radius > 0.998) > 0.5, (
        "a quarter of the time are fades"
    )


def voice(seconds: float, seed: int = 0) -> af.Wave:
    """Syllables whose pitch and upper harmonics rise and fall by turns of four seconds."""
    at = np.arange(round(seconds * RATE)) / RATE
    level = 0.5 - 0.4 * np.cos(2 * np.pi * at / 8 + seed)
    phase = 2 * np.pi * np.cumsum(110.0 + 110.0 * level) / RATE + seed
    tone = sum(np.sin(k * phase) / k ** (2 - level) for k in range(1, 16))
    syllables = np.maximum(np.sin(2 * np.pi * (2.0 + level) * at + seed), 0.0)
    return af.Wave((0.1 * syllables * tone).astype(np.float32), RATE)


def write_speakers(folder: Path) -> Path:
    """Write recordings of Ann (marked 1, 9 s) and Bo (-1, 8 s), and return their manifest."""
    items = []
    for seed, (speaker, seconds, mark) in enumerate((("Ann", 9.0, 1.0), ("Bo", 8.0, -1.0))):
        files = {"audio": folder / f"{speaker}.wav", "motion": folder / f"{speaker}.npz"}
        recording(seconds, seed, mark).save(files["motion"])
        soundfile.write(files["audio"], voice(seconds, seed).samples, RATE)
        items.append(Item(id=speaker, duration=seconds, speaker=speaker, **files))
    Manifest(items).save(folder / "corpus.jsonl")
    return folder / "corpus.jsonl"
