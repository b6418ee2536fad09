"""Extractor protocol, a stack of several extractors, and construction from a spec."""

from __future__ import annotations

import inspect
import json
import logging
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

from audio_features.acoustic import AcousticExtractor, ShortTimeSpectrum
from audio_features.errors import AudioFeaturesError, FeatureError, WeightsError
from audio_features.kinds import KINDS, digest_of_sources, installed_kinds
from audio_features.track import FeatureTrack
from audio_features.wave import Wave
from audio_features.weight_files import WeightPlaces

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

log = logging.getLogger(__name__)

_PLACES = {kind: entry.place for kind, entry in KINDS.items() if entry.place is not None}
"""Kinds of extractors with weights or files, and the setting of a spec that names their folder."""


@runtime_checkable
class Extractor(Protocol):
    """Sound in, feature track out.

    Examples:
        >>> isinstance(af.LogMel(), af.Extractor)
        True
    """

    @property
    def spec(self) -> dict[str, Any]:
        """JSON-serialisable settings; `extractor_from_spec` is the inverse."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the D columns."""

    @property
    def dim(self) -> int:
        """Number of columns D."""

    @property
    def centred(self) -> tuple[bool, ...]:
        """D flags; true if a clip's mean depends only on voice and recording conditions."""

    def extract(self, wave: Wave) -> FeatureTrack:
        """Extract the features of a sound: (T, D) on their own time base."""


class Stack:
    """Concatenation of several extractors, on the time base of the one with the most frames.

    Acoustic extractors share one spectrum.

    Examples:
        >>> stack = af.Stack([af.LogMel(n_mels=24), af.Prosody()])
        >>> stack.dim
        28
        >>> stack.names[-4:]
        ('f0', 'voicing', 'energy', 'onset')
    """

    def __init__(self, parts: Sequence[Extractor]) -> None:
        self.parts = tuple(parts)
        if not self.parts:
            raise FeatureError("an empty stack: give at least one extractor")
        self.names = tuple(name for part in self.parts for name in part.names)
        self.centred = tuple(mark for part in self.parts for mark in part.centred)
        self.dim = len(self.names)
        self.spec = {"kind": "stack", "parts": [part.spec for part in self.parts]}
        doubles = sorted({name for name in self.names if self.names.count(name) > 1})
        if doubles:
            raise FeatureError(f"two parts of a stack both give {doubles[0]!r}: list it once")

    def extract(
        self,
        wave: Wave,
        extract: Callable[[Extractor, Wave], FeatureTrack] = lambda part, wave: part.extract(wave),
    ) -> FeatureTrack:
        """Extract and concatenate the parts' features: values (T, D).

        Args:
            wave: the sound.
            extract: function for the parts that share no spectrum, for example a cache's.
        """
        spectra: dict[str | None, ShortTimeSpectrum] = {}
        tracks = []
        for part in self.parts:
            if isinstance(part, AcousticExtractor):
                tracks.append(part.extract(wave, spectra))
            else:
                tracks.append(extract(part, wave))
        times = max((track.times for track in tracks), key=len)
        each = [track if track.times is times else track.at(times) for track in tracks]
        values = np.concatenate([track.values for track in each], axis=1)
        return FeatureTrack(values, times, self.spec, self.names)

    def __repr__(self) -> str:
        return f"Stack({list(self.parts)})"


