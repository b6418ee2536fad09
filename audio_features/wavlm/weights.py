"""WavLM's weights in three layouts: Hugging Face, Microsoft and torchaudio.

Only tensors and settings are read from a file, and neither transformers nor torchaudio is needed.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from audio_features.errors import WeightsError, check_values
from audio_features.weight_files import (
    EncoderWeights,
    add_tensors,
    encoder_tensors,
    expected_normalization,
    fitting_tensors,
    normalization_text,
    plain_tensors,
    read_file,
    read_folder,
    read_json,
    renamed,
)

if TYPE_CHECKING:
    import torch

KERNELS, STRIDES = (10, 3, 3, 3, 3, 2, 2), (5, 2, 2, 2, 2, 2, 2)
"""Sizes of the seven convolutions of the front end."""
WINDOW = 400
"""Samples that one frame covers, at 16 kHz."""
HOP = 320
"""Samples between two frames."""
MICROSOFT_EPS = 1e-5
"""Constant that Microsoft's and torchaudio's code add to the waveform's variance."""

_NO_WAVLM = ": describes no WavLM network: "
_MOST_LAYERS = 256  # ten times those of Large
_LAYOUTS = "a Hugging Face folder, Microsoft's WavLM-*.pt with its cfg, or torchaudio's state dict"


