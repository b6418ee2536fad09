"""Choice of an encoder's layers, on states that are all 0, all 1, all 2 and all 3."""

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
        (3, True, [30]),
        ("last", None, [30]),
        ("last", False, [3]),
        ([3, 1], None, [3, 1]),
        ((0, 3), True, [0, 30]),
        ("mean", None, [1.5]),
        ({1: 1, 3: 3}, None, [2.5]),
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
        (4, None, r"(?=.*\b4\b).*\b3\b"),
        ([], None, r"\[\]"),
        ((1, 1), None, r"\(1, 1\)"),
        (2, True, "layer 3"),
        (3, 1, "final_norm=1"),
        ({1: 1.0, 2: -1.0}, None, "-1.0"),
    ],
)
def test_other_layers_are_refused(layer, norm, says):
    with pytest.raises(af.FeatureError, match=says):
        LayerChoice(layer, norm, 3)


def test_lengths_of_chunks_and_contexts_are_checked():
    right = {"full_context": 0, "chunk": 0.5, "context": 0}
    assert Options(**right).seconds == right
    for wrong in ({"chunk": 0.001, "context": 0}, {"chunk": 1, "context": 2}, {"chunk": "long"}):
        with pytest.raises(af.FeatureError, match=f"chunk.*{wrong['chunk']}"):
            Options(**wrong)
