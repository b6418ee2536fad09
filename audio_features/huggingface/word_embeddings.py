"""Embeddings of the spoken words, by a Hugging Face text encoder in a local folder."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any, Literal

import numpy as np

from audio_features.errors import FeatureError, WeightsError
from audio_features.huggingface.weights import TEXT_FAMILIES, read_configuration, read_network
from audio_features.speech_encoders import checked_device
from audio_features.track import FeatureTrack
from audio_features.wave import Wave
from audio_features.weight_files import check_fingerprint
from audio_features.words import frames_of, words_of

RATE = 50
"""Frames per second; frame k is at k/50 s."""

_MAX_TOKENS = 32  # a longer word is cut
_MAX_TOKENISER_BYTES = 128 << 20
# Its tokens show differences that the vocabulary does not: case, accents, how words are split.
_PROBE = "The Café's 42 naïve don't-KNOWs, говорит 日本 🙂"


class WordEmbeddings:
    """Embedding of the word that is spoken, by a text encoder in a local folder.

    BERT, RoBERTa, XLM-RoBERTa, DistilBERT, MPNet and ELECTRA are supported. The embedding of a
    word is the mean of its tokens' hidden states, without the special tokens, where the text is
    this word alone: it does not depend on its neighbours. It is held over the word's interval;
    pauses are zeros. Words come from the word list beside the recording, see `Words`. Nothing is
    downloaded and no code in the folder is run.

    Args:
        encoder: folder with config.json, the weights, and the tokeniser's files.
        layer: a number counts transformers' `hidden_states`; "last" is the output.
        fingerprint: fingerprint of weights and tokeniser, as in a spec; others are refused.
        device: "cpu" or "cuda"; not part of the spec.

    Attributes:
        fingerprint: sha256 over model_type, settings and tensors, and the tokeniser's vocabulary.

    Raises WeightsError if the folder cannot be used, FeatureError for an invalid setting.

    Examples:
        The folder of an encoder must be there:

        >>> af.WordEmbeddings("bert-base/")
        Traceback (most recent call last):
        audio_features.errors.WeightsError: bert-base: no such folder: give a local
        Hugging Face folder with config.json and model.safetensors
    """

    def __init__(
        self,
        encoder: str | os.PathLike[str],
        layer: int | Literal["last"] = "last",
        *,
        fingerprint: str | None = None,
        device: str = "cpu",
    ) -> None:
        folder = Path(encoder)
        self.device = checked_device(device)
        self.model, config = read_configuration(folder, TEXT_FAMILIES, "text")
        self._tokeniser, digest = _tokeniser(folder, int(config.vocab_size))
        about = {"model_type": self.model, "tokeniser": digest}
        network, self.fingerprint = read_network(folder, TEXT_FAMILIES[self.model], config, about)
        check_fingerprint(folder, self.fingerprint, fingerprint)
        count = int(config.num_hidden_layers)
        whole = isinstance(layer, int) and not isinstance(layer, bool)
        if layer != "last" and not (whole and 0 <= layer <= count):
            raise FeatureError(f"layer={layer!r}: a number from 0 to {count}, or 'last'")
        self.layer = layer
        stem = self.model.replace("-", "_")
        self.names = tuple(f"{stem}_{i}" for i in range(int(config.hidden_size)))
        self.dim = len(self.names)
        # A clip's mean depends on what is said.
        self.centred = (False,) * self.dim
        self.spec = {"kind": "words", "model": self.model, "layer": layer}
        self.spec["fingerprint"] = self.fingerprint
        self._network = network.to(self.device)
        self._known: dict[str, np.ndarray] = {}

    def embedding(self, word: str) -> np.ndarray:
        """Return the embedding (D,) of a word, zeros if it has no token."""
        if word not in self._known:
            self._known[word] = self._embedding(word)
        return self._known[word]

    def extract(self, wave: Wave) -> FeatureTrack:
        """Extract the embeddings of a recording's words: values (T, D).

        Raises FeatureError if there is no word list, or it cannot be read.
        """
        n_frames = wave.n_frames(RATE)
        values = np.zeros((n_frames, self.dim), np.float32)
        for word in words_of(wave):
            frames = frames_of(word, RATE)
            if frames.start < min(frames.stop, n_frames):
                values[frames] = self.embedding(word.text)
        return FeatureTrack(values, np.arange(n_frames) / RATE, self.spec, self.names)

    def digest_beside(self, wave: Wave) -> str:
        """Return a digest of the words, which the sound alone does not determine."""
        words = [(word.start, word.end, word.text) for word in words_of(wave)]
        return hashlib.sha256(json.dumps(words).encode()).hexdigest()

    def _embedding(self, word: str) -> np.ndarray:
        import torch

        encoded = self._tokeniser(
            word, truncation=True, max_length=_MAX_TOKENS, return_special_tokens_mask=True
        )
        special = np.array(encoded["special_tokens_mask"], bool)
        if special.all():
            return np.zeros(self.dim, np.float32)
        with torch.inference_mode():
            tokens = torch.tensor([encoded["input_ids"]], device=self.device)
            states = self._network(input_ids=tokens, output_hidden_states=True).hidden_states
            state = states[-1 if self.layer == "last" else self.layer][0]
        return state.cpu().numpy()[~special].mean(axis=0)

    def __repr__(self) -> str:
        return f"WordEmbeddings({self.spec})"


def _tokeniser(folder: Path, vocabulary: int) -> tuple[Any, str]:
    """Load the tokeniser in a folder, without a network and without code, and its digest."""
    for file in folder.iterdir():
        is_weights = file.suffix in (".safetensors", ".bin")
        if not is_weights and file.is_file() and file.stat().st_size > _MAX_TOKENISER_BYTES:
            raise WeightsError(f"{file}: {file.stat().st_size} bytes: too large for a tokeniser")
    try:
        from transformers import AutoTokenizer

        tokeniser = AutoTokenizer.from_pretrained(
            str(folder), local_files_only=True, trust_remote_code=False
        )
        largest = max(tokeniser.get_vocab().values())
        known = [sorted(tokeniser.get_vocab().items()), tokeniser(_PROBE)["input_ids"]]
    except Exception as error:  # transformers and tokenizers raise several classes
        reason = " ".join(str(error).split())[:200]
        files = "tokenizer.json and tokenizer_config.json"
        raise WeightsError(f"{folder}: no tokeniser ({reason}): download {files}") from error
    if not 0 <= largest < vocabulary:
        sizes = f"token {largest}, the encoder has {vocabulary}"
        raise WeightsError(f"{folder}: the tokeniser, of another model, reaches {sizes}")
    return tokeniser, hashlib.sha256(json.dumps(known).encode()).hexdigest()
