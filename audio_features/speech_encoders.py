"""Parts that all speech encoders share: options, layers, normalisation, chunks, devices."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from audio_features.errors import FeatureError

if TYPE_CHECKING:
    import torch

SAMPLE_RATE = 16_000
"""Sample rate in Hz of every speech encoder."""
_SHORTEST_CHUNK = 320 / SAMPLE_RATE  # seconds: one frame of the published encoders


def normalized(samples: np.ndarray, eps: float | None) -> np.ndarray:
    """Scale a waveform (N,) float32 to mean 0 and variance 1, with `eps` added to the variance.

    Returns the waveform itself if `eps` is None.
    """
    if eps is None:
        return samples
    # In float32, as in the networks' own code: Large normalises frames one by one, which would
    # amplify the rounding difference of another precision in near silence.
    return (samples - samples.mean()) / np.sqrt(samples.var() + np.float32(eps))


def chunk_slices(n_frames: int, longest: int, context: int) -> Iterator[tuple[slice, slice]]:
    """Yield (input frames, output frames) of as few chunks as possible, all of one length.

    The output frames are contiguous and leave out a chunk's context, except at the start and the
    end of the sound.
    """
    count = max(1, -(-(n_frames - 2 * context) // (longest - 2 * context)))
    length = min(n_frames, -(-(n_frames + (count - 1) * 2 * context) // count))
    done = 0
    while done < n_frames:
        start = min(max(0, done - context), n_frames - length)
        stop = start + length
        keep = slice(done, n_frames if stop == n_frames else stop - context)
        yield slice(start, stop), keep
        done = keep.stop


def check_names(
    extractor: str, settings: Iterable[str], known: Sequence[str], place: Sequence[str] = ()
) -> None:
    """Raise FeatureError for a setting of a spec, or a keyword, that an extractor does not have.

    The message lists the `known` ones after `place`, the setting that names the weights.
    """
    unknown = sorted(set(settings) - set(known))
    if unknown:
        names = ", ".join((*place, *known))
        raise FeatureError(f"{extractor}: unknown setting {unknown[0]!r}; there are {names}")


def checked_device(name: str) -> Any:
    """Return the torch device of that name; raises FeatureError if it cannot be used."""
    import torch

    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError, TypeError) as error:
        reason = str(error).splitlines()[0]
        raise FeatureError(f"device={name!r} cannot be used: {reason}: give 'cpu'") from error
    return device


@dataclass(frozen=True)
class Options:
    """Options of `WavLM` and `HuggingFace`, which document them."""

    final_norm: bool | None = None
    normalize: bool | float | None = None
    full_context: float = 300.0
    chunk: float = 30.0
    context: float = 5.0

    def __post_init__(self) -> None:
        given = ", ".join(f"{name}={getattr(self, name)!r}" for name in _SECONDS)
        try:
            full, length, around = (float(getattr(self, name)) for name in _SECONDS)
        except (TypeError, ValueError) as error:
            raise FeatureError(f"{given}: give three numbers of seconds") from error
        if not (
            0 <= full < 1e6 and 0 <= around < 1e6 and 2 * around + _SHORTEST_CHUNK <= length < 1e6
        ):
            raise FeatureError(
                f"{given}: give seconds from 0 to 1000000, and chunks longer than twice their "
                "context"
            )
        for name, value in zip(_SECONDS, (full, length, around), strict=True):
            object.__setattr__(self, name, value)

    @property
    def seconds(self) -> dict[str, float]:
        """`full_context`, `chunk` and `context` by name, in seconds."""
        return {name: getattr(self, name) for name in _SECONDS}

    def frames(self, hop: int) -> tuple[int, int, int]:
        """Return `full_context`, `chunk` and `context` in frames of `hop` samples."""
        full, chunk, context = (round(s * (SAMPLE_RATE / hop)) for s in self.seconds.values())
        return full, chunk, context

    def eps(self, expected: float | None) -> float | None:
        """Return the number added to the variance; None leaves the waveform unnormalised.

        Args:
            expected: the value for the weights, used where `normalize` is None.
        """
        value = expected if self.normalize is None else self.normalize
        if value is None or value is False:
            return None
        if not isinstance(value, float) or not 0 < value < 1:
            raise FeatureError(f"normalize={value!r}: False, or a number between 0 and 1")
        return value


_SECONDS = ("full_context", "chunk", "context")


class Encoder(Protocol):
    """Network whose hidden states become features."""

    @property
    def ends_in_norm(self) -> bool:
        """True if a final normalisation follows the topmost layer and is not in its state."""

    def final_norm(self, x: torch.Tensor) -> torch.Tensor:
        """Apply the final normalisation to the topmost state (B, T, width)."""


Layer = int | str | list[int] | tuple[int, ...] | Mapping[int | str, float]
"""Argument of `WavLM`: a number, "last", "mean", several numbers, or {number: weight}."""


@dataclass(frozen=True)
class LayerChoice:
    """Selection from hidden states 0 to `top`, concatenated or averaged.

    Args:
        layer: see `WavLM`.
        final_norm: true applies the encoder's final normalisation to the topmost state; None
            means only for "last".
        top: number of layers of the network.

    Raises FeatureError for a layer that does not exist, or contradictory settings.
    """

    layer: Layer
    final_norm: bool | None
    top: int

    def __post_init__(self) -> None:
        layer, norm = self.layer, self.final_norm
        if norm is not None and not isinstance(norm, bool):
            raise FeatureError(f"final_norm={norm!r}: true or false")
        object.__setattr__(self, "final_norm", layer == "last" if norm is None else norm)
        for index in self.indices:
            if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index <= self.top:
                raise FeatureError(
                    f"layer={layer!r}: 'last', 'mean', or whole numbers from 0 to {self.top}"
                )
        if not self.indices or len(set(self.indices)) < len(self.indices):
            raise FeatureError(f"layer={layer!r}: name each layer once, and at least one")
        if norm and self.top not in self.indices:
            raise FeatureError(
                f"layer={layer!r} with final_norm: the final normalisation belongs to layer "
                f"{self.top} alone: leave final_norm out"
            )
        if self.weights is not None and not (
            np.isfinite(self.weights).all() and abs(sum(self.weights)) > 0
        ):
            raise FeatureError(f"layer={layer!r}: the weights must be finite and not sum to 0")

    @property
    def indices(self) -> tuple[int, ...]:
        """Selected indices into transformers' `hidden_states`."""
        if self.layer == "last":
            return (self.top,)
        layer: Any = self.layer  # until `__post_init__` has checked it
        if self.layer == "mean":
            return tuple(range(self.top + 1))
        if isinstance(layer, Mapping):
            # JSON turns the keys of a spec into strings.
            return tuple(
                int(key) if isinstance(key, str) and key.isdecimal() else key for key in layer
            )
        return tuple(layer) if isinstance(layer, list | tuple) else (layer,)

    @property
    def weights(self) -> tuple[float, ...] | None:
        """One weight per state if they are averaged, else None."""
        if self.layer == "mean":
            return (1.0,) * (self.top + 1)
        if not isinstance(self.layer, Mapping):
            return None
        try:
            return tuple(float(weight) for weight in self.layer.values())
        except (TypeError, ValueError) as error:
            raise FeatureError(f"layer={self.layer!r}: a weight is not a number") from error

    @property
    def spec(self) -> int | str | list[int] | dict[str, float]:
        """Selection as a JSON-serialisable value."""
        if isinstance(self.layer, Mapping):
            return {str(i): weight for i, weight in zip(self.indices, self.weights or ())}
        return list(self.layer) if isinstance(self.layer, tuple) else self.layer

    @property
    def is_list(self) -> bool:
        """True if several states are concatenated; the column names then include the layer."""
        return isinstance(self.layer, list | tuple)

    def pick(self, encoder: Encoder, states: Iterable[torch.Tensor]) -> torch.Tensor:
        """Compute the features (B, T, D) from the states 0, 1, … that `encoder` yields."""
        import torch

        share = dict.fromkeys(self.indices, 1.0)
        if self.weights is not None:
            share = {i: w / sum(self.weights) for i, w in zip(self.indices, self.weights)}
        picked: dict[int, torch.Tensor] = {}
        for index, state in enumerate(states):
            if index not in share:
                continue
            if index == self.top and self.final_norm and encoder.ends_in_norm:
                state = encoder.final_norm(state)
            if self.weights is None:
                picked[index] = state
            else:
                picked[0] = picked.get(0, 0.0) + share[index] * state
        if self.weights is not None or len(share) == 1:
            return next(iter(picked.values()))
        return torch.cat([picked[index] for index in self.indices], dim=-1)


