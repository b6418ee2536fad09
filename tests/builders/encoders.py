"""Tiny speech and text encoders of random weights, as Hugging Face saves them."""

from pathlib import Path
from typing import Any

import torch
import transformers

_TRANSFORMER = {
    "hidden_size": 32,
    "num_hidden_layers": 3,
    "num_attention_heads": 4,
    "intermediate_size": 64,
}
_CONVOLUTIONS = {
    **_TRANSFORMER,
    "conv_dim": [16] * 7,
    "num_conv_pos_embeddings": 16,
    "num_conv_pos_embedding_groups": 4,
}
_DATA2VEC = {"num_conv_pos_embeddings": 2, "conv_pos_kernel_size": 5}
_WHISPER = {
    "d_model": 32,
    "encoder_layers": 3,
    "encoder_attention_heads": 4,
    "encoder_ffn_dim": 64,
    "decoder_layers": 1,
    "decoder_attention_heads": 4,
    "decoder_ffn_dim": 32,
    "vocab_size": 60,
    "max_source_positions": 150,
    "num_mel_bins": 80,
    **{f"{name}_token_id": 1 for name in ("pad", "bos", "eos", "decoder_start")},
}
# Classes of transformers and settings, by name; "wavlm" has the front end of its Large models.
ENCODERS = {
    "hubert": ("Hubert", "Model", _CONVOLUTIONS),
    "wav2vec2": ("Wav2Vec2", "ForCTC", {**_CONVOLUTIONS, "vocab_size": 8}),
    "data2vec-audio": ("Data2VecAudio", "Model", {**_CONVOLUTIONS, **_DATA2VEC}),
    "wavlm-base": ("WavLM", "Model", _CONVOLUTIONS),
    "wavlm": (
        "WavLM",
        "Model",
        {**_CONVOLUTIONS, "feat_extract_norm": "layer", "do_stable_layer_norm": True},
    ),
    "wav2vec2-bert": ("Wav2Vec2Bert", "Model", _TRANSFORMER),
    "whisper": ("Whisper", "Model", _WHISPER),
}


_VOCABULARY = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]", "so", "hand", "##s", "wave"]
_SIZES = {
    "vocab_size": len(_VOCABULARY),
    "hidden_size": 16,
    "num_hidden_layers": 2,
    "num_attention_heads": 2,
    "intermediate_size": 24,
    "max_position_embeddings": 40,
    "pad_token_id": 0,
}
_STEMS = {
    "bert": "Bert",
    "roberta": "Roberta",
    "xlm-roberta": "XLMRoberta",
    "distilbert": "DistilBert",
    "mpnet": "MPNet",
    "electra": "Electra",
}


def _save(folder: Path, stem: str, head: str, settings: dict[str, Any], seed: int) -> Any:
    """Save an encoder in which every tensor counts, and return it."""
    torch.manual_seed(seed)
    config = getattr(transformers, f"{stem}Config")(**settings)
    model = getattr(transformers, f"{stem}{head}")(config).eval()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    model.save_pretrained(folder)
    return model


def write_encoder(folder: Path, name: str, seed: int = 0) -> Any:
    """Save a speech encoder by its name in `ENCODERS`, and return transformers' model."""
    return _save(folder, *ENCODERS[name], seed)


def write_wavlm(folder: Path, seed: int = 0, norm: str = "group") -> Any:
    """Save a WavLM, and return it; norm "layer" is the front end of the Large models."""
    name = "wavlm" if norm == "layer" else "wavlm-base"
    return write_encoder(folder, name, seed)


def write_text_encoder(folder: Path, name: str = "bert", seed: int = 0, head: str = "Model") -> Any:
    """Save a text encoder and its tokeniser, and return transformers' model."""
    sizes = dict(_SIZES)
    if name == "distilbert":
        sizes = {"vocab_size": 9, "dim": 16, "n_layers": 2, "n_heads": 2, "hidden_dim": 24}
    if name == "electra":
        sizes["embedding_size"] = 8
    model = _save(folder, _STEMS[name], head, sizes, seed)
    (folder / "vocab.txt").write_text("\n".join(_VOCABULARY), encoding="utf-8")
    transformers.BertTokenizerFast(str(folder / "vocab.txt")).save_pretrained(folder)
    return model
