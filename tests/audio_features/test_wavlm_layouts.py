"""One WavLM as Hugging Face, Microsoft and torchaudio lay it out: one network, one fingerprint."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from sounds import distance
from wavlm_layouts import microsoft, old_norm, torchaudio_state

import audio_features as af
from audio_features.wavlm.weights import Architecture

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
        "headed": "Hugging Face",
        "WavLM.pt": "Microsoft",
        "legacy.pt": "Microsoft",
        "state.pth": "torchaudio",
        "wrapped.pth": "torchaudio",
    }
    found = {tmp_path / name: layout for name, layout in names.items()}
    return {wavlm_folder: "Hugging Face", **found}


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
        for fact in (layout, r"\b3\b", r"\b32\b", r"\b4\b", own.fingerprint):
            assert re.search(fact, text), fact
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


LARGE = {
    "hidden_size": 1024,
    "num_hidden_layers": 24,
    "num_attention_heads": 16,
    "intermediate_size": 4096,
    "feat_extract_norm": "layer",
    "do_stable_layer_norm": True,
}
ODD = {
    "hidden_size": 48,
    "num_hidden_layers": 2,
    "num_attention_heads": 6,
    "intermediate_size": 40,
    "conv_dim": [8, 9, 10, 11, 12, 13, 14],
    "conv_bias": True,
    "num_conv_pos_embeddings": 20,
    "num_conv_pos_embedding_groups": 3,
    "num_buckets": 32,
}


def network(settings: dict) -> dict:
    """The tensors of transformers' network on the device "meta": shapes, and no numbers."""
    with torch.device("meta"):
        return transformers.WavLMModel(transformers.WavLMConfig(**settings)).state_dict()


@pytest.mark.parametrize(("settings", "size"), [({}, "Base"), (LARGE, "Large"), (ODD, "")])
def test_tensors_are_those_of_transformers(settings, size):
    tensors = network(settings)
    theirs = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
    theirs.pop("masked_spec_embed")
    found = Architecture.from_huggingface(settings, tensors, "config.json")
    assert found.shapes() == theirs
    assert {type(n) for shape in found.shapes().values() for n in shape} == {int}
    assert found.unpublished == {}
    assert [name for name in ("Base", "Large") if name in found.size] == [size] * bool(size)
    assert Architecture.from_tensors(tensors, "a.pth") == found


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"max_bucket_distance": 0}, "max_distance is 0"),
        ({"conv_kernel": "10333322"[:7]}, "(?=.*kernel).*'1033332'"),
        ({"feat_extract_norm": "batch"}, "(?=.*front_norm)(?=.*'batch').*'group'"),
        *(
            ({"layer_norm_eps": eps}, f"eps.*{eps}")
            for eps in (0.0, 2.0, -1e-5, True, "1e-5", float("nan"))
        ),
        ({"hidden_act": "relu"}, "(?=.*hidden_act)(?=.*'relu').*'gelu'"),
    ],
)
def test_settings_of_no_wavlm_are_named(changes, says):
    with pytest.raises(af.WeightsError, match=f"config.json.*{says}"):
        Architecture.from_huggingface(changes, network(ODD), "config.json")
