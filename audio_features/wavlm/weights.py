"""Reading of WavLM weights in three layouts: Hugging Face, Microsoft and torchaudio.

Their own loaders are not used because they fill missing tensors with random numbers, contact a hub
about a local folder, evaluate settings as code, or unpickle objects. Only tensors and settings are
read from a file, and neither transformers nor torchaudio is needed.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from audio_features.errors import WeightsError
from audio_features.wavlm.architecture import Architecture
from audio_features.weight_files import (
    expected_normalization,
    plain_tensors,
    read_file,
    read_folder,
    read_json,
    refuse_tensors,
)

if TYPE_CHECKING:
    import torch

MICROSOFT_EPS = 1e-5
"""Constant that Microsoft's and torchaudio's code add to the waveform's variance."""


@dataclass(frozen=True)
class Weights:
    """Description of the weights found at a path.

    Attributes:
        path: as given.
        layout: "Hugging Face folder", "Microsoft checkpoint" or "torchaudio state dict".
        architecture: sizes of the network.
        normalize: None if the weights expect the waveform unnormalised; otherwise they expect
            mean 0 and variance 1 with this number added to the variance.
        fingerprint: sha256 over the sorted names (transformers'), shapes and float32 bytes of the
            tensors, and over settings that differ from the published ones. The same weights
            have the same fingerprint in every layout.
    """

    path: str
    layout: str
    architecture: Architecture
    normalize: float | None
    fingerprint: str

    @property
    def width(self) -> int:
        """Columns of one hidden state."""
        return self.architecture.width

    def describe(self) -> str:
        """Summarise in one line: layout, size, layers, width, normalisation, fingerprint."""
        shape = self.architecture
        eps = self.normalize
        rule = (
            "not normalised"
            if eps is None
            else f"normalised to mean 0 and variance 1 (eps {eps:g})"
        )
        return (
            f"{self.path}: WavLM {shape.size}, {self.layout}: {shape.layers} layers of "
            f"{shape.width}, {shape.heads} heads, relative positions up to {shape.max_distance}; "
            f"waveform {rule}; fingerprint {self.fingerprint}"
        )


def read_weights(path: str | os.PathLike[str]) -> tuple[Weights, dict[str, torch.Tensor]]:
    """Read the weights at `path`: description, and float32 CPU tensors by transformers' names.

    Args:
        path: a Hugging Face folder (config.json with model.safetensors or pytorch_model.bin),
            Microsoft's WavLM-*.pt, or a state dict of torchaudio's models (torch's or
            safetensors' format). The layout is detected from the content.

    Raises WeightsError if the path holds no such weights, if a tensor is missing, unknown or of
    another shape, and if a file could only be read by running code from it.
    """
    path = Path(path)
    if path.is_dir():
        layout = "Hugging Face folder"
        config = _huggingface_config(path)
        shape = Architecture.from_huggingface(config, str(path / "config.json"))
        tensors = from_huggingface(read_folder(path))
        normalize = expected_normalization(path, shape.front_norm)
    elif path.is_file():
        content = read_file(path)
        if _is_microsoft(content):
            layout = "Microsoft checkpoint"
            shape = Architecture.from_microsoft(content["cfg"], str(path))
            tensors = from_microsoft(plain_tensors(path, content["model"]))
            normalize = MICROSOFT_EPS if content["cfg"].get("normalize", False) else None
        elif isinstance(content, dict) and is_torchaudio(map(str, content)):
            layout = "torchaudio state dict"
            tensors = from_torchaudio(plain_tensors(path, content))
            shape = Architecture.from_tensors(tensors, str(path))
            # As in torchaudio's pipelines: only Large expects a normalised waveform.
            normalize = MICROSOFT_EPS if shape.front_norm == "layer" else None
        else:
            raise _unknown_layout(path, content)
    else:
        what = "not a file or folder" if path.exists() else "no such folder or file"
        raise WeightsError(
            f"{path}: {what}: give a local WavLM: Hugging Face's folder with config.json and "
            "model.safetensors, Microsoft's WavLM-*.pt, or a torchaudio state dict"
        )
    tensors = _fitting(path, tensors, shape)
    return Weights(str(path), layout, shape, normalize, _fingerprint(tensors, shape)), tensors


