"""Samples for the papers' evaluation protocols and of baseline models, written to a folder.

`gesturekit.evaluation` only reads such folders, not models. Motion has the model's own frame rate,
each recording's own style and speaker, and random numbers drawn from the seed and the clip's name.
Clips are named after their recordings: `STEM_s1` ..., `STEM_w000_s1` ... for windows.

Baselines that need a model are rendered here; `gesturekit.evaluation` makes those that need
recordings alone.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import audio_features as af
from gesturekit.corpus.manifest import Item, Manifest
from gesturekit.errors import ConfigError
from gesturekit.evaluation.comparison import LDA_SAMPLES, MULTIRES_LENGTH, MULTIRES_SAMPLES
from gesturekit.evaluation.pairs import WINDOW_SECONDS, files_by_key, motion_files
from gesturekit.formats.sources import SPEECH_SUFFIXES, load
from gesturekit.model import Model
from gesturekit.wording import listed

RETRIEVAL = "multires_speech/retrieval"
"""Recipe of the model that only chooses recorded pieces by the speech."""


@dataclass(frozen=True, kw_only=True)
class SamplingOptions:
    """Settings of `sample_multires` and `sample_lda`.

    Attributes:
        samples: number of samples for each sequence or window; None for that of the paper.
        seed: of `generate`, whose `item` is the name of the clip.
        skip: keep existing samples, to continue an interrupted run.
        controls: of `generate`, beside each recording's own style and speaker; `raw` unless it is
            given as False, as both papers measure what the network generates.
    """

    samples: int | None = None
    seed: int = 0
    skip: bool = False
    controls: Mapping[str, Any] = field(default_factory=dict)


def sample_multires(
    model: Model, items: Sequence[Item], out: Path, options: SamplingOptions
) -> Iterator[Path]:
    """Sample for Table 1 of Moreno-Villamarín et al. 2024, twice as long as training sequences.

    A model with speech input gets each sound twice in a row. Noise enters at the model's
    `noise_levels`, as in `generate`.

    Args:
        model: model from `gesturekit.load`.
        items: the training sequences.
        out: folder to fill with `STEM_s1.npz` ...
        options: settings.

    Yields:
        each file, as it is written.

    Raises:
        ConfigError: the style of an item is not one of the model's.
    """
    _check_styles(model, items)
    for item in items:
        controls = _controls(model, item, options, round(MULTIRES_LENGTH))
        yield from _samples(model, item.id, controls, out, options, MULTIRES_SAMPLES)


def sample_lda(
    model: Model, items: Sequence[Item], out: Path, options: SamplingOptions
) -> Iterator[Path]:
    """Sample for Table 4 of Alexanderson et al. 2023: for adjacent 10 s windows of speech.

    The rest of an item after its last whole window is not used. Files are `STEM_w000_s1.npz` ...;
    arguments are as in `sample_multires`, with the test recordings as items.

    Raises:
        ConfigError: no item is as long as a window, or the style of one is not the model's.
    """
    _check_styles(model, items)
    made = 0
    for item in items:
        for number in range(int(item.duration / WINDOW_SECONDS + 1e-6)):
            start = number * WINDOW_SECONDS
            window = replace(
                item,
                id=f"{item.id}_w{number:03d}",
                audio_start=item.audio_start + start,
                motion_start=item.motion_start + start,
                duration=WINDOW_SECONDS,
            )
            controls = _controls(model, window, options, 1)
            yield from _samples(model, window.id, controls, out, options, LDA_SAMPLES)
            made += 1
    if not made:
        longest = max((item.duration for item in items), default=0.0)
        short = f"no recording has {WINDOW_SECONDS:g} s, a window; the longest has {longest:.1f} s"
        raise ConfigError(f"{short}. Give another --split, or --protocol multires")


def sequences_of(folder: Path, audio: Path | None, reading: Mapping[str, Any]) -> list[Item]:
    """Return the motion of a folder as items, whose styles and speakers are not known.

    An item is as long as the shorter of its motion and its sound.

    Args:
        folder: folder of motion.
        audio: folder of its sound, or None.
        reading: options of `gesturekit.formats.sources.load`.

    Raises:
        CorpusError: an empty folder.
        ConfigError: `audio` lacks the sound of a motion.
    """
    motions = motion_files(folder)
    sounds = {} if audio is None else files_by_key(audio, SPEECH_SUFFIXES, "sound")
    missing = [stem for stem in motions if audio is not None and stem not in sounds]
    if missing:
        raise ConfigError(f"{audio}: no sound file named {', '.join(missing[:3])}")
    items = []
    for stem, path in motions.items():
        duration, sound = load(path, reading).duration, sounds.get(stem)
        if sound is not None:
            duration = min(duration, af.Wave.load(sound).duration)
        items.append(Item(id=stem, audio=sound, motion=path, duration=duration, reading=reading))
    return items


def sounds_of(folder: Path) -> list[Item]:
    """Return the sounds of a folder as items, whose styles and speakers are not known.

    Raises:
        CorpusError: an empty folder.
    """
    sounds = files_by_key(folder, SPEECH_SUFFIXES, "sound")
    return [
        Item(id=stem, audio=path, motion=None, duration=af.Wave.load(path).duration)
        for stem, path in sounds.items()
    ]


def train_retrieval(corpus: Path, folder: Path, *, seed: int) -> Path:
    """Return the folder of a model that plays recorded bodies, chosen by a drawn state.

    The pieces are those of the training split; no network is used.

    Args:
        corpus: manifest.
        folder: a new folder for the run.
        seed: of the run.

    Raises:
        ConfigError: see `gesturekit.train`, such as a corpus without training recordings.
    """
    from gesturekit.systems import train
    from gesturekit.training.trainer import silently

    run = partial(train, RETRIEVAL, corpus=str(corpus), out=str(folder), seed=seed)
    return silently(run, logging.WARNING)


def split_sounds(corpus: Path, split: str) -> dict[str, af.Wave]:
    """Return {id: sound} of the paired items of a split."""
    return {item.id: item.load_wave() for item in Manifest.load(corpus).paired(split)}


def other_sounds(corpus: Path, split: str) -> dict[str, af.Wave]:
    """Return {id: sound of another item, as long as the item's own}.

    It is the next item of the split, or an item of the training split if there is no other.
    A shorter sound is repeated.

    Raises:
        ConfigError: there is no other item.
    """
    own = split_sounds(corpus, split)
    others = own if len(own) > 1 else split_sounds(corpus, "train")
    names = list(others)
    if not set(names) - set(own) and len(names) < 2:
        raise ConfigError(f"{corpus}: speech_blind needs the sound of another recording")
    result = {}
    for name, wave in own.items():
        after = (names.index(name) + 1) % len(names) if name in others else 0
        other = others[names[after]].resample(wave.sample_rate)
        samples = np.resize(other.samples, len(wave.samples))
        result[name] = af.Wave(samples, wave.sample_rate, other.source)
    return result


def render_baseline(
    model: Model, sounds: Mapping[str, af.Wave], out: Path, *, seed: int
) -> Iterator[Path]:
    """Write ID.npz for each sound to `out`, and yield its path."""
    for name, wave in sounds.items():
        path = out / f"{name}.npz"
        path.parent.mkdir(parents=True, exist_ok=True)
        model.generate(wave, seed=seed, item=name).save(path)
        yield path


def _check_styles(model: Model, items: Sequence[Item]) -> None:
    """Check that the model has the style of each item.

    Raises:
        ConfigError: it lacks one, or an item has none.
    """
    unknown = {str(item.style) for item in items if item.style not in model.styles}
    if model.styles and unknown:
        names = [item.id for item in items if item.style not in model.styles]
        whose = f"style {listed(sorted(unknown), 3)} of {listed(names, 3)}"
        how = "give --corpus, a manifest with the recordings' styles"
        raise ConfigError(f"{whose}: the model has {', '.join(model.styles)}; {how}")


def _controls(model: Model, item: Item, options: SamplingOptions, repeats: int) -> dict[str, Any]:
    """Return the arguments of `generate` for an item, several times as long as the item."""
    found = item.controls(model) | {"raw": True} | dict(options.controls)
    if item.audio is None or not model.inputs.speech:
        return found | {"seconds": repeats * item.duration}
    wave = item.load_wave()
    return found | {"speech": replace(wave, samples=np.tile(wave.samples, repeats))}


def _samples(
    model: Model,
    name: str,
    controls: Mapping[str, Any],
    out: Path,
    options: SamplingOptions,
    usual: int,
) -> Iterator[Path]:
    # One at a time: 200 motions of some minutes do not fit into memory together.
    for number in range(options.samples or usual):
        stem = f"{name}_s{number + 1}"
        path = out / f"{stem}.npz"
        path.parent.mkdir(parents=True, exist_ok=True)
        if not (options.skip and path.exists()):
            motion = model.generate(**controls, seed=options.seed, item=stem, fps=model.fps)
            with warnings.catch_warnings():
                # Limits of other readers of npz do not matter: only `evaluate` reads samples.
                warnings.simplefilter("ignore")
                motion.save(path)
        yield path
