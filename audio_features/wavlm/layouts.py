"""Tensor names of WavLM in Microsoft's, torchaudio's and Hugging Face's files.

All are renamed to transformers' names, with torch's current names for weight normalisation.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch

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


def is_torchaudio(names: Mapping[str, object]) -> bool:
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
