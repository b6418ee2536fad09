"""Task: one input of a batch, and a line of its plan."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


@dataclass(frozen=True, slots=True)
class Task:
    """One input of a batch.

    Attributes:
        id: path of the results below the output folder, without suffix; unique in a batch.
        path: the input file, or the folder of a sequence; None for a task without input.
        duration: seconds of sound or motion, by which shards are balanced; None if unknown.
        more: what else the verb needs of this input, as JSON values.
        source: name of the input in messages; by default the path as it was given.
        error: reason why nothing can be made of it, or None; such a task is not in the plan.
    """

    id: str
    path: Path | None = None
    duration: float | None = None
    more: Mapping[str, Any] = field(default_factory=dict)
    source: str = ""
    error: str | None = None

    def __post_init__(self) -> None:
        if not self.source:
            object.__setattr__(self, "source", str(self.path or self.id))

    @property
    def file(self) -> Path:
        """The `path` of a task that has one."""
        assert self.path is not None, self.id
        return self.path
