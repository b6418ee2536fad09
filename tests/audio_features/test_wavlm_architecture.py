"""Architecture of WavLM: settings and shapes as transformers has them, and what is no WavLM."""

from __future__ import annotations

import pytest

import audio_features as af
from audio_features.wavlm.architecture import Architecture

torch = pytest.importorskip("torch")
transformers = pytest.importorskip("transformers")

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
    ("settings", "size"), [({}, "Base or Base+"), (LARGE, "Large"), (ODD, "of a custom size")]
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