@dataclass(frozen=True)
class Architecture:
    """Sizes of a WavLM network, which its tensors show, and variants, which they do not show.

    Attributes:
        width, layers, heads: sizes of the encoder.
        inner: width of the encoder's feed-forward part.
        front_norm: "group" normalises the first convolution over the whole sound (Base),
            "layer" normalises every convolution frame by frame (Large).
        pre_norm: true if layers normalise their input (Large), false for their output (Base).
        channels: of the seven convolutions.
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
    conv_bias: bool
    position_kernel: int
    position_groups: int
    buckets: int
    max_distance: int
    eps: float

    @classmethod
    def from_huggingface(
        cls, config: Mapping[str, Any], tensors: Mapping[str, torch.Tensor], where: str
    ) -> Architecture:
        """Read config.json; missing settings have the defaults of transformers' WavLMConfig.

        Raises WeightsError, which names `where`, for settings that are not a WavLM network's.
        """
        usual: dict[str, Any] = {"hidden_act": "gelu", "feat_extract_activation": "gelu"}
        usual |= {"conv_kernel": list(KERNELS), "conv_stride": list(STRIDES)}
        _check_settings(where, usual | dict(config), usual)
        return cls.from_tensors(
            tensors,
            where,
            front_norm=config.get("feat_extract_norm", "group"),
            pre_norm=config.get("do_stable_layer_norm", False),
            max_distance=config.get("max_bucket_distance", 800),
            eps=config.get("layer_norm_eps", 1e-5),
        )

    @classmethod
    def from_microsoft(
        cls, cfg: Mapping[str, Any], tensors: Mapping[str, torch.Tensor], where: str
    ) -> Architecture:
        """Read the `cfg` of Microsoft's checkpoint; a missing setting is an error.

        Microsoft's own loader falls back on defaults that no published model has (a
        max_distance of 1280, no relative positions).
        """
        # Microsoft's loader evaluates them: "[(512,10,5)] + [(512,3,2)] * 4 + [(512,2,2)] * 2".
        layers = str(cfg.get("conv_feature_layers")).replace(" ", "")
        sizes = re.findall(r"\(\d+,(\d+,\d+)\)", layers)
        usual: dict[str, Any] = {"activation_fn": "gelu", "relative_position_embedding": True}
        usual |= {"gru_rel_pos": True, "conv_feature_layers": ["10,5", "3,2", "2,2"]}
        _check_settings(where, {**cfg, "conv_feature_layers": sizes}, usual)
        mode = cfg.get("extractor_mode")
        return cls.from_tensors(
            tensors,
            where,
            front_norm={"default": "group", "layer_norm": "layer"}.get(str(mode), mode),
            pre_norm=cfg.get("layer_norm_first"),
            max_distance=cfg.get("max_distance"),
        )

    @classmethod
    def from_tensors(
        cls,
        tensors: Mapping[str, torch.Tensor],
        where: str,
        *,
        front_norm: Any = None,
        pre_norm: Any = None,
        max_distance: Any = 800,
        eps: Any = 1e-5,
    ) -> Architecture:
        """Infer the sizes from tensors under Hugging Face's names; variants are as published.

        Raises WeightsError, which names `where`, for tensors or variants of no WavLM network.
        """

        def shape(name: str, axes: int) -> tuple[int, ...]:
            sizes = tuple(tensors[name].shape) if name in tensors else ()
            if len(sizes) != axes or not all(sizes):
                raise WeightsError(f"{where}: tensor {name} is {sizes}, expected {axes} axes")
            return sizes

        first, convolution = "encoder.layers.0.", "feature_extractor.conv_layers."
        large = f"{convolution}1.layer_norm.weight" in tensors
        depths = [re.match(r"encoder\.layers\.(\d+)\.", name) for name in tensors]
        kernel = shape("encoder.pos_conv_embed.conv.parametrizations.weight.original1", 3)
        convolutions = [shape(f"{convolution}{i}.conv.weight", 3) for i in range(len(KERNELS))]
        made = cls(
            width=kernel[0],
            layers=1 + max((int(depth[1]) for depth in depths if depth), default=0),
            heads=shape(f"{first}attention.gru_rel_pos_const", 4)[1],
            inner=shape(f"{first}feed_forward.intermediate_dense.weight", 2)[0],
            front_norm=("layer" if large else "group") if front_norm is None else front_norm,
            pre_norm=large if pre_norm is None else pre_norm,
            channels=tuple(sizes[0] for sizes in convolutions),
            conv_bias=f"{convolution}0.conv.bias" in tensors,
            position_kernel=kernel[2],
            position_groups=kernel[0] // kernel[1],
            buckets=shape(f"{first}attention.rel_attn_embed.weight", 2)[0],
            max_distance=max_distance,
            eps=eps,
        )
        is_distance = isinstance(max_distance, int) and max_distance > made.buckets // 4
        checks = {
            "layers": (made.layers <= _MOST_LAYERS, f"at most {_MOST_LAYERS}"),
            "heads": (made.width % made.heads == 0, f"a divisor of {made.width}"),
            "position_groups": (made.width % made.position_groups == 0, "a divisor of the width"),
            "buckets": (made.buckets % 4 == 0, "a multiple of 4"),
            "max_distance": (is_distance, f"a whole number above {made.buckets // 4}"),
            "front_norm": (made.front_norm in ("group", "layer"), "'group' or 'layer'"),
            "pre_norm": (isinstance(made.pre_norm, bool), "true or false"),
            "eps": (isinstance(eps, float) and 0 < eps < 1, "a number from 0 to 1"),
        }
        values = ((name, getattr(made, name), *check) for name, check in checks.items())
        check_values(WeightsError, f"{where}{_NO_WAVLM}", values)
        return made

    @property
    def size(self) -> str:
        """Name of the published size; Base and Base+ have the same shape."""
        names = {(768, 12): "Base or Base+", (1024, 24): "Large"}
        return names.get((self.width, self.layers), "of a custom size")

    @property
    def unpublished(self) -> dict[str, Any]:
        """Settings that do not show in the shapes and differ from those of published models."""
        usual = {"pre_norm": self.front_norm == "layer", "max_distance": 800, "eps": 1e-5}
        return {key: value for key in usual if (value := getattr(self, key)) != usual[key]}

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shape of every tensor of the network by its name in transformers."""
        width, head = self.width, self.width // self.heads
        shapes: dict[str, tuple[int, ...]] = {}

        def add(name: str, *sizes: int, bias: bool = True) -> None:
            shapes[f"{name}.weight"] = sizes
            if bias:
                shapes[f"{name}.bias"] = sizes[:1]

        for i, (n_in, n_out) in enumerate(zip((1, *self.channels), self.channels)):
            conv = f"feature_extractor.conv_layers.{i}."
            add(f"{conv}conv", n_out, n_in, KERNELS[i], bias=self.conv_bias)
            if self.front_norm == "layer" or i == 0:
                add(f"{conv}layer_norm", n_out)
        add("feature_projection.layer_norm", self.channels[-1])
        add("feature_projection.projection", width, self.channels[-1])
        position = "encoder.pos_conv_embed.conv."
        kernel, inputs = self.position_kernel, width // self.position_groups
        shapes[f"{position}bias"] = (width,)
        shapes[f"{position}parametrizations.weight.original0"] = (1, 1, kernel)
        shapes[f"{position}parametrizations.weight.original1"] = (width, inputs, kernel)
        add("encoder.layer_norm", width)
        add("encoder.layers.0.attention.rel_attn_embed", self.buckets, self.heads, bias=False)
        for i in range(self.layers):
            layer = f"encoder.layers.{i}."
            for part in ("q_proj", "k_proj", "v_proj", "out_proj"):
                add(f"{layer}attention.{part}", width, width)
            add(f"{layer}attention.gru_rel_pos_linear", 8, head)
            shapes[f"{layer}attention.gru_rel_pos_const"] = (1, self.heads, 1, 1)
            add(f"{layer}layer_norm", width)
            add(f"{layer}feed_forward.intermediate_dense", self.inner, width)
            add(f"{layer}feed_forward.output_dense", width, self.inner)
            add(f"{layer}final_layer_norm", width)
        return shapes


def _check_settings(where: str, given: Mapping[str, Any], usual: Mapping[str, Any]) -> None:
    """Raise WeightsError for the first of the usual settings that is given otherwise."""
    items = usual.items()
    values = (
        (name, given.get(name), given.get(name) == value, repr(value)) for name, value in items
    )
    check_values(WeightsError, f"{where}{_NO_WAVLM}", values)


