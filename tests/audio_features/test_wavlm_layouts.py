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
from audio_features.wavlm.architecture import Architecture

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


# Settings and shapes as transformers has them, and what is no WavLM.

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
PUBLISHED = {
    "extractor_mode": "default",
    "encoder_layers": 12,
    "encoder_embed_dim": 768,
    "encoder_ffn_embed_dim": 3072,
    "encoder_attention_heads": 12,
    "activation_fn": "gelu",
    "layer_norm_first": False,
    "conv_feature_layers": "[(512,10,5)] + [(512,3,2)] * 4 + [(512,2,2)] * 2",
    "conv_bias": False,
    "conv_pos": 128,
    "conv_pos_groups": 16,
    "relative_position_embedding": True,
    "num_buckets": 320,
    "max_distance": 800,
    "gru_rel_pos": True,
}
"""Settings of WavLM Base as Microsoft published them."""


def read(settings: dict) -> Architecture:
    return Architecture.from_huggingface(settings, "config.json")


def test_settings_that_a_file_leaves_out_are_those_of_transformers():
    usual, found = transformers.WavLMConfig(), read({})
    for name, theirs in {
        "width": usual.hidden_size,
        "layers": usual.num_hidden_layers,
        "heads": usual.num_attention_heads,
        "inner": usual.intermediate_size,
        "front_norm": usual.feat_extract_norm,
        "pre_norm": usual.do_stable_layer_norm,
        "channels": tuple(usual.conv_dim),
        "kernels": tuple(usual.conv_kernel),
        "strides": tuple(usual.conv_stride),
        "conv_bias": usual.conv_bias,
        "position_kernel": usual.num_conv_pos_embeddings,
        "position_groups": usual.num_conv_pos_embedding_groups,
        "buckets": usual.num_buckets,
        "max_distance": usual.max_bucket_distance,
        "eps": usual.layer_norm_eps,
    }.items():
        assert getattr(found, name) == theirs, name
    assert read(usual.to_dict()) == found
    assert Architecture.from_microsoft(PUBLISHED, "a.pt") == found


@pytest.mark.parametrize(
    ("settings", "size"),
    [
        ({}, "Base or Base+"),
        (LARGE, "Large"),
        (ODD, "of a custom size"),
        (ODD | {"num_conv_pos_embedding_groups": 48}, "of a custom size"),
    ],
)
def test_tensors_are_those_of_transformers(settings, size):
    """Networks on the device "meta", which have shapes and no numbers."""
    with torch.device("meta"):
        model = transformers.WavLMModel(transformers.WavLMConfig(**settings))
    theirs = {name: tuple(tensor.shape) for name, tensor in model.state_dict().items()}
    theirs.pop("masked_spec_embed")
    found = read(settings)
    assert found.shapes() == theirs
    assert {type(n) for shape in found.shapes().values() for n in shape} == {int}
    assert found.size == size and found.unpublished == {}
    assert Architecture.from_tensors(model.state_dict(), "a.pth") == found


def test_settings_that_do_not_show_in_shapes():
    changed = {
        "do_stable_layer_norm": True,
        "max_bucket_distance": 200,
        "layer_norm_eps": 1e-6,
        "conv_stride": [5, 2, 2, 2, 2, 2, 2],
    }
    found = read(changed).unpublished
    assert found == {"pre_norm": True, "max_distance": 200, "eps": 1e-6}
    assert read({"hidden_size": 1024, "num_attention_heads": 16}).size == "of a custom size"


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        *(
            ({key: 0}, f"{name} is '0', expected a whole number from 1 to 16384")
            for key, name in {
                "hidden_size": "width",
                "num_attention_heads": "heads",
                "intermediate_size": "inner",
                "num_conv_pos_embeddings": "position_kernel",
                "num_conv_pos_embedding_groups": "position_groups",
                "num_buckets": "buckets",
                "max_bucket_distance": "max_distance",
            }.items()
        ),
        *(({"intermediate_size": odd}, "inner is ") for odd in (True, 8.0, "8", 16_385)),
        ({"num_hidden_layers": 257}, "layers is '257', expected a whole number from 1 to 256"),
        ({"conv_dim": [512] * 6}, "channels is .* expected seven numbers"),
        ({"conv_kernel": "10333322"[:7]}, "kernels is '1033332', expected seven numbers"),
        ({"conv_dim": [512] * 6 + [0]}, "channels is '0', expected a whole number"),
        ({"conv_kernel": [10, 3, 3, 3, 3, 2, 3]}, "frames of 560 samples every 320, expected 400"),
        ({"conv_stride": [5, 2, 2, 2, 2, 2, 4]}, "frames of 400 samples every 640"),
        ({"feat_extract_norm": "batch"}, "front_norm is 'batch', expected 'group' or 'layer'"),
        ({"do_stable_layer_norm": 1}, "pre_norm is '1', expected true or false"),
        ({"conv_bias": None}, "conv_bias is 'None', expected true or false"),
        *(
            ({"layer_norm_eps": eps}, "eps is .*, expected a number between 0 and 1")
            for eps in (0.0, 1.0, -1e-5, True, 1, "1e-5", float("nan"))
        ),
        ({"num_attention_heads": 5}, "heads is '5', expected a divisor of 768"),
        ({"num_conv_pos_embedding_groups": 5}, "position_groups is '5', expected a divisor of 768"),
        ({"num_buckets": 322}, "buckets is '322', expected a multiple of 4 below 4 times"),
        ({"max_bucket_distance": 80}, "buckets is '320', expected a multiple of 4 below 4 times"),
        ({"hidden_act": "relu"}, "hidden_act is 'relu', expected 'gelu'"),
        ({"feat_extract_activation": "silu"}, "feat_extract_activation is 'silu'"),
        ({"hidden_act": "x" * 200}, f"is '{'x' * 80}', expected"),
    ],
)
def test_settings_of_no_wavlm_are_named(changes, says):
    with pytest.raises(af.WeightsError, match=f"^config.json: .*{says}"):
        read(changes)


