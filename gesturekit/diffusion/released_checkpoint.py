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
from types import SimpleNamespace
from typing import Any, BinaryIO

import numpy as np
import torch
from torch import Tensor

from audio_features.archive import check_directory, read_bytes
from audio_features.weight_files import plain_tensors
from gesturekit.errors import ModelError

_MOST_PICKLED = 16 << 20  # bytes beside the tensors; the released files have less than one MiB
_MOST = 4 << 30  # bytes of a checkpoint


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
        self.values = dtype.numbers(content)
        if math.prod(shape) != len(self.values):
            raise ValueError(f"an array of shape {shape} has {len(self.values)} numbers")


_STAND_INS: dict[str, Any] = {"numpy.ndarray": _Array, "numpy.dtype": _DType}
"""Functions and classes that stand for the names in a pickle."""
for _core in ("core", "_core"):
    _STAND_INS[f"numpy.{_core}.multiarray._reconstruct"] = lambda *_: _Array()
    _STAND_INS[f"numpy.{_core}.multiarray.scalar"] = lambda dtype, number: dtype.numbers(number)[0]
for _module in ("_data", "data"):
    _STAND_INS[f"sklearn.preprocessing.{_module}.StandardScaler"] = SimpleNamespace

_KNOWN = {"collections.OrderedDict", "torch._utils._rebuild_tensor_v2", "_codecs.encode"}
_KNOWN |= {f"torch.{kind}Storage" for kind in ("Float", "Double", "Half", "Long", "Int", "Bool")}
_KNOWN |= _STAND_INS.keys()


@dataclass(frozen=True)
class ReleasedCheckpoint:
    """Contents of a checkpoint.

    Attributes:
        path: its file.
        tensors: of the network, by their released names.
        data: settings of the data, without the scalers.
        diffusion: settings of diffusion and network.
        scalers: mean and scale (S,) float64 of each column of the features (`in_scaler`), the
            motion (`out_scaler`) and the `style_scaler`; None for one that the model lacks.
    """

    path: Path
    tensors: dict[str, Tensor]
    data: Mapping[str, Any]
    diffusion: Mapping[str, Any]
    scalers: Mapping[str, Any]


def read_checkpoint(path: Path) -> ReleasedCheckpoint:
    """Read a checkpoint.

    Raises:
        ModelError: it is missing, damaged, of another kind, or holds any other Python object.
        WeightsError: its tensors claim more numbers than the file has.
    """
    if path.suffix.lower() in (".sav", ".pkl"):
        how = "give the .ckpt, with --rig, --styles and --features in place of this file"
        raise ModelError(f"{path}: a pickle, which can run code and is never read: {how}")
    file = io.BytesIO(read_bytes(path, _MOST, ModelError))
    try:
        check_directory(path, zip64=True)
        unsafe = _unsafe_name(file)
        file.seek(0)
        with torch.serialization.safe_globals([(made, name) for name, made in _STAND_INS.items()]):
            content = {} if unsafe else torch.load(file, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:  # torch's message advises to load it anyway
        raise ModelError(f"{path}: cannot be read as a checkpoint: it is damaged") from error
    except Exception as error:  # zipfile and torch document no exceptions for damaged files
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ModelError(f"{path}: cannot be read as a checkpoint: {reason}") from error
    if unsafe:
        usual = "a checkpoint has tensors, numbers, text and StandardScaler only"
        raise ModelError(f"{path}: holds {unsafe}, which could run code; nothing was read: {usual}")
    try:
        state, settings = content["state_dict"], content["hyper_parameters"]
        data, diffusion = dict(settings["Data"]), dict(settings["Diffusion"])
        scalers = {name: _scales(value) for name, value in data.pop("scalers").items()}
        tensors = plain_tensors(path, state)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        why = f"no entry {error}" if isinstance(error, KeyError) else error
        what = "no checkpoint of Listen, Denoise, Action!, the .ckpt that its training wrote"
        raise ModelError(f"{path}: {what}: {why}") from error
    prefix = "diffusion_model."
    ours = {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
    return ReleasedCheckpoint(path, ours, data, diffusion, scalers)


def _scales(value: Any) -> np.ndarray | None:
    """Return mean and scale (2, S) of a scaler."""
    if value is None:
        return None
    scales = np.array([value.mean_.values, value.scale_.values], np.float64)
    if not np.isfinite(scales).all() or (scales[1] <= 0).any():
        raise ValueError("a scaler whose mean and scale are not finite numbers, scale above 0")
    return scales


def _unsafe_name(file: BinaryIO) -> str | None:
    """Return a class or function that the pickle of a zip names, other than ours; None for none.

    Raises:
        ValueError: another kind of file, or a zip that unpacks to more than it is.
    """
    with zipfile.ZipFile(file) as archive:
        members = archive.infolist()
        pickled = [member for member in members if member.filename.endswith("data.pkl")]
        claimed = sum(member.file_size for member in members)
        is_one = len(pickled) == 1 and pickled[0].file_size <= _MOST_PICKLED
        problems = {
            "it is compressed, which torch never does": any(m.compress_type for m in members),
            "its members claim more bytes than the file has": claimed > file.seek(0, io.SEEK_END),
            "not one data.pkl of at most 16 MiB": not is_one,
        }
        if problem := next((text for text, is_so in problems.items() if is_so), None):
            raise ValueError(problem)
        content = archive.read(pickled[0])
    for operation, argument, _ in pickletools.genops(content):
        if operation.name == "STACK_GLOBAL":
            raise ValueError("a pickle of a newer protocol than torch writes")
        name = str(argument).replace(" ", ".")
        if operation.name in ("GLOBAL", "INST") and name not in _KNOWN:
            return name
    return None
