"""Reading of a Hugging Face encoder: settings, tensors, fingerprint.

transformers' own loader is not used: it fills missing tensors with random numbers, contacts a hub
about a local folder, and may run code that lies in the folder. Here transformers gives only the
network; tensors come from safetensors, or from torch files that hold only tensors.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from audio_features.errors import WeightsError
from audio_features.huggingface.families import FAMILIES, Family, front_norm
from audio_features.weight_files import (
    expected_normalization,
    read_folder,
    read_json,
    refuse_tensors,
)

if TYPE_CHECKING:
    import torch

_LARGEST = 1 << 16  # far above every published size; limits the memory a damaged file can request
_MOST_LAYERS = 256
_MOST_LISTED = 6  # files with code
# Parts of the networks that are left out: they belong to training, or follow the encoder.
_OFF = {
    "mask_time_prob": 0.0,
    "mask_feature_prob": 0.0,
    "apply_spec_augment": False,
    "add_adapter": False,
    "use_intermediate_ffn_before_adapter": False,
    "layerdrop": 0.0,
    "encoder_layerdrop": 0.0,
}
_LEFT_OUT = ("adapter.", "intermediate_ffn.", "masked_spec_embed", "embeddings.position_ids")
# Names of normalisations in files that older versions wrote.
_OLD_NAMES = {
    "parametrizations.weight.original0": "weight_g",
    "parametrizations.weight.original1": "weight_v",
    "LayerNorm.weight": "LayerNorm.gamma",
    "LayerNorm.bias": "LayerNorm.beta",
}


@dataclass(frozen=True)
class EncoderWeights:
    """Description of the encoder in a folder.

    Attributes:
        path: folder, as given.
        model_type: key of `FAMILIES`.
        config: transformers' configuration, without parts that only training uses.
        normalize: None if the encoder takes no waveform or expects it unnormalised; otherwise the
            number that it expects to be added to the waveform's variance.
        stride: mel frames that are stacked to one frame; 1 for other encoders.
        fingerprint: sha256 over model_type, the settings that change the values, and the names,
            shapes and float32 bytes of the encoder's tensors.
    """

    path: str
    model_type: str
    config: Any
    normalize: float | None
    stride: int
    fingerprint: str

    @property
    def family(self) -> Family:
        """Architecture of the encoder."""
        return FAMILIES[self.model_type]

    @property
    def layers(self) -> int:
        """Number of layers."""
        return int(getattr(self.config, "encoder_layers", 0) or self.config.num_hidden_layers)

    @property
    def width(self) -> int:
        """Columns of one hidden state."""
        return int(self.config.hidden_size)

    def describe(self) -> str:
        """Summarise in one line: architecture, size, input, fingerprint."""
        if self.family.inputs != "waveform":
            takes = f"takes a {self.family.inputs}"
        elif self.normalize is None:
            takes = "waveform not normalised"
        else:
            takes = f"waveform normalised to mean 0 and variance 1 (eps {self.normalize:g})"
        return (
            f"{self.path}: {self.family.title}, Hugging Face folder: {self.layers} layers of "
            f"{self.width}; {takes}; fingerprint {self.fingerprint}"
        )


def is_encoder_folder(path: str | os.PathLike[str]) -> bool:
    """Return True for a folder whose config.json names an encoder other than WavLM."""
    folder = Path(path)
    if not (folder / "config.json").is_file():
        return False
    return read_json(folder / "config.json").get("model_type") in FAMILIES.keys() - {"wavlm"}


def read_encoder(path: str | os.PathLike[str]) -> tuple[EncoderWeights, torch.nn.Module]:
    """Read the encoder in a folder: its description, and the network in float32 on the CPU.

    Args:
        path: folder with config.json, the weights (model.safetensors, its parts with their index,
            or pytorch_model.bin) and, for the normalisation, preprocessor_config.json.

    Raises WeightsError if the folder holds no such encoder, if a tensor is missing or of another
    shape, if the folder brings code of its own, or if transformers cannot be imported.
    """
    folder = Path(path)
    model_type, config = read_configuration(folder, FAMILIES, "speech")
    family = FAMILIES[model_type]
    normalize, stride = None, 1
    if family.inputs == "waveform":
        normalize = expected_normalization(folder, front_norm(config))
    elif family.inputs == "filter bank":
        stride = _stacked_frames(folder, config)
    else:
        _check_log_mel(folder, config)
    network, tensors = read_network(folder, family, config)
    about = {"model_type": model_type, "stride": stride}
    fingerprint = fingerprint_of(family, config, tensors, about)
    return EncoderWeights(str(folder), model_type, config, normalize, stride, fingerprint), network


def read_configuration(folder: Path, families: Mapping[str, Family], what: str) -> tuple[str, Any]:
    """Return the model_type and transformers' configuration of the encoder in a folder.

    Args:
        folder: Hugging Face's folder.
        families: supported encoders by model_type.
        what: kind of encoder, for messages: "speech" or "text".

    Raises WeightsError if it is no such folder, or brings code of its own.
    """
    if not folder.is_dir():
        problem = "not a folder" if folder.exists() else "no such folder"
        raise WeightsError(
            f"{folder}: {problem}: give a local Hugging Face folder with config.json and "
            "model.safetensors"
        )
    _refuse_code(folder, families)
    settings = read_json(folder / "config.json")
    model_type = settings.get("model_type")
    if not isinstance(model_type, str) or model_type not in families:
        raise WeightsError(
            f"{folder / 'config.json'}: model_type is {model_type!r}, expected one of "
            f"{', '.join(families)}: give the folder of a {what} encoder"
        )
    return model_type, _configuration(folder / "config.json", families[model_type], settings)


def _refuse_code(folder: Path, families: Mapping[str, Family]) -> None:
    code = sorted(file.name for file in folder.glob("*.py"))
    for name in ("config.json", "preprocessor_config.json", "tokenizer_config.json"):
        if (folder / name).is_file() and "auto_map" in read_json(folder / name):
            code.append(f"auto_map in {name}")
    if code:
        raise WeightsError(
            f"{folder}: the model brings code of its own ({', '.join(code[:_MOST_LISTED])}), which "
            "is never run (trust_remote_code): give an encoder that transformers has itself: "
            f"{', '.join(families)}"
        )


def _configuration(path: Path, family: Family, settings: Mapping[str, Any]) -> Any:
    """Return transformers' configuration object, checked for absurd sizes."""
    for name, value in settings.items():
        numbers = value if isinstance(value, list) else [value]
        sized = name not in ("vocab_size",) and not name.endswith("_token_id")
        if sized and any(isinstance(n, int | float) and abs(n) > _LARGEST for n in numbers):
            raise WeightsError(f"{path}: {name} is {value!r}: not an encoder's size")
        if name.endswith("layers") and isinstance(value, int) and value > _MOST_LAYERS:
            raise WeightsError(f"{path}: {name} is {value}, at most {_MOST_LAYERS} are read")
    transformers = transformers_module()
    try:
        config = getattr(transformers, family.config).from_dict(dict(settings))
        for name, value in _OFF.items():
            if hasattr(config, name):
                setattr(config, name, value)
        return config
    except Exception as error:  # transformers' checks of settings raise several classes
        reason = " ".join(str(error).split())[:200]
        raise WeightsError(f"{path}: not the settings of {family.title}: {reason}") from error


