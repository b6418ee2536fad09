"""Hugging Face encoders: transformers' values on the true time base, from local folders only."""

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.torch import load_file, save_file
from sounds import distance, swelling
from wavlm_layouts import old_norm

import audio_features as af

torch = pytest.importorskip("torch")
transformers = pytest.importorskip("transformers")

pytestmark = pytest.mark.usefixtures("no_network")

ENCODERS = ("hubert", "wav2vec2", "data2vec-audio", "wavlm", "wav2vec2-bert", "whisper")
# One of each kind of front end and positions; wav2vec2 and WavLM are as HuBERT.
each_kind = pytest.mark.parametrize(
    "encoder", ["hubert", "data2vec-audio", "wav2vec2-bert", "whisper"], indirect=True
)
FIRST = {"wav2vec2-bert": 0.0175, "whisper": 0.0}  # centre of frame 0 in seconds; else 0.0125


@pytest.fixture(scope="module", params=ENCODERS)
def encoder(request, tmp_path_factory, write_encoder) -> tuple[str, Path, Any]:
    """Name, folder with preprocessor_config.json, and transformers' model."""
    folder = tmp_path_factory.mktemp(request.param)
    model = write_encoder(folder, request.param)
    preprocessor(request.param).save_pretrained(folder)
    return request.param, folder, model


@pytest.fixture
def copy(encoder, tmp_path) -> Path:
    """The folder again, to be changed."""
    return shutil.copytree(encoder[1], tmp_path / "copy")


@pytest.fixture
def hubert(tmp_path, write_encoder) -> Path:
    """A folder to be damaged."""
    write_encoder(tmp_path / "hubert", "hubert")
    return tmp_path / "hubert"


def preprocessor(name: str) -> Any:
    if name == "wav2vec2-bert":
        return transformers.SeamlessM4TFeatureExtractor()
    if name == "whisper":
        return transformers.WhisperFeatureExtractor(chunk_length=3)
    return transformers.Wav2Vec2FeatureExtractor(do_normalize=True)


def of_transformers(name: str, model: Any, samples: np.ndarray) -> tuple[np.ndarray, list]:
    """Return the output (T, D) and all hidden states of transformers' own pipeline."""
    inputs = preprocessor(name)(samples, sampling_rate=16_000, return_tensors="pt")
    network = {"whisper": lambda: model.encoder, "wav2vec2": lambda: model.wav2vec2}
    network = network.get(name, lambda: model)()
    with torch.no_grad():
        out = network(**inputs, output_hidden_states=True)
    return out.last_hidden_state[0].numpy(), [state[0].numpy() for state in out.hidden_states]


