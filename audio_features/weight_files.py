"""Weights of networks: their files, the JSON files beside them, and what must agree.

No code in a file is run, no missing tensor is filled with random numbers, and nothing is
downloaded, as the loaders of transformers, Microsoft and torchaudio might do.
"""

from __future__ import annotations

import io
import os
import pickle
import re
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from audio_features.archive import parse_json, read_bytes
from audio_features.errors import WeightsError

if TYPE_CHECKING:
    import torch

HUGGINGFACE_EPS = 1e-7
"""Constant that Hugging Face's feature extractor adds to the waveform's variance."""

WeightPlaces = str | os.PathLike[str] | Mapping[str, str | os.PathLike[str]]
"""Folder or file of the weights of an encoder; or that of each encoder by its kind."""

_MAX_CONFIG_BYTES = 1 << 20
_MOST_LISTED = 8
_INDEX = "model.safetensors.index.json"
# Tensors that belong to training, follow the encoder, or are computed.
_LEFT_OUT = ("adapter.", "intermediate_ffn.", "masked_spec_embed", "embeddings.position_ids")
# Names of normalisations in files of older versions.
_OLD_NAMES = (
    (r"\.weight_g", ".parametrizations.weight.original0"),
    (r"\.weight_v", ".parametrizations.weight.original1"),
    (r"LayerNorm\.gamma", "LayerNorm.weight"),
    (r"LayerNorm\.beta", "LayerNorm.bias"),
)


@dataclass(frozen=True)
class EncoderWeights:
    """Description of the weights of a speech encoder.

    Attributes:
        path: file or folder, as given.
        model: model_type of the encoder in transformers.
        summary: architecture, layout, size and input, for `describe`.
        layers: number of layers.
        width: columns of one hidden state.
        normalize: None if the encoder expects its waveform unnormalised; otherwise the number
            that it expects to be added to the waveform's variance.
        fingerprint: sha256 over names, shapes and float32 bytes of the tensors, and settings that
            change the values.
    """

    path: str
    model: str
    summary: str
    layers: int
    width: int
    normalize: float | None
    fingerprint: str

    def describe(self) -> str:
        """Summarise in one line: layout, size, normalisation, fingerprint."""
        return f"{self.path}: {self.summary}; fingerprint {self.fingerprint}"


def normalization_text(eps: float | None) -> str:
    """Say how a waveform is normalised with `eps` added to its variance."""
    if eps is None:
        return "waveform not normalised"
    return f"waveform normalised to mean 0 and variance 1 (eps {eps:g})"


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object from a small file."""
    content = read_bytes(path, _MAX_CONFIG_BYTES, WeightsError)
    value = parse_json(content, str(path), WeightsError)
    if not isinstance(value, dict):
        raise WeightsError(f"{path}: holds a {type(value).__name__}, not an object: download again")
    return value


def read_preprocessor(folder: Path, usual: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings in preprocessor_config.json; none without that file.

    Raises WeightsError if one differs from the `usual` ones, the only ones that are computed.
    """
    path = folder / "preprocessor_config.json"
    settings = read_json(path) if path.exists() else {}
    for name, value in ({"sampling_rate": 16_000} | dict(usual)).items():
        if settings.get(name, value) != value:
            raise WeightsError(f"{path}: {name} is {settings[name]!r}, expected {value}")
    return settings


def expected_normalization(folder: Path, front_norm: str) -> float | None:
    """Return the number that a Hugging Face model expects to be added to the waveform's variance.

    None means that it expects the waveform unnormalised. preprocessor_config.json decides; without
    that file, only models with `feat_extract_norm: layer` expect a normalised waveform.

    Args:
        folder: Hugging Face's folder.
        front_norm: `feat_extract_norm` of its config.json.
    """
    settings = read_preprocessor(folder, {})
    normalize = settings.get("do_normalize", True) if settings else front_norm == "layer"
    return HUGGINGFACE_EPS if normalize else None


def check_fingerprint(source: str | os.PathLike[str], actual: str, wanted: str | None) -> None:
    """Raise WeightsError if an encoder is not the one in a feature spec.

    Args:
        source: file or folder of the encoder, for the message.
        actual: fingerprint of what was read.
        wanted: fingerprint in the spec; None accepts every encoder.
    """
    if wanted not in (None, actual):
        made = f"have fingerprint {actual}, the features were made with {wanted}"
        raise WeightsError(f"{os.fspath(source)}: these weights {made}: give the model's own")


def read_folder(folder: Path) -> dict[str, torch.Tensor]:
    """Read the tensors of a Hugging Face folder by their names in the file.

    Reads model.safetensors, its parts by model.safetensors.index.json, or pytorch_model.bin.
    Raises WeightsError if there is none of them or one cannot be read.
    """
    names = ("model.safetensors", _INDEX, "pytorch_model.bin")
    files = [name for name in names if (folder / name).is_file()][:1]
    if not files:
        here = ", ".join(sorted(entry.name for entry in folder.iterdir())[:10]) or "nothing"
        wanted = "no model.safetensors and no pytorch_model.bin"
        raise WeightsError(f"{folder}: {wanted} (found: {here}): download the weights")
    if files == [_INDEX]:
        parts = read_json(folder / _INDEX).get("weight_map")
        files = sorted(set(map(str, parts.values()))) if isinstance(parts, dict) else []
        outside = [name for name in files if Path(name).name != name]
        if not files or outside:
            held = outside[:1] or "no files"
            raise WeightsError(f"{folder / _INDEX}: weight_map names {held}, not files beside it")
    tensors: dict[str, torch.Tensor] = {}
    for name in files:
        tensors |= plain_tensors(folder / name, read_file(folder / name))
    return tensors


