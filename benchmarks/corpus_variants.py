"""Corpora of any size, made from a few recordings: the variants of each, written as own takes.

A variant is its recording at another tempo, begun at another time (the part before it follows at
the end), possibly mirrored, and with another gain. Sound and motion are changed together. The first
take of each recording is the recording itself.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import soundfile
import soxr

from gesturekit.corpus import Manifest, prepare
from gesturekit.corpus.manifest import Item
from gesturekit.motion import Motion
from gesturekit.motion.concatenation import concatenate
from gesturekit.motion.motion import can_be_mirrored

TEMPO, GAIN_DB = 0.1, 6.0
"""Largest change of the tempo, as a share, and of the gain."""
SEAM, FADE = 0.3, 0.005
"""Seconds of motion that are changed after a seam, and of sound that fade on each side of it."""
PEAK = 0.99
"""Largest sample; a gain is reduced where it would clip."""
TAKES_AT_ONCE = 16
"""Takes of one recording that a process writes before it reads another one."""


@dataclass(frozen=True)
class Change:
    """Difference between a variant and its recording; `shift` is a share of the duration."""

    tempo: float = 1.0
    shift: float = 0.0
    mirror: bool = False
    gain_db: float = 0.0


@dataclass(frozen=True)
class Task:
    """Takes of one recording to write: name without suffix to change."""

    item: Item
    takes: dict[str, Change]
    folder: Path
    suffix: str


def make_corpus(
    recordings: Path,
    hours: float,
    folder: Path,
    *,
    suffix: str = "bvh",
    speakers: int = 0,
    seed: int = 0,
) -> Path:
    """Write a corpus of about `hours` hours and return its manifest.

    Args:
        recordings: folder of wav and BVH files of equal names.
        hours: length of the corpus; it has at least one take.
        folder: folder of the corpus, made if it is missing.
        suffix: format of the motion, "bvh" or "npz".
        speakers: number of speakers whose names are given to the takes in turn; 0 gives none.
        seed: seed of all changes; the files depend on nothing else.
    """
    items = _items(prepare([recordings], holdout=0.0).manifest, recordings)
    folder.mkdir(parents=True, exist_ok=True)
    takes: list[dict[str, Change]] = [{} for _ in items]
    for index, change in enumerate(_changes(items, 3600 * hours, seed)):
        speaker = f"speaker{index % speakers + 1:02d}/" if speakers else ""
        takes[index % len(items)][f"{speaker}take{index:05d}"] = change
    tasks = [
        Task(item, dict(names[start : start + TAKES_AT_ONCE]), folder, suffix)
        for item, names in zip(items, (list(one.items()) for one in takes), strict=True)
        for start in range(0, len(names), TAKES_AT_ONCE)
    ]
    workers = os.cpu_count() or 1
    with ProcessPoolExecutor(min(workers, len(tasks)), get_context("spawn")) as pool:
        list(pool.map(_write, tasks))
    pattern = "(?P<speaker>speaker[0-9]+)/" if speakers else None
    manifest = folder / "corpus.jsonl"
    report = prepare([folder], manifest, workers=workers, style_pattern=pattern)
    if errors := [str(problem) for problem in report.problems if problem.severity == "error"]:
        raise SystemExit("\n".join(errors))
    return manifest


def _items(manifest: Manifest, recordings: Path) -> Sequence[Item]:
    """Return the paired items of a manifest; end the program if there are none."""
    items = [item for item in manifest if item.is_paired]
    if not items:
        raise SystemExit(f"{recordings}: no recordings with sound and motion of equal names")
    return items


def _changes(items: Sequence[Item], seconds: float, seed: int) -> Iterable[Change]:
    """Yield changes, for the recordings in turn, until their takes have a total of `seconds`."""
    total, index = 0.0, 0
    while True:
        change = Change()
        if index >= len(items):
            rng = np.random.default_rng((seed, index))
            change = Change(
                tempo=rng.uniform(1 - TEMPO, 1 + TEMPO),
                shift=rng.uniform(),
                mirror=bool(rng.integers(2)),
                gain_db=rng.uniform(-GAIN_DB, GAIN_DB),
            )
        length = items[index % len(items)].duration / change.tempo
        if index and total + length / 2 > seconds:
            return
        yield change
        total, index = total + length, index + 1


def _write(task: Task) -> None:
    """Write takes of one recording, each as a 16-bit wav and a motion file."""
    motion, wave = task.item.load_motion(), task.item.load_wave()
    for name, change in task.takes.items():
        path = task.folder / name
        path.parent.mkdir(exist_ok=True)
        varied, samples = variant(motion, wave.samples, wave.sample_rate, change)
        varied.save(path.with_suffix(f".{task.suffix}"))
        soundfile.write(path.with_suffix(".wav"), samples, wave.sample_rate, subtype="PCM_16")


def variant(
    motion: Motion, samples: np.ndarray, rate: int, change: Change
) -> tuple[Motion, np.ndarray]:
    """Return changed motion, and changed sound of its length."""
    if change.tempo != 1.0:
        motion = replace(motion, fps=motion.fps * change.tempo).resample(motion.fps)
        samples = soxr.resample(samples, rate * change.tempo, rate)
    samples = _of_length(samples, round(motion.duration * rate))
    frames = round(change.shift * motion.n_frames)
    if 0 < frames < motion.n_frames:
        motion = concatenate([motion[frames:], motion[:frames]], blend=SEAM)
        samples = _shifted_sound(samples, round(frames / motion.fps * rate), round(FADE * rate))
    if change.mirror and can_be_mirrored(motion.skeleton):
        motion = motion.mirror()
    gain = 10 ** (change.gain_db / 20)
    return motion, samples * min(gain, PEAK / max(np.abs(samples).max(), 1e-6))


def _of_length(samples: np.ndarray, length: int) -> np.ndarray:
    """Cut samples, or add silence."""
    return np.pad(samples[:length], (0, max(0, length - len(samples))))


def _shifted_sound(samples: np.ndarray, start: int, fade: int) -> np.ndarray:
    """Return samples from `start` on, followed by those before it, with a fade at the seam."""
    samples, seam = np.roll(samples, -start), len(samples) - start
    near = np.abs(np.arange(len(samples)) - seam) / fade
    return samples * np.minimum(near, 1.0)