def transformers_module(name: str = "transformers") -> Any:
    """Import a module of transformers, which the extra `encoders` installs.

    Raises:
        WeightsError: it cannot be imported; the message says what to do.
    """
    try:
        return import_module(name)
    except Exception as error:  # a broken torchaudio makes it fail with any exception
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        absent = isinstance(error, ModuleNotFoundError) and error.name == "transformers"
        remedy = "pip install 'gesturekit[encoders]'" if absent else "gesturekit doctor"
        message = f"transformers cannot be imported ({reason}): run `{remedy}`"
        raise WeightsError(message) from error


def _preprocessor(folder: Path) -> dict[str, Any]:
    path = folder / "preprocessor_config.json"
    return read_json(path) if path.is_file() else {}


def _stacked_frames(folder: Path, config: Any) -> int:
    """Return the stride of w2v-BERT's front end: two frames of 80 bins unless a file differs."""
    settings = _preprocessor(folder)
    stride, bins = settings.get("stride", 2), settings.get("num_mel_bins", 80)
    wanted = config.feature_projection_input_dim
    usual = settings.get("sampling_rate", 16_000) == 16_000
    if not usual or not isinstance(stride, int) or stride < 1 or stride * bins != wanted:
        raise WeightsError(
            f"{folder / 'preprocessor_config.json'}: {bins!r} mel bins in stacks of {stride!r} at "
            f"{settings.get('sampling_rate', 16_000)!r} Hz, expected {wanted} columns at 16000 Hz: "
            "take the file that came with the weights"
        )
    return stride


