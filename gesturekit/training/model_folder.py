"""Folders on disk of a model, and of the training data from which a resumed run continues."""

from __future__ import annotations

import hashlib
import json
import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

import audio_features as af
from audio_features.atomic import atomic_write, remove_unfinished, write_tensors
from gesturekit.errors import ConfigError, ModelError
from gesturekit.motion.parts import unidentified
from gesturekit.motion.resampling import checked_fps
from gesturekit.motion.skeleton import Skeleton
from gesturekit.training.config import dump_yaml, read_yaml
from gesturekit.training.run.folder import unfinished
from gesturekit.training.run.session import memory_ran_out
from gesturekit.training.run_config import MOST_SMOOTH

FORMAT = 1
_MOST_HEADER = 4 << 20  # some 40,000 tensors; the largest of our models have 2,000


class _HasSkeleton(Protocol):
    @property
    def skeleton(self) -> Skeleton: ...


Model = TypeVar("Model", bound=_HasSkeleton)
Data = TypeVar("Data")

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ModelParts:
    """Contents of a model folder.

    Attributes:
        folder: its path.
        config: `config.yaml`.
        rig: `skeleton.json`.
        tensors: `model.safetensors`.
    """

    folder: Path
    config: dict[str, Any]
    rig: dict[str, Any]
    tensors: dict[str, Tensor]

    def tensors_under(self, prefix: str) -> dict[str, Tensor]:
        """Return the tensors whose names begin with a prefix, named without it."""
        return {k.removeprefix(prefix): v for k, v in self.tensors.items() if k.startswith(prefix)}


def save_model(
    folder: str | Path,
    config: Mapping[str, Any],
    rig: Mapping[str, Any],
    tensors: Mapping[str, Tensor],
    readme: str,
) -> None:
    """Write a model folder, and remove what a killed process left of writing it.

    Args:
        folder: created if missing.
        config: with `kind` and `fps`; the format's number is added.
        rig: content of `skeleton.json`.
        tensors: content of `model.safetensors`.
        readme: content of `README.md`.
    """
    folder = Path(folder)
    for name in ("skeleton.json", "model.safetensors", "README.md", "config.yaml"):
        remove_unfinished(folder / name)
    with atomic_write(folder / "skeleton.json") as temporary:
        temporary.write_text(json.dumps(rig), encoding="utf-8")
    write_tensors(folder / "model.safetensors", tensors)
    with atomic_write(folder / "README.md") as temporary:
        temporary.write_text(readme, encoding="utf-8")
    # Last: a folder with a config.yaml is a whole model.
    with atomic_write(folder / "config.yaml") as temporary:
        temporary.write_text(dump_yaml({"format": FORMAT, **config}), encoding="utf-8")


