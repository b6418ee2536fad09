"""The model of a training run: its parts, its README, and predictions for live speech."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import audio_features as af
from audio_features.acoustic import SAMPLE_RATE
from audio_features.acoustic.streaming import check_streams
from gesturekit.corpus.manifest import Item, Manifest
from gesturekit.corpus.speech import SpeechConditioner
from gesturekit.errors import ModelError
from gesturekit.multires.config import MultiresConfig
from gesturekit.multires.model import MultiresModel
from gesturekit.multires.motion_vector import fastest_second
from gesturekit.multires.networks import MultiresGenerator
from gesturekit.multires.pyramid import TrainedNoise, TrainedSequence
from gesturekit.multires.retrieval import RecordedLibrary
from gesturekit.multires.stream import SpeechStream
from gesturekit.multires.training.data import TrainingData
from gesturekit.multires.training.state import TrainingState
from gesturekit.progress import Progress
from gesturekit.state.prediction import (
    LOOK_AHEADS,
    AheadPrediction,
    FeatureWindow,
    live_rows,
    slow_part,
)
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


def trained_model(
    config: MultiresConfig,
    data: TrainingData,
    network: MultiresGenerator,
    state: TrainingState | None,
    library: RecordedLibrary | None,
) -> MultiresModel:
    """Return the model of a network, which is moved to the CPU."""
    # With a state of movement, a recording is made of its state, which is not kept.
    reconstructed = data.sample if state is None else ()
    names, xz = data.conditions.styles, data.representation.layout.root_xz
    sequences = {
        each.name: TrainedSequence(each.n_frames, names[each.style] if names else None)
        for each in reconstructed
    }
    steps = [data.normaliser.to_values(each.motion[:, :][None])[:, xz] for each in data.sample]
    noise = TrainedNoise(
        sigma=torch.stack([sequence.sigma for sequence in data.sample]),
        z_star={sequence.name: sequence.z_star for sequence in reconstructed},
        sequences=sequences,
        z_star_shuffle=config.z_star_shuffle,
        noise_levels=config.noise_levels,
    )
    return MultiresModel(
        fps=config.fps,
        representation=data.representation,
        normaliser=data.normaliser,
        conditions=data.conditions,
        library=library,
        state_process=None if state is None else state.process,
        network_config=config.network,
        network=network.cpu().eval(),
        noise=noise,
        speakers=data.speakers,
        fastest=data.representation.scale * max(fastest_second(way, config.fps) for way in steps),
        smooth=config.smooth,
        recorded_fps=data.recorded_fps,
    )


def live_predictions(model: MultiresModel, corpus: Path) -> tuple[AheadPrediction, ...]:
    """Return predictions of movement for live speech; none for a model that cannot stream.

    Args:
        model: with a state of movement.
        corpus: of its training.

    Raises:
        CorpusError, AudioError, FormatError: a file cannot be read.
    """
    conditioner, process = model.conditions.conditioner, model.state_process
    if process is None or conditioner is None or process.wanted is None:
        return ()
    try:
        check_streams(conditioner.extractor)
    except af.FeatureError:
        return ()
    items = training_items(Manifest.load(corpus), corpus, with_audio=True)
    chosen = [excerpt.of(items) for excerpt in systematic_sample(items, _MOST_SECONDS)]
    fast, slow, speeches = [], [], []
    for item in Progress(chosen, desc="Fitting to live speech", unit="recording"):
        movement, scores = _movement(model, process, conditioner, item)
        fast.append(movement)
        slow.append(scores)
        stream = SpeechStream(conditioner, SAMPLE_RATE, round(_ROWS_SECONDS * model.fps), _EVERY)
        speeches.append(list(_windows(stream, item)))
    # The largest set of columns first; one that predicts hardly worse with fewer is used.
    columns = (conditioner.acoustic, conditioner.prosody)
    sets = [[i for i in numbers if i not in conditioner.effort] for numbers in columns]
    predictions = []
    for look_ahead in LOOK_AHEADS:
        ahead = stream.rows_ahead(look_ahead)
        known, fast_known, slow_known = [], [], []
        for windows, movement, scores in zip(speeches, fast, slow, strict=True):
            pairs = [(rows, row - ahead) for row, rows in windows]
            pairs = [(rows, frame) for rows, frame in pairs if 0 <= frame < len(movement)]
            frames = [frame for _, frame in pairs]
            known.append([rows for rows, _ in pairs])
            fast_known.append(movement[frames])
            slow_known.append(scores[frames])
        takes = [item.take for item in chosen]
        given = known, fast_known, slow_known, takes, process.wanted, sets
        predictions.append(AheadPrediction.fit(look_ahead, *given, model.fps / _EVERY))
    log.info("Live: %s.", *live_rows(predictions).values())
    return tuple(predictions)


def fit_live(model: MultiresModel, corpus: Path) -> None:
    """Add predictions for live speech to the folder of a model, from the corpus of its training.

    Raises:
        ModelError: the model cannot stream.
        CorpusError, AudioError, FormatError: a file cannot be read.
    """
    folder, ahead = model.folder, live_predictions(model, corpus)
    if not ahead or folder is None:
        raise ModelError(
            f"{folder}: the model cannot stream: it needs a state of movement, acoustic "
            "features, and speech that predicted movement in training"
        )
    readme = (folder / "README.md").read_text(encoding="utf-8").splitlines()
    kept = [line for line in readme if not line.startswith("- **Live**")]
    last = max((i for i, line in enumerate(kept) if line.startswith("- **")), default=-1)
    rows = [f"- **{name}**: {text}" for name, text in live_rows(ahead).items()]
    kept[last + 1 : last + 1] = rows
    assert model.state_process is not None
    process = replace(model.state_process, ahead=ahead)
    parts = replace(model, state_process=process).parts()
    save_model(folder, *parts, "\n".join(kept) + "\n")


def _movement(
    model: MultiresModel, process: StateProcess, conditioner: SpeechConditioner, item: Item
) -> tuple[np.ndarray, np.ndarray]:
    """Return the fast movement of both hands together, and the mean of their normal scores of the
    slow one, both (T,)."""
    channels = process.channels
    values = model.state(item.load_motion(model.skeleton.parts)).T
    speech = conditioner(item.load_wave(), values.shape[1]).T
    both = values[channels.fast].mean(axis=0)
    scores = process.scores(values, speech)[channels.of_hands]
    return both - slow_part(both, model.fps), scores.mean(axis=0)


def _windows(stream: SpeechStream, item: Item) -> Iterator[tuple[int, FeatureWindow]]:
    """Yield what a stream knows with each of some of its rows, and their numbers."""
    sound = item.load_wave().resample(SAMPLE_RATE).samples
    sound = np.pad(sound, (0, round(_AFTER_SECONDS * SAMPLE_RATE)))
    for window in stream.push(sound):
        yield stream.n_rows - 1, window
