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
class Variants:
    """Choices among published variants of metrics.

    Attributes:
        patches: of the patch metrics (`gesturekit.evaluation.metrics.patches`): "ganimator" or
            "paper".
        threshold: coverage threshold; None for the default of `patches`.
        bas: of beat alignment (`gesturekit.evaluation.metrics.rhythm.beat_alignment`): "seconds"
            or "bailando".
    """

    patches: str = "ganimator"
    threshold: float | None = None
    bas: Literal["seconds", "bailando"] = "seconds"

    @property
    def has_coverage(self) -> bool:
        """True if coverage is defined: the variant "paper" needs a threshold."""
        return self.patches != "paper" or self.threshold is not None


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

    def at(self, fps: float, variants: Variants) -> Definition:
        """Return the definition with the settings filled in.

        `{30}` becomes "30 frames (1.20 s)", `{threshold}` the threshold of coverage.
        """
        chosen = {variants.patches, variants.bas}
        changed = next((new for name, new in _CHANGES[self.key].items() if name in chosen), {})
        threshold = THRESHOLD if variants.threshold is None else variants.threshold

        def filled(text: str) -> str:
            text = " ".join(text.split()).replace("{threshold}", f"{threshold:g}")
            return re.sub(r"\{(\d+)\}", lambda n: f"{n[1]} frames ({int(n[1]) / fps:.2f} s)", text)

        return replace(
            self,
            variant=filled(changed.get("variant", self.variant)),
            text=filled(changed.get("text", self.text)),
            fps_bound=changed.get("fps_bound", self.fps_bound),
        )

    def to_json(self) -> dict[str, Any]:
        """Return plain values."""
        return asdict(self)


_TABLE = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
_CHANGES = {
    key: {name: fields.pop(name) for name in [*fields] if isinstance(fields[name], dict)}
    for key, fields in _TABLE.items()
}
"""{key of a metric: {variant: fields that differ in it}}"""
DEFINITIONS = {key: Definition(key, **fields) for key, fields in _TABLE.items()}
