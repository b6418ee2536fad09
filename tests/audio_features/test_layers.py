"""Choice of an encoder's layers, on states that are all 0, all 1, all 2 and all 3."""

from __future__ import annotations

import math

import pytest

import audio_features as af
from audio_features.speech_encoders import LayerChoice, Options

torch = pytest.importorskip("torch")


class Network:
    """Network whose final normalisation multiplies by ten."""

    def __init__(self, ends_in_norm: bool) -> None:
        self.ends_in_norm = ends_in_norm

    def final_norm(self, x):
        return 10 * x


@pytest.mark.parametrize(
    ("layer", "norm", "values"),
    [
        (0, None, [0]),
        (2, None, [2]),
        (2, False, [2]),
        (3, None, [3]),
        (3, True, [30]),
        ("last", None, [30]),
        ("last", False, [3]),
        ([3, 1], None, [3, 1]),
        ((0, 3), True, [0, 30]),
        ([2], None, [2]),
        ("mean", None, [1.5]),
        ("mean", True, [(0 + 1 + 2 + 30) / 4]),
        ({1: 1, 3: 3}, None, [2.5]),
        ({"3": 3, 1: 1}, True, [(1 + 3 * 30) / 4]),
        ({"1": 1.0, "3": -0.5}, None, [-1]),
        ({2: -4.0}, None, [2]),
    ],
)
def test_states_are_picked_weighted_and_normalised(layer, norm, values):
    states = [torch.full((1, 5, 2), float(k)) for k in range(4)]
    choice = LayerChoice(layer, norm, 3)
    found = choice.pick(Network(True), iter(states))
    assert found.shape == (1, 5, 2 * len(values))
    assert found[0, 0, ::2].tolist() == pytest.approx(values)
    if layer in (3, "last", (0, 3)):
        plain = choice.pick(Network(False), iter(states))[0, 0, ::2]
        assert plain.tolist() == [min(value, 3) for value in values]
    assert choice.is_list == isinstance(layer, list | tuple)


@pytest.mark.parametrize(
    ("layer", "norm", "says"),
    [
        (4, None, "whole numbers from 0 to 3"),
        (-1, None, "whole numbers from 0 to 3"),
        (True, None, "whole numbers from 0 to 3"),
        ([0, False], None, "whole numbers from 0 to 3"),
        ({"x": 1.0}, None, "whole numbers from 0 to 3"),
        ([], None, "at least one"),
        ({}, None, "at least one"),
        ((1, 1), None, "name each layer once"),
        ({1: 1.0, "1": 1.0}, None, "name each layer once"),
        (2, True, "belongs to layer 3 alone"),
        ([1, 2], True, "belongs to layer 3 alone"),
        (3, 1, "final_norm=1: true or false"),
        ({1: math.inf}, None, "must be finite"),
        ({1: 1.0, 2: -1.0}, None, "not sum to 0"),
        ({1: None}, None, "a weight is not a number"),
    ],
)
def test_other_layers_are_refused(layer, norm, says):
    with pytest.raises(af.FeatureError, match=says):
        LayerChoice(layer, norm, 3)


def test_a_choice_is_written_as_json_has_it():
    for layer, spec in ((2, 2), ("mean", "mean"), ((0, 3), [0, 3]), ([3, 0], [3, 0]),
                        ({2: 1, "0": 2.5}, {"2": 1.0, "0": 2.5})):  # fmt: skip
        assert LayerChoice(layer, None, 3).spec == spec
    assert LayerChoice("mean", None, 3).indices == (0, 1, 2, 3)


@pytest.mark.parametrize(
    ("options", "is_right"),
    [
        ({"full_context": 0, "chunk": 0.02, "context": 0}, True),
        ({"full_context": 999_999, "chunk": 999_999, "context": 400_000}, True),
        ({"chunk": 10.02, "context": 5.0}, True),
        ({"full_context": -1}, False),
        ({"full_context": 1e6}, False),
        ({"context": -1}, False),
        ({"chunk": 0.019, "context": 0}, False),
        ({"chunk": 10.0, "context": 5.0}, False),
        ({"chunk": 1e6}, False),
        ({"chunk": float("nan")}, False),
        ({"chunk": "long"}, False),
    ],
)
def test_lengths_of_chunks_and_contexts_are_checked(options, is_right):
    if is_right:
        assert Options(**options).seconds | options == Options(**options).seconds
    else:
        with pytest.raises(af.FeatureError, match="seconds"):
            Options(**options)


def test_seconds_become_frames_and_the_waveform_is_normalised_as_asked():
    assert Options(None, None, 1.0, 0.5, 0.1).frames(320) == (50, 25, 5)
    assert Options().eps(None) is None and Options().eps(1e-5) == 1e-5
    assert Options(normalize=False).eps(1e-5) is None
    assert Options(normalize=0.5).eps(None) == 0.5
    for value in (True, 0.0, 1.0, "yes", 1):
        with pytest.raises(af.FeatureError, match="a number between 0 and 1"):
            Options(normalize=value).eps(1e-5)
