"""Reading of a Hugging Face encoder: settings, tensors, fingerprint.

transformers gives only the network; see `weight_files` for the tensors.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from audio_features.errors import WeightsError
from audio_features.weight_files import (
    EncoderWeights,
    add_tensors,
    encoder_tensors,
    expected_normalization,
    fitting_tensors,
    normalization_text,
    read_folder,
    read_json,
    read_preprocessor,
)

if TYPE_CHECKING:
    import torch

_CONVOLUTIONAL = (
    *("hidden_act", "feat_extract_activation", "feat_extract_norm", "conv_stride"),
    *("num_attention_heads", "do_stable_layer_norm", "layer_norm_eps"),
)
_DATA2VEC = (*_CONVOLUTIONAL, "num_conv_pos_embeddings", "conv_pos_kernel_size")
_W2V_BERT = (
    *("hidden_act", "num_attention_heads", "layer_norm_eps", "position_embeddings_type"),
    *("left_max_position_embeddings", "right_max_position_embeddings", "rotary_embedding_base"),
    *("max_source_positions", "conv_depthwise_kernel_size"),
)
_WHISPER = ("activation_function", "encoder_attention_heads", "scale_embedding")
_TEXT = (
    *("hidden_act", "activation", "num_attention_heads", "layer_norm_eps"),
    *("pad_token_id", "position_embedding_type"),
)


@dataclass(frozen=True)
class Family:
    """Encoders of one model_type.

    Attributes:
        title: name in messages.
        settings: settings of config.json that change the values and that no tensor's shape shows.
        inputs: input of the network: the waveform, stacked frames of a mel filter bank (kaldi),
            Whisper's log-mel spectrogram, or tokens of text.
    """

    title: str
    settings: tuple[str, ...]
    inputs: Literal["waveform", "filter bank", "log-mel", "tokens"] = "waveform"


FAMILIES = {
    "hubert": Family("HuBERT", _CONVOLUTIONAL),
    "wav2vec2": Family("wav2vec 2.0", _CONVOLUTIONAL),
    "data2vec-audio": Family("data2vec-audio", _DATA2VEC),
    "wavlm": Family("WavLM", (*_CONVOLUTIONAL, "max_bucket_distance")),
    "wav2vec2-bert": Family("w2v-BERT 2.0", _W2V_BERT, "filter bank"),
    "whisper": Family("Whisper", _WHISPER, "log-mel"),
}
"""Supported speech encoders by the model_type of their config.json."""
TEXT_FAMILIES = {
    name: Family(name, _TEXT, "tokens")
    for name in ("bert", "roberta", "xlm-roberta", "distilbert", "mpnet", "electra")
}
"""Supported text encoders by model_type."""

_LARGEST = 1 << 16  # far above every published size; limits the memory a damaged file can request
_MOST_LAYERS = 256
_MOST_LISTED = 6  # files with code
# Parts of the networks that are left out: they belong to training, or follow the encoder.
_OFF = {
    **dict.fromkeys(("mask_time_prob", "mask_feature_prob", "layerdrop", "encoder_layerdrop"), 0.0),
    **dict.fromkeys(("apply_spec_augment", "add_adapter"), False),
    "use_intermediate_ffn_before_adapter": False,
}


def front_norm(config: Any) -> str:
    """Return `feat_extract_norm` of a configuration; data2vec-audio always has "layer"."""
    return getattr(config, "feat_extract_norm", "layer")


def is_encoder_folder(path: str | os.PathLike[str]) -> bool:
    """Return True for a folder whose config.json names an encoder other than WavLM."""
    config = Path(path) / "config.json"
    return config.is_file() and read_json(config).get("model_type") in FAMILIES.keys() - {"wavlm"}


def read_encoder(path: str | os.PathLike[str]) -> tuple[EncoderWeights, Any, torch.nn.Module]:
    """Read the encoder in a folder.

    Returns its description, transformers' configuration without what only training uses, and the
    network in float32 on the CPU.

    Args:
        path: folder with config.json, the weights (model.safetensors, its parts with their index,
            or pytorch_model.bin) and, for the normalisation, preprocessor_config.json.

    Raises WeightsError if the folder holds no such encoder, if a tensor is missing or of another
    shape, if the folder brings code of its own, or if transformers cannot be imported.
    """
    folder = Path(path)
    model_type, config = read_configuration(folder, FAMILIES, "speech")
    family = FAMILIES[model_type]
    normalize, stacked, takes = None, 1, f"takes a {family.inputs}"
    if family.inputs == "waveform":
        normalize = expected_normalization(folder, front_norm(config))
        takes = normalization_text(normalize)
    elif family.inputs == "filter bank":
        stacked = 2
        bins = config.feature_projection_input_dim // stacked
        read_preprocessor(folder, {"num_mel_bins": bins, "stride": stacked})
    else:
        usual = {"n_fft": 400, "hop_length": 160, "dither": 0.0}
        read_preprocessor(folder, {"feature_size": config.num_mel_bins, **usual})
    about = {"model_type": model_type, "stride": stacked}
    network, fingerprint = read_network(folder, family, config, about)
    layers = int(getattr(config, "encoder_layers", 0) or config.num_hidden_layers)
    width = int(config.hidden_size)
    summary = f"{family.title}, Hugging Face folder: {layers} layers of {width}; {takes}"
    weights = EncoderWeights(
        str(folder), model_type, summary, layers, width, normalize, fingerprint
    )
    return weights, config, network


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
        wanted = "a local Hugging Face folder with config.json and model.safetensors"
        raise WeightsError(f"{folder}: {problem}: give {wanted}")
    code = sorted(file.name for file in folder.glob("*.py"))
    for name in ("config.json", "preprocessor_config.json", "tokenizer_config.json"):
        if (folder / name).is_file() and "auto_map" in read_json(folder / name):
            code.append(f"auto_map in {name}")
    if code:
        held = f"code of its own ({', '.join(code[:_MOST_LISTED])}), which is never run"
        known = f"give an encoder that transformers has itself: {', '.join(families)}"
        raise WeightsError(f"{folder}: the model brings {held} (trust_remote_code): {known}")
    path = folder / "config.json"
    settings = read_json(path)
    model_type = settings.get("model_type")
    if not isinstance(model_type, str) or model_type not in families:
        known = f"{', '.join(families)}: give the folder of a {what} encoder"
        raise WeightsError(f"{path}: model_type is {model_type!r}, expected one of {known}")
    for name, value in settings.items():
        numbers = value if isinstance(value, list) else [value]
        most = _MOST_LAYERS if name.endswith("layers") else _LARGEST
        sized = name != "vocab_size" and not name.endswith("_token_id")
        if sized and any(isinstance(n, int | float) and abs(n) > most for n in numbers):
            raise WeightsError(f"{path}: {name} is {value!r}: not an encoder's size, up to {most}")
    with transformers_needed():
        from transformers import CONFIG_MAPPING
    try:
        config: Any = CONFIG_MAPPING[model_type].from_dict(settings)
        for name in filter(partial(hasattr, config), _OFF):
            setattr(config, name, _OFF[name])
    except Exception as error:  # transformers' checks of settings raise several classes
        raise _not_settings(path, families[model_type], error) from error
    return model_type, config


@contextmanager
def transformers_needed() -> Iterator[None]:
    """Import what is needed of transformers, which the extra `encoders` installs.

    Raises:
        WeightsError: it cannot be imported; the message says what to do.
    """
    try:
        yield
    except Exception as error:  # a broken torchaudio makes it fail with any exception
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        absent = isinstance(error, ModuleNotFoundError) and error.name == "transformers"
        remedy = "pip install 'gesturekit[encoders]'" if absent else "gesturekit doctor"
        message = f"transformers cannot be imported ({reason}): run `{remedy}`"
        raise WeightsError(message) from error


def read_network(
    folder: Path, family: Family, config: Any, about: Mapping[str, Any]
) -> tuple[torch.nn.Module, str]:
    """Build the network with the folder's tensors, without using the caller's random numbers.

    Args:
        folder: Hugging Face's folder.
        family: family of the encoder.
        config: transformers' configuration.
        about: what the fingerprint says beside the tensors and the family's settings.

    Returns the network, and its fingerprint.
    """
    import torch

    with transformers_needed():
        from transformers import MODEL_MAPPING

        kind = MODEL_MAPPING[type(config)]
        kind = getattr(import_module(kind.__module__), "WhisperEncoder", kind)
    prefixes = [f"{kind.base_model_prefix}."]
    if family.inputs == "log-mel":
        prefixes = ["model.encoder.", "encoder."]
    tensors = encoder_tensors(read_folder(folder), prefixes)
    try:
        if "add_pooling_layer" in inspect.signature(kind).parameters:
            kind = partial(kind, add_pooling_layer=False)
        with torch.random.fork_rng(devices=[]):
            with torch.device("meta"):
                network = kind(config)
            shapes = {name: tuple(value.shape) for name, value in network.state_dict().items()}
            tensors = fitting_tensors(folder, tensors, shapes)
            if any(buffer.is_meta for buffer in network.buffers()):
                network = kind(config)  # has computed buffers that no file holds
    except WeightsError:
        raise
    except Exception as error:  # transformers checks settings while it builds
        raise _not_settings(folder / "config.json", family, error) from error
    network.load_state_dict(tensors, assign=True)
    settings = {**about, **{name: getattr(config, name, None) for name in family.settings}}
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    add_tensors(digest, tensors)
    return network.eval().requires_grad_(False), digest.hexdigest()


def _not_settings(path: Path, family: Family, error: Exception) -> WeightsError:
    reason = " ".join(str(error).split())[:200]
    return WeightsError(f"{path}: not the settings of {family.title}: {reason}")
