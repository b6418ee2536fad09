"""Rarely used options of WavLM."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from audio_features.errors import FeatureError
from audio_features.wavlm.architecture import HOP

SAMPLE_RATE = 16_000


@dataclass(frozen=True)
class Options:
    """Options of `WavLM`, which documents them; a preset fixes all of them."""

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
            0 <= full < 1e6 and 0 <= around < 1e6 and 2 * around + HOP / SAMPLE_RATE <= length < 1e6
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

    @property
    def frames(self) -> tuple[int, int, int]:
        """`full_context`, `chunk` and `context` in WavLM frames."""
        full, chunk, context = (round(s * SAMPLE_RATE / HOP) for s in self.seconds.values())
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
# Parameters of WavLM that a spec may hold.
_NAMED = ("layer", "dtype", "implementation", "preset", "fingerprint")


def check_names(settings: Mapping[str, Any]) -> None:
    """Raise FeatureError for an unknown setting of a spec or a keyword of `WavLM`."""
    known = (*_NAMED, *(option.name for option in fields(Options)))
    unknown = sorted(settings.keys() - set(known))
    if unknown:
        raise FeatureError(f"WavLM: unknown setting {unknown[0]!r}; there are {', '.join(known)}")
