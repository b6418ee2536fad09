"""Sounds the tests share."""

from __future__ import annotations

import json
import re
import shutil
import sys
import types
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from audio_features import Wave
from audio_features.acoustic import torchaudio_backend


@pytest.fixture
def speech() -> Wave:
    """4 s: syllables of 250 ms every 400 ms, harmonics of a gliding pitch under an envelope."""
    rate = 16_000
    times = np.arange(4 * rate) / rate
    fundamental = 150.0 + 30.0 * np.sin(2 * np.pi * 0.5 * times)
    phase = 2 * np.pi * np.cumsum(fundamental) / rate
    voice = sum(np.sin(k * phase) / k for k in range(1, 20))
    place = (times % 0.4) / 0.25
    envelope = np.where(place < 1, np.sin(np.pi * np.minimum(place, 1.0)) ** 2, 0.0)
    return Wave((0.15 * envelope * voice).astype(np.float32), rate, "synthetic speech")


@pytest.fixture(scope="module", params=["group", "layer"])
def wavlm_folder(request, tmp_path_factory, write_wavlm) -> Path:
    """A tiny Base and a tiny Large in which no tensor is all zeros or ones."""
    path = tmp_path_factory.mktemp(request.param)
    write_wavlm(path, norm=request.param)
    return path


@pytest.fixture
def wavlm_copy(wavlm_folder, tmp_path) -> Path:
    """The folder again, to be changed."""
    shutil.copytree(wavlm_folder, tmp_path / "copy")
    return tmp_path / "copy"


@pytest.fixture(scope="session")
def microsoft() -> Callable[..., dict]:
    """microsoft(folder, **cfg): Microsoft's checkpoint of the network in a Hugging Face folder."""
    return _microsoft


@pytest.fixture(scope="session")
def torchaudio_state() -> Callable[[Path], dict]:
    """torchaudio_state(folder): what torchaudio's model of the same network has."""
    return _torchaudio_state


@pytest.fixture(scope="session")
def old_norm() -> Callable[[dict], dict]:
    """old_norm(tensors): under old torch's names of weight normalisation."""
    return lambda tensors: _renamed(tensors, _OLD_NORM)


@pytest.fixture
def torchaudio(monkeypatch):
    """torchaudio, with a stub in place of the extension where that is built for another torch.

    The functions compared here are plain torch; on a CPU-only torch the registry's torchaudio
    fails in nothing but loading its CUDA extension.
    """
    from importlib.util import find_spec

    if find_spec("torchaudio") is None:
        pytest.skip("torchaudio is not installed")
    torchaudio_backend.import_torchaudio.cache_clear()
    if torchaudio_backend.import_torchaudio()[0] is None:
        stub = types.ModuleType("torchaudio._extension")
        stub._IS_TORCHAUDIO_EXT_AVAILABLE = stub._IS_ALIGN_AVAILABLE = False
        stub.fail_if_no_align = lambda function: function
        for name in [name for name in sys.modules if name.partition(".")[0] == "torchaudio"]:
            monkeypatch.delitem(sys.modules, name)
        monkeypatch.setitem(sys.modules, "torchaudio._extension", stub)
        torchaudio_backend.import_torchaudio.cache_clear()
    yield torchaudio_backend.import_torchaudio()[0]
    for name in [name for name in sys.modules if name.partition(".")[0] == "torchaudio"]:
        monkeypatch.delitem(sys.modules, name)
    torchaudio_backend.import_torchaudio.cache_clear()


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


def _renamed(tensors: dict, *tables: list) -> dict:
    found = {}
    for name, tensor in tensors.items():
        for table in tables:
            for pattern, replacement in table:
                name = re.sub(pattern, replacement, name)
        found[name] = tensor
    return found


def _microsoft(folder: Path, **changes) -> dict:
    from safetensors.torch import load_file

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


def _torchaudio_state(folder: Path) -> dict:
    import torch
    from safetensors.torch import load_file

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