class HiddenStateExtractor:
    """Columns of an extractor whose features are hidden states of an encoder.

    Attributes:
        weights: description of the weights; `weights.describe()` summarises it in one line.
        stem: beginning of the columns' names.
    """

    weights: Any
    stem: str
    _choice: LayerChoice

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the weights, see their class."""
        return self.weights.fingerprint

    @property
    def layer(self) -> Any:
        """Layer or layers, as in the spec."""
        return self._choice.spec

    @property
    def centred(self) -> tuple[bool, ...]:
        """D flags, all true: a clip's mean depends on voice and recording conditions."""
        return (True,) * self.dim

    @property
    def spec(self) -> dict[str, Any]:
        """Settings from which the extractor can be built again, as a JSON-serialisable value."""
        raise NotImplementedError

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the columns: wavlm_0 …; wavlm_LAYER_0 … if there are several layers."""
        width = range(self.weights.width)
        if not self._choice.is_list:
            return tuple(f"{self.stem}_{i}" for i in width)
        return tuple(f"{self.stem}_{layer}_{i}" for layer in self._choice.indices for i in width)

    @property
    def dim(self) -> int:
        """Number of columns D: the encoder's width for each layer (WavLM Base 768, Large 1024)."""
        return len(self.names)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.weights.path!r}, {self.spec})"