def _huggingface_config(folder: Path) -> dict[str, Any]:
    path = folder / "config.json"
    checkpoints = sorted(folder.glob("*.pt")) + sorted(folder.glob("*.pth"))
    if not path.is_file() and checkpoints:
        raise WeightsError(
            f"{folder}: no config.json, so no Hugging Face folder: name the file, {checkpoints[0]}"
        )
    config = read_json(path)
    if config.get("model_type") != "wavlm":
        raise WeightsError(
            f"{path}: model_type is {config.get('model_type')!r}, expected 'wavlm': "
            "give the folder of a WavLM model"
        )
    return config


def _is_microsoft(content: Any) -> bool:
    return (
        isinstance(content, dict)
        and isinstance(content.get("cfg"), dict)
        and isinstance(content.get("model"), Mapping)
    )


def _unknown_layout(path: Path, content: Any) -> WeightsError:
    names = [str(name) for name in content] if isinstance(content, Mapping) else []
    if path.name in ("model.safetensors", "pytorch_model.bin"):
        do = f"for Hugging Face's layout name the folder, {path.parent}, with its config.json"
    elif any(re.fullmatch(r"encoder\.layers\.\d+\.self_attn\..*", name) for name in names):
        do = "these are Microsoft's names without their cfg: give the checkpoint as published"
    else:
        do = "give Hugging Face's folder, Microsoft's WavLM-*.pt or a torchaudio state dict"
    found = ", ".join(names[:4]) or type(content).__name__
    return WeightsError(f"{path}: no WavLM in a known layout (found: {found[:200]}): {do}")


def _fitting(
    path: Path, tensors: dict[str, torch.Tensor], shape: Architecture
) -> dict[str, torch.Tensor]:
    """Return exactly the network's tensors, in float32."""
    import torch

    expected = shape.shapes()
    problems = {
        "missing": [name for name in expected if name not in tensors],
        "unknown": [name for name in tensors if name not in expected],
        "of another shape": [
            f"{name} {tuple(tensors[name].shape)}, not {wanted}"
            for name, wanted in expected.items()
            if name in tensors and tuple(tensors[name].shape) != wanted
        ],
        "not floating point": [
            name for name in expected if name in tensors and not tensors[name].is_floating_point()
        ],
    }
    refuse_tensors(path, problems, "settings and weights must come from the same WavLM model")
    fitting = {name: tensors[name].float().contiguous() for name in expected}
    for name, tensor in fitting.items():
        if not torch.isfinite(tensor).all():
            raise WeightsError(f"{path}: tensor {name} is not finite: download it again")
    return fitting


def _fingerprint(tensors: dict[str, torch.Tensor], shape: Architecture) -> str:
    digest = hashlib.sha256()
    for name in sorted(tensors):
        digest.update(f"{name} {list(tensors[name].shape)}\n".encode())
        digest.update(tensors[name].numpy().data)
    if shape.unpublished:
        digest.update(json.dumps(shape.unpublished, sort_keys=True).encode())
    return digest.hexdigest()


