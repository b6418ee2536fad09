from __future__ import annotations

import json
import shutil
import warnings

import numpy as np
import pytest

import audio_features as af

torch = pytest.importorskip("torch")
transformers = pytest.importorskip("transformers")


pytestmark = pytest.mark.usefixtures("no_network")


@pytest.fixture(scope="module", params=["group", "layer"])
def weights(request, tmp_path_factory, write_wavlm):
    folder = tmp_path_factory.mktemp(request.param)
    return folder, write_wavlm(folder, norm=request.param), request.param


@pytest.fixture
def base(tmp_path, write_wavlm):
    write_wavlm(tmp_path / "base")
    return tmp_path / "base"


@pytest.mark.parametrize("layer", ["last", 0, 1, 3])
def test_values_are_those_of_transformers(weights, layer, speech):
    folder, model, norm = weights
    samples = torch.from_numpy(speech.samples)[None]
    if norm == "layer":
        extractor = transformers.Wav2Vec2FeatureExtractor(do_normalize=True)
        inputs = extractor(speech.samples, sampling_rate=16_000, return_tensors="pt")
        samples = inputs.input_values
    with torch.no_grad():
        outputs = model(samples, output_hidden_states=True)
    states = outputs.last_hidden_state if layer == "last" else outputs.hidden_states[layer]
    track = af.WavLM(folder, layer=layer).extract(speech)
    np.testing.assert_allclose(track.values, states[0].numpy(), atol=2e-5)
    assert len(track.values) == (64_000 - 400) // 320 + 1
    np.testing.assert_allclose(track.times, 0.0125 + 0.02 * np.arange(len(track.times)))


def test_the_preprocessor_file_decides_on_normalisation(base, speech):
    plain = af.WavLM(base).extract(speech).values
    file = base / "preprocessor_config.json"
    file.write_text(json.dumps({"do_normalize": False, "sampling_rate": 16_000}))
    np.testing.assert_array_equal(af.WavLM(base).extract(speech).values, plain)
    file.write_text(json.dumps({"do_normalize": True, "sampling_rate": 16_000}))
    normalised = af.WavLM(base).extract(speech).values
    assert np.abs(normalised - plain).max() > 1e-4
    file.write_text(json.dumps({"sampling_rate": 8_000}))
    with pytest.raises(af.WeightsError, match="8000"):
        af.WavLM(base)


