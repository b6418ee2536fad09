"""Reading a WavLM folder in Hugging Face's layout: config.json and the tensors beside it.

The files are read here rather than by `from_pretrained`, which fills missing tensors with
random numbers, may contact the hub about a local folder, and follows settings of config.json
that name code to fetch. Only numbers are taken from the folder.
"""

from __future__ import annotations

import hashlib
import json
import os
import pickle
from pathlib import Path
from typing import TYPE_CHECKING, Any

from audio_features.errors import WeightsError

if TYPE_CHECKING:
    import torch
    from transformers import WavLMModel

# What shapes the network. Everything else in config.json is about training, or about heads.
_ARCHITECTURE = (
    "hidden_size",
    "num_hidden_layers",
    "num_attention_heads",
    "intermediate_size",
    "hidden_act",
    "layer_norm_eps",
    "feat_extract_norm",
    "feat_extract_activation",
    "conv_dim",
    "conv_stride",
    "conv_kernel",
    "conv_bias",
    "num_conv_pos_embeddings",
    "num_conv_pos_embedding_groups",
    "num_buckets",
    "max_bucket_distance",
    "do_stable_layer_norm",
)
# transformers builds these even where they are unused; without them all weights are read.
_NO_EXTRAS = {"mask_time_prob": 0.0, "mask_feature_prob": 0.0, "add_adapter": False}

_NETWORK_PREFIXES = ("feature_extractor.", "feature_projection.", "encoder.")
_MAX_CONFIG_BYTES = 1 << 20


def read_model(folder: str | os.PathLike[str]) -> tuple[WavLMModel, str]:
    """The network in evaluation mode (float32, CPU) and its fingerprint.

    The fingerprint is sha256 over the sorted names, shapes and float32 bytes of the tensors:
    the same weights have the same one in model.safetensors and in pytorch_model.bin.

    Raises WeightsError where the folder, a file or a tensor is missing, or does not fit.
    """
    folder = Path(folder)
    if not folder.is_dir():
        what = "is a file" if folder.exists() else "no such folder"
        raise WeightsError(
            f"{folder}: {what}: give a local WavLM folder with config.json and model.safetensors "
            "(from huggingface.co/microsoft/wavlm-base-plus or wavlm-large, downloaded beforehand)"
        )
    config = read_json(folder / "config.json")
    model = _empty_model(folder, config)
    tensors = _fitting(folder, _read_tensors(folder), model.state_dict())
    model.load_state_dict(tensors, assign=True)
    return model.eval().requires_grad_(False), _fingerprint(tensors)