class Installed:
    """Extractor of an installed package, made by its entry point; its results are checked.

    The spec names the package, its version and a digest of its code, so that a cache knows other
    code, and a machine without the package knows what is missing.

    Args:
        entry: entry point whose name is the kind.
        settings: keywords of the extractor, and `package` if the spec has one.
        device: given to an extractor that has this keyword.

    Raises FeatureError if the package cannot be used.
    """

    def __init__(self, entry: EntryPoint, settings: dict[str, Any], device: str) -> None:
        dist = entry.dist
        version = f"{dist.name} {dist.version}" if dist else entry.module
        self._who = f"extractor {entry.name!r} of {version}"
        made_with = settings.pop("package", None)
        try:
            make = entry.load()
            if "device" in inspect.signature(make).parameters:
                settings["device"] = device
            self._made = make(**settings)
            self.names = tuple(f"{entry.name}.{name}" for name in self._made.names)
            self.centred = tuple(map(bool, self._made.centred))
            if len(self.names) != len(self.centred):
                raise FeatureError(f"{len(self.names)} names and {len(self.centred)} of centred")
            spec = json.loads(json.dumps(self._made.spec, allow_nan=False))
            package = f"{version} ({_code_of(entry)})"
            self.spec = spec | {"kind": entry.name, "package": package}
        except Exception as error:
            raise FeatureError(f"{self._who}: {error or repr(error)}") from error
        self.dim, self.worth_caching = len(self.names), getattr(self._made, "worth_caching", True)
        if made_with not in (None, package):
            text = "%s: %s is installed, the features were made with %s"
            log.warning(text, entry.name, package, made_with)

    def extract(self, wave: Wave) -> FeatureTrack:
        """Extract the features of a sound: values (T, D). Raises FeatureError if that fails."""
        try:
            track = self._made.extract(wave)
            return FeatureTrack(track.values, track.times, self.spec, self.names)
        except Exception as error:  # foreign code may raise anything; other sounds go on
            reason = error if isinstance(error, AudioFeaturesError) else repr(error)
            raise FeatureError(f"{wave.source or 'the sound'}: {self._who}: {reason}") from error

    def __repr__(self) -> str:
        return f"Installed({self.spec})"


def _code_of(entry: EntryPoint) -> str:
    """Return 8 digits that change with the source code of an entry point's package."""
    package, module = sys.modules[entry.module.partition(".")[0]], sys.modules[entry.module]
    file = Path(getattr(package, "__file__", None) or str(module.__file__))
    return digest_of_sources(file.parent if file.stem == "__init__" else file)[:8]


def extractor_from_spec(
    spec: dict[str, Any], *, weights: WeightPlaces | None = None, device: str = "cpu"
) -> Extractor:
    """Build the extractor that a spec describes.

    Args:
        spec: value of `Extractor.spec`, as stored in feature files and models.
        weights: folder or file of the WavLM weights, or folder of the Hugging Face encoder of
            speech or words, if the spec contains one and does not name its path; or the folder of
            the files of `Files`. For several, {kind: path}, such as {"wavlm": "wavlm-base-plus/",
            "words": "bert-base/", "files": "own_features/"}.
        device: "cpu" or "cuda", for WavLM, Hugging Face encoders, torchaudio and installed kinds.

    Kinds of installed packages are found by their entry points, see `kinds.GROUP`.

    Raises FeatureError for a kind that is unknown or not installed, or a setting that the kind
    does not have, and WeightsError if weights are missing or have another fingerprint than the
    spec.

    Examples:
        >>> extractor = af.extractor_from_spec({"kind": "mfcc", "n": 13})
        >>> extractor.dim
        13
        >>> af.extractor_from_spec({"kind": "mffc"})
        Traceback (most recent call last):
        audio_features.errors.FeatureError: feature spec {'kind': 'mffc'}: kind 'mffc' is none
        of logmel, mfcc, prosody, onset, prosodic_range, effort, music, words, wavlm, hf, files,
        stack
    """
    settings = dict(spec) if isinstance(spec, dict) else {}
    kind, places = settings.pop("kind", None), _places(spec, weights)
    if kind == "stack":
        parts = settings.pop("parts", None)
        if settings or not isinstance(parts, list):
            raise FeatureError(f"feature spec {spec!r}: a stack has 'parts', a list of specs")
        return Stack([extractor_from_spec(part, weights=places, device=device) for part in parts])
    if kind not in KINDS:
        return _installed(kind, settings, device)
    module, name = KINDS[kind].module, KINDS[kind].name
    if needs_weights(spec) and kind == "words":
        module, name = "huggingface.word_embeddings", "WordEmbeddings"
    make: Any = getattr(import_module(f"audio_features.{module}"), name)
    if needs_weights(spec):
        make = partial(make, _folder_of(kind, settings, places), device=device)
    elif kind == "files" and kind in places:
        settings["folder"] = places[kind]
    if settings.get("backend") == "torchaudio":
        settings["device"] = device
    try:
        return make(**settings)
    except TypeError as error:
        raise FeatureError(f"feature spec {spec!r}: {error}") from error


