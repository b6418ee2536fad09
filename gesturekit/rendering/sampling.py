"""Samples for the papers' evaluation protocols, written to a folder.

`gesturekit.evaluation` only reads such folders, not models. Motion has the model's own frame rate.
Clips are named after their recordings: `STEM_s1` ..., `STEM_w000_s1` ... for windows.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import audio_features as af
from gesturekit.errors import ConfigError
from gesturekit.evaluation.comparison import LDA_SAMPLES, MULTIRES_LENGTH, MULTIRES_SAMPLES
from gesturekit.evaluation.pairs import (
    WINDOW_SECONDS,
    files_by_key,
    motion_files,
)
from gesturekit.formats.sources import SPEECH_SUFFIXES
from gesturekit.model import Model
from gesturekit.motion.motion import Motion


def sample_multires(
    model: Model,
    reference: Path,
    out: Path,
    *,
    audio: Path | None = None,
    samples: int = MULTIRES_SAMPLES,
    seed: int = 0,
    skip: bool = False,
) -> Iterator[Path]:
    """Sample for Table 1 of Moreno-Villamarín et al. 2024, twice as long as training sequences.

    Noise is given to level 1 only, as in `generate`, and feet are not locked.

    Args:
        model: model from `gesturekit.load`.
        reference: folder of the training sequences.
        out: folder to fill with `STEM_s1.npz` ...
        audio: folder of their sound; a model with speech input gets each sound twice in a row.
            Without it, the model generates without speech.
        samples: number of samples for each sequence.
        seed: seed of the first sample of each; the others count up from it.
        skip: keep existing samples, to continue an interrupted run.

    Yields:
        each file, as it is written.

    Raises:
        CorpusError: an empty folder.
        ConfigError: `audio` lacks the sound of a sequence.
    """
    sequences = motion_files(reference)
    sounds = {} if audio is None else files_by_key(audio, SPEECH_SUFFIXES, "sound")
    missing = [stem for stem in sequences if audio is not None and stem not in sounds]
    if missing:
        raise ConfigError(f"{audio}: no sound file named {', '.join(missing[:3])}")
    for stem, path in sequences.items():
        if stem in sounds:
            wave = af.Wave.load(sounds[stem])
            whole = np.tile(wave.samples, round(MULTIRES_LENGTH))
            asked = {"speech": af.Wave(whole, wave.sample_rate, wave.source)}
        else:
            asked = {"seconds": MULTIRES_LENGTH * Motion.load(path).duration}
        yield from _samples(model, asked | {"foot_lock": False}, out, stem, samples, seed, skip)


def sample_lda(
    model: Model,
    audio: Path,
    out: Path,
    *,
    samples: int = LDA_SAMPLES,
    seed: int = 0,
    skip: bool = False,
) -> Iterator[Path]:
    """Sample for Table 4 of Alexanderson et al. 2023: for adjacent 10 s windows of speech.

    The rest of a recording after its last whole window is not used. Files are `STEM_w000_s1.npz`
    ...; `audio` is the folder of the test recordings' sound, and the rest as in `sample_multires`.

    Raises:
        CorpusError: an empty folder.
        ConfigError: no recording is as long as a window.
    """
    made = 0
    for stem, path in files_by_key(audio, SPEECH_SUFFIXES, "sound").items():
        wave = af.Wave.load(path)
        for window in range(int(wave.duration / WINDOW_SECONDS + 1e-6)):
            asked = {"speech": wave.slice(window * WINDOW_SECONDS, WINDOW_SECONDS)}
            yield from _samples(model, asked, out, f"{stem}_w{window:03d}", samples, seed, skip)
            made += 1
    if not made:
        raise ConfigError(f"{audio}: no recording is as long as a window of {WINDOW_SECONDS:g} s")


def _samples(
    model: Model, asked: dict[str, Any], out: Path, stem: str, samples: int, seed: int, skip: bool
) -> Iterator[Path]:
    # One at a time: 200 motions of some minutes do not fit into memory together.
    for number in range(samples):
        path = out / f"{stem}_s{number + 1}.npz"
        path.parent.mkdir(parents=True, exist_ok=True)
        if not (skip and path.exists()):
            model.generate(**asked, seed=seed + number, fps=model.fps).save(path)
        yield path
