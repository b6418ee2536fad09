"""Reading of weight files and of a model folder's JSON files; no code in a file is run."""

from __future__ import annotations

import io
import json
import os
import pickle
import re
import struct
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

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


def expected_normalization(folder: Path, front_norm: str) -> float | None:
    """Return the number that a Hugging Face model expects to be added to the waveform's variance.

    None means that it expects the waveform unnormalised. preprocessor_config.json decides; without
    that file, only models with `feat_extract_norm: layer` expect a normalised waveform.

    Args:
        folder: Hugging Face's folder.
        front_norm: `feat_extract_norm` of its config.json.
    """
    path = folder / "preprocessor_config.json"
    normalize: Any = front_norm == "layer"
    if path.exists():
        settings = read_json(path)
        rate, normalize = settings.get("sampling_rate", 16_000), settings.get("do_normalize", True)
        if rate != 16_000 or not isinstance(normalize, bool):
            raise WeightsError(
                f"{path}: sampling_rate {rate!r} and do_normalize {normalize!r}, "
                "expected 16000 and true or false: take the file that came with the weights"
            )
    return HUGGINGFACE_EPS if normalize else None


def check_fingerprint(source: str | os.PathLike[str], found: str, wanted: str | None) -> None:
    """Raise WeightsError if an encoder is not the one in a feature spec.

    Args:
        source: file or folder of the encoder, for the message.
        found: fingerprint of what was read.
        wanted: fingerprint in the spec; None accepts every encoder.
    """
    if wanted not in (None, found):
        raise WeightsError(
            f"{os.fspath(source)}: these weights have fingerprint {found}, the features were made "
            f"with {wanted}: give the weights that the model was trained on"
        )


def weights_needed(encoder: str, wanted: str | None, how: str) -> WeightsError:
    """Return the error of a spec that comes without the place of its weights.

    Args:
        encoder: what is missing, for example "WavLM".
        wanted: fingerprint in the spec, None if any weights will do.
        how: setting and option that name the place.
    """
    which = f" with fingerprint {wanted}" if wanted else ""
    return WeightsError(f"weights of {encoder}{which} are needed: name their place ({how})")


def read_folder(folder: Path) -> dict[str, torch.Tensor]:
    """Read the tensors of a Hugging Face folder by their names in the file.

    Reads model.safetensors, its parts by model.safetensors.index.json, or pytorch_model.bin.
    Raises WeightsError if there is none of them or one cannot be read.
    """
    if not (folder / "model.safetensors").is_file() and (folder / _INDEX).is_file():
        return _read_parts(folder)
    for name in ("model.safetensors", "pytorch_model.bin"):
        if (folder / name).is_file():
            return plain_tensors(folder / name, read_file(folder / name))
    here = ", ".join(sorted(entry.name for entry in folder.iterdir())[:10]) or "nothing"
    raise WeightsError(
        f"{folder}: no model.safetensors and no pytorch_model.bin (found: {here}): "
        "download the model's weights into the folder"
    )


def _read_parts(folder: Path) -> dict[str, torch.Tensor]:
    """Read the files that model.safetensors.index.json names; all must lie in the folder."""
    parts = read_json(folder / _INDEX).get("weight_map")
    names = sorted(set(map(str, parts.values()))) if isinstance(parts, dict) else []
    outside = [name for name in names if Path(name).name != name]
    if not names or outside:
        raise WeightsError(
            f"{folder / _INDEX}: weight_map names {outside[:1] or 'no files'}, expected files of "
            "this folder: download it again"
        )
    tensors: dict[str, torch.Tensor] = {}
    for name in names:
        if not (folder / name).is_file():
            raise WeightsError(f"{folder}: {name} is missing: download all parts of the weights")
        tensors |= plain_tensors(folder / name, read_file(folder / name))
    return tensors


def read_file(path: Path) -> Any:
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
                    raise ValueError("it is compressed, which torch never does")
            return torch.load(path, map_location="cpu", weights_only=True)
        if start[:2] != b"\x80\x02":  # the pickle that a legacy file of torch begins with
            raise ValueError(
                f"it begins with {start[:8]!r}, unlike the files of torch and safetensors"
            )
        # A file allocates as much as its pickle claims to need; bytes give what they have.
        content = io.BytesIO(path.read_bytes())
        return torch.load(content, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        kind = re.search(r"GLOBAL (\S+)", str(error))
        if kind is None:  # torch's own message would advise loading it anyway
            raise _unreadable(
                path, ValueError("it is damaged, or holds more than plain tensors")
            ) from error
        what = f"{path}: holds a Python object ({kind[1]}), which could run code and is not read: "
        if kind[1] != "argparse.Namespace":
            raise WeightsError(
                f"{what}no speech encoder needs one: do not load this file; use the "
                "published weights"
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
    except (EOFError, LookupError, TypeError, AttributeError, AssertionError) as error:
        raise _unreadable(path, error) from error
    except (MemoryError, RecursionError, struct.error) as error:
        raise _unreadable(path, error) from error


def refuse_tensors(place: Path, problems: Mapping[str, list[str]], remedy: str) -> None:
    """Raise WeightsError if tensors do not fit the network.

    Args:
        place: file or folder, for the message.
        problems: {what is wrong, such as "missing": names of the tensors}.
        remedy: what must be given instead.
    """
    for problem, names in problems.items():
        if names:
            more = f"; and {len(names) - _MOST_LISTED} more" if len(names) > _MOST_LISTED else ""
            raise WeightsError(
                f"{place}: {len(names)} tensors are {problem} "
                f"({'; '.join(sorted(names)[:_MOST_LISTED])}{more}): {remedy}"
            )


def _unreadable(path: Path, error: BaseException) -> WeightsError:
    reason = (str(error).splitlines() or [type(error).__name__])[0]
    return WeightsError(f"{path}: cannot be read as weights: {reason}: download it again")


def plain_tensors(path: Path, content: Any) -> dict[str, torch.Tensor]:
    """Return the content of a weight file if it is a plain table of tensors by name."""
    import torch

    if not isinstance(content, Mapping) or not all(map(torch.is_tensor, content.values())):
        raise WeightsError(f"{path}: holds no plain table of tensors: give the published file")
    # A tensor with stride 0 may claim more values than the file holds.
    claimed = sum(tensor.numel() * tensor.element_size() for tensor in content.values())
    if claimed > 2 * path.stat().st_size:
        raise WeightsError(
            f"{path}: cannot be read as weights: the tensors claim {claimed} bytes, the file has "
            f"{path.stat().st_size}: download it again"
        )
    return {str(name): tensor for name, tensor in content.items()}
