"""Definitions of all metrics: name, unit, better direction, variant, definition, source.

The table is `definitions.toml`. Report and JSON contain it, so that each value can be reproduced.
"""

from __future__ import annotations

import re
import tomllib
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from gesturekit.evaluation.metrics.patches import THRESHOLD

HEADLINE, SPEECH, MOVEMENT, LIFE, SIMILARITY, PATCHES, FRECHET = GROUPS = (
    "Headline",
    "Speech",
    "Movement",
    "Life: all clips pooled",
    "Similarity",
    "Patches",
    "Fréchet distances and diversity",
)


@dataclass(frozen=True)
class PatchOptions:
    """Settings of the patch metrics; see `gesturekit.evaluation.metrics.patches`.

    Attributes:
        variant: "ganimator" or "paper".
        threshold: coverage threshold; None for the default of the variant.
    """

    variant: str = "ganimator"
    threshold: float | None = None

    @property
    def has_coverage(self) -> bool:
        """True if coverage is defined: the variant "paper" needs a threshold."""
        return self.variant != "paper" or self.threshold is not None


@dataclass(frozen=True)
class Definition:
    """Definition of a metric; the fields are explained at the top of `definitions.toml`."""

    key: str
    name: str
    group: str
    unit: str
    better: Literal["higher", "lower", "reference"]
    variant: str
    text: str
    source: str
    fps_bound: bool = False
    cheap: bool = False

    def at(self, fps: float, patches: PatchOptions) -> Definition:
        """Return the definition with the settings filled in.

        `{30}` becomes "30 frames (1.20 s)", `{threshold}` the threshold of coverage.
        """
        changed = _PAPER.get(self.key, {}) if patches.variant == "paper" else {}
        threshold = THRESHOLD if patches.threshold is None else patches.threshold

        def filled(text: str) -> str:
            text = " ".join(text.split()).replace("{threshold}", f"{threshold:g}")
            return re.sub(r"\{(\d+)\}", lambda n: f"{n[1]} frames ({int(n[1]) / fps:.2f} s)", text)

        return replace(
            self,
            variant=filled(changed.get("variant", self.variant)),
            text=filled(changed.get("text", self.text)),
        )

    def to_json(self) -> dict[str, Any]:
        """Return plain values."""
        return asdict(self)


_TABLE = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
_PAPER = {key: fields.pop("paper") for key, fields in _TABLE.items() if "paper" in fields}
DEFINITIONS = {key: Definition(key, **fields) for key, fields in _TABLE.items()}
