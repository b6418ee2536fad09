"""Reader of the checkpoints that the paper's released code writes: PyTorch Lightning, one zip.

A checkpoint is a pickle, and a pickle can run code. It is therefore read by
`torch.load(weights_only=True)`, after all names in it were compared with a list. Arrays of numpy
and the `StandardScaler` of scikit-learn become plain holders of what the file says.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from audio_features.archive import check_directory
from audio_features.weight_files import plain_tensors
from gesturekit.errors import ModelError

_MOST_PICKLED = 16 << 20  # bytes beside the tensors; the released files have less than one MiB
_NETWORK = "diffusion_model."


class _DType:
    """Type of an array's numbers."""

    def __init__(self, name: Any, *_: Any) -> None:
        self.name = str(name)
        self.order: Any = "<"

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self.order = state[1]

    def numbers(self, content: Any) -> np.ndarray:
        """Return the numbers (N,) in the bytes of an array, as many as there are."""
        if self.name[:1] not in ("f", "i", "u", "b") or not isinstance(content, bytes):
            raise ValueError(f"an array of {self.name!r}, not of numbers")
        return np.frombuffer(content, np.dtype(self.name).newbyteorder(self.order))


class _Array:
    """A numpy array, which never has more numbers than its bytes."""

    values: np.ndarray

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, shape, dtype, _, content = state
        values = dtype.numbers(content)
        if math.prod(shape) != len(values):
            raise ValueError(f"an array of shape {shape} has {len(values)} numbers")
        self.values = values


def _new_array(*_: Any) -> _Array:
    return _Array()


def _scalar(dtype: _DType, content: bytes) -> Any:
    (value,) = dtype.numbers(content)
    return value


class _Scaler:
    """The fields of a pickled `StandardScaler`."""


_STAND_INS: dict[str, Any] = {
    "numpy.ndarray": _Array,
    "numpy.dtype": _DType,
    **dict.fromkeys(
        ("sklearn.preprocessing._data.StandardScaler", "sklearn.preprocessing.data.StandardScaler"),
        _Scaler,
    ),
    **{f"numpy.{core}.multiarray._reconstruct": _new_array for core in ("core", "_core")},
    **{f"numpy.{core}.multiarray.scalar": _scalar for core in ("core", "_core")},
}
"""Functions and classes that stand for the names in a pickle."""

_KNOWN = {"collections.OrderedDict", "torch._utils._rebuild_tensor_v2", "_codecs.encode"}
_KNOWN |= {f"torch.{kind}Storage" for kind in ("Float", "Double", "Half", "Long", "Int", "Bool")}
_KNOWN |= _STAND_INS.keys()


@dataclass(frozen=True)
class Scaler:
    """Mean and scale of each column (S,), float64."""

    mean: np.ndarray
    scale: np.ndarray


@dataclass(frozen=True)
class ReleasedCheckpoint:
    """Contents of a checkpoint.

    Attributes:
        path: its file.
        tensors: of the network, by their released names.
        data: settings of the data, without the scalers.
        diffusion: settings of diffusion and network.
        scalers: `in_scaler` of the features, `style_scaler` and `out_scaler` of the motion; None
            for one that the model lacks.
    """

    path: Path
    tensors: dict[str, Tensor]
    data: Mapping[str, Any]
    diffusion: Mapping[str, Any]
    scalers: Mapping[str, Scaler | None]

    @classmethod
    def load(cls, path: Path) -> ReleasedCheckpoint:
        """Read a checkpoint.

        Raises:
            ModelError: it is missing, damaged, of another kind, or holds any other Python object.
            WeightsError: its tensors claim more numbers than the file has.
        """
        content = _read(path)
        try:
            state, settings = content["state_dict"], content["hyper_parameters"]
            data, diffusion = dict(settings["Data"]), dict(settings["Diffusion"])
            scalers = {name: _scaler(value) for name, value in data.pop("scalers").items()}
            tensors = plain_tensors(path, state)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            why = f"no entry {error}" if isinstance(error, KeyError) else error
            raise ModelError(
                f"{path}: no checkpoint of Listen, Denoise, Action! ({why}); expected the .ckpt "
                "that its training wrote"
            ) from error
        ours = {
            name.removeprefix(_NETWORK): tensor
            for name, tensor in tensors.items()
            if name.startswith(_NETWORK)
        }
        return cls(path, ours, data, diffusion, scalers)


def _scaler(value: Any) -> Scaler | None:
    if value is None:
        return None
    mean, scale = (np.array(part.values, np.float64) for part in (value.mean_, value.scale_))
    if mean.shape != scale.shape or not np.isfinite([mean, scale]).all() or (scale <= 0).any():
        raise ValueError("a scaler whose mean and scale are not finite numbers, scale above 0")
    return Scaler(mean, scale)


def _read(path: Path) -> dict[str, Any]:
    """Return the pickled dictionary of a checkpoint."""
    if path.suffix.lower() in (".sav", ".pkl"):
        raise ModelError(
            f"{path}: a pickle of Python objects, which can run code and is never read. Rig, "
            "styles and features are given by --rig, --styles and --features; give the .ckpt"
        )
    try:
        if path.exists() and not path.is_file():  # reading a pipe may never end
            raise ValueError("not a regular file")
        _check_names(path)
        with torch.serialization.safe_globals([(made, name) for name, made in _STAND_INS.items()]):
            content = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(content, dict):
            raise ValueError("no dictionary")
    except ModelError:
        raise
    except FileNotFoundError:
        raise ModelError(f"{path}: no such file") from None
    except pickle.UnpicklingError as error:  # torch's message advises to load it anyway
        raise ModelError(f"{path}: cannot be read as a checkpoint: it is damaged") from error
    except Exception as error:  # zipfile and torch document no exceptions for damaged files
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ModelError(f"{path}: cannot be read as a checkpoint: {reason}") from error
    return content


def _check_names(path: Path) -> None:
    """Refuse a zip that unpacks to more than it is, and every name of a class or function but ours.

    Raises:
        ModelError: another name.
        ValueError: another kind of file.
    """
    check_directory(path, zip64=True)
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        if any(member.compress_type for member in members):
            raise ValueError("it is compressed, which torch never does")
        if sum(member.file_size for member in members) > path.stat().st_size:
            raise ValueError("its members claim more bytes than the file has")
        pickled = [member for member in members if member.filename.endswith("data.pkl")]
        if len(pickled) != 1 or pickled[0].file_size > _MOST_PICKLED:
            raise ValueError("not one data.pkl of at most 16 MiB")
        content = archive.read(pickled[0])
    for operation, argument, _ in pickletools.genops(io.BytesIO(content)):
        if operation.name == "STACK_GLOBAL":
            raise ValueError("a pickle of a newer protocol than torch writes")
        name = str(argument).replace(" ", ".")
        if operation.name in ("GLOBAL", "INST") and name not in _KNOWN:
            raise ModelError(
                f"{path}: holds {name}, which could run code; nothing was read. A checkpoint of "
                "the released code has tensors, numbers, text and StandardScaler only"
            )
