"""Motion that should fail, made from recordings, and the answers of `evaluate` to each: a table.

The corpus is a folder of STEM.wav beside STEM.bvh or STEM.npz of one speaker; every STEM that is
not held out is training motion. Motion of another speaker is retargeted. The recordings themselves
are among the models: they must pass every answer.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d

import gesturekit as gk
from audio_features import Wave
from gesturekit.corpus import Item, Manifest
from gesturekit.corpus.alignment import speech_envelope
from gesturekit.evaluation.measuring.clips import chosen_frames
from gesturekit.evaluation.measuring.made_motion import halved, held, mean_pose, shaken, turned
from gesturekit.evaluation.pairs import motion_files
from gesturekit.motion import Motion
from gesturekit.motion.parts import arm_joints, find_parts
from gesturekit.motion.retarget import retarget
from gesturekit.motion.rotations import (
    multiply_quaternions,
    rotation_vector_from_quaternion,
    slerp,
)

CLIP = 10.0
"""Seconds of the clips that held-out recordings are cut into."""
RECORDING = "recording"


@dataclass(frozen=True)
class Source:
    """Recordings that a fooling clip is made from.

    Attributes:
        motion: the held-out clip.
        wave: its speech.
        training: (at least as long) training motion of the same speaker.
        second: training motion from another place or take.
        other: motion of another speaker on the rig of this one; None without one.
        number: number of the clip, which seeds its noise.
    """

    motion: Motion
    wave: Wave
    training: Motion
    second: Motion
    other: Motion | None
    number: int


def statue(source: Source) -> Motion:
    """Hold the mean pose."""
    return held(mean_pose([source.motion]), source.motion.n_frames)


def _loudness(source: Source) -> np.ndarray:
    """Return (T,) loudness of the speech, smoothed, from 0 to 1."""
    motion = source.motion
    level = gaussian_filter1d(speech_envelope(source.wave, motion.fps, motion.n_frames), 3.0)
    return (level - level.min()) / max(float(np.ptp(level)), 1e-9)


def nodding_statue(source: Source) -> Motion:
    """Swing the arms and the head of the mean pose with the loudness."""
    skeleton = source.motion.skeleton
    moving = [*arm_joints(skeleton), *(n for n in skeleton.names if "head" in n.lower())]
    vectors = np.zeros((source.motion.n_frames, skeleton.n_joints, 3))
    for name in moving:
        vectors[:, skeleton.index(name), 0] = 0.5 * _loudness(source)
    return turned(statue(source), vectors)


def pose_and_noise(source: Source) -> Motion:
    """Add smooth noise, about as large as the recording's movement, to the mean pose."""
    motion, rng = source.motion, np.random.default_rng(source.number)
    away = _away(source)
    noise = gaussian_filter1d(rng.standard_normal(away.shape), 0.2 * motion.fps, axis=0)
    noise *= away.std(axis=0) / np.maximum(noise.std(axis=0), 1e-9)
    return turned(statue(source), noise)


def phase_noise(source: Source) -> Motion:
    """Keep the spectrum of each joint's rotation, with random phases."""
    away, rng = _away(source), np.random.default_rng(source.number)
    spectrum = np.fft.rfft(away, axis=0)
    turn = np.exp(2j * np.pi * rng.random(spectrum.shape))
    turn[0] = 1.0
    return turned(statue(source), np.fft.irfft(spectrum * turn, len(away), axis=0))


def _away(source: Source) -> np.ndarray:
    """Return (T, J, 3) rotation vectors from the mean pose."""
    back = statue(source).rotations * (-1.0, -1.0, -1.0, 1.0)
    return rotation_vector_from_quaternion(multiply_quaternions(back, source.motion.rotations))


def another_speaker(source: Source) -> Motion | None:
    """Take the motion of another speaker."""
    if source.other is None:
        return None
    n = source.motion.n_frames
    start = (source.number * n) % max(1, source.other.n_frames - n)
    return source.other[start : start + n]


def mirrored(source: Source) -> Motion:
    """Exchange left and right."""
    return source.motion.mirror()


def half_amplitude(source: Source) -> Motion:
    """Halve all rotations about the mean pose."""
    return halved(source.motion, source.motion.skeleton.names)


def _shifted(source: Source, seconds: float) -> Motion:
    motion = source.motion
    return chosen_frames(motion, np.roll(np.arange(motion.n_frames), round(seconds * motion.fps)))


def jitter(source: Source) -> Motion:
    """Turn each joint by .5° of noise in each frame."""
    return shaken(source.motion, np.radians(0.5), source.number)


def copied_arms(source: Source) -> Motion:
    """Copy each arm from another place of the training motion."""
    motion, skeleton = source.motion, source.motion.skeleton
    rotations = motion.rotations.copy()
    arms = find_parts(skeleton).arms
    for side, donor in (("left", source.training), ("right", source.second)):
        arm = (arms[side].shoulder, arms[side].elbow, arms[side].wrist)
        at = [skeleton.index(name) for name in arm if name is not None]
        rotations[:, at] = donor.rotations[: motion.n_frames, at]
    return replace(motion, rotations=rotations)


