"""One WavLM as Hugging Face, Microsoft and torchaudio lay it out: one network, one fingerprint."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from sounds import distance
from wavlm_layouts import microsoft, old_norm, torchaudio_state

import audio_features as af

torch = pytest.importorskip("torch")
transformers = pytest.importorskip("transformers")
load_file = pytest.importorskip("safetensors.torch").load_file

pytestmark = pytest.mark.usefixtures("no_network")


@pytest.fixture
def layouts(wavlm_folder, tmp_path) -> dict[str, Path]:
    """The same network in every layout and spelling."""
    tensors = load_file(wavlm_folder / "model.safetensors")
    headed = {f"wavlm.{name}": tensor for name, tensor in old_norm(tensors).items()}
    headed |= {"lm_head.weight": torch.zeros(3), "feature_extractor.weight": torch.zeros(3)}
    (tmp_path / "headed").mkdir()
    shutil.copy(wavlm_folder / "config.json", tmp_path / "headed")
    torch.save(headed, tmp_path / "headed" / "pytorch_model.bin")
    checkpoint, state = microsoft(wavlm_folder), torchaudio_state(wavlm_folder)
    torch.save(checkpoint, tmp_path / "WavLM.pt")
    torch.save(checkpoint, tmp_path / "legacy.pt", _use_new_zipfile_serialization=False)
    torch.save(state, tmp_path / "state.pth")
    wrapped = {f"model.{name}": tensor for name, tensor in old_norm(state).items()}
    torch.save({**wrapped, "aux.weight": torch.zeros(3)}, tmp_path / "wrapped.pth")
    names = {
        "headed": "Hugging Face folder",
        "WavLM.pt": "Microsoft checkpoint",
        "legacy.pt": "Microsoft checkpoint",
        "state.pth": "torchaudio state dict",
        "wrapped.pth": "torchaudio state dict",
    }
    found = {tmp_path / name: layout for name, layout in names.items()}
    return {wavlm_folder: "Hugging Face folder", **found}


def test_all_layouts_of_one_network_give_the_same_features(wavlm_folder, layouts, speech):
    model = transformers.WavLMModel.from_pretrained(wavlm_folder)
    large = model.config.do_stable_layer_norm
    extractor = transformers.Wav2Vec2FeatureExtractor(do_normalize=large)
    inputs = extractor(speech.samples, sampling_rate=16_000, return_tensors="pt").input_values
    with torch.no_grad():
        truth = model(inputs).last_hidden_state[0].numpy()
    fingerprints = set()
    for path, layout in layouts.items():
        own = af.WavLM(path)
        fingerprints.add(own.fingerprint)
        text = own.weights.describe()
        assert layout in text and own.fingerprint in text and "3 layers of 32, 4 heads" in text
        assert ("mean 0" in text) == large
        # The layouts' own eps differ, which the speech's digital silence would show.
        wavlm = af.WavLM(path, normalize=1e-7 if large else False)
        values = wavlm.extract(speech).values
        assert distance(values, truth) < 1e-5, path
    assert len(fingerprints) == 1


def test_a_model_of_one_layout_takes_weights_of_another(wavlm_folder, tmp_path, speech):
    """Even in near silence, where the three code bases' normalisations differ."""
    torch.save(microsoft(wavlm_folder), tmp_path / "WavLM.pt")
    quiet = af.Wave(speech.samples * np.float32(1e-3), 16_000)
    trained = af.WavLM(wavlm_folder)
    again = af.extractor_from_spec(trained.spec, weights=tmp_path / "WavLM.pt")
    np.testing.assert_array_equal(again.extract(quiet).values, trained.extract(quiet).values)
    own = af.WavLM(tmp_path / "WavLM.pt")
    large = trained.normalize is not None
    assert (own.normalize, trained.normalize) == ((1e-5, 1e-7) if large else (None, None))
    differ = np.abs(own.extract(quiet).values - trained.extract(quiet).values).max() > 1e-3
    assert differ == large