def model_digest(
    config: Mapping[str, Any], rig: Mapping[str, Any], tensors: Mapping[str, Tensor]
) -> str:
    """Return the SHA-256 of what `save_model` writes, its README apart, without writing it."""
    digest = hashlib.sha256(json.dumps(rig).encode())
    digest.update(dump_yaml({"format": FORMAT, **config}).encode())
    for name, tensor in sorted(tensors.items()):
        values = tensor.detach().cpu().contiguous()
        digest.update(f"{name} {values.dtype} {tuple(values.shape)}".encode())
        digest.update(values.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def load_model(folder: str | Path, kind: str, assemble: Callable[[ModelParts], Model]) -> Model:
    """Read a model folder.

    Args:
        folder: as written by `save_model`.
        kind: expected kind of model.
        assemble: build the model from its parts.

    Raises:
        ModelError: a part is missing, damaged, or of a newer format, or a GPU's memory ran out.
        WeightsError: WavLM weights are missing, or differ from those of training.
    """
    folder = Path(folder)
    config = _read_config(folder, kind)
    try:
        fps = float(config["fps"])
        if not 0 < fps < math.inf:
            raise ValueError(f"fps is {fps}")
        model = assemble(ModelParts(folder, config, *_read_files(folder)))
    except af.FeatureError as error:
        raise ModelError(f"{folder / 'config.yaml'}: features: {error}") from error
    except (af.AudioFeaturesError, ModelError):
        raise
    except torch.cuda.OutOfMemoryError as error:
        raise ModelError(
            f"{folder}: {memory_ran_out(error)}; free it, or load the model with device cpu"
        ) from error
    except Exception as error:
        # Damage, memory that ran out, a library that is missing. torch lists every tensor that does
        # not fit, on a line of its own.
        reason = " ".join(str(error).splitlines()[:2]).replace("\t", " ")
        reason = f"{type(error).__name__}: {reason}".removesuffix(": ")
        raise ModelError(f"{folder}: the model is damaged or cannot be used ({reason})") from error
    if missing := unidentified(model.skeleton):
        locked = "feet are not locked, and " if missing.startswith("legs") else ""
        log.warning(
            "%s: %s of the rig cannot be identified: %sthe upper body is not smoothed",
            folder,
            missing,
            locked,
        )
    return model


def _read_files(folder: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Return the content of skeleton.json and of model.safetensors.

    What is no regular file, whose reading may never end, and a million tensors are refused.

    Raises:
        ModelError: a file is missing or damaged.
    """
    file = folder / "skeleton.json"
    try:
        rig = json.loads(_regular(file).read_text(encoding="utf-8"))
        file = folder / "model.safetensors"
        with _regular(file).open("rb") as opened:
            header = int.from_bytes(opened.read(8), "little")  # bytes of JSON about the tensors
        if header > _MOST_HEADER:
            raise ValueError(f"{header} bytes of names")
        return rig, load_file(file)
    except (OSError, ValueError, SafetensorError) as error:
        raise ModelError(f"{file}: missing or damaged ({error})") from error


def _regular(file: Path) -> Path:
    if file.exists() and not file.is_file():
        raise ValueError("not a regular file")
    return file


def _read_config(folder: Path, kind: str) -> dict[str, Any]:
    """Read the settings of a model of this kind.

    Raises:
        ModelError: there are none, or those of another kind or format, or of an unfinished run.
    """
    path = folder / "config.yaml"
    if why := unfinished(folder):
        raise ModelError(why)
    try:
        config = read_yaml(path)
    except ConfigError as error:
        raise ModelError(f"not a model folder: {error}") from None
    if config.get("format") != FORMAT:
        raise ModelError(
            f"{path}: format {config.get('format')!r}; this gesturekit reads format {FORMAT}. A "
            "newer format needs a newer gesturekit"
        )
    if config.get("kind") != kind:
        raise ModelError(f"{path}: kind {config.get('kind')!r}, not {kind}")
    return config


def model_readme(rows: Mapping[str, str], call: str) -> str:
    """Return the text of a model's README.md.

    Args:
        rows: facts by name.
        call: arguments of `generate` in the example, without the seed.
    """
    lines = [f"- **{key}**: {value}" for key, value in rows.items()]
    return (
        "# A gesturekit model\n\n" + "\n".join(lines) + "\n\n```python\nimport gesturekit as gk\n\n"
        'model = gk.load("THIS FOLDER")\n'
        f'model.generate({call}, seed=0).save("motion.bvh")\n```\n'
    )


def common_arguments(parts: ModelParts) -> dict[str, Any]:
    """Return the fields of `BaseModel` from a model folder, without those of each system."""
    smooth = parts.config["smooth"]
    if smooth is not None and not 0 <= smooth <= MOST_SMOOTH:
        raise ValueError(f"smooth is {smooth}, not 0 to {MOST_SMOOTH} s")
    return {
        "fps": float(parts.config["fps"]),
        "speakers": read_speakers(parts.rig),
        "smooth": None if smooth is None else float(smooth),
        "recorded_fps": checked_fps(parts.config["recorded_fps"]),
        "folder": parts.folder.resolve(),
    }


def rig_values(representation: Any, speakers: Mapping[str, Skeleton]) -> dict[str, Any]:
    """Return the content of skeleton.json, which run folders store too."""
    return {
        "skeleton": representation.skeleton.to_json(),
        "motion": representation.to_json(),
        "speakers": {name: body.to_json() for name, body in speakers.items()},
    }


def read_speakers(rig: Mapping[str, Any]) -> dict[str, Skeleton]:
    """Return the reference skeletons in `rig_values`."""
    return {name: Skeleton.from_json(body) for name, body in rig["speakers"].items()}


def save_data(folder: Path, tensors: dict[str, Tensor], about: Mapping[str, Any]) -> None:
    """Write the training data of a run: `data.safetensors`, and plain values in `data.json`.

    Features and encoded motion computed again would differ in their last bits, because numpy's
    vector instructions depend on the alignment of arrays.
    """
    for name in ("data.safetensors", "data.json"):
        remove_unfinished(folder / name)
    write_tensors(folder / "data.safetensors", tensors)
    with atomic_write(folder / "data.json") as temporary:
        temporary.write_text(json.dumps(about), encoding="utf-8")


def load_data(folder: Path, assemble: Callable[[dict[str, Any], dict[str, Tensor]], Data]) -> Data:
    """Read what `save_data` wrote.

    Args:
        folder: as written by `save_data`.
        assemble: build the data from plain values and tensors.

    Raises:
        ConfigError: the folder's data is missing or damaged.
        WeightsError: the WavLM weights differ from those at the start of the run.
    """
    try:
        about = json.loads((folder / "data.json").read_text(encoding="utf-8"))
        return assemble(about, load_file(folder / "data.safetensors"))
    except af.WeightsError:
        raise
    except (OSError, ValueError, KeyError, TypeError, SafetensorError) as error:
        raise ConfigError(
            f"{folder}: the run's training data cannot be read ({error}); start a new run"
        ) from error
