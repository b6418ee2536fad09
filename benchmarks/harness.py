"""Shared parts of all benchmarks: the flags, medians of interleaved runs, and the JSON."""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path


def common_options(description: str) -> argparse.ArgumentParser:
    """Return a parser with the options that every benchmark has."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--quick", action="store_true", help="under 60 s on 2 cores")
    parser.add_argument("--json", type=Path, help="write the figures here as well")
    return parser


def arguments(description: str, *, takes_device: bool = False) -> argparse.Namespace:
    parser = common_options(description)
    if takes_device:
        parser.add_argument("--device", default="cpu", help="cpu (default), cuda, cuda:1 ...")
    return parser.parse_args()


def wait_for_gpu() -> None:
    """Wait for what a GPU has been given to do: calls return before it is done."""
    torch = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_initialized():
        torch.cuda.synchronize()


def timed(work: Callable[[], object], runs: int) -> list[float]:
    """Seconds of each of some runs with nothing between them."""
    times = []
    for _ in range(runs):
        wait_for_gpu()
        start = time.perf_counter()
        work()
        wait_for_gpu()
        times.append(time.perf_counter() - start)
    return times


def gpu_peak(work: Callable[[], object]) -> str:
    """ ", N MiB of GPU memory" at the peak of some work, that of weights included; "" on a CPU."""
    import torch

    if not torch.cuda.is_initialized():
        return ""
    wait_for_gpu()
    torch.cuda.reset_peak_memory_stats()
    work()
    wait_for_gpu()
    return f", {torch.cuda.max_memory_allocated() / 2**20:.0f} MiB of GPU memory"


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
    """Print figures and write them as JSON; values without a `unit` are seconds."""
    for name, row in figures.items():
        scale, unit = (1, row["unit"]) if "unit" in row else (1e3, "ms")
        print(
            f"{name}: ours {row['ours'] * scale:.2f} {unit}, "
            f"other {row['other'] * scale:.2f} {unit}, ratio {row['ratio']:.2f} ({row['note']})"
        )
    if path is not None:
        path.write_text(json.dumps(figures, indent=1), encoding="utf-8")


def with_children(pid: int) -> list[int]:
    """The process and all below it (Linux)."""
    try:
        own = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:
        return []
    return [pid, *(p for child in own for p in with_children(int(child)))]
