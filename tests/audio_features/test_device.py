"""Encoders on a GPU give the CPU's values."""

import pytest
from sounds import distance

import audio_features as af

pytest.importorskip("transformers")

# Four seconds are 13 chunks, more than a GPU takes at once.
CHUNKS = {"full_context": 0.0, "chunk": 0.5, "context": 0.1}


def apart(make, wave: af.Wave) -> float:
    there, here = (make(device).extract(wave).values for device in ("cuda", "cpu"))
    return distance(there, here)


@pytest.mark.parametrize(
    ("settings", "largest"),
    [({}, 1e-5), (CHUNKS, 1e-5), ({"dtype": "bf16"}, 2e-2)],
    ids=str,
)
def test_wavlm(gpu, wavlm_folder, speech, settings, largest):
    assert apart(lambda d: af.WavLM(wavlm_folder, device=d, **settings), speech) < largest


@pytest.mark.parametrize("name", ["hubert", "wav2vec2-bert", "whisper"])
def test_encoders_of_hugging_face(gpu, tmp_path, write_encoder, speech, name):
    write_encoder(tmp_path / "encoder", name)
    part = speech.slice(0.0, 0.8)
    assert apart(lambda d: af.HuggingFace(tmp_path / "encoder", device=d, **CHUNKS), part) < 1e-5


def test_word_embeddings(gpu, tmp_path, write_speech, write_text_encoder):
    wav = write_speech(tmp_path / "talk.wav", 2.0)
    (tmp_path / "talk.ctm").write_text("x 1 0.2 0.3 Hands\nx 1 1.0 0.5 so\n")
    write_text_encoder(tmp_path / "text")
    folder = tmp_path / "text"
    assert apart(lambda d: af.WordEmbeddings(folder, device=d), af.Wave.load(wav)) < 1e-5
