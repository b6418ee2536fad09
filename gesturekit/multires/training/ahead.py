"""Fit the predictions of movement for live speech."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

import audio_features as af
from audio_features.acoustic.analysis import SAMPLE_RATE
from audio_features.acoustic.streaming import check_streams
from gesturekit.corpus.item import Item
from gesturekit.corpus.manifest import Manifest
from gesturekit.errors import ModelError
from gesturekit.multires.model import MultiresModel
from gesturekit.multires.streaming.features import SpeechStream
from gesturekit.progress import Progress
from gesturekit.state.ahead import LOOK_AHEADS, AheadPrediction, FeatureWindow, live_rows
from gesturekit.state.prediction import slow_part
from gesturekit.state.process import StateProcess
from gesturekit.training.model_folder import save_model
from gesturekit.training.recordings import systematic_sample, training_items

log = logging.getLogger(__name__)

_MOST_SECONDS = 600.0
"""Recordings to fit to, spread over the corpus."""
_EVERY = 3
"""One in so many motion frames is used; frames beside each other are alike."""
_AFTER_SECONDS = 1.0
"""Silence after a recording, as its last frames look ahead."""
_ROWS_SECONDS = 1.0
"""Length of the window of features up to a frame."""


def with_live_predictions(model: MultiresModel, items: Sequence[Item]) -> MultiresModel:
    """Return a model with predictions for live speech, if it can stream; else the model itself.

    Args:
        model: with a state of movement.
        items: paired items of its training.

    Raises:
        CorpusError, AudioError, FormatError: a file cannot be read.
    """
    conditioner, process = model.conditions.conditioner, model.state_process
    if process is None or conditioner is None or process.wanted is None:
        return model
    try:
        check_streams(conditioner.extractor)
    except af.FeatureError:
        return model
    chosen = [excerpt.of(items) for excerpt in systematic_sample(items, _MOST_SECONDS)]
    fast, slow, speeches = [], [], []
    for item in Progress(chosen, desc="Fitting to live speech", unit="recording"):
        movement, states = _movement(model, process, item)
        fast.append(movement)
        slow.append(states)
        stream = SpeechStream(conditioner, SAMPLE_RATE, round(_ROWS_SECONDS * model.fps), _EVERY)
        speeches.append(_windows(stream, item))
    scores = [own.mean(axis=0) for own in slow]
    # The largest set of columns first; one that predicts hardly worse with fewer is used.
    columns = (conditioner.acoustic, conditioner.prosody)
    sets = [[i for i in own if i not in conditioner.effort] for own in columns]
    predictions = []
    for look_ahead in LOOK_AHEADS:
        ahead = stream.rows_ahead(look_ahead)
        pairs = [
            [(rows, row - ahead) for row, rows in windows if 0 <= row - ahead < len(movement)]
            for windows, movement in zip(speeches, fast, strict=True)
        ]
        frames = [[frame for _, frame in own] for own in pairs]
        predictions.append(
            AheadPrediction.fit(
                look_ahead,
                [[rows for rows, _ in own] for own in pairs],
                [curve[own] for curve, own in zip(fast, frames)],
                [curve[own] for curve, own in zip(scores, frames)],
                [item.take for item in chosen],
                process.wanted,
                sets,
                model.fps / _EVERY,
            )
        )
    log.info("Live: %s.", *live_rows(predictions).values())
    return with_ahead(model, tuple(predictions))


def with_ahead(model: MultiresModel, ahead: tuple[AheadPrediction, ...]) -> MultiresModel:
    """Return a model with these predictions for live speech."""
    assert model.state_process is not None
    return replace(model, state_process=replace(model.state_process, ahead=ahead))


def fit_live(model: MultiresModel, corpus: Path) -> None:
    """Add predictions for live speech to the folder of a model, from the corpus of its training.

    Raises:
        ModelError: the model cannot stream.
        CorpusError, AudioError, FormatError: a file cannot be read.
    """
    folder = model.folder
    items = training_items(Manifest.load(corpus), corpus, with_audio=True)
    fitted = with_live_predictions(model, items)
    if fitted is model or folder is None:
        raise ModelError(
            f"{folder}: the model cannot stream: it needs a state of movement, acoustic "
            "features, and speech that predicted movement in training"
        )
    readme = (folder / "README.md").read_text(encoding="utf-8").splitlines()
    kept = [line for line in readme if not line.startswith("- **Live**")]
    last = max((i for i, line in enumerate(kept) if line.startswith("- **")), default=-1)
    rows = [f"- **{name}**: {text}" for name, text in live_rows(fitted.ahead).items()]
    kept[last + 1 : last + 1] = rows
    save_model(folder, *fitted.parts(), "\n".join(kept) + "\n")


def _movement(
    model: MultiresModel, process: StateProcess, item: Item
) -> tuple[np.ndarray, np.ndarray]:
    """Return the fast movement of both hands together (T,), and normal scores of the slow one of
    each, (H, T)."""
    conditioner, channels = model.conditions.conditioner, process.channels
    assert conditioner is not None
    values = model.state(item.load_motion(model.skeleton.parts)).T
    speech = conditioner(item.load_wave(), values.shape[1]).T
    both = values[channels.fast].mean(axis=0)
    scores = process.scores(values, speech)[channels.of_hands]
    return both - slow_part(both, model.fps), scores


def _windows(stream: SpeechStream, item: Item) -> list[tuple[int, FeatureWindow]]:
    """Return what a stream knows with each of some of its rows, and their numbers."""
    sound = item.load_wave().resample(SAMPLE_RATE).samples
    sound = np.pad(sound, (0, round(_AFTER_SECONDS * SAMPLE_RATE)))
    return [(stream.n_rows - 1, window) for window in stream.push(sound)]
