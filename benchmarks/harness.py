"""Shared parts of all benchmarks: the two flags, medians of interleaved runs, and the JSON."""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path


def arguments(description: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--quick", action="store_true", help="under 60 s on 2 cores")
    parser.add_argument("--json", type=Path, help="write the figures here as well")
    return parser.parse_args()


def timed(work: Callable[[], object], runs: int) -> list[float]:
    """Seconds of each of some runs with nothing between them."""
    times = []
    for _ in range(runs):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return times


def compare(
    ours: Callable[[], object], other: Callable[[], object], runs: int, note: str, turn: int = 1
) -> dict[str, float | str]:
    """Median seconds of both, run in turn so that a busy machine slows both alike.

    Each has `turn` runs before it is the other's turn.
    """
    times: dict[str, list[float]] = {"ours": [], "other": []}
    ours(), other()
    for _ in range(runs):
        for name, work in (("ours", ours), ("other", other)):
            times[name] += timed(work, turn)
    one, two = statistics.median(times["ours"]), statistics.median(times["other"])
    return {"ours": one, "other": two, "ratio": two / one, "note": note}


def report(figures: dict[str, dict[str, float | str]], path: Path | None) -> None:
    for name, row in figures.items():
        print(
            f"{name}: ours {row['ours'] * 1e3:.2f} ms, other {row['other'] * 1e3:.2f} ms, "
            f"ratio {row['ratio']:.2f} ({row['note']})"
        )
    if path is not None:
        path.write_text(json.dumps(figures, indent=1), encoding="utf-8")
