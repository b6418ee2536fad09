"""Architecture of a WavLM network, read from the settings of any of the three layouts."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from audio_features.errors import WeightsError

if TYPE_CHECKING:
    import torch

WINDOW = 400
"""Samples that one frame covers, at 16 kHz."""
HOP = 320
"""Samples between two frames."""

_STRIDES = (5, 2, 2, 2, 2, 2, 2)
# Far above Large (1024, 24, 4096); limits the memory that a damaged file can request.
_LARGEST = 1 << 14
_MOST_LAYERS = 256

_MICROSOFT_KEYS = {
    "width": "encoder_embed_dim",
    "layers": "encoder_layers",
    "heads": "encoder_attention_heads",
    "inner": "encoder_ffn_embed_dim",
    "pre_norm": "layer_norm_first",
    "conv_bias": "conv_bias",
    "position_kernel": "conv_pos",
    "position_groups": "conv_pos_groups",
    "buckets": "num_buckets",
    "max_distance": "max_distance",
}
_RELATIVE = ("relative_position_embedding", "gru_rel_pos")


@dataclass(frozen=True)
class Architecture:
    """Sizes and variants of a WavLM network.

    Attributes:
        width, layers, heads: sizes of the encoder.
        inner: width of the encoder's feed-forward part.
        front_norm: "group" normalises the first convolution over the whole sound (Base),
            "layer" normalises every convolution frame by frame (Large).
        pre_norm: true if layers normalise their input (Large), false for their output (Base).
        channels, kernels, strides: sizes of the seven convolutions.
        conv_bias: true if those convolutions have a bias.
        position_kernel, position_groups: sizes of the positional convolution.
        buckets, max_distance: sizes of the relative position bias.
        eps: epsilon of the encoder's layer normalisations.
    """

    width: int
    layers: int
    heads: int
    inner: int
    front_norm: Literal["group", "layer"]
    pre_norm: bool
    channels: tuple[int, ...]
    kernels: tuple[int, ...]
    strides: tuple[int, ...]
    conv_bias: bool
    position_kernel: int
    position_groups: int
    buckets: int
    max_distance: int
    eps: float

    @classmethod
    def from_huggingface(cls, config: Mapping[str, Any], where: str) -> Architecture:
        """Read config.json; missing settings have the defaults of transformers' WavLMConfig.

        Raises WeightsError, which names `where`, for settings that are not a WavLM network's.
        """
        _check_gelu(where, config, "hidden_act", "feat_extract_activation")
        return cls._checked(
            where,
            width=config.get("hidden_size", 768),
            layers=config.get("num_hidden_layers", 12),
            heads=config.get("num_attention_heads", 12),
            inner=config.get("intermediate_size", 3072),
            front_norm=config.get("feat_extract_norm", "group"),
            pre_norm=config.get("do_stable_layer_norm", False),
            channels=config.get("conv_dim", (512,) * 7),
            kernels=config.get("conv_kernel", (10, 3, 3, 3, 3, 2, 2)),
            strides=config.get("conv_stride", _STRIDES),
            conv_bias=config.get("conv_bias", False),
            position_kernel=config.get("num_conv_pos_embeddings", 128),
            position_groups=config.get("num_conv_pos_embedding_groups", 16),
            buckets=config.get("num_buckets", 320),
            max_distance=config.get("max_bucket_distance", 800),
            eps=config.get("layer_norm_eps", 1e-5),
        )

    @classmethod
    def from_microsoft(cls, cfg: Mapping[str, Any], where: str) -> Architecture:
        """Read the `cfg` of Microsoft's checkpoint; a missing setting is an error.

        Microsoft's own loader falls back on defaults that no published model has (a
        max_distance of 1280, no relative positions).
        """
        needed = [*_MICROSOFT_KEYS.values(), "extractor_mode", "conv_feature_layers", *_RELATIVE]
        missing = [name for name in needed if name not in cfg]
        if missing:
            raise WeightsError(
                f"{where}: cfg lacks {', '.join(missing)}: give the checkpoint as Microsoft "
                "published it"
            )
        _check_gelu(where, cfg, "activation_fn")
        for name in _RELATIVE:
            if cfg[name] is not True:
                raise _not_wavlm(where, name, cfg[name], "True")
        convolutions = _convolutions(cfg["conv_feature_layers"], where)
        modes = {"default": "group", "layer_norm": "layer"}
        return cls._checked(
            where,
            **{field: cfg[name] for field, name in _MICROSOFT_KEYS.items()},
            front_norm=modes.get(str(cfg["extractor_mode"]), cfg["extractor_mode"]),
            channels=[conv[0] for conv in convolutions],
            kernels=[conv[1] for conv in convolutions],
            strides=[conv[2] for conv in convolutions],
            eps=1e-5,
        )

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, torch.Tensor], where: str) -> Architecture:
        """Infer the shapes from tensors under Hugging Face's names; the rest is as published."""
        depth = 1 + max(
            (int(name.split(".")[2]) for name in tensors if re.match(r"encoder\.layers\.\d", name)),
            default=0,
        )

        def shape(name: str, axes: int) -> tuple[int, ...]:
            found = tuple(tensors[name].shape) if name in tensors else ()
            if len(found) != axes:
                raise WeightsError(
                    f"{where}: tensor {name} has shape {found}, expected {axes} axes: "
                    "the network's size cannot be determined"
                )
            return found

        convolutions = [
            shape(f"feature_extractor.conv_layers.{i}.conv.weight", 3) for i in range(len(_STRIDES))
        ]
        first = "encoder.layers.0."
        kernel = shape("encoder.pos_conv_embed.conv.parametrizations.weight.original1", 3)
        large = "feature_extractor.conv_layers.1.layer_norm.weight" in tensors
        return cls._checked(
            where,
            width=kernel[0],
            layers=depth,
            heads=shape(f"{first}attention.gru_rel_pos_const", 4)[1],
            inner=shape(f"{first}feed_forward.intermediate_dense.weight", 2)[0],
            front_norm="layer" if large else "group",
            pre_norm=large,
            channels=[conv[0] for conv in convolutions],
            kernels=[conv[2] for conv in convolutions],
            strides=_STRIDES,
            conv_bias="feature_extractor.conv_layers.0.conv.bias" in tensors,
            position_kernel=kernel[2],
            position_groups=kernel[0] // max(1, kernel[1]),
            buckets=shape(f"{first}attention.rel_attn_embed.weight", 2)[0],
            max_distance=800,
            eps=1e-5,
        )

    @classmethod
    def _checked(cls, where: str, **numbers: Any) -> Architecture:
        for name in ("channels", "kernels", "strides"):
            if not isinstance(numbers[name], list | tuple) or len(numbers[name]) != len(_STRIDES):
                raise _not_wavlm(where, name, numbers[name], "seven numbers")
            numbers[name] = tuple(numbers[name])
            for number in numbers[name]:
                _check_count(where, name, number)
        for name in ("width", "heads", "inner", "position_kernel", "position_groups", "buckets"):
            _check_count(where, name, numbers[name])
        _check_count(where, "max_distance", numbers["max_distance"])
        _check_count(where, "layers", numbers["layers"], _MOST_LAYERS)
        if numbers["front_norm"] not in ("group", "layer"):
            raise _not_wavlm(where, "front_norm", numbers["front_norm"], "'group' or 'layer'")
        for name in ("pre_norm", "conv_bias"):
            if not isinstance(numbers[name], bool):
                raise _not_wavlm(where, name, numbers[name], "true or false")
        eps = numbers["eps"]
        if isinstance(eps, bool) or not isinstance(eps, float) or not 0 < eps < 1:
            raise _not_wavlm(where, "eps", eps, "a number between 0 and 1")
        for name in ("heads", "position_groups"):
            if numbers["width"] % numbers[name]:
                raise _not_wavlm(where, name, numbers[name], f"a divisor of {numbers['width']}")
        if numbers["buckets"] % 4 or numbers["max_distance"] <= numbers["buckets"] // 4:
            raise _not_wavlm(
                where, "buckets", numbers["buckets"], "a multiple of 4 below 4 times max_distance"
            )
        window, hop = 1, 1
        for kernel, stride in zip(numbers["kernels"], numbers["strides"], strict=True):
            window += (kernel - 1) * hop
            hop *= stride
        if (window, hop) != (WINDOW, HOP):
            raise WeightsError(
                f"{where}: kernels and strides give frames of {window} samples every {hop}, "
                f"expected {WINDOW} every {HOP}: this is not WavLM's front end"
            )
        return cls(**numbers)

    @property
    def size(self) -> str:
        """Name of the published size; Base and Base+ have the same shape."""
        names = {(768, 12): "Base or Base+", (1024, 24): "Large"}
        return names.get((self.width, self.layers), "of a custom size")

    @property
    def unpublished(self) -> dict[str, Any]:
        """Settings that do not show in the shapes and differ from those of published models."""
        usual = {
            "pre_norm": self.front_norm == "layer",
            "strides": _STRIDES,
            "max_distance": 800,
            "eps": 1e-5,
        }
        return {key: value for key in usual if (value := getattr(self, key)) != usual[key]}

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shape of every tensor of the network by its name in transformers."""
        width, head = self.width, self.width // self.heads
        shapes: dict[str, tuple[int, ...]] = {}
        for i, (n_in, n_out) in enumerate(zip((1, *self.channels), self.channels)):
            conv = f"feature_extractor.conv_layers.{i}."
            shapes[f"{conv}conv.weight"] = (n_out, n_in, self.kernels[i])
            if self.conv_bias:
                shapes[f"{conv}conv.bias"] = (n_out,)
            if self.front_norm == "layer" or i == 0:
                shapes |= _norm(f"{conv}layer_norm", n_out)
        shapes |= _norm("feature_projection.layer_norm", self.channels[-1])
        shapes |= _linear("feature_projection.projection", self.channels[-1], width)
        position = "encoder.pos_conv_embed.conv."
        shapes[f"{position}bias"] = (width,)
        shapes[f"{position}parametrizations.weight.original0"] = (1, 1, self.position_kernel)
        shapes[f"{position}parametrizations.weight.original1"] = (
            width,
            width // self.position_groups,
            self.position_kernel,
        )
        shapes |= _norm("encoder.layer_norm", width)
        for i in range(self.layers):
            layer = f"encoder.layers.{i}."
            for part in ("q_proj", "k_proj", "v_proj", "out_proj"):
                shapes |= _linear(f"{layer}attention.{part}", width, width)
            shapes |= _linear(f"{layer}attention.gru_rel_pos_linear", head, 8)
            shapes[f"{layer}attention.gru_rel_pos_const"] = (1, self.heads, 1, 1)
            if i == 0:
                shapes[f"{layer}attention.rel_attn_embed.weight"] = (self.buckets, self.heads)
            shapes |= _norm(f"{layer}layer_norm", width)
            shapes |= _linear(f"{layer}feed_forward.intermediate_dense", width, self.inner)
            shapes |= _linear(f"{layer}feed_forward.output_dense", self.inner, width)
            shapes |= _norm(f"{layer}final_layer_norm", width)
        return shapes


def _linear(name: str, n_in: int, n_out: int) -> dict[str, tuple[int, ...]]:
    return {f"{name}.weight": (n_out, n_in), f"{name}.bias": (n_out,)}


def _norm(name: str, width: int) -> dict[str, tuple[int, ...]]:
    return {f"{name}.weight": (width,), f"{name}.bias": (width,)}


def _convolutions(text: Any, where: str) -> list[tuple[int, int, int]]:
    """Parse Microsoft's "[(512,10,5)] + [(512,3,2)] * 4 + …", which their loader evaluates."""
    layers: list[tuple[int, int, int]] = []
    for term in str(text)[:1000].split("+"):
        found = re.fullmatch(r"\s*\[\((\d+),\s*(\d+),\s*(\d+)\)\]\s*(?:\*\s*(\d{1,2}))?\s*", term)
        if found is None:
            raise _not_wavlm(where, "conv_feature_layers", text, "'[(512,10,5)] + …'")
        width, kernel, stride, times = (int(number or 1) for number in found.groups())
        layers += [(width, kernel, stride)] * times
    return layers


def _check_gelu(where: str, settings: Mapping[str, Any], *names: str) -> None:
    for name in names:
        if settings.get(name, "gelu") != "gelu":
            raise _not_wavlm(where, name, settings[name], "'gelu'")


def _check_count(where: str, name: str, value: Any, most: int = _LARGEST) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= most:
        raise _not_wavlm(where, name, value, f"a whole number from 1 to {most}")


def _not_wavlm(where: str, name: str, value: Any, expected: str) -> WeightsError:
    return WeightsError(
        f"{where}: describes no WavLM network: {name} is {str(value)[:80]!r}, expected {expected}"
    )
