"""Shape of a person's body, in the shape space of a body model of the SMPL family."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from gesturekit.errors import MotionError

GENDERS = ("female", "male", "neutral")
MAX_BETAS = 1000


@dataclass(frozen=True)
class BodyShape:
    """Body shape of the person on a rig; a person without a known shape has the default one.

    Attributes:
        betas: (B,) shape coefficients; trailing zeros, which change nothing, are dropped.
        gender: of GENDERS, the body model that `betas` belong to; None if unknown.
        version: of that model, such as "smplx2020"; None if unknown.
        pelvis: (3,) rest position of the pelvis in the body model, metres, to which the `trans` of
            a file is added; None if unknown.

    Raises:
        MotionError: an unknown gender, numbers that are not finite, or too many of them.
    """

    betas: tuple[float, ...] = ()
    gender: str | None = None
    version: str | None = None
    pelvis: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        betas = _numbers("betas", self.betas)
        if len(betas) > MAX_BETAS:
            raise MotionError(f"{len(betas)} betas; a body has up to {MAX_BETAS}")
        if self.gender not in (None, *GENDERS):
            raise MotionError(f"gender {self.gender!r}; expected {', '.join(GENDERS)}")
        pelvis = None if self.pelvis is None else tuple(_numbers("pelvis", self.pelvis).tolist())
        if pelvis is not None and len(pelvis) != 3:
            raise MotionError(f"pelvis: {len(pelvis)} numbers; expected three")
        object.__setattr__(self, "betas", tuple(np.trim_zeros(betas, "b").tolist()))
        object.__setattr__(self, "pelvis", pelvis)

    def to_json(self) -> dict[str, Any]:
        """Return the known attributes as JSON values."""
        return {name: value for name, value in asdict(self).items() if value not in (None, ())}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> BodyShape:
        """Return the inverse of `to_json`.

        Raises:
            MotionError: see the class.
            TypeError: an unknown attribute.
        """
        return cls(**values)


def _numbers(name: str, values: Any) -> np.ndarray:
    numbers = np.asarray(values, dtype=np.float64)
    if numbers.ndim != 1 or not np.isfinite(numbers).all():
        raise MotionError(f"{name} of shape {numbers.shape}; expected finite numbers")
    return numbers