def normalizes_waveform(folder: str | os.PathLike[str]) -> bool:
    """Whether these weights expect sound of mean 0 and variance 1.

    `do_normalize` of preprocessor_config.json; without that file, whether the front end
    normalises per layer (Large) and not per group (Base), as the published weights do.
    """
    path = Path(folder) / "preprocessor_config.json"
    if not path.exists():
        return read_json(Path(folder) / "config.json").get("feat_extract_norm") == "layer"
    settings = read_json(path)
    rate, normalize = settings.get("sampling_rate", 16_000), settings.get("do_normalize", True)
    if rate != 16_000 or not isinstance(normalize, bool):
        raise WeightsError(
            f"{path}: sampling_rate {rate!r} and do_normalize {normalize!r}, "
            "expected 16000 and true or false: take the file that came with the weights"
        )
    return normalize


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object from a small file."""
    if not path.is_file():
        raise WeightsError(f"{path}: no such file: the folder must hold all of the model's files")
    try:
        if path.stat().st_size > _MAX_CONFIG_BYTES:
            raise ValueError(f"{path.stat().st_size} bytes, at most {_MAX_CONFIG_BYTES} are read")
        value = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(value, dict):
            raise ValueError(f"holds a {type(value).__name__}, expected an object")
    except (OSError, ValueError, RecursionError) as error:
        raise WeightsError(f"{path}: not a configuration file: {error}: download again") from error
    return value


def _empty_model(folder: Path, config: dict[str, Any]) -> WavLMModel:
    import torch
    from transformers import WavLMConfig, WavLMModel

    path = folder / "config.json"
    if config.get("model_type") != "wavlm":
        raise WeightsError(
            f"{path}: model_type is {config.get('model_type')!r}, expected 'wavlm': "
            "give the folder of a WavLM model"
        )
    try:
        settings = WavLMConfig(
            **{key: config[key] for key in _ARCHITECTURE if key in config}, **_NO_EXTRAS
        )
        _check_frames(path, settings.conv_kernel, settings.conv_stride)
        # On "meta" no memory is taken and nothing is initialised: every tensor is read below.
        with torch.device("meta"):
            return WavLMModel(settings)
    except WeightsError:
        raise
    except Exception as error:
        # The settings come from a file; what transformers raises on absurd ones is not defined.
        raise WeightsError(f"{path}: describes no WavLM network: {error}") from error


def _check_frames(path: Path, kernels: list[int], strides: list[int]) -> None:
    """A frame must be 400 samples every 320: the time base of the features rests on it."""
    window, hop = 1, 1
    for kernel, stride in zip(kernels, strides, strict=True):
        window += (kernel - 1) * hop
        hop *= stride
    if (window, hop) != (400, 320):
        raise WeightsError(
            f"{path}: conv_kernel and conv_stride give frames of {window} samples every {hop}, "
            "expected 400 every 320: this is not WavLM's front end"
        )


def _read_tensors(folder: Path) -> dict[str, torch.Tensor]:
    import torch
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    safe, pickled = folder / "model.safetensors", folder / "pytorch_model.bin"
    path = safe if safe.is_file() else pickled
    if not path.is_file():
        here = ", ".join(sorted(entry.name for entry in folder.iterdir())[:10]) or "nothing"
        raise WeightsError(
            f"{folder}: no model.safetensors and no pytorch_model.bin (found: {here}): "
            "download the model's weights into the folder"
        )
    try:
        if path == safe:
            return load_file(path)
        tensors = torch.load(path, map_location="cpu", weights_only=True)
    except (
        SafetensorError,
        pickle.UnpicklingError,
        OSError,
        RuntimeError,
        ValueError,
        EOFError,
    ) as error:
        raise WeightsError(
            f"{path}: cannot be read as weights: {str(error).splitlines()[0]}: download it again"
        ) from error
    if not isinstance(tensors, dict) or not all(map(torch.is_tensor, tensors.values())):
        raise WeightsError(f"{path}: holds no plain table of tensors: give Hugging Face's file")
    return tensors


def _fitting(
    folder: Path, tensors: dict[str, torch.Tensor], expected: dict[str, torch.Tensor]
) -> dict[str, torch.Tensor]:
    """The network's tensors in float32, under the names that it has in this transformers."""
    found = {_network_name(name): tensor for name, tensor in tensors.items()}
    problems = {
        "missing": [name for name in expected if name not in found],
        "unknown": [
            name for name in found if name not in expected and name.startswith(_NETWORK_PREFIXES)
        ],
        "of another shape": [
            f"{name} {tuple(found[name].shape)}, not {tuple(tensor.shape)}"
            for name, tensor in expected.items()
            if name in found and found[name].shape != tensor.shape
        ],
    }
    for problem, names in problems.items():
        if names:
            listed = "; ".join(sorted(names)[:3]) + ("; …" if len(names) > 3 else "")
            raise WeightsError(
                f"{folder}: {len(names)} tensors are {problem} ({listed}): "
                "config.json and the weights must come from the same WavLM model"
            )
    return {name: found[name].float().contiguous() for name in expected}


def _network_name(name: str) -> str:
    """A tensor's name without the prefix of models with heads, and with torch's new weight norm."""
    name = name.removeprefix("wavlm.")
    for old, new in (("weight_g", "original0"), ("weight_v", "original1")):
        name = name.replace(
            f"pos_conv_embed.conv.{old}", f"pos_conv_embed.conv.parametrizations.weight.{new}"
        )
    return name


def _fingerprint(tensors: dict[str, torch.Tensor]) -> str:
    digest = hashlib.sha256()
    for name in sorted(tensors):
        digest.update(f"{name} {list(tensors[name].shape)}\n".encode())
        digest.update(tensors[name].numpy())
    return digest.hexdigest()
