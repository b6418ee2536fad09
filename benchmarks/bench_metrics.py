"""Coverage, global and local diversity, compared with a direct computation over all window pairs.

742 generated and 371 reference frames of 168 columns: one sample of GANimator's published
evaluation. "other" sums the cost of every segment of one motion for every segment of the other, as
the published kernel does (compiled too, with its 1.6 GB table allocated beforehand); that kernel
took 870 ms for the three metrics once its table was in memory. Also prints the peak memory for
5,500 frames and 5,500.
"""

from __future__ import annotations

import resource
import statistics
import time

import numpy as np
from harness import arguments, compare, report, timed
from numba import njit

from gesturekit.evaluation import coverage, global_diversity, local_diversity, patch_scores

L, N, WIDTH = 742, 371, 168


@njit(cache=True)
def fill(table: np.ndarray, distances: np.ndarray) -> None:
    """table[i, j, k]: rows i to j - 1 of `distances` along the diagonal from column k."""
    n_rows, n_columns = distances.shape
    for i in range(n_rows):
        table[i, i] = 0.0
        for j in range(i + 1, n_rows + 1):
            for k in range(n_columns - (j - i - 1)):
                table[i, j, k] = table[i, j - 1, k] + distances[j - 1, k + j - i - 1]


@njit(cache=True)
def best_segments(table: np.ndarray, shortest: int) -> float:
    n_rows, n_columns = table.shape[0], table.shape[2]
    best = np.full(n_rows + 1, np.inf)
    best[0] = 0.0
    for i in range(shortest, n_rows + 1):
        for k in range(n_columns):
            for j in range(i - shortest + 1):
                best[i] = min(best[i], best[j] + table[j, i, k])
    return best[n_rows]


@njit(cache=True)
def nearest_windows(table: np.ndarray, window: int) -> np.ndarray:
    n = table.shape[0] - window
    nearest = np.empty(n)
    for i in range(n):
        nearest[i] = table[i, i + window].min() / window
    return nearest


def walk(rng: np.random.Generator, n_frames: int) -> np.ndarray:
    """Frames that wander like motion: neighbours are near, the whole does not drift away."""
    frames = np.zeros((n_frames, WIDTH))
    for k in range(1, n_frames):
        frames[k] = 0.97 * frames[k - 1] + 0.06 * rng.standard_normal(WIDTH)
    return frames


def main() -> None:
    options = arguments(__doc__.splitlines()[0])
    rng = np.random.default_rng(0)
    large = walk(rng, 5500), walk(rng, 5500)
    start = time.perf_counter()
    patch_scores(*large)
    took = time.perf_counter() - start
    # First of all, as the table below takes more than this process ever did before.
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(f"5,500 × 5,500 frames, compiling included: {took:.2f} s, {peak:.2f} GB at the peak")

    generated, reference = walk(rng, L), walk(rng, N)
    one_way = np.full((L, L + 1, N), np.inf)
    other_way = np.full((N, N + 1, L), np.inf)

    def ours() -> tuple[float, float, float]:
        return (
            coverage(generated, reference),
            global_diversity(generated, reference),
            local_diversity(generated, reference),
        )

    def at_once() -> tuple[float, float, float]:
        scores = patch_scores(generated, reference)
        return scores.coverage, scores.global_diversity, scores.local_diversity

    def other() -> tuple[float, float, float]:
        distances = np.linalg.norm(generated[:, None] - reference, axis=-1)
        fill(one_way, distances)
        fill(other_way, np.ascontiguousarray(distances.T))
        covered = (nearest_windows(other_way, 30) < 2.0).mean()
        return covered, best_segments(one_way, 30) / L, nearest_windows(one_way, 15).mean()

    np.testing.assert_allclose(ours(), other(), rtol=1e-6)
    np.testing.assert_allclose(at_once(), other(), rtol=1e-6)
    for name, work in (("three calls", ours), ("one call", at_once)):
        print(f"{name}, one after the other: {1e3 * statistics.median(timed(work, 50)):.2f} ms")
    runs = 3 if options.quick else 15
    note = "742 × 371 × 168; other: all window pairs"
    figures = {
        "patch_metrics": compare(ours, other, runs, f"{note}; three calls"),
        "patch_scores": compare(at_once, other, runs, f"{note}; one call"),
    }
    report(figures, options.json)


if __name__ == "__main__":
    main()