_MICROSOFT = (
    (r"(feature_extractor\.conv_layers\.\d+)\.0\.(\w+)", r"\1.conv.\2"),
    (r"(feature_extractor\.conv_layers\.\d+)\.2\.(?:1\.)?(\w+)", r"\1.layer_norm.\2"),
    (r"layer_norm\.(\w+)", r"feature_projection.layer_norm.\1"),
    (r"post_extract_proj\.(\w+)", r"feature_projection.projection.\1"),
    (r"encoder\.pos_conv\.0\.(.+)", r"encoder.pos_conv_embed.conv.\1"),
    (
        r"(encoder\.layers\.\d+)\.self_attn\.grep_linear\.(\w+)",
        r"\1.attention.gru_rel_pos_linear.\2",
    ),
    (r"(encoder\.layers\.\d+)\.self_attn\.grep_a", r"\1.attention.gru_rel_pos_const"),
    (
        r"(encoder\.layers\.\d+)\.self_attn\.relative_attention_bias\.(\w+)",
        r"\1.attention.rel_attn_embed.\2",
    ),
    (r"(encoder\.layers\.\d+)\.self_attn\.(.+)", r"\1.attention.\2"),
    (r"(encoder\.layers\.\d+)\.self_attn_layer_norm\.(\w+)", r"\1.layer_norm.\2"),
    (r"(encoder\.layers\.\d+)\.fc1\.(\w+)", r"\1.feed_forward.intermediate_dense.\2"),
    (r"(encoder\.layers\.\d+)\.fc2\.(\w+)", r"\1.feed_forward.output_dense.\2"),
)
_TORCHAUDIO = (
    (r"encoder\.feature_projection\.(.+)", r"feature_projection.\1"),
    (r"encoder\.transformer\.(layers\.\d+\.attention)\.attention\.(.+)", r"encoder.\1.\2"),
    (r"encoder\.transformer\.(.+)", r"encoder.\1"),
)
# Heads of models for pre-training, recognition or speaker tasks.
_HEADS = (
    r"(lm_head|quantizer|project_hid|project_q|projector|classifier|tdnn|objective)\..*"
    r"|layer_weights"
)
_MASK = {"masked_spec_embed", "mask_emb"}  # replaces masked frames, in training only


def from_huggingface(tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Remove the prefix `wavlm.` and the heads from Hugging Face's tensors."""
    if any(name.startswith("wavlm.") for name in tensors):
        # If the network has the prefix, every tensor without it belongs to a head.
        found = {
            name.removeprefix("wavlm."): tensor
            for name, tensor in tensors.items()
            if name.startswith("wavlm.")
        }
    else:
        found = {name: t for name, t in tensors.items() if not re.fullmatch(_HEADS, name)}
    return _weight_norm({name: t for name, t in found.items() if name not in _MASK})


def from_microsoft(tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Rename the tensors of the `model` of Microsoft's checkpoint."""
    return _weight_norm(
        {_renamed(name, _MICROSOFT): t for name, t in tensors.items() if name not in _MASK}
    )


def from_torchaudio(tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Rename the state dict of `torchaudio.models.wavlm_*` or of its pipelines."""
    found: dict[str, torch.Tensor] = {}
    for name, tensor in tensors.items():
        name = name.removeprefix("model.")
        if name.startswith("aux."):
            continue
        name = _renamed(name, _TORCHAUDIO)
        stacked = re.fullmatch(r"(.+)\.in_proj_(weight|bias)", name)
        if stacked is None or len(tensor) % 3:
            found[name] = tensor
        else:
            attention, kind = stacked.groups()
            for part, chunk in zip("qkv", tensor.chunk(3)):
                found[f"{attention}.{part}_proj.{kind}"] = chunk
    return _weight_norm(found)


def is_torchaudio(names: Iterable[str]) -> bool:
    """Return true for torchaudio's names, the only layout with `encoder.transformer`."""
    return any(name.removeprefix("model.").startswith("encoder.transformer.") for name in names)


def _renamed(name: str, table: tuple[tuple[str, str], ...]) -> str:
    for pattern, replacement in table:
        if re.fullmatch(pattern, name):
            return re.sub(pattern, replacement, name)
    return name


def _weight_norm(tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Rename magnitude and direction, which older torch calls weight_g and weight_v."""
    conv = "encoder.pos_conv_embed.conv"
    new = {
        f"{conv}.weight_g": f"{conv}.parametrizations.weight.original0",
        f"{conv}.weight_v": f"{conv}.parametrizations.weight.original1",
    }
    return {new.get(name, name): tensor for name, tensor in tensors.items()}
