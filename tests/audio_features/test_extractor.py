import json

import numpy as np
import pytest

import audio_features as af


@pytest.mark.parametrize(
    "extractor",
    [
        af.LogMel(16),
        af.MFCC(13),
        af.Prosody(),
        af.Onset(),
        af.Music(1),
        af.Stack([af.MFCC(), af.Prosody()]),
    ],
)
def test_a_spec_makes_the_same_extractor_again(extractor, speech):
    spec = json.loads(json.dumps(extractor.spec))
    again = af.extractor_from_spec(spec)
    assert again.spec == extractor.spec
    np.testing.assert_array_equal(again.extract(speech).values, extractor.extract(speech).values)
    assert isinstance(again, af.Extractor)


@pytest.mark.parametrize(
    ("spec", "word"),
    [
        ({"kind": "mell"}, "mell"),
        ({}, "None"),
        ([], "None"),
        ({"kind": "logmel", "bands": 3}, "bands"),
        ({"kind": "logmel", "n_mels": "many"}, "many"),
        ({"kind": "stack", "parts": "logmel"}, "parts"),
        ({"kind": "stack", "parts": []}, "empty"),
    ],
)
def test_wrong_specs_are_refused(spec, word):
    with pytest.raises(af.FeatureError, match=word):
        af.extractor_from_spec(spec)