def test_other_rates_and_the_shortest_sound(weights):
    extractor = af.WavLM(weights[0])
    assert extractor.dim == len(extractor.names) == 32
    rng = np.random.default_rng(0)
    for rate in (8_000, 11_025, 44_100, 48_000):
        n = -(-rate // 40)  # 25 ms
        short = af.Wave(0.1 * rng.standard_normal(n).astype(np.float32), rate)
        assert extractor.extract(short).values.shape == (1, 32)
    silence = af.Wave(np.zeros(16_000, np.float32), 16_000)
    assert np.isfinite(extractor.extract(silence).values).all()


def test_long_sound_is_seen_in_chunks_with_the_right_frames(weights, monkeypatch, speech):
    """With chunks cut small, frames stay in place: values near those of the whole."""
    from audio_features.wavlm import extractor as module

    extractor = af.WavLM(weights[0], layer=1)
    samples = np.concatenate([speech.samples] * 3 + [speech.samples[:1_000]])
    long = af.Wave(samples, 16_000)
    whole = extractor.extract(long)
    monkeypatch.setattr(module, "FULL_CONTEXT_FRAMES", 300)
    monkeypatch.setattr(module, "_CHUNK_FRAMES", 280)
    chunked = extractor.extract(long)
    assert chunked.values.shape == whole.values.shape
    distance = np.linalg.norm(chunked.values - whole.values, axis=1).mean()
    for shift in (1, 2, 5):
        moved = np.linalg.norm(chunked.values[shift:] - whole.values[:-shift], axis=1).mean()
        assert moved > 2 * distance


def test_fingerprints_name_the_weights_and_not_the_file(base, tmp_path):
    first = af.WavLM(base).fingerprint
    assert first == af.WavLM(base, layer=1).fingerprint and len(first) == 64

    model = transformers.WavLMModel.from_pretrained(base)
    other = tmp_path / "bin"
    other.mkdir()
    shutil.copy(base / "config.json", other)
    renamed = {
        "wavlm." + name.replace("parametrizations.weight.original0", "weight_g"): tensor
        for name, tensor in model.state_dict().items()
    }
    torch.save({**renamed, "lm_head.weight": torch.zeros(3)}, other / "pytorch_model.bin")
    assert af.WavLM(other).fingerprint == first

    model.encoder.layers[2].feed_forward.output_dense.bias.data[0] += 1e-3
    model.save_pretrained(base)
    assert af.WavLM(base).fingerprint != first


def test_a_spec_asks_for_its_own_weights(base, tmp_path, speech, write_wavlm):
    extractor = af.WavLM(base, layer=2)
    spec = json.loads(json.dumps(extractor.spec))
    again = af.extractor_from_spec(spec, weights=base)
    np.testing.assert_array_equal(again.extract(speech).values, extractor.extract(speech).values)
    with pytest.raises(af.WeightsError, match="--weights"):
        af.extractor_from_spec(spec)
    write_wavlm(tmp_path / "other", norm="layer")
    with pytest.raises(af.WeightsError) as caught:
        af.extractor_from_spec(spec, weights=tmp_path / "other")
    assert extractor.fingerprint in str(caught.value)
    assert af.WavLM(tmp_path / "other").fingerprint in str(caught.value)


def test_a_stack_puts_wavlm_on_the_acoustic_frames(base, speech):
    wavlm = af.WavLM(base)
    track = af.Stack([wavlm, af.Prosody()]).extract(speech)
    assert track.values.shape == (400, 36)
    np.testing.assert_array_equal(
        track.values[:, :32], wavlm.extract(speech).at(track.times).values
    )


def test_weights_that_cannot_be_used_are_refused_by_name(base, tmp_path):
    def refused(folder, match: str) -> None:
        with pytest.raises(af.WeightsError, match=match) as caught:
            af.WavLM(folder)
        assert str(folder) in str(caught.value)

    refused(tmp_path / "missing", "no such folder")
    refused(base / "config.json", "is a file")
    (tmp_path / "empty").mkdir()
    refused(tmp_path / "empty", "config.json: no such file")
    shutil.copy(base / "config.json", tmp_path / "empty")
    refused(tmp_path / "empty", "no model.safetensors")

    config = json.loads((base / "config.json").read_text())

    def with_config(**changes) -> None:
        (base / "config.json").write_text(json.dumps({**config, **changes}))

    with_config(num_hidden_layers=4)
    refused(base, "tensors are missing")
    with_config(num_hidden_layers=2)
    refused(base, "tensors are unknown")
    with_config(intermediate_size=48)
    refused(base, "another shape")
    with_config(num_attention_heads=5)
    refused(base, "no WavLM network")
    with_config(hidden_size="large")
    refused(base, "no WavLM network")
    with_config(conv_stride=[5, 2, 2, 2, 2, 2, 1])
    refused(base, "every 160")
    with_config(model_type="bert")
    refused(base, "bert")
    (base / "config.json").write_text("[1]")
    refused(base, "not a configuration file")
    with_config()
    (base / "model.safetensors").write_bytes(b"not tensors")
    refused(base, "cannot be read as weights")


def test_a_bin_that_would_run_code_is_refused(base):
    class Payload:
        def __reduce__(self):
            return print, ("code from the file was run",)

    (base / "model.safetensors").unlink()
    torch.save({"weight": Payload()}, base / "pytorch_model.bin")
    with pytest.raises(af.WeightsError, match="pytorch_model.bin"):
        af.WavLM(base)


def test_layers_the_network_has_not_are_refused(base):
    for layer in (4, -1, 1.0, "first"):
        with pytest.raises(af.FeatureError, match="from 0 to 3"):
            af.WavLM(base, layer=layer)


def test_nothing_is_printed_or_warned_about(base, speech, capfd):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        af.WavLM(base).extract(speech)
    assert capfd.readouterr() == ("", "")
