"""Baselines that need a model: rendered to a folder, which `gesturekit evaluate` compares with.

`gesturekit.evaluation.measuring.baselines` makes those that need recordings alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from audio_features import Wave
from gesturekit.corpus.manifest import Manifest
from gesturekit.errors import ConfigError
from gesturekit.model import Model

RETRIEVAL = "multires_speech/retrieval"
"""Recipe of the model that only chooses recorded pieces by the speech."""


def train_retrieval(corpus: Path, folder: Path, *, seed: int = 0) -> Path:
    """Return the folder of a model that moves in recorded pieces, chosen by the speech.

    The pieces are those of the training split; no network is used.

    Args:
        corpus: manifest.
        folder: a new folder for the run.
        seed: of the run.

    Raises:
        ConfigError: see `gesturekit.train`, such as a corpus without training recordings.
    """
    from gesturekit.systems import train

    return train(RETRIEVAL, corpus=str(corpus), out=str(folder), seed=seed)


def sounds_of(corpus: Path, split: str) -> dict[str, Wave]:
    """Return {id: sound} of the paired items of a split."""
    return {item.id: item.load_wave() for item in Manifest.load(corpus).paired(split)}


def other_sounds(corpus: Path, split: str) -> dict[str, Wave]:
    """Return {id: sound of another item, as long as the item's own}.

    It is the next item of the split, or an item of the training split if there is no other.
    A shorter sound is repeated.

    Raises:
        ConfigError: there is no other item.
    """
    own = sounds_of(corpus, split)
    others = own if len(own) > 1 else sounds_of(corpus, "train")
    names = list(others)
    if not set(names) - set(own) and len(names) < 2:
        raise ConfigError(f"{corpus}: speech_blind needs the sound of another recording")
    result = {}
    for name, wave in own.items():
        after = (names.index(name) + 1) % len(names) if name in others else 0
        other = others[names[after]].resample(wave.sample_rate)
        samples = np.resize(other.samples, len(wave.samples))
        result[name] = Wave(samples, wave.sample_rate, other.source)
    return result


def render_baseline(
    model: Model, sounds: Mapping[str, Wave], out: Path, *, seed: int = 0
) -> Iterator[Path]:
    """Write ID.npz for each sound to `out`, and yield its path."""
    for name, wave in sounds.items():
        path = out / f"{name}.npz"
        path.parent.mkdir(parents=True, exist_ok=True)
        model.generate(wave, seed=seed).save(path)
        yield path
