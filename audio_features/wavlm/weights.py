"""Reading of WavLM weights in three layouts: Hugging Face, Microsoft and torchaudio.

Their own loaders are not used because they fill missing tensors with random numbers, contact a hub
about a local folder, evaluate settings as code, or unpickle objects. Only tensors and settings are
read from a file, and neither transformers nor torchaudio is needed.
"""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from audio_features.errors import WeightsError
from audio_features.wavlm.architecture import Architecture
from audio_features.wavlm.layouts import (
    from_huggingface,
    from_microsoft,
    from_torchaudio,
    is_torchaudio,
)

if TYPE_CHECKING:
    import torch

HUGGINGFACE_EPS = 1e-7
"""Constant that Hugging Face's feature extractor adds to the waveform's variance."""
MICROSOFT_EPS = 1e-5
"""Constant that Microsoft's and torchaudio's code add to the waveform's variance."""

_MAX_CONFIG_BYTES = 1 << 20
_MOST_LISTED = 8


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
        tensors = from_huggingface(_read_folder(path))
        normalize = _huggingface_normalize(path, shape)
    elif path.is_file():
        content = _read_file(path)
        if _is_microsoft(content):
            layout = "Microsoft checkpoint"
            shape = Architecture.from_microsoft(content["cfg"], str(path))
            tensors = from_microsoft(_plain_tensors(path, content["model"]))
            normalize = MICROSOFT_EPS if content["cfg"].get("normalize", False) else None
        elif isinstance(content, dict) and is_torchaudio({str(key): 0 for key in content}):
            layout = "torchaudio state dict"
            tensors = from_torchaudio(_plain_tensors(path, content))
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


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object from a small file."""
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


def _huggingface_normalize(folder: Path, shape: Architecture) -> float | None:
    """Return eps by preprocessor_config.json; without that file, as for the published weights."""
    path = folder / "preprocessor_config.json"
    normalize: Any = shape.front_norm == "layer"
    if path.exists():
        settings = read_json(path)
        rate, normalize = settings.get("sampling_rate", 16_000), settings.get("do_normalize", True)
        if rate != 16_000 or not isinstance(normalize, bool):
            raise WeightsError(
                f"{path}: sampling_rate {rate!r} and do_normalize {normalize!r}, "
                "expected 16000 and true or false: take the file that came with the weights"
            )
    return HUGGINGFACE_EPS if normalize else None


def _read_folder(folder: Path) -> dict[str, torch.Tensor]:
    for name in ("model.safetensors", "pytorch_model.bin"):
        if (folder / name).is_file():
            return _plain_tensors(folder / name, _read_file(folder / name))
    here = ", ".join(sorted(entry.name for entry in folder.iterdir())[:10]) or "nothing"
    raise WeightsError(
        f"{folder}: no model.safetensors and no pytorch_model.bin (found: {here}): "
        "download the model's weights into the folder"
    )


def _read_file(path: Path) -> Any:
    """Return the content of a safetensors or torch file; no object is ever unpickled."""
    import torch
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        with path.open("rb") as file:
            start = file.read(16)
        if start[8:9] == b"{":  # after the length of its header, a safetensors file is JSON
            return load_file(path)
        if start[:2] == b"PK":
            with zipfile.ZipFile(path) as archive:
                if any(entry.compress_type for entry in archive.infolist()):
                    raise ValueError("it is compressed, as torch never writes it")
        elif start[:2] != b"\x80\x02":  # the pickle that a legacy file of torch begins with
            raise ValueError(f"it begins with {start[:8]!r}, as no file of torch or safetensors")
        return torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        kind = re.search(r"GLOBAL (\S+)", str(error))
        if kind is None:  # torch's own message would advise loading it anyway
            raise _unreadable(path, ValueError("it is damaged, or no plain tensors")) from error
        what = f"{path}: holds a Python object ({kind[1]}), which could run code and is not read: "
        if kind[1] != "argparse.Namespace":
            raise WeightsError(
                f"{what}no WavLM needs one: do not load this file; take the published weights"
            ) from error
        raise WeightsError(
            f"{what}save it again with a plain dict, in Python: import argparse, torch; "
            "torch.serialization.add_safe_globals([argparse.Namespace]); "
            f"c = torch.load({str(path)!r}); "
            "torch.save({'cfg': vars(c['cfg']), 'model': c['model']}, 'plain.pt')"
        ) from error
    # torch documents no exception for damaged files; safetensors has its own class.
    except (SafetensorError, zipfile.BadZipFile, OSError, RuntimeError, ValueError) as error:
        raise _unreadable(path, error) from error
    except (EOFError, KeyError, TypeError, IndexError, AttributeError, MemoryError) as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: BaseException) -> WeightsError:
    reason = (str(error).splitlines() or [type(error).__name__])[0]
    return WeightsError(f"{path}: cannot be read as weights: {reason}: download it again")


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


def _plain_tensors(path: Path, content: Any) -> dict[str, torch.Tensor]:
    import torch

    if not isinstance(content, Mapping) or not all(map(torch.is_tensor, content.values())):
        raise WeightsError(f"{path}: holds no plain table of tensors: give the published file")
    # A tensor with stride 0 may claim more values than the file holds.
    claimed = sum(tensor.numel() * tensor.element_size() for tensor in content.values())
    if claimed > 2 * path.stat().st_size:
        raise WeightsError(
            f"{path}: cannot be read as weights: {path.stat().st_size} bytes that claim to be "
            f"{claimed}: download it again"
        )
    return {str(name): tensor for name, tensor in content.items()}


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
    for problem, names in problems.items():
        if names:
            more = f"; and {len(names) - _MOST_LISTED} more" if len(names) > _MOST_LISTED else ""
            raise WeightsError(
                f"{path}: {len(names)} tensors are {problem} "
                f"({'; '.join(sorted(names)[:_MOST_LISTED])}{more}): "
                "settings and weights must come from the same WavLM model"
            )
    fitting = {name: tensors[name].float().contiguous() for name in expected}
    for name, tensor in fitting.items():
        if not torch.isfinite(tensor).all():
            raise WeightsError(f"{path}: tensor {name} is not finite: download it again")
    return fitting


def _fingerprint(tensors: dict[str, torch.Tensor], shape: Architecture) -> str:
    digest = hashlib.sha256()
    for name in sorted(tensors):
        digest.update(f"{name} {list(tensors[name].shape)}\n".encode())
        digest.update(tensors[name].numpy())
    if shape.unpublished:
        digest.update(json.dumps(shape.unpublished, sort_keys=True).encode())
    return digest.hexdigest()