def read_weights(
    path: str | os.PathLike[str],
) -> tuple[EncoderWeights, Architecture, dict[str, torch.Tensor]]:
    """Read the weights at `path`: float32 CPU tensors by transformers' names.

    The same weights have the same fingerprint in every layout.

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
        config = _config(path)
        tensors = encoder_tensors(read_folder(path), ["wavlm."])
        shape = Architecture.from_huggingface(config, tensors, str(path / "config.json"))
        normalize = expected_normalization(path, shape.front_norm)
    elif path.is_file():
        layout, shape, tensors, normalize = _read_file(path)
    else:
        what = "not a file or folder" if path.exists() else "no such folder or file"
        raise WeightsError(f"{path}: {what}: give a local WavLM: {_LAYOUTS}")
    tensors = fitting_tensors(path, tensors, shape.shapes())
    digest = hashlib.sha256()
    add_tensors(digest, tensors)
    if shape.unpublished:
        digest.update(json.dumps(shape.unpublished, sort_keys=True).encode())
    sizes = f"{shape.layers} layers of {shape.width}, {shape.heads} heads"
    about = f"WavLM {shape.size}, {layout}: {sizes}, relative positions up to {shape.max_distance}"
    summary = f"{about}; {normalization_text(normalize)}"
    weights = EncoderWeights(
        str(path), "wavlm", summary, shape.layers, shape.width, normalize, digest.hexdigest()
    )
    return weights, shape, tensors


def _read_file(path: Path) -> tuple[str, Architecture, dict[str, torch.Tensor], float | None]:
    """Return layout, architecture, tensors and normalisation of a file in one of two layouts."""
    content = read_file(path)
    names = [str(name) for name in content] if isinstance(content, Mapping) else []
    if {"cfg", "model"} <= set(names) and isinstance(content["cfg"], dict):
        tensors = renamed(plain_tensors(path, content["model"]), _MICROSOFT)
        shape = Architecture.from_microsoft(content["cfg"], tensors, str(path))
        normalize = MICROSOFT_EPS if content["cfg"].get("normalize", False) else None
        return "Microsoft checkpoint", shape, tensors, normalize
    if any(name.removeprefix("model.").startswith("encoder.transformer.") for name in names):
        tensors = _from_torchaudio(plain_tensors(path, content))
        shape = Architecture.from_tensors(tensors, str(path))
        # As in torchaudio's pipelines: only Large expects a normalised waveform.
        normalize = MICROSOFT_EPS if shape.front_norm == "layer" else None
        return "torchaudio state dict", shape, tensors, normalize
    held = ", ".join(names[:4]) or type(content).__name__
    raise WeightsError(f"{path}: no WavLM in a known layout (found: {held[:200]}): give {_LAYOUTS}")


def _config(folder: Path) -> dict[str, Any]:
    path = folder / "config.json"
    checkpoints = sorted(folder.glob("*.pt")) + sorted(folder.glob("*.pth"))
    if not path.is_file() and checkpoints:
        raise WeightsError(f"{folder}: no config.json: name the file, {checkpoints[0]}")
    config = read_json(path)
    if config.get("model_type") != "wavlm":
        raise WeightsError(f"{path}: model_type is {config.get('model_type')!r}, expected 'wavlm'")
    return config


_MICROSOFT = (
    (r"^layer_norm\.", "feature_projection.layer_norm."),
    (r"^post_extract_proj\.", "feature_projection.projection."),
    (r"(conv_layers\.\d+)\.0\.", r"\1.conv."),
    (r"(conv_layers\.\d+)\.2\.(1\.)?", r"\1.layer_norm."),
    (r"\.pos_conv\.0\.", ".pos_conv_embed.conv."),
    (r"\.self_attn_layer_norm\.", ".layer_norm."),
    (r"\.self_attn\.", ".attention."),
    (r"\.grep_linear\.", ".gru_rel_pos_linear."),
    (r"\.grep_a$", ".gru_rel_pos_const"),
    (r"\.relative_attention_bias\.", ".rel_attn_embed."),
    (r"\.fc1\.", ".feed_forward.intermediate_dense."),
    (r"\.fc2\.", ".feed_forward.output_dense."),
)
_TORCHAUDIO = (
    (r"^model\.", ""),
    (r"^encoder\.feature_projection\.", "feature_projection."),
    (r"^encoder\.transformer\.", "encoder."),
    (r"\.attention\.attention\.", ".attention."),
)


def _from_torchaudio(tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Rename the state dict of `torchaudio.models.wavlm_*` or of its pipelines."""
    split: dict[str, torch.Tensor] = {}
    for name, tensor in renamed(tensors, _TORCHAUDIO).items():
        stacked = re.fullmatch(r"(.+)\.in_proj_(weight|bias)", name)
        if stacked is None or len(tensor) % 3:
            split[name] = tensor
        else:
            attention, kind = stacked.groups()
            for part, chunk in zip("qkv", tensor.chunk(3)):
                split[f"{attention}.{part}_proj.{kind}"] = chunk
    return split
