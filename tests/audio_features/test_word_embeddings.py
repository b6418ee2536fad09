"""Embeddings of words by Hugging Face text encoders: transformers' values over each word's time."""

import json

import numpy as np
import pytest

import audio_features as af

torch = pytest.importorskip("torch")
transformers = pytest.importorskip("transformers")
pytestmark = pytest.mark.usefixtures("no_network")


@pytest.fixture
def talk(write_speech, tmp_path) -> af.Wave:
    wav = write_speech(tmp_path / "talk.wav", 2.0)
    (tmp_path / "talk.ctm").write_text("x 1 0.2 0.3 Hands\nx 1 1.0 0.5 so\nx 1 1.6 0.1 so\n")
    return af.Wave.load(wav)


@pytest.mark.parametrize(
    "name", ["bert", "roberta", "xlm-roberta", "distilbert", "mpnet", "electra"]
)
def test_a_spoken_word_has_the_mean_of_its_tokens_states(name, talk, tmp_path, write_text_encoder):
    model = write_text_encoder(tmp_path / "text", name)
    with torch.no_grad():  # [CLS] hand ##s [SEP], [CLS] so [SEP]
        hands = model(torch.tensor([[2, 6, 7, 3]]), output_hidden_states=True)
        so = model(torch.tensor([[2, 5, 3]])).last_hidden_state[0, 1].numpy()
    spec = {"kind": "words", "encoder": str(tmp_path / "text")}
    track = af.extractor_from_spec(spec).extract(talk)
    assert track.values.shape == (100, 16) and track.times[50] == 1.0
    spoken = np.zeros((100, 16), np.float32)
    spoken[10:25] = hands.last_hidden_state[0, 1:3].mean(dim=0)  # 0.2 to 0.5 s, 50 frames a second
    spoken[50:75] = spoken[80:85] = so
    np.testing.assert_allclose(track.values, spoken, atol=1e-5)
    first = af.extractor_from_spec({**spec, "layer": 1}).extract(talk).values[10]
    np.testing.assert_allclose(first, hands.hidden_states[1][0, 1:3].mean(dim=0), atol=1e-5)


def test_words_are_cached_and_the_encoder_is_recognised(talk, tmp_path, write_text_encoder):
    write_text_encoder(tmp_path / "text")
    cache, words = af.FeatureCache(tmp_path / "cache"), af.WordEmbeddings(tmp_path / "text")
    first = cache.extract(words, talk).values
    again = af.extractor_from_spec(words.spec, weights=tmp_path / "text")
    assert again.spec == words.spec and "text" not in json.dumps(words.spec)
    again.embedding = None  # calling it would fail: the cache has the values
    np.testing.assert_array_equal(cache.extract(again, talk).values, first)
    (tmp_path / "talk.ctm").write_text("x 1 0.9 0.3 so\n")
    assert not cache.extract(words, talk).values[10:45].any(), "other words, same sound"
    with pytest.raises(af.WeightsError, match=words.fingerprint):
        af.extractor_from_spec(words.spec)
    write_text_encoder(tmp_path / "other", seed=1)
    with pytest.raises(af.WeightsError, match=words.fingerprint):
        af.extractor_from_spec(words.spec, weights=tmp_path / "other")
    file = tmp_path / "text" / "tokenizer.json"
    file.write_text(file.read_text().replace('"so"', '"os"'))
    assert af.WordEmbeddings(tmp_path / "text").fingerprint != words.fingerprint


def test_published_files_with_heads_and_old_names_are_read(talk, tmp_path, write_text_encoder):
    """bert-base-uncased has a prefix, a head for masked words, and gamma and beta."""
    from safetensors.torch import load_file, save_file

    model = write_text_encoder(tmp_path / "text", head="ForMaskedLM").bert
    file = tmp_path / "text" / "model.safetensors"
    old = {}
    for name, value in load_file(file).items():
        name = name.replace("LayerNorm.weight", "LayerNorm.gamma")
        old[name.replace("LayerNorm.bias", "LayerNorm.beta")] = value
    assert any(name.endswith("gamma") for name in old)
    save_file({**old, "bert.embeddings.position_ids": torch.arange(40)[None]}, file)
    with torch.no_grad():
        so = model(torch.tensor([[2, 5, 3]])).last_hidden_state[0, 1]
    words = af.WordEmbeddings(tmp_path / "text")
    np.testing.assert_allclose(words.embedding("so"), so, atol=1e-5)
    assert not words.embedding("\u200b").any(), "no token is left of it"
    assert np.isfinite(words.embedding("so" * 5000)).all()


def test_folders_that_cannot_be_used_are_named(talk, tmp_path, write_text_encoder):
    folder = tmp_path / "text"
    write_text_encoder(folder)
    with pytest.raises(af.FeatureError, match=r"(?=.*layer=3).*\b2\b"):
        af.WordEmbeddings(folder, layer=3)
    with pytest.raises(af.FeatureError, match="'lyer'"):
        af.extractor_from_spec({"kind": "words", "encoder": str(folder), "lyer": 1})
    with pytest.raises(af.WeightsError, match="(?=.*'bert').*hubert"):
        af.HuggingFace(folder)
    settings = json.loads((folder / "tokenizer_config.json").read_text())
    (folder / "tokenizer_config.json").write_text(json.dumps(settings | {"auto_map": {"x": "y"}}))
    with pytest.raises(af.WeightsError, match="(?=.*auto_map).*tokenizer_config.json"):
        af.WordEmbeddings(folder)
    (folder / "tokenizer_config.json").unlink()
    (folder / "tokenizer.json").write_text("{}")
    with pytest.raises(af.WeightsError, match="tokenizer.json"):
        af.WordEmbeddings(folder)
    with pytest.raises(af.WeightsError, match="none"):
        af.WordEmbeddings(tmp_path / "none")
