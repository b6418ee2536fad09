"""What a model is told: columns, frames, and what is refused."""

import numpy as np
import pytest
import torch

import audio_features as af
from gesturekit.corpus.speech import SpeechConditioner
from gesturekit.diffusion.conditions import Conditions, smooth_path
from gesturekit.formats.tables import Event
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


def test_a_path_is_smoothed_over_a_third_of_a_second():
    corner = RootPath(np.array([[0, 0]] * 30 + [[1, 0]] * 30, float), np.zeros(60), 60.0)
    moved = np.flatnonzero(np.abs(np.diff(smooth_path(corner, 30.0).positions[:, 0])) > 1e-6)
    assert 8 <= len(moved) <= 12