def warped(source: Source) -> Motion:
    """Play training motion at a speed that follows the loudness."""
    motion = source.training
    speed = 0.4 + 1.6 * _loudness(source)
    speed *= (motion.n_frames - 1) / speed[1:].sum()
    at = np.clip(np.concatenate([[0.0], np.cumsum(speed[1:])]), 0, motion.n_frames - 1)
    before = np.minimum(at.astype(int), motion.n_frames - 2)
    first, second = chosen_frames(motion, before), chosen_frames(motion, before + 1)
    share = np.tile((at - before)[:, None], (1, motion.skeleton.n_joints))
    place = first.translation + share[:, :1] * (second.translation - first.translation)
    rotations = slerp(first.rotations, second.rotations, share)
    return replace(first, rotations=rotations, translation=place)


def broken(source: Source) -> Motion:
    """Turn each joint by smooth noise of 60°."""
    rng = np.random.default_rng(source.number)
    noise = gaussian_filter1d(rng.standard_normal((*source.motion.rotations.shape[:2], 3)), 8, 0)
    standing = replace(source.motion, translation=statue(source).translation)
    return turned(standing, noise / noise.std())


FOOLINGS: Mapping[str, Callable[[Source], Motion | None]] = {
    RECORDING: lambda source: source.motion,
    "statue": statue,
    "statue nodding to loudness": nodding_statue,
    "mean pose and noise": pose_and_noise,
    "phase noise": phase_noise,
    "another speaker": another_speaker,
    "left-right mirror": mirrored,
    "half amplitude": half_amplitude,
    "shift of .3 s": lambda source: _shifted(source, 0.3),
    "shift of 1 s": lambda source: _shifted(source, 1.0),
    "jitter of .5°": jitter,
    "training copy": lambda source: source.training[: source.motion.n_frames],
    "training copy per arm": copied_arms,
    "mirrored training copy": lambda source: source.training.mirror()[: source.motion.n_frames],
    "loudness-warped training copy": warped,
    "broken body": broken,
}
"""Functions that make motion which fools, by name."""


def write(
    corpus: Path, held_out: Sequence[str], other: Path | None, folder: Path
) -> dict[str, Path]:
    """Write a manifest and the clips of each fooling below a folder; return {name: folder}."""
    files = motion_files(corpus)
    motions = {stem: Motion.load(path) for stem, path in files.items()}
    rig = next(iter(motions.values())).skeleton
    spoken = retarget(Motion.load(other), rig) if other else None
    training = [motion for stem, motion in motions.items() if stem not in held_out]
    items = []
    for stem, path in files.items():
        sound, motion = path.with_suffix(".wav"), motions[stem]
        count = max(1, int(motion.duration / CLIP)) if stem in held_out else 1
        length = motion.duration / count
        for k in range(count):
            items.append(Item(
                id=f"{stem}_{k}", take=stem, audio=sound, motion=path, audio_start=k * length,
                motion_start=k * length, duration=length, speaker="the speaker",
                split="test" if stem in held_out else "train",
            ))  # fmt: skip
    Manifest(items).save(folder / "corpus.jsonl")
    tested = [item for item in items if item.split == "test"]
    for number, item in enumerate(tested):
        clip = item.load_motion()
        first, second = (_stretch(training, clip, number + 7 * k) for k in range(2))
        source = Source(clip, item.load_wave(), first, second, spoken, number)
        for name, make in FOOLINGS.items():
            made = make(source)
            if made is not None:
                made.save(folder / name.replace(" ", "_") / f"{item.id}.npz")
    return {name: folder / name.replace(" ", "_") for name in FOOLINGS}


def _stretch(training: Sequence[Motion], clip: Motion, number: int) -> Motion:
    """Return a stretch of training motion as long as a clip."""
    motion = training[number % len(training)]
    start = (number * clip.n_frames) % max(1, motion.n_frames - clip.n_frames)
    return motion[start : start + clip.n_frames]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("corpus", type=Path, help="folder of STEM.wav with STEM.bvh or STEM.npz")
    parser.add_argument("--held-out", required=True, help="STEM,STEM that is not training motion")
    parser.add_argument("--other", type=Path, help="motion of another speaker")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        models = write(options.corpus, options.held_out.split(","), options.other, Path(name))
        models = {label: folder for label, folder in models.items() if folder.exists()}
        found = gk.evaluate(models, Path(name) / "corpus.jsonl", cheap=True)
    print("| motion | In time with the speech? | Moves like this speaker? | Is it new? |")
    print("|---|---|---|---|")
    for model in found.models:
        cells = []
        for answer in model.answers:
            result = model.metrics.get(answer.key)
            value = "" if result is None else f", {result.interval.value:.2f}"
            broken = "broken" in answer.sentence
            cells.append("broken" if broken else f"{answer.state}{value}")
        print(f"| {' | '.join([model.label, *cells])} |")


if __name__ == "__main__":
    main()
