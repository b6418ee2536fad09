"""Speech features of a run: reduced to components, stored, and loaded again."""

import logging
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import soundfile

import audio_features as af
from gesturekit.corpus import Item, Manifest, prepare
from gesturekit.corpus.speech import extract
from gesturekit.training.arrays import array_key, stored_arrays
from gesturekit.training.features import (
    FeatureConfig,
    SpeechArrays,
    conditioner_tensors,
    conditioner_values,
    load_conditioner,
    raw_speech,
    speech_frames,
)


def features_of(items, config, most=None):
    """Return a conditioner, and the features of items or of their first frames."""
    maker = SpeechArrays.open(config, 25.0, "cpu")
    made = maker.in_memory(items)
    conditioner = maker.fit([(array, 0, array.shape[0]) for array in made], None)
    frames = speech_frames(made, conditioner, [most or 10_000] * len(made))
    return conditioner, [values[:, :].T.numpy() for values in frames]


EXTRACTORS = ({"kind": "logmel", "n_mels": 12}, {"kind": "effort"})


@pytest.fixture(scope="module")
def heard(corpus):
    """f(config): conditioner and features of a corpus, and a wave."""

    def hear(config):
        items = [item for item in Manifest.load(corpus) if item.audio]
        return *features_of(items, config), items[0].load_wave()

    return hear


@pytest.mark.parametrize(
    ("normalise", "components"), [("clip", 3), ("corpus", 3), ("none", 3), ("clip", None)]
)
def test_stored_settings_give_the_features_of_training(heard, normalise, components, caplog):
    caplog.set_level(logging.INFO)
    config = FeatureConfig(EXTRACTORS, normalise=normalise, components=components)
    conditioner, speeches, wave = heard(config)
    said = re.search(r"(?=.*\b12\b)(?=.*\b15\b)(?=.*\b3\b)", caplog.text)
    assert (said is None) == (components is None)
    values, tensors = conditioner_values(conditioner), conditioner_tensors(conditioner)
    again = load_conditioner(values, tensors, 25.0, None)
    assert values["components"] == components and again.dim == (6 if components else 15)
    np.testing.assert_array_equal(again(wave), conditioner(wave))
    np.testing.assert_allclose(again(wave, len(speeches[0])), speeches[0], atol=1e-4)


def test_sound_without_voice_counts_as_silence_in_training_too(tmp_path, write_speech, caplog):
    noise = np.random.default_rng(0).standard_normal(64_000).astype(np.float32)
    soundfile.write(tmp_path / "floor.wav", 0.01 * noise, 16_000)
    soundfile.write(tmp_path / "still.wav", 0 * noise, 16_000)
    write_speech(tmp_path / "talk.wav", 4.0)
    prepare([], tmp_path / "corpus.jsonl", unpaired=[tmp_path], holdout=0.0)
    items = sorted(Manifest.load(tmp_path / "corpus.jsonl"), key=lambda item: item.audio.stem)

    def features(**settings):
        config = FeatureConfig(EXTRACTORS, **settings)
        return features_of(items, config)

    conditioner, (floor, still, talk) = features()
    (message,) = [text for text in caplog.messages if "voice" in text]
    assert re.search(r"(?=.*\b1\b)(?=.*\b3\b)(?=.*features\.vad=false)", message)
    np.testing.assert_array_equal(floor, still)
    assert not np.allclose(talk, still)
    np.testing.assert_allclose(conditioner(items[0].load_wave()), floor, atol=1e-6)
    caplog.clear()
    conditioner, (floor, still, _) = features(vad=False)
    assert not caplog.messages and not np.allclose(floor, still)
    values, tensors = conditioner_values(conditioner), conditioner_tensors(conditioner)
    again = load_conditioner(values, tensors, 25.0, None)
    np.testing.assert_allclose(again(items[0].load_wave()), floor, atol=1e-4)


@pytest.mark.parametrize("most", [None, 60])
def test_features_on_disk_are_those_in_memory(tmp_path, write_speech, most, caplog):
    """Two sounds, one with a pause and one of noise, whole or as long as their motion."""
    voice, _ = soundfile.read(write_speech(tmp_path / "in" / "a.wav", 3.0))
    voice[16_000:24_000] = 0.0
    soundfile.write(tmp_path / "in" / "a.wav", voice, 16_000)
    noise = 0.01 * np.random.default_rng(0).standard_normal(48_000)
    soundfile.write(tmp_path / "in" / "b.wav", noise, 16_000)
    items = prepare([], unpaired=[tmp_path / "in"], holdout=0.0).manifest.items
    config = FeatureConfig(EXTRACTORS)
    maker = SpeechArrays.open(config, 25.0, "cpu")
    ((one, other),) = stored_arrays(tmp_path / "arrays", [(maker, items)], 1)
    conditioner, speeches = features_of(items, config, most)
    caplog.clear()
    stored = speech_frames([one, other], conditioner, [most, 70] if most else [75, 75])
    assert re.search(rf"(?=.*\b1\b)(?=.*\b2\b)(?=.*{items[1].id})", caplog.text)
    assert stored[0].shape == (conditioner.dim, most or 75)
    assert stored[1].shape == (conditioner.dim, 70 if most else 75)
    np.testing.assert_allclose(stored[0][:, :].numpy().T, speeches[0], atol=1e-5)
    values, active = raw_speech(one, 20, 40)
    whole, spoken = extract(af.speech_only(items[0].load_wave()), maker.extractor, 25.0, "mean")
    np.testing.assert_allclose(values, whole[20:40], atol=1e-5)
    np.testing.assert_array_equal(active, spoken[20:40])
    assert 0 < active.sum() < 20
    assert one.facts["spoken"] == spoken.sum()
    exact = whole[spoken].astype(np.float64).sum(axis=0)
    np.testing.assert_allclose(one.facts["total"], exact)


def test_an_array_of_speech_is_made_anew_where_what_it_depends_on_changes(tmp_path, write_speech):
    audio, words = write_speech(tmp_path / "a.wav", 1.0), tmp_path / "a.tsv"
    words.write_text("0.1\t0.4\thello\n")
    item = Item(id="a", audio=audio, motion=None, duration=1.0, conditions={"words": words})
    plain = FeatureConfig(({"kind": "prosody"},))

    def key(config: FeatureConfig = plain, fps: float = 25.0, **changes: Any) -> str:
        return array_key(SpeechArrays.open(config, fps, "cpu"), replace(item, **changes))

    known = key()
    assert key(id="b", speaker="ann", motion_start=0.5, conditions={}) == known
    assert key(replace(plain, components=3)) == key(replace(plain, normalise="clip")) == known
    others = [
        *(key(audio_start=0.1), key(duration=0.9), key(channel=1), key(audible=[(0.0, 0.5)])),
        *(key(fps=30.0), key(replace(plain, align="linear")), key(replace(plain, vad=False))),
        *(key(replace(plain, normalise="corpus")), key(FeatureConfig(({"kind": "effort"},)))),
        *(key(FeatureConfig(({"kind": "words"},))), key(audio=words)),
    ]
    assert len({known, *others}) == len(others) + 1
    spoken = FeatureConfig(({"kind": "words"},))
    with_words = key(spoken)
    assert key(spoken, conditions={}) != with_words
    words.write_text("0.1\t0.4\tthere\n")
    assert key(spoken) != with_words and key() == known