def _folder_of(
    kind: str, settings: dict[str, Any], places: Mapping[str, str | os.PathLike[str]]
) -> str | os.PathLike[str]:
    """Return the place of an encoder, and take it and the model's name out of the settings."""
    name = _PLACES[kind]
    folder = settings.pop(name, None) or places.get(kind)
    usual = {"wavlm": "WavLM", "words": "a text encoder", "hf": "a Hugging Face speech encoder"}
    model = settings.pop("model", None) or usual[kind]
    if folder is None:
        wanted = settings.get("fingerprint")
        which = f" with fingerprint {wanted}" if wanted else ""
        setting = f"{name}: FOLDER in the config" if name else "features.weights=PATH"
        how = f"name their place ({setting} to train, else --weights {kind}=PATH)"
        raise WeightsError(f"weights of {model}{which} are needed: {how}")
    return folder


def _installed(kind: Any, settings: dict[str, Any], device: str) -> Installed:
    """Return the extractor of an installed package; FeatureError for a kind that none has."""
    if entry := (kinds := installed_kinds()).get(kind):
        return Installed(entry, settings, device)
    known, spec = ", ".join([*KINDS, *kinds, "stack"]), {"kind": kind, **settings}
    problem = f"feature spec {spec!r}: kind {kind!r} is none of {known}"
    if package := settings.get("package"):
        problem = f"extractor {kind!r} is not here: install {package!r} if you trust it"
    raise FeatureError(problem)


def needs_weights(spec: Any) -> bool:
    """Return whether an extractor of this spec has the weights of an encoder.

    Times of words, {"kind": "words"}, need none; a word encoder has further settings.
    """
    kind = spec.get("kind") if isinstance(spec, dict) else None
    return kind in ("wavlm", "hf") or (kind == "words" and len(spec) > 1)


def needs_of(spec: Any) -> list[str]:
    """Return what an extractor of this spec needs beside the sound, in phrases.

    Examples:
        >>> needs_of({"kind": "files", "dim": 64, "suffix": ".npy", "rate": 50})
        ['STEM.npy with 64 columns, beside each sound or in --weights files=FOLDER']
    """
    needs = []
    for part in _leaves(spec):
        kind = part.get("kind")
        if needs_weights(part):
            needs.append(f"the weights of the encoder: --weights {kind}=PATH")
        if kind == "words":
            needs.append("a list of words with times beside each sound, such as STEM.TextGrid")
        elif kind == "files":
            files = f"STEM{part.get('suffix')} with {part.get('dim')} columns"
            needs.append(f"{files}, beside each sound or in --weights files=FOLDER")
        elif kind is not None and kind not in KINDS:
            here = "" if kind in installed_kinds() else ", which is not installed here"
            needs.append(f"the extractor {kind} of the package {part.get('package')}{here}")
    return needs


def _leaves(spec: Any) -> list[dict[str, Any]]:
    """Return the specs of a stack, or the spec alone; none of what is no spec."""
    if not isinstance(spec, dict):
        return []
    if spec.get("kind") != "stack":
        return [spec]
    parts = spec["parts"] if isinstance(spec.get("parts"), list) else []
    return [leaf for part in parts for leaf in _leaves(part)]


def folder_in_spec(spec: Mapping[str, Any]) -> str | None:
    """Return the folder of the weights or files that a spec names itself."""
    name = _PLACES.get(spec.get("kind", ""))
    return spec.get(name) if name else None


def _places(spec: Any, weights: WeightPlaces | None) -> Mapping[str, str | os.PathLike[str]]:
    """Return the places of weights and files by kind; one path is that of the spec's encoder.

    Raises WeightsError for a kind without weights and files, and for one path of several encoders.
    """
    if weights is None:
        return {}
    if isinstance(weights, Mapping):
        known = ", ".join(_PLACES)
        for name in weights.keys() - _PLACES.keys():
            problem = f"{name!r} has no weights or files; expected {known}"
            raise WeightsError(f"weights {name}={os.fspath(weights[name])}: {problem}")
        return weights
    encoders = [part for part in _leaves(spec) if needs_weights(part) and not folder_in_spec(part)]
    kinds = list(dict.fromkeys(part["kind"] for part in encoders)) or ["files"]
    if len(kinds) > 1:
        named = " ".join(f"--weights {kind}=PATH" for kind in kinds)
        raise WeightsError(f"{os.fspath(weights)}: give the weights of each encoder ({named})")
    return {kinds[0]: weights}
