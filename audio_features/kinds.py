"""Table of the kinds of extractors: the one place in which a speech feature is entered."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any


@dataclass(frozen=True)
class Kind:
    """Entry of an extractor.

    Attributes:
        module: module of audio_features that holds the class; imported on first use.
        name: name of the class, which audio_features exports.
        argument: setting that may follow the kind after a colon, as in `mfcc:20`; None for none.
        place: setting of the folder of its weights or files, which may be given beside the spec;
            "" if no setting names it, None for an extractor without.
    """

    module: str
    name: str
    argument: str | None = None
    place: str | None = None

    def load(self) -> Any:
        """Import and return the class."""
        return getattr(import_module(f"audio_features.{self.module}"), self.name)


KINDS = {
    "logmel": Kind("acoustic.extractors", "LogMel", "n_mels"),
    "mfcc": Kind("acoustic.extractors", "MFCC", "n"),
    "prosody": Kind("acoustic.extractors", "Prosody", "f0"),
    "onset": Kind("acoustic.extractors", "Onset"),
    "prosodic_range": Kind("acoustic.extractors", "ProsodicRange", "seconds"),
    "effort": Kind("acoustic.extractors", "Effort", "seconds"),
    "music": Kind("acoustic.extractors", "Music", "n_chroma"),
    "words": Kind("words", "Words", "encoder", place="encoder"),
    "wavlm": Kind("wavlm.extractor", "WavLM", place=""),
    "hf": Kind("huggingface.extractor", "HuggingFace", "path", place="path"),
    "files": Kind("files", "Files", "dim", place="folder"),
}
"""Extractors by the `kind` of their specs, in the order in which messages list them."""
