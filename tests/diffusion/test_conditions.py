"""What a model is told: columns, frames, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import audio_features as af
from gesturekit.corpus.speech import SpeechConditioner
from gesturekit.diffusion.conditions import Conditions, smooth_path
from gesturekit.errors import ModelError
from gesturekit.formats.tables.events import Event
from gesturekit.motion.root_path import RootPath

FPS = 30.0


@pytest.fixture(scope="module")
def conditions() -> Conditions:
    extractor = af.extractor_from_spec({"kind": "logmel", "n_mels": 4})
    conditioner = SpeechConditioner(extractor, FPS, "mean", np.full(4, 0.5), np.full(4, 2.0))
    styles, events = ("calm", "lively", "old"), ("kick", "punch")
    scaling = np.array([0.0, 0.02, 0.0]), np.array([0.1, 0.01, 0.01])
    return Conditions(conditioner, True, events, styles, *scaling)


def test_each_part_stands_in_its_columns(conditions):
    path = RootPath(np.stack([np.zeros(10), 0.03 * np.arange(10)], axis=-1), np.zeros(10), FPS)
    style = np.tile([0.0, 0.25, 0.75], (10, 1))
    told = {"events": [Event(0.1, "punch"), Event(0.2, "kick", 0.1)], "style": style}
    rows = conditions.encode(10, FPS, speech=np.full((10, 4), 7.0), path=path, **told)
    assert rows.dtype == np.float32 and rows.shape == (10, conditions.width) == (10, 12)
    columns = conditions.columns
    assert (rows[:, columns["speech"]] == 7).all()
    assert np.allclose(rows[:, columns["path"]], [0.0, 1.0, 0.0], atol=1e-5)  # normalised
    assert rows[:, columns["events"]].T.tolist() == [
        [0, 0, 0, 0, 0, 0, 1, 1, 1, 0],
        [0, 0, 0, 1, 0, 0, 0, 0, 0, 0],
    ]
    assert np.allclose(rows[:, columns["styles"]], style)


def test_missing_and_dropped_conditions_are_zeros(conditions):
    speech = np.ones((5, 4), np.float32)
    style = np.tile([1.0, 0.0, 0.0], (5, 1))
    rows = conditions.encode(5, FPS, speech=speech, style=style)
    assert not rows[:, conditions.columns["path"]].any()
    for values in (rows, torch.from_numpy(rows)[None]):
        mute = conditions.without(values, "speech")
        assert not mute[..., :4].any() and mute[..., -3].all() and values[..., :4].all()
        assert not conditions.without(values).any()


def test_events_past_the_end_are_left_out_and_the_last_frame_is_reached(conditions):
    # 0.05 s is between frames 1 and 2, and 0.045 s nearer to 1; each lasts a frame at least.
    events = [Event(0.05, "kick"), Event(0.045, "punch", 0.01), Event(0.1, "punch", 0.05)]
    flags = conditions.encode(6, FPS, events=events)[:, conditions.columns["events"]]
    assert flags.T.tolist() == [[0, 0, 1, 0, 0, 0], [0, 1, 0, 1, 1, 0]]
    flags = conditions.encode(3, FPS, events=[Event(0.07, "kick", 9.0), Event(5.0, "punch")])
    assert flags[:, conditions.columns["events"]].T.tolist() == [[0, 0, 1], [0, 0, 0]]


def test_invalid_conditions_are_one_clear_error(conditions):
    with pytest.raises(ModelError, match=r"event 'kik': did you mean kick\? the model has kick"):
        conditions.encode(3, FPS, events=[Event(0.0, "kik")])
    with pytest.raises(ModelError, match=r"speech of shape \(3, 5\); expected \(3, 4\)"):
        conditions.encode(3, FPS, speech=np.zeros((3, 5)))
    with pytest.raises(ModelError, match=r"styles of shape .* the model has no such part"):
        Conditions().encode(3, FPS, style=np.ones((3, 1)))
    with pytest.raises(ModelError, match=r"path of shape .* expected \(3, 3\)"):
        conditions.encode(3, FPS, path=RootPath(np.zeros((4, 2)), np.zeros(4), FPS))


def test_a_saved_condition_comes_back(conditions):
    back = Conditions.from_values(conditions.to_values(), conditions.to_tensors(), FPS)
    speech = np.random.default_rng(0).normal(size=(6, 4)).astype(np.float32)
    path = smooth_path(RootPath.looking_ahead(speech[:, :2].cumsum(0), 60.0), FPS)
    told = {"n_frames": path.n_frames, "fps": FPS, "path": path, "events": [Event(0.0, "kick")]}
    assert np.array_equal(back.encode(**told), conditions.encode(**told))
    wave = af.Wave(0.1 * speech.repeat(800).astype(np.float32), 16000, None)
    assert np.array_equal(back.conditioner(wave), conditions.conditioner(wave))
    empty = Conditions.from_values(Conditions().to_values(), Conditions().to_tensors(), FPS)
    assert empty.encode(4, FPS).shape == (4, 0)


def test_a_path_is_smoothed_over_a_third_of_a_second():
    corner = RootPath(np.array([[0, 0]] * 30 + [[1, 0]] * 30, float), np.zeros(60), 60.0)
    moved = np.flatnonzero(np.abs(np.diff(smooth_path(corner, 30.0).positions[:, 0])) > 1e-6)
    assert 10 <= len(moved) <= 11
