"""Definitions of all metrics: name, unit, better direction, variant, definition, source.

The table is `definitions.toml`. Report and JSON contain it, so that each value can be reproduced.
"""

from __future__ import annotations

import math
import pkgutil
import re
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from gesturekit.evaluation.metrics.patches import THRESHOLD

HEADLINE, SPEECH, MOVEMENT, POOLED, SIMILARITY, PATCHES, FRECHET = GROUPS = (
    "Headline",
    "Speech",
    "Movement",
    "Life: all clips pooled",
    "Similarity",
    "Patches",
    "Fréchet distances and diversity",
)


_ANY = (-math.inf, math.inf)


@dataclass(frozen=True)
class Variants:
    """Choices among published variants of metrics.

    Attributes:
        patches: of the patch metrics (`gesturekit.evaluation.metrics.patches`): "ganimator" or
            "paper".
        threshold: coverage threshold; None for the default of `patches`.
        bas: of beat alignment (`gesturekit.evaluation.metrics.rhythm.beat_alignment`): "seconds"
            or "bailando".
        kinetic: of the features of FID_k and Div_k (`gesturekit.evaluation.kinetic_features`):
            "corrected" or "released".

    Examples:
        What coverage is in the variant of the paper:

        >>> variants = Variants(patches="paper", threshold=3)
        >>> DEFINITIONS["coverage"].at(30, variants).variant
        'paper: 30 frames (1.00 s), 3'
    """

    patches: str = "ganimator"
    threshold: float | None = None
    bas: Literal["seconds", "bailando"] = "seconds"
    kinetic: Literal["corrected", "released"] = "corrected"


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
    within: tuple[float, float] = _ANY
    fps_bound: bool = False
    cheap: bool = False
    function: str = ""
    of: Literal["", "motion", "comparison", "sound", "distance", "diversity"] = ""
    arguments: Mapping[str, Any] = field(default_factory=dict)
    factor: float = 1.0
    with_group: str = ""
    mismatched: bool = False
    aspect: str = ""
    ratio_floor: float | None = None
    enough: Literal["", "at least", "at most"] = ""
    tested: bool = True
    shown: tuple[str, ...] = ()

    def at(self, fps: float, variants: Variants) -> Definition:
        """Return the definition with the settings filled in.

        `{30}` becomes "30 frames (1.20 s)", `{threshold}` the threshold of coverage.
        """
        chosen = {variants.patches, variants.bas, variants.kinetic}
        changes = (new for name, new in _CHANGES[self.key].items() if name in chosen)
        changed = replace(self, **next(changes, {}))
        threshold = THRESHOLD if variants.threshold is None else variants.threshold

        def filled(text: str) -> str:
            text = " ".join(text.split()).replace("{threshold}", f"{threshold:g}")
            return re.sub(r"\{(\d+)\}", lambda n: f"{n[1]} frames ({int(n[1]) / fps:.2f} s)", text)

        return replace(changed, variant=filled(changed.variant), text=filled(changed.text))

    @property
    def title(self) -> str:
        """Name and unit."""
        return f"{self.name}, {self.unit}" if self.unit else self.name

    @property
    def taken_with(self) -> str:
        """The group with which the metric is taken."""
        return self.with_group or self.group

    def load_function(self) -> Callable[..., Any]:
        """Return the function in `gesturekit.evaluation.metrics`."""
        return pkgutil.resolve_name(f"gesturekit.evaluation.metrics.{self.function}")

    def to_json(self) -> dict[str, Any]:
        """Return what a reader of a report needs, as plain values."""
        return {name: getattr(self, name) for name in _REPORTED}


_REPORTED = (
    *("key", "name", "group", "unit", "better", "variant", "text", "source"),
    *("fps_bound", "cheap"),
)
_TABLE = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
_CHANGES = {
    key: {
        name: fields.pop(name) for name in [*fields] if name not in Definition.__dataclass_fields__
    }
    for key, fields in _TABLE.items()
}
"""{key of a metric: {variant: fields that differ in it}}"""
DEFINITIONS = {
    key: Definition(key, **{**fields, "within": tuple(fields.get("within", _ANY))})
    for key, fields in _TABLE.items()
}
"""Metrics by key, in the order of reports."""


def definitions_of(*of: str) -> list[Definition]:
    """Return the metrics whose function is computed of that, in the order of reports."""
    return [definition for definition in DEFINITIONS.values() if definition.of in of]


def shown_in(place: str) -> tuple[str, ...]:
    """Return the keys of the metrics that are shown in a place: clips, ratios or ranking."""
    return tuple(key for key, definition in DEFINITIONS.items() if place in definition.shown)