def read_file(path: Path) -> Any:
    """Return the content of a safetensors or torch file; no object is ever unpickled."""
    import torch
    from safetensors.torch import load_file

    try:
        with path.open("rb") as file:
            start = file.read(16)
        if start[8:9] == b"{":  # after the length of its header, a safetensors file is JSON
            return load_file(path)
        if start[:2] == b"PK":
            with zipfile.ZipFile(path) as archive:
                if any(entry.compress_type for entry in archive.infolist()):
                    raise ValueError("it is compressed, which torch never does")
            return torch.load(path, map_location="cpu", weights_only=True)
        if start[:2] != b"\x80\x02":  # the pickle that a legacy file of torch begins with
            raise ValueError(f"it begins with {start[:8]!r}, unlike torch's and safetensors'")
        # A file allocates as much as its pickle claims to need; bytes give what they have.
        content = io.BytesIO(path.read_bytes())
        return torch.load(content, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        kind = re.search(r"GLOBAL (\S+)", str(error))
        if kind is None:  # torch's own message would advise loading it anyway
            raise _unreadable(path, "it is damaged, or holds more than plain tensors") from error
        remedy = "no speech encoder needs one: do not load this file; use the published weights"
        if kind[1] == "argparse.Namespace":
            remedy = (
                "save it again with a plain dict, in Python: import argparse, torch; "
                "torch.serialization.add_safe_globals([argparse.Namespace]); "
                f"c = torch.load({str(path)!r}); "
                "torch.save({'cfg': vars(c['cfg']), 'model': c['model']}, 'plain.pt')"
            )
        what = f"holds a Python object ({kind[1]}), which could run code and is not read"
        raise WeightsError(f"{path}: {what}: {remedy}") from error
    except Exception as error:  # torch documents no exception for damaged files
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise _unreadable(path, reason) from error


def _unreadable(path: Path, reason: str) -> WeightsError:
    return WeightsError(f"{path}: cannot be read as weights: {reason}: download it again")


def plain_tensors(path: Path, content: Any) -> dict[str, torch.Tensor]:
    """Return the content of a weight file if it is a plain table of tensors by name.

    Names of older versions of torch and transformers become those of newer ones.
    """
    import torch

    if not isinstance(content, Mapping) or not all(map(torch.is_tensor, content.values())):
        raise WeightsError(f"{path}: holds no plain table of tensors: give the published file")
    # A tensor with stride 0 may claim more values than the file holds.
    claimed = sum(tensor.numel() * tensor.element_size() for tensor in content.values())
    if claimed > 2 * path.stat().st_size:
        raise _unreadable(path, f"tensors claim {claimed} bytes of {path.stat().st_size}")
    return renamed({str(name): tensor for name, tensor in content.items()}, _OLD_NAMES)


def renamed(
    tensors: Mapping[str, torch.Tensor], table: Iterable[tuple[str, str]]
) -> dict[str, torch.Tensor]:
    """Return tensors by names in which each regular expression of a table is replaced."""
    for old, new in table:
        tensors = {re.sub(old, new, name): tensor for name, tensor in tensors.items()}
    return dict(tensors)


def encoder_tensors(
    tensors: dict[str, torch.Tensor], prefixes: Sequence[str]
) -> dict[str, torch.Tensor]:
    """Return the tensors with the first prefix that there is, without it; else all of them.

    In files of models with heads, the encoder's tensors have a prefix.
    """
    for prefix in prefixes:
        if inside := [name for name in tensors if name.startswith(prefix)]:
            return {name.removeprefix(prefix): tensors[name] for name in inside}
    return tensors


def fitting_tensors(
    place: Path, tensors: Mapping[str, torch.Tensor], shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, torch.Tensor]:
    """Return exactly the tensors of a network, in float32, without the heads beside it.

    Args:
        place: file or folder, for the message.
        tensors: what was read.
        shapes: shape of every tensor of the network.

    Raises WeightsError if a tensor is missing, unknown, of another shape or not finite.
    """
    import torch

    parts = {name.split(".")[0] for name in shapes}
    others = (name for name in tensors if name not in shapes and not name.startswith(_LEFT_OUT))
    found = {name: tuple(tensors[name].shape) for name in shapes if name in tensors}
    differing = {name: shape for name, shape in found.items() if shape != shapes[name]}
    problems = {
        "missing": [name for name in shapes if name not in tensors],
        "unknown": [name for name in others if name.split(".")[0] in parts],
        "of another shape": [f"{n} {shape}, not {shapes[n]}" for n, shape in differing.items()],
    }
    for problem, names in problems.items():
        if names:
            more = f"; and {len(names) - _MOST_LISTED} more" if len(names) > _MOST_LISTED else ""
            held = f"{problem} ({'; '.join(sorted(names)[:_MOST_LISTED])}{more})"
            same = "settings and weights must come from the same model"
            raise WeightsError(f"{place}: {len(names)} tensors are {held}: {same}")
    fitting = {}
    for name in shapes:
        tensor = tensors[name].contiguous()
        fitting[name] = tensor.float() if tensor.is_floating_point() else tensor
        if not torch.isfinite(fitting[name]).all():
            raise WeightsError(f"{place}: tensor {name} is not finite: download it again")
    return fitting


def add_tensors(digest: Any, tensors: Mapping[str, torch.Tensor]) -> None:
    """Update a digest by names, shapes and bytes of tensors."""
    for name in sorted(tensors):
        digest.update(f"{name} {list(tensors[name].shape)}\n".encode())
        digest.update(tensors[name].reshape(-1).numpy().data)
