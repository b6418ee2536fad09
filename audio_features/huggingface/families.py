"""Speech and text encoders that are read, by the model_type of their config.json."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

_CONVOLUTIONAL = (
    "hidden_act",
    "feat_extract_activation",
    "feat_extract_norm",
    "conv_stride",
    "num_attention_heads",
    "do_stable_layer_norm",
    "layer_norm_eps",
)
_TEXT = (
    "hidden_act",
    "activation",
    "num_attention_heads",
    "layer_norm_eps",
    "pad_token_id",
    "position_embedding_type",
)


@dataclass(frozen=True)
class Family:
    """Architecture of transformers.

    Attributes:
        title: name in messages.
        model, config: names of the classes in transformers.
        module: module of `model`.
        prefixes: prefixes of the encoder's tensors in checkpoints with further parts.
        inputs: input of the network: the waveform, stacked frames of a mel filter bank (kaldi),
            Whisper's log-mel spectrogram, or tokens of text.
        settings: settings of config.json that change the values and that no tensor's shape shows.
        pools: the network ends in a pooling layer that may be left out.
    """

    title: str
    model: str
    config: str
    module: str
    prefixes: tuple[str, ...]
    inputs: Literal["waveform", "filter bank", "log-mel", "tokens"]
    settings: tuple[str, ...]
    pools: bool


def _family(
    title: str,
    stem: str,
    module: str,
    inputs: Literal["waveform", "filter bank", "tokens"],
    settings: tuple[str, ...],
    *,
    package: str | None = None,
    pools: bool = False,
) -> Family:
    """Return a family whose names in transformers follow the usual pattern."""
    return Family(
        title,
        f"{stem}Model",
        f"{stem}Config",
        f"transformers.models.{package or module}.modeling_{module}",
        (f"{module.replace('xlm_', '')}.",),
        inputs,
        settings,
        pools,
    )


FAMILIES = {
    "hubert": _family("HuBERT", "Hubert", "hubert", "waveform", _CONVOLUTIONAL),
    "wav2vec2": _family("wav2vec 2.0", "Wav2Vec2", "wav2vec2", "waveform", _CONVOLUTIONAL),
    "data2vec-audio": _family(
        "data2vec-audio",
        "Data2VecAudio",
        "data2vec_audio",
        "waveform",
        (*_CONVOLUTIONAL, "num_conv_pos_embeddings", "conv_pos_kernel_size"),
        package="data2vec",
    ),
    "wavlm": _family(
        "WavLM", "WavLM", "wavlm", "waveform", (*_CONVOLUTIONAL, "max_bucket_distance")
    ),
    "wav2vec2-bert": _family(
        "w2v-BERT 2.0",
        "Wav2Vec2Bert",
        "wav2vec2_bert",
        "filter bank",
        (
            "hidden_act",
            "num_attention_heads",
            "layer_norm_eps",
            "position_embeddings_type",
            "left_max_position_embeddings",
            "right_max_position_embeddings",
            "rotary_embedding_base",
            "max_source_positions",
            "conv_depthwise_kernel_size",
        ),
    ),
    "whisper": Family(
        "Whisper",
        "WhisperEncoder",
        "WhisperConfig",
        "transformers.models.whisper.modeling_whisper",
        ("model.encoder.", "encoder."),
        "log-mel",
        ("activation_function", "encoder_attention_heads", "scale_embedding"),
        False,
    ),
}
"""Supported speech encoders by model_type."""

TEXT_FAMILIES = {
    "bert": _family("BERT", "Bert", "bert", "tokens", _TEXT, pools=True),
    "roberta": _family("RoBERTa", "Roberta", "roberta", "tokens", _TEXT, pools=True),
    "xlm-roberta": _family("XLM-RoBERTa", "XLMRoberta", "xlm_roberta", "tokens", _TEXT, pools=True),
    "distilbert": _family("DistilBERT", "DistilBert", "distilbert", "tokens", _TEXT),
    "mpnet": _family("MPNet", "MPNet", "mpnet", "tokens", _TEXT, pools=True),
    "electra": _family("ELECTRA", "Electra", "electra", "tokens", _TEXT),
}
"""Supported text encoders by model_type."""


def front_norm(config: Any) -> str:
    """Return `feat_extract_norm` of a configuration; data2vec-audio always has "layer"."""
    return getattr(config, "feat_extract_norm", "layer")
