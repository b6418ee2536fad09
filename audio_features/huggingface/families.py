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
    pools: bool = False


FAMILIES = {
    "hubert": Family(
        "HuBERT",
        "HubertModel",
        "HubertConfig",
        "transformers.models.hubert.modeling_hubert",
        ("hubert.",),
        "waveform",
        _CONVOLUTIONAL,
    ),
    "wav2vec2": Family(
        "wav2vec 2.0",
        "Wav2Vec2Model",
        "Wav2Vec2Config",
        "transformers.models.wav2vec2.modeling_wav2vec2",
        ("wav2vec2.",),
        "waveform",
        _CONVOLUTIONAL,
    ),
    "data2vec-audio": Family(
        "data2vec-audio",
        "Data2VecAudioModel",
        "Data2VecAudioConfig",
        "transformers.models.data2vec.modeling_data2vec_audio",
        ("data2vec_audio.",),
        "waveform",
        (*_CONVOLUTIONAL, "num_conv_pos_embeddings", "conv_pos_kernel_size"),
    ),
    "wavlm": Family(
        "WavLM",
        "WavLMModel",
        "WavLMConfig",
        "transformers.models.wavlm.modeling_wavlm",
        ("wavlm.",),
        "waveform",
        (*_CONVOLUTIONAL, "max_bucket_distance"),
    ),
    "wav2vec2-bert": Family(
        "w2v-BERT 2.0",
        "Wav2Vec2BertModel",
        "Wav2Vec2BertConfig",
        "transformers.models.wav2vec2_bert.modeling_wav2vec2_bert",
        ("wav2vec2_bert.",),
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
    ),
}
"""Supported speech encoders by model_type."""


def _text(title: str, stem: str, module: str, *, pools: bool = True) -> Family:
    return Family(
        title,
        f"{stem}Model",
        f"{stem}Config",
        f"transformers.models.{module}.modeling_{module}",
        (f"{module.replace('xlm_', '')}.",),
        "tokens",
        (
            "hidden_act",
            "activation",
            "num_attention_heads",
            "layer_norm_eps",
            "pad_token_id",
            "position_embedding_type",
        ),
        pools,
    )


TEXT_FAMILIES = {
    "bert": _text("BERT", "Bert", "bert"),
    "roberta": _text("RoBERTa", "Roberta", "roberta"),
    "xlm-roberta": _text("XLM-RoBERTa", "XLMRoberta", "xlm_roberta"),
    "distilbert": _text("DistilBERT", "DistilBert", "distilbert", pools=False),
    "mpnet": _text("MPNet", "MPNet", "mpnet"),
    "electra": _text("ELECTRA", "Electra", "electra", pools=False),
}
"""Supported text encoders by model_type."""


def front_norm(config: Any) -> str:
    """Return `feat_extract_norm` of a configuration; data2vec-audio always has "layer"."""
    return getattr(config, "feat_extract_norm", "layer")
