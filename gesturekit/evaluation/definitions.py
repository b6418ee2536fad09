"""What every figure of a report is: name, unit, which way is better, variant, definition, source.

The table is `definitions.toml`; the report prints it, and the JSON holds it, so that a number can
be had again.
"""

from __future__ import annotations

import re
import tomllib
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

SPEECH, MOVEMENT, LIKENESS, PATCHES, FRECHET = GROUPS = (
    "Speech",
    "Movement",
    "Likeness",
    "Patches",
    "Fréchet distances and diversity",
)


@dataclass(frozen=True)
class Definition:
    """A measure; the fields are explained at the top of `definitions.toml`."""

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

    def at(self, fps: float) -> Definition:
        """The same with its windows in seconds too: `{30}` becomes "30 frames (1.20 s)"."""

        def frames(place: re.Match[str]) -> str:
            return f"{place[1]} frames ({int(place[1]) / fps:.2f} s)"

        return replace(
            self,
            variant=re.sub(r"\{(\d+)\}", frames, self.variant),
            text=re.sub(r"\{(\d+)\}", frames, " ".join(self.text.split())),
        )

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


def _read() -> dict[str, Definition]:
    table = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
    return {key: Definition(key, **fields) for key, fields in table.items()}


DEFINITIONS = _read()
