"""Parts that all speech encoders share: options, layers, normalisation, chunks, devices."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from audio_features.errors import AudioError, FeatureError
from audio_features.track import FeatureTrack
from audio_features.wave import Wave
from audio_features.weight_files import check_fingerprint

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

    normalize: bool | float | None = None
    full_context: float = 300.0
    chunk: float = 30.0
    context: float = 5.0
    seconds: dict[str, float] = field(init=False, repr=False)
    """`full_context`, `chunk` and `context` by name, in seconds."""

    def __post_init__(self) -> None:
        given = {name: value for name, value in vars(self).items() if name != "normalize"}
        try:
            seconds = dict(zip(given, map(float, given.values())))
            full, length, around = seconds.values()
            is_right = max(full, length) < 1e6 and min(full, around) >= 0
            is_right &= 2 * around + _SHORTEST_CHUNK <= length
        except (TypeError, ValueError):
            is_right = False
        if not is_right:
            values = ", ".join(f"{name}={value!r}" for name, value in given.items())
            how = "seconds from 0 to 1000000, and chunks longer than twice their context"
            raise FeatureError(f"{values}: give {how}")
        object.__setattr__(self, "seconds", seconds)

    def chunks(self, n_frames: int, hop: int, most: int | None = None) -> list[tuple[slice, slice]]:
        """Return the `chunk_slices` of a sound.

        Args:
            n_frames: length of the sound.
            hop: samples between two frames.
            most: frames that the encoder takes at once; None without a limit.
        """
        full, chunk, context = (round(s * (SAMPLE_RATE / hop)) for s in self.seconds.values())
        if most is not None:
            if chunk > most:
                context = min(context, most // 4)
            full, chunk = min(full, most), min(chunk, most)
        longest = n_frames if n_frames <= full else max(chunk, 2 * context + 1)
        return list(chunk_slices(n_frames, longest, context))

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


Layer = int | str | list[int] | tuple[int, ...] | Mapping[int | str, float]
"""Argument of `WavLM`: a number, "last", "mean", several numbers, or {number: weight}."""


class LayerChoice:
    """Selection from hidden states 0 to `top`, concatenated or averaged.

    Args:
        layer: see `WavLM`.
        final_norm: true applies the encoder's final normalisation to the topmost state; None
            means only for "last".
        top: number of layers of the network.

    Attributes:
        indices: selected indices into transformers' `hidden_states`.
        shares: weight of each index, which sum to 1, if the states are averaged, else empty.
        is_list: true if several states are concatenated; the column names then include the layer.
        spec: the selection as a JSON-serialisable value.

    Raises FeatureError for a layer that does not exist, or contradictory settings.
    """

    def __init__(self, layer: Layer, final_norm: bool | None, top: int) -> None:
        if final_norm is not None and not isinstance(final_norm, bool):
            raise FeatureError(f"final_norm={final_norm!r}: true or false")
        self.top, self.final_norm = top, layer == "last" if final_norm is None else final_norm
        self.is_list = isinstance(layer, list | tuple)
        self.spec: Any = list(layer) if isinstance(layer, tuple) else layer
        weights: list[float] = []
        if isinstance(layer, Mapping):
            # JSON turns the keys of a spec into strings.
            chosen = [int(key) if str(key).isdecimal() else key for key in layer]
            try:
                weights = [float(weight) for weight in layer.values()]
            except (TypeError, ValueError):
                weights = [np.nan]
            self.spec = dict(zip(map(str, chosen), weights))
        elif layer == "mean":
            chosen = list(range(top + 1))
            weights = [1.0] * len(chosen)
        else:
            several: list[Any] = list(layer) if isinstance(layer, list | tuple) else [layer]
            chosen = [top] if layer == "last" else several
        numbers = {index for index in chosen if type(index) is int and 0 <= index <= top}
        total, problem = sum(weights), ""
        if not chosen or len(numbers) < len(chosen):
            problem = f"give 'last', 'mean', or different numbers from 0 to {top}"
        elif final_norm and top not in chosen:
            problem = f"leave out final_norm, which is layer {top}'s"
        elif weights and not (np.isfinite(total) and total):
            problem = "give finite weights that do not sum to 0"
        if problem:
            raise FeatureError(f"layer={layer!r}: {problem}")
        self.indices = tuple(chosen)
        self.shares = {index: weight / total for index, weight in zip(chosen, weights)}

    def pick(self, encoder: Any, states: Iterable[torch.Tensor]) -> torch.Tensor:
        """Compute the features (B, T, D) from the states 0, 1, … that `encoder` yields.

        The encoder says whether it `ends_in_norm`, that is whether a final normalisation follows
        the topmost layer, not in its state, and has this `final_norm`.
        """
        import torch

        picked: dict[int, torch.Tensor] = {}
        for index, state in enumerate(states):
            if index not in self.indices:
                continue
            if index == self.top and self.final_norm and encoder.ends_in_norm:
                state = encoder.final_norm(state)
            if self.shares:
                picked[0] = picked.get(0, 0.0) + self.shares[index] * state
            else:
                picked[index] = state
        if len(picked) == 1:
            return next(iter(picked.values()))
        return torch.cat([picked[index] for index in self.indices], dim=-1)


class HiddenStateExtractor(ABC):
    """Extractor whose features are hidden states of an encoder.

    Attributes:
        weights: description of the weights; `weights.describe()` summarises it in one line.
        spec: settings from which the extractor can be built again, as a JSON-serialisable value.
        normalize: number added to the waveform's variance; None if it is not normalised.
        first, hop: centre of the first frame, and the distance of two, in samples at 16 kHz.
        names: of the D columns: wavlm_0 …; wavlm_LAYER_0 … if there are several layers.
        dim: D, the encoder's width for each layer (WavLM Base 768, Large 1024).
    """

    weights: Any
    spec: Any
    first: float
    hop: int

    def _choose(
        self, layer: Layer, final_norm: bool | None, options: Options, fingerprint: str | None
    ) -> None:
        """Set what follows from `weights`, which must be those of `fingerprint`, and settings."""
        check_fingerprint(self.weights.path, self.weights.fingerprint, fingerprint)
        self.fingerprint, self._options = self.weights.fingerprint, options
        self.normalize = options.eps(self.weights.normalize)
        self._choice = choice = LayerChoice(layer, final_norm, self.weights.layers)
        stem = self.weights.model.replace("-", "_")
        stems = [f"{stem}_{index}" for index in choice.indices] if choice.is_list else [stem]
        self.names = tuple(f"{stem}_{i}" for stem in stems for i in range(self.weights.width))
        self.dim = len(self.names)
        self.centred = (True,) * self.dim  # a clip's mean is that of voice and recording

    @abstractmethod
    def hidden_states(self, samples: np.ndarray) -> np.ndarray:
        """Compute (T, D) float32 from (N,) samples at 16 kHz, without normalising them."""

    def extract(self, wave: Wave) -> FeatureTrack:
        """Extract the hidden states of a sound at any sample rate: values (T, D).

        Raises AudioError for a sound shorter than one frame.
        """
        values = self.hidden_states(normalized(wave.resample(SAMPLE_RATE).samples, self.normalize))
        if len(values) == 0:
            short = f"{wave.duration:.4f} s is shorter than one frame of {self.weights.model}"
            raise AudioError(f"{wave.source or 'the sound'}: {short}: give a longer sound")
        times = (self.first + self.hop * np.arange(len(values))) / SAMPLE_RATE
        return FeatureTrack(values, times, self.spec, self.names)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.weights.path!r}, {self.spec})"