def test_the_largest_networks_are_allowed():
    largest = {"hidden_size": 1 << 14, "num_attention_heads": 1 << 14, "num_hidden_layers": 256}
    assert read(largest).layers == 256
    least = {"max_bucket_distance": 81, "num_hidden_layers": 1, "intermediate_size": 1}
    assert (read(least).layers, read(least).inner) == (1, 1)


def test_microsofts_settings_are_all_needed():
    for name in PUBLISHED:
        if name == "activation_fn":
            continue
        cfg = {key: value for key, value in PUBLISHED.items() if key != name}
        with pytest.raises(af.WeightsError, match=f"a.pt: cfg lacks {name}: give the checkpoint"):
            Architecture.from_microsoft(cfg, "a.pt")
    large = Architecture.from_microsoft(
        {**PUBLISHED, "extractor_mode": "layer_norm", "layer_norm_first": True}, "a.pt"
    )
    assert (large.front_norm, large.pre_norm) == ("layer", True)
    ones = "[(512, 10, 5)]+[(512,3,2)]*3 + [(511,3,2)] + [(512,2,2)] *02"
    found = Architecture.from_microsoft({**PUBLISHED, "conv_feature_layers": ones}, "a.pt")
    assert found.channels == (512, 512, 512, 512, 511, 512, 512)
    for change, says in (
        ({"gru_rel_pos": 1}, "gru_rel_pos is '1', expected True"),
        ({"relative_position_embedding": False}, "relative_position_embedding is 'False'"),
        ({"activation_fn": "relu"}, "activation_fn is 'relu'"),
        ({"extractor_mode": "other"}, "front_norm is 'other'"),
        ({"conv_feature_layers": "[(512,10,5)] * 100"}, "conv_feature_layers is "),
        ({"conv_feature_layers": "[(512,10)]"}, r"expected '\[\(512,10,5\)\]"),
    ):
        with pytest.raises(af.WeightsError, match=f"a.pt: .*{says}"):
            Architecture.from_microsoft({**PUBLISHED, **change}, "a.pt")


def test_tensors_that_give_no_size_are_named():
    shapes = read(ODD).shapes()
    tensors = {name: torch.empty(shape, device="meta") for name, shape in shapes.items()}
    for name in (
        "feature_extractor.conv_layers.6.conv.weight",
        "encoder.pos_conv_embed.conv.parametrizations.weight.original1",
        "encoder.layers.0.attention.gru_rel_pos_const",
        "encoder.layers.0.feed_forward.intermediate_dense.weight",
        "encoder.layers.0.attention.rel_attn_embed.weight",
    ):
        axes = len(shapes[name])
        for wrong, found in ({}, r"\(\)"), ({name: tensors[name][0]}, ".+"):
            others = {key: value for key, value in tensors.items() if key != name}
            with pytest.raises(
                af.WeightsError, match=f"a.pth: tensor {name} has shape {found}, expected {axes} "
            ):
                Architecture.from_tensors(others | wrong, "a.pth")