def test_microsoft_applies_layer_norm_to_the_waveform(wavlm_folder, tmp_path, speech):
    torch.save(microsoft(wavlm_folder, normalize=True), tmp_path / "WavLM.pt")
    samples = torch.from_numpy(speech.samples * np.float32(1e-2))
    normal = torch.nn.functional.layer_norm(samples, samples.shape)
    model = transformers.WavLMModel.from_pretrained(wavlm_folder)
    with torch.no_grad():
        truth = model(normal[None]).last_hidden_state[0].numpy()
    values = af.WavLM(tmp_path / "WavLM.pt").extract(af.Wave(samples.numpy(), 16_000)).values
    assert distance(values, truth) < 1e-5


def test_the_preprocessor_file_decides_on_normalisation(wavlm_copy, speech):
    file = wavlm_copy / "preprocessor_config.json"
    file.write_text(json.dumps({"do_normalize": False, "sampling_rate": 16_000}))
    plain = af.WavLM(wavlm_copy)
    file.write_text(json.dumps({"do_normalize": True, "sampling_rate": 16_000}))
    normalised = af.WavLM(wavlm_copy)
    assert (plain.normalize, normalised.normalize) == (None, 1e-7)
    assert np.abs(normalised.extract(speech).values - plain.extract(speech).values).max() > 1e-4
    file.write_text(json.dumps({"sampling_rate": 8_000}))
    with pytest.raises(af.WeightsError, match="8000"):
        af.WavLM(wavlm_copy)


def test_positions_reach_as_checkpoints_say(wavlm_folder, wavlm_copy, tmp_path, speech):
    """Published models say 800; Microsoft's class has 1280 where a checkpoint is silent."""
    config = json.loads((wavlm_copy / "config.json").read_text())
    (wavlm_copy / "config.json").write_text(json.dumps({**config, "max_bucket_distance": 200}))
    torch.save(microsoft(wavlm_folder, max_distance=200), tmp_path / "near.pt")
    paths = (wavlm_copy, tmp_path / "near.pt", wavlm_folder)
    other, near, usual = (af.WavLM(path, normalize=False) for path in paths)
    values = other.extract(speech).values
    np.testing.assert_allclose(near.extract(speech).values, values, atol=1e-4)
    assert np.abs(usual.extract(speech).values - values).max() > 1e-4
    assert near.fingerprint == other.fingerprint != usual.fingerprint
    checkpoint = microsoft(wavlm_folder)
    del checkpoint["cfg"]["max_distance"]
    torch.save(checkpoint, tmp_path / "silent.pt")
    with pytest.raises(af.WeightsError, match="lacks max_distance"):
        af.WavLM(tmp_path / "silent.pt")


@pytest.mark.parametrize("mode", ["group_norm", "layer_norm"])
def test_a_state_dict_of_torchaudio_gives_its_models_features(torchaudio, mode, tmp_path, speech):
    large = mode == "layer_norm"
    kernels = (10, 3, 3, 3, 3, 2, 2)
    model = torchaudio.models.wavlm_model(
        extractor_mode=mode,
        extractor_conv_layer_config=[(16, k, 2 if i else 5) for i, k in enumerate(kernels)],
        extractor_conv_bias=False,
        encoder_embed_dim=32,
        encoder_projection_dropout=0.0,
        encoder_pos_conv_kernel=16,
        encoder_pos_conv_groups=4,
        encoder_num_layers=3,
        encoder_num_heads=4,
        encoder_num_buckets=320,
        encoder_max_distance=800,
        encoder_attention_dropout=0.0,
        encoder_ff_interm_features=64,
        encoder_ff_interm_dropout=0.0,
        encoder_dropout=0.0,
        encoder_layer_norm_first=large,
        encoder_layer_drop=0.0,
        aux_num_out=None,
    ).eval()
    samples = torch.from_numpy(speech.samples)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
        sound = torch.nn.functional.layer_norm(samples, samples.shape) if large else samples
        layers, _ = model.extract_features(sound[None])
        last, _ = model(sound[None])
    torch.save(model.state_dict(), tmp_path / "model.pth")
    for layer, truth in (("last", last), *enumerate(layers, 1)):
        values = af.WavLM(tmp_path / "model.pth", layer=layer).extract(speech).values
        assert distance(values, truth[0].numpy()) < 1e-5, layer
