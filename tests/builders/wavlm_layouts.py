"""One WavLM as other programs than transformers lay it out."""

import json
import re
from pathlib import Path

import torch
from safetensors.torch import load_file

# transformers' names to Microsoft's.
_MICROSOFT = [
    (r"conv_layers\.(\d+)\.conv\.", r"conv_layers.\1.0."),
    (r"feature_projection\.layer_norm", "layer_norm"),
    (r"feature_projection\.projection", "post_extract_proj"),
    (r"pos_conv_embed\.conv\.", "pos_conv.0."),
    (r"masked_spec_embed", "mask_emb"),
    (r"(layers\.\d+)\.layer_norm", r"\1.self_attn_layer_norm"),
    (r"(layers\.\d+)\.attention\.", r"\1.self_attn."),
    (r"gru_rel_pos_linear", "grep_linear"),
    (r"gru_rel_pos_const", "grep_a"),
    (r"rel_attn_embed", "relative_attention_bias"),
    (r"feed_forward\.intermediate_dense", "fc1"),
    (r"feed_forward\.output_dense", "fc2"),
]
_OLD_NORM = [(r"parametrizations\.weight\.original0", "weight_g")]
_OLD_NORM += [(r"parametrizations\.weight\.original1", "weight_v")]
_CONVOLUTIONS = "[(16,10,5)] + [(16,3,2)] * 4 + [(16,2,2)] * 2"


def old_norm(tensors: dict) -> dict:
    """Return tensors under old torch's names of weight normalisation."""
    return _renamed(tensors, _OLD_NORM)


def _renamed(tensors: dict, *tables: list) -> dict:
    found = {}
    for name, tensor in tensors.items():
        for table in tables:
            for pattern, replacement in table:
                name = re.sub(pattern, replacement, name)
        found[name] = tensor
    return found


def microsoft(folder: Path, **changes) -> dict:
    """Return Microsoft's checkpoint of the network in a Hugging Face folder."""
    config = json.loads((folder / "config.json").read_text())
    large = config["feat_extract_norm"] == "layer"
    norm = [(r"(conv_layers\.\d+)\.layer_norm\.", r"\1.2.1." if large else r"\1.2.")]
    cfg = {
        "extractor_mode": "layer_norm" if large else "default",
        "encoder_layers": config["num_hidden_layers"],
        "encoder_embed_dim": config["hidden_size"],
        "encoder_ffn_embed_dim": config["intermediate_size"],
        "encoder_attention_heads": config["num_attention_heads"],
        "activation_fn": "gelu",
        "layer_norm_first": large,
        "conv_feature_layers": _CONVOLUTIONS,
        "conv_bias": False,
        "normalize": large,
        "conv_pos": config["num_conv_pos_embeddings"],
        "conv_pos_groups": config["num_conv_pos_embedding_groups"],
        "relative_position_embedding": True,
        "num_buckets": config["num_buckets"],
        "max_distance": config["max_bucket_distance"],
        "gru_rel_pos": True,
        "mask_prob": 0.8,
    }
    tensors = load_file(folder / "model.safetensors")
    return {"cfg": {**cfg, **changes}, "model": _renamed(tensors, norm, _MICROSOFT, _OLD_NORM)}


def torchaudio_state(folder: Path) -> dict:
    """Return what torchaudio's model of the network in a Hugging Face folder has."""
    found = {}
    for name, tensor in load_file(folder / "model.safetensors").items():
        name = name.replace("attention.out_proj", "attention.attention.out_proj")
        if name.startswith("encoder."):
            name = name.replace("encoder.", "encoder.transformer.", 1)
        elif name.startswith("feature_projection"):
            name = f"encoder.{name}"
        found[name] = tensor
    found.pop("masked_spec_embed")
    for name in [name for name in found if "q_proj" in name]:
        stacked = [found.pop(name.replace("q_proj", f"{part}_proj")) for part in "qkv"]
        found[name.replace("q_proj.", "attention.in_proj_")] = torch.cat(stacked)
    return found
