"""Distances between all frames of two motions, and their sums along diagonals.

The distance of two windows of w frames is a sum over w entries of a diagonal of the matrix of frame
distances. Sums are never computed as differences of longer sums, so that equal windows have
distance exactly 0. Compiled by numba, O(L N) time and memory.
"""

from __future__ import annotations

import numpy as np

from gesturekit.compiled import compiled

# Squared distances below this fraction of the squared lengths are recomputed from the frames, as
# |a|² + |b|² - 2ab loses digits there. All others have a relative error below about 1e-9.
_NEAR = 1e-6
_ROWS = 64  # at a time: in cache, and no second matrix in memory
_BOUND_ERROR = 1e-6  # relative; far above that of `frame_distances`


def frame_distances(a: np.ndarray, b: np.ndarray, *, squared: bool = False) -> np.ndarray:
    """Return (L, N) Euclidean distances of the rows of `a` (L, D) and `b` (N, D), float64.

    Relative error below 1e-8; equal rows have distance exactly 0.
    """
    from scipy.spatial.distance import cdist

    centre = b.mean(axis=0)  # smaller numbers cancel; distances stay the same
    left, right = a - centre, b - centre
    left_squares, right_squares = (np.einsum("ij,ij->i", side, side) for side in (left, right))
    distances = left @ right.T
    for at in range(0, len(a), _ROWS):
        block = distances[at : at + _ROWS]
        sizes = left_squares[at : at + _ROWS, None] + right_squares
        np.subtract(sizes, 2.0 * block, out=block)
        near = block < _NEAR * sizes
        for i in np.flatnonzero(near.any(axis=1)):
            block[i, near[i]] = cdist(a[at + i, None], b[near[i]], "sqeuclidean")[0]
    return distances if squared else np.sqrt(distances, out=distances)


@compiled()
def lower_to_nearest(nearest: np.ndarray, bounds: np.ndarray, a: np.ndarray, b: np.ndarray) -> None:
    """Lower `nearest` (L,) to the distances of the rows of `a` (L, D) from their nearest rows of
    `b`.

    Only distances are computed whose lower bound, `bounds` (L, N), is below the nearest so far;
    bounds may be too large by their rounding errors.
    """
    for i in range(bounds.shape[0]):
        least = bounds[i].argmin()  # most likely the nearest: then all others are left out
        for step in range(bounds.shape[1] + 1):
            j = least if step == 0 else step - 1
            if bounds[i, j] * (1.0 - _BOUND_ERROR) < nearest[i]:
                total = 0.0
                for k in range(a.shape[1]):
                    total += (a[i, k] - b[j, k]) ** 2
                nearest[i] = min(nearest[i], np.sqrt(total))


@compiled()
def _sum_windows(
    start: int, distances: np.ndarray, ends: np.ndarray, begins: np.ndarray, sums: np.ndarray
) -> None:
    """Set sums[j] (N - w + 1) to the sum of distances[start + t, j + t] over t < w.

    Called with start = 0, 1, 2 ... Rows of `distances` (L, N) are cut into blocks of w; a window is
    the end of one block, summed in `ends` (w, N), and the beginning of the next, in `begins` (N +
    w) by diagonal. Both are state between calls.
    """
    width, n_columns = ends.shape
    into = start % width
    if into == 0:
        last = start + width - 1
        ends[width - 1] = distances[last]
        for up in range(1, width):
            # Views, because numba is slow if it cannot infer that an index is not negative.
            row, above, below = distances[last - up], ends[width - 1 - up], ends[width - up, 1:]
            for column in range(n_columns - up):
                above[column] = row[column] + below[column]
        begins[:] = 0.0
        sums[:] = ends[0, : len(sums)]
        return
    row, begun = distances[start + width - 1], begins[width - into :]
    for column in range(n_columns):
        begun[column] += row[column]
    ending = begun[width - 1 :]
    for column in range(len(sums)):
        sums[column] = ends[into, column] + ending[column]


@compiled()
def _memory(n_columns: int, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return (
        np.empty((width, n_columns)),
        np.empty(n_columns + width),
        np.empty(n_columns - width + 1),
    )


@compiled()
def window_sums(distances: np.ndarray, width: int) -> np.ndarray:
    """Return (L - w + 1, N - w + 1) sums of distances[i + t, j + t] over t < w.

    Args:
        distances: (L, N).
        width: w.
    """
    n_rows, n_columns = distances.shape
    ends, begins, _ = _memory(n_columns, width)
    sums = np.empty((n_rows - width + 1, n_columns - width + 1))
    for start in range(len(sums)):
        _sum_windows(start, distances, ends, begins, sums[start])
    return sums


@compiled()
def least_window_sums(distances: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the minima of `window_sums` over columns (L - w + 1,) and over rows (N - w + 1,)."""
    n_rows, n_columns = distances.shape
    ends, begins, sums = _memory(n_columns, width)
    of_rows = np.empty(n_rows - width + 1)
    of_columns = np.full(len(sums), np.inf)
    for start in range(len(of_rows)):
        _sum_windows(start, distances, ends, begins, sums)
        of_rows[start] = sums.min()
        np.minimum(of_columns, sums, of_columns)
    return of_rows, of_columns


@compiled()
def segmentation_cost(distances: np.ndarray, shortest: int) -> float:
    """Return the least sum of distances (L, N) over all segmentations of the rows into diagonals.

    Segments are consecutive, at least `shortest` rows long and inside the matrix; the first column
    of each is free. Infinite if there is no such segmentation.
    """
    n_rows, n_columns = distances.shape
    ends, begins, sums = _memory(n_columns, shortest)
    best = np.full(n_rows + 1, np.inf)  # least cost of the first i rows
    best[0] = 0.0
    # By diagonal: least cost of the rows so far if the last segment runs along this diagonal and
    # is long enough to end.
    running = np.full(n_rows + n_columns, np.inf)
    for start in range(n_rows - shortest + 1):
        _sum_windows(start, distances, ends, begins, sums)
        row = distances[start + shortest - 1, shortest - 1 :]
        along = running[n_rows - start :]
        before = best[start]
        least = np.inf
        for column in range(len(sums)):
            cost = min(along[column] + row[column], before + sums[column])
            along[column] = cost
            least = min(least, cost)
        best[start + shortest] = least
    return float(best[n_rows])