def test_values_are_those_of_transformers(encoder):
    name, folder, model = encoder
    samples = swelling(10.3 if name == "data2vec-audio" else 1.73)  # blocks of convolutions: 10 s
    last, states = of_transformers(name, model, samples)
    wave = af.Wave(samples, 16_000)
    track = af.HuggingFace(folder, layer="last").extract(wave)
    n = {"whisper": -(-len(samples) // 320), "wav2vec2-bert": (len(samples) - 240) // 320}
    n_frames = n.get(name, (len(samples) - 400) // 320 + 1)
    assert track.values.shape == (n_frames, 32)
    assert distance(track.values, last[:n_frames]) < 1e-5
    every = af.HuggingFace(folder, layer=[0, 1, 2, 3]).extract(wave)
    for index, ours in enumerate(np.split(every.values, 4, axis=1)):
        assert distance(ours, states[index][:n_frames]) < 1e-5, index
    weighted = af.HuggingFace(folder, layer={1: 1.0, 3: 3.0}).extract(wave).values
    assert distance(weighted, (0.25 * states[1] + 0.75 * states[3])[:n_frames]) < 1e-5
    assert len(set(every.names)) == every.values.shape[1] == 128


@each_kind
def test_a_click_lands_in_its_frame(encoder):
    name, folder, _ = encoder
    extractor = af.HuggingFace(folder, layer=0)
    plain = 0.1 * np.random.default_rng(1).standard_normal(16_000)
    before = extractor.extract(af.Wave(plain, 16_000))
    n_frames, first = len(before.times), FIRST.get(name, 0.0125)
    np.testing.assert_allclose(before.times, first + 0.02 * np.arange(n_frames))
    errors = []
    for at in range(2_000, 14_000, 2_222):
        clicked = plain.copy()
        clicked[at : at + 3] += [0.4, -0.8, 0.4]
        change = np.abs(extractor.extract(af.Wave(clicked, 16_000)).values - before.values)
        loudest = before.times[np.argmax(change.sum(axis=1))]
        errors.append(loudest - (at + 1) / 16_000)
    assert np.abs(errors).max() < 0.016
    assert abs(np.mean(errors)) < 0.008


@each_kind
def test_long_sounds_are_processed_in_chunks_with_context(encoder, copy):
    """Inputs of the layers are exact; their outputs differ a little, less with more context."""
    if encoder[0] == "whisper":  # its positions count from the start of a chunk
        tensors = load_file(copy / "model.safetensors")
        tensors["encoder.embed_positions.weight"].zero_()
        save_file(tensors, copy / "model.safetensors")
    wave = af.Wave(swelling(2.9), 16_000)
    last = {"wav2vec2-bert": 0.1, "whisper": 0.25}.get(encoder[0], 0.03)
    whole = af.HuggingFace(copy, layer=[0, 3]).extract(wave)
    errors = []
    for chunk, context in ((0.8, 0.2), (2.6, 1.0)):
        settings = {"full_context": 1.0, "chunk": chunk, "context": context}
        chunked = af.HuggingFace(copy, layer=[0, 3], **settings).extract(wave)
        np.testing.assert_array_equal(chunked.times, whole.times)
        assert distance(chunked.values[:, :32], whole.values[:, :32]) < 1e-5
        errors.append(distance(chunked.values[:, 32:], whole.values[:, 32:]))
    assert errors[1] < last and errors[1] < errors[0]


@pytest.mark.parametrize("encoder", ["wav2vec2-bert", "whisper"], indirect=True)
def test_sounds_longer_than_whisper_takes_and_shorter_than_a_frame(encoder):
    name, folder, _ = encoder
    extractor, short = af.HuggingFace(folder), af.Wave(swelling(0.03), 16_000)
    if name == "whisper":  # three seconds at a time
        track = extractor.extract(af.Wave(swelling(7.01), 16_000))
        assert abs(track.times[-1] - 7.01) < 0.05 and np.isfinite(track.values).all()
        assert len(extractor.extract(short).values) in (1, 2)
    else:
        with pytest.raises(af.AudioError, match=r"0\.03"):
            extractor.extract(short)


def test_a_folder_with_code_of_its_own_is_refused(hubert):
    proof = hubert.parent / "ran"
    (hubert / "modeling.py").write_text(f"open({str(proof)!r}, 'w')")
    with pytest.raises(af.WeightsError, match="modeling.py"):
        af.HuggingFace(hubert)
    (hubert / "modeling.py").unlink()
    config = json.loads((hubert / "config.json").read_text())
    config["auto_map"] = {"AutoModel": "modeling.Own"}
    (hubert / "config.json").write_text(json.dumps(config))
    with pytest.raises(af.WeightsError, match="(?=.*auto_map)(?=.*config.json).*trust_remote_code"):
        af.HuggingFace(hubert)
    assert not proof.exists()


def test_sizes_that_no_encoder_has_are_refused_and_numbers_of_tokens_are_no_sizes(hubert):
    path = hubert / "config.json"
    known = json.loads(path.read_text())
    for name, value, most in (
        ("num_hidden_layers", 257, 256),
        ("some_size", 65_537, 65_536),
        ("some_size", -65_537, 65_536),
        ("some_sizes", [8, 65_537.0], 65_536),
    ):
        path.write_text(json.dumps(known | {name: value}))
        with pytest.raises(af.WeightsError, match=rf"(?=.*{name})(?=.*65537|.*257).*\b{most}$"):
            af.HuggingFace(hubert)
    fine = {"vocab_size": 1 << 20, "pad_token_id": 1 << 20, "some_sizes": [65_536, "x"]}
    path.write_text(json.dumps(known | fine))
    assert af.HuggingFace(hubert).weights.model == "hubert"


def test_the_same_weights_in_other_files_have_the_same_fingerprint(hubert):
    print_of = af.HuggingFace(hubert).fingerprint
    tensors = load_file(hubert / "model.safetensors")
    (hubert / "model.safetensors").unlink()
    torch.save(old_norm(tensors), hubert / "pytorch_model.bin")
    assert af.HuggingFace(hubert).fingerprint == print_of


def test_broken_folders_are_errors_that_name_the_file(hubert, tmp_path):
    with pytest.raises(af.WeightsError, match="nowhere"):
        af.HuggingFace(tmp_path / "nowhere")
    tensors = load_file(hubert / "model.safetensors")
    name = next(name for name in sorted(tensors) if "layers.1." in name and "decoder" not in name)
    save_file({key: value for key, value in tensors.items() if key != name}, hubert / "x")
    (hubert / "x").replace(hubert / "model.safetensors")
    with pytest.raises(af.WeightsError, match=r"(?=.*\b1\b).*layers\.1"):
        af.HuggingFace(hubert)
    wide = torch.cat([tensors[name], tensors[name]])
    for value, complaint in (
        (wide, r"(?=.*\b1\b)(?=.*shape).*layers\.1"),
        (tensors[name] * float("nan"), r"(?=.*layers\.1).*finite"),
    ):
        save_file({**tensors, name: value}, hubert / "model.safetensors")
        with pytest.raises(af.WeightsError, match=complaint):
            af.HuggingFace(hubert)
    config = json.loads((hubert / "config.json").read_text())
    for changes, complaint in (
        ({"model_type": "bert"}, "(?=.*'bert').*hubert"),
        ({"hidden_size": 10**8, "d_model": 10**8}, "(?=.*hidden_size).*100000000"),
    ):
        (hubert / "config.json").write_text(json.dumps({**config, **changes}))
        with pytest.raises(af.WeightsError, match=complaint):
            af.HuggingFace(hubert)
    (hubert / "config.json").write_text("{")
    with pytest.raises(af.WeightsError, match="config.json"):
        af.HuggingFace(hubert)


def test_without_transformers_the_extra_is_named(tmp_path, wavlm_folder, monkeypatch):
    (tmp_path / "config.json").write_text('{"model_type": "hubert"}')
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(af.WeightsError, match=r"pip install 'gesturekit\[encoders\]'"):
        af.HuggingFace(tmp_path)
    af.WavLM(wavlm_folder)  # ours needs none


def test_a_pickle_is_not_loaded(hubert, capsys):
    class Evil:
        def __reduce__(self):
            return print, ("ran",)

    (hubert / "model.safetensors").unlink()
    torch.save({"x": Evil()}, hubert / "pytorch_model.bin")
    with pytest.raises(af.WeightsError, match="pytorch_model.bin"):
        af.HuggingFace(hubert)
    assert "ran" not in capsys.readouterr().out


def test_the_waveform_is_normalised_as_the_folder_says(tmp_path, write_encoder):
    for norm in ("hubert", "wavlm"):  # feat_extract_norm group and layer
        folder = tmp_path / norm
        write_encoder(folder, norm)
        found = af.HuggingFace(folder).normalize
        assert (found is not None) == (norm == "wavlm")
        for normalize in (True, False):
            settings = {"do_normalize": normalize, "sampling_rate": 16_000}
            (folder / "preprocessor_config.json").write_text(json.dumps(settings))
            assert (af.HuggingFace(folder).normalize is not None) == normalize
    write_encoder(tmp_path / "whisper", "whisper")
    with pytest.raises(af.FeatureError, match="normalize: whisper"):
        af.HuggingFace(tmp_path / "whisper", normalize=True)
    settings["sampling_rate"] = 8_000
    (folder / "preprocessor_config.json").write_text(json.dumps(settings))
    with pytest.raises(af.WeightsError, match="(?=.*sampling_rate).*8000"):
        af.HuggingFace(folder)