def _check_log_mel(folder: Path, config: Any) -> None:
    usual = {
        "feature_size": config.num_mel_bins,
        "sampling_rate": 16_000,
        "n_fft": 400,
        "hop_length": 160,
        "dither": 0.0,
    }
    settings = _preprocessor(folder)
    for name, value in usual.items():
        if settings.get(name, value) != value:
            raise WeightsError(
                f"{folder / 'preprocessor_config.json'}: {name} is {settings[name]!r}, expected "
                f"{value}: take the file that came with the weights"
            )


def read_network(
    folder: Path, family: Family, config: Any
) -> tuple[torch.nn.Module, dict[str, torch.Tensor]]:
    """Build the network with the folder's tensors, without using the caller's random numbers."""
    import torch

    kind = getattr(transformers_module(family.module), family.model)
    if family.pools:
        kind = partial(kind, add_pooling_layer=False)
    found = _encoder_names(read_folder(folder), family)
    try:
        with torch.random.fork_rng(devices=[]):
            with torch.device("meta"):
                network = kind(config)
            tensors = _fitting(folder, found, network.state_dict())
            if any(buffer.is_meta for buffer in network.buffers()):
                network = kind(config)  # has computed buffers that no file holds
    except WeightsError:
        raise
    except Exception as error:  # transformers checks settings while it builds
        reason = " ".join(str(error).split())[:200]
        raise WeightsError(
            f"{folder / 'config.json'}: not the settings of {family.title}: {reason}"
        ) from error
    network.load_state_dict(tensors, assign=True)
    return network.eval().requires_grad_(False), tensors


def _encoder_names(tensors: Mapping[str, torch.Tensor], family: Family) -> dict[str, torch.Tensor]:
    """Return the tensors under the encoder's own names, without heads."""
    for prefix in family.prefixes:
        inside = {
            name.removeprefix(prefix): tensor
            for name, tensor in tensors.items()
            if name.startswith(prefix)
        }
        if inside:
            return inside
    return dict(tensors)


def _fitting(
    folder: Path, found: Mapping[str, torch.Tensor], expected: Mapping[str, torch.Tensor]
) -> dict[str, torch.Tensor]:
    """Return exactly the encoder's tensors, in float32."""
    import torch

    tensors, missing, shapes = {}, [], []
    used = set()
    for name, wanted in expected.items():
        old = name
        for new, former in _OLD_NAMES.items():
            old = old.replace(new, former)
        tensor = found.get(name, found.get(old))
        used |= {name, old}
        if tensor is None:
            missing.append(name)
        elif tuple(tensor.shape) != tuple(wanted.shape):
            shapes.append(f"{name} {tuple(tensor.shape)}, not {tuple(wanted.shape)}")
        else:
            tensors[name] = tensor.contiguous()
            if tensor.is_floating_point():
                tensors[name] = tensors[name].float()
            if not torch.isfinite(tensors[name]).all():
                raise WeightsError(f"{folder}: tensor {name} is not finite: download it again")
    parts = {name.split(".")[0] for name in expected}
    unknown = [
        name
        for name in found
        if name not in used and name.split(".")[0] in parts and not name.startswith(_LEFT_OUT)
    ]
    problems = {"missing": missing, "of another shape": shapes, "unknown": unknown}
    refuse_tensors(folder, problems, "config.json and weights must come from the same model")
    return tensors


def fingerprint_of(
    family: Family, config: Any, tensors: Mapping[str, torch.Tensor], about: Mapping[str, Any]
) -> str:
    """Return the sha256 of the tensors, the settings that change the values, and `about`."""
    settings = {**about, **{name: getattr(config, name, None) for name in family.settings}}
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    for name in sorted(tensors):
        digest.update(f"{name} {list(tensors[name].shape)}\n".encode())
        digest.update(tensors[name].reshape(-1).numpy().data)
    return digest.hexdigest()
