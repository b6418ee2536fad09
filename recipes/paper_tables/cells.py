"""Cells and captions of the papers' tables."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from gesturekit.training.config import read_yaml

PUBLISHED = {"TSG": 112_000, "ZeroEGGS": 67_000, "dance": 180_000}
"""Updates of the diffusion models by corpus (Alexanderson et al. 2023, Table 1)."""


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown; the first column holds names."""
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def number(value: float | None, low: float | None = None, high: float | None = None) -> str:
    """Return a value in three digits with its interval; a dash for none."""
    if value is None or math.isnan(value):
        return "–"
    return f"{value:.3g}" + ("" if low is None or high is None else f" [{low:.3g}, {high:.3g}]")


def share_trained(model: Path, updates: int | None = None) -> str:
    """Return which share of the published schedule a model's run trained, for a caption.

    Args:
        model: model folder, in the folder of its run.
        updates: published ones of a diffusion model; None for a multires run, whose configuration
            has the published schedule.
    """
    run = model.parent / "config.yaml"
    if not run.is_file():
        return "an unknown share of the schedule (no run folder)"
    settings: dict[str, Any] = read_yaml(run)
    trained = settings["longer"]
    if updates is not None:
        trained *= settings["training"]["updates"] / updates
    return f"{100 * trained:.3g} % of the published schedule"
