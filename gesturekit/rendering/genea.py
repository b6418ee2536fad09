"""Submission to the GENEA leaderboard: rendered from the published test split, and checked.

The leaderboard (https://genea-workshop.github.io/leaderboard) asks for motion in the SMPL-X format
for every recording of the English test set of BEAT2, as long as the sound, and for five samples a
recording where a model has randomness. Seamless Interaction is written as SMPL-H in the same way.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from audio_features import AudioError, Wave
from gesturekit.corpus.layouts import read_layout
from gesturekit.errors import CorpusError, GestureKitError
from gesturekit.jobs.batch import Batch, Execution
from gesturekit.model import Model
from gesturekit.motion.motion import Motion
from gesturekit.rendering.renderer import Output, render_batch
from gesturekit.wording import did_you_mean

RIGS = {"beat2": "smplx", "seamless": "smplh"}
"""Body model of each corpus' submission."""
_JOINTS = {"smplx": 55, "smplh": 52}
FPS = 30.0
SAMPLES = 5


def published_sounds(folder: str | Path, layout: str = "beat2") -> dict[str, Path]:
    """Return {name: sound} of a corpus' published test split.

    Sounds are whole; the manifest of `prepare` trims them to the recorded motion.

    Raises:
        CorpusError: an unknown layout, a folder that is not in its form, or no test split.
    """
    if layout not in RIGS:
        hint = did_you_mean(layout, RIGS, "did you mean {}? ")
        raise CorpusError(f"layout {layout!r}: {hint}a submission is for {' or '.join(RIGS)}")
    recordings = read_layout(layout, Path(folder)).recordings
    sounds = [r.audio for r in recordings if r.split == "test" and r.audio is not None]
    if not sounds:
        raise CorpusError(f"{folder}: no sound in the test split of {layout}")
    return {sound.stem: sound for sound in sorted(sounds)}


def export(
    model: Model,
    folder: str | Path,
    out: str | Path,
    *,
    layout: str = "beat2",
    samples: int = SAMPLES,
    existing: str = "refuse",
    workers: int = 1,
    seed: int = 0,
) -> Batch:
    """Return the work of rendering a submission, which makes what is missing.

    Files are NAME_s1.npz to NAME_s5.npz (NAME.npz for one sample) for each sound.

    Args:
        model: any rig is retargeted.
        folder: the corpus as published.
        out: folder for the files.
        layout: beat2 or seamless.
        samples: number of motions for each sound.
        existing, workers: see `Output` and `Execution`.
        seed: of `generate`.

    Raises:
        CorpusError: see `published_sounds`.
        GestureKitError: see `gesturekit.render`.
    """
    sounds = list(published_sounds(folder, layout).values())
    output = Output("npz", existing, rig=RIGS[layout])
    execution = Execution(workers)
    return render_batch(model, sounds, out, output, execution, fps=FPS, samples=samples, seed=seed)


def check(out: str | Path, sounds: Mapping[str, Path], rig: str, samples: int) -> list[str]:
    """Return what is wrong with a submission, one line a fault; [] if nothing is.

    Checked are: a sound that can be read, a file for each sample, joints of the rig, frame rate,
    finite values, the number of frames of the whole sound, and samples that differ.

    Args:
        out: folder of the submission.
        sounds: see `published_sounds`.
        rig: smplx or smplh.
        samples: number of motions for each sound.
    """
    faults = []
    for stem, sound in sounds.items():
        try:
            wanted = Wave.load(sound).n_frames(FPS)
        except AudioError as error:
            faults.append(str(error))
            continue
        seen: list[np.ndarray] = []
        for k in range(samples):
            name = f"{stem}.npz" if samples == 1 else f"{stem}_s{k + 1}.npz"
            motion, fault = _read(Path(out) / name, rig, wanted)
            if motion is not None and any(np.array_equal(motion, other) for other in seen):
                fault = "the same motion as another sample; render with other noise"
            if fault:
                faults.append(f"{name}: {fault}")
            elif motion is not None:
                seen.append(motion)
    return faults


def _read(path: Path, rig: str, n_frames: int) -> tuple[np.ndarray | None, str]:
    """Return the rotations of a file, and its fault or ""."""
    if not path.is_file():
        return None, "missing"
    try:
        motion = Motion.load(path)
    except GestureKitError as error:
        return None, str(error)
    joints = motion.skeleton.n_joints
    if joints != _JOINTS[rig]:
        return None, f"{joints} joints; {rig} has {_JOINTS[rig]}"
    if motion.fps != FPS:
        return None, f"{motion.fps:g} fps; {FPS:g} are asked for"
    if motion.n_frames != n_frames:
        return None, f"{motion.n_frames} frames; the sound has {n_frames} at {FPS:g} fps"
    return motion.rotations, ""
