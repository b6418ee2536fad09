"""What `live_conv` and a discriminator's step are made of, compiled by numba.

Rows are laid out as `live_conv.Rows` has them: in each the frames of all windows of a channel.
All of it stands in this file, as numba's cache does not see that a function of another file has
changed. A sum of products may be rounded once, which is what the processor does; the order of sums
over time is free where a function says so, as many are made side by side.
"""

from __future__ import annotations

import numpy as np

from gesturekit.compiled import compiled

TAPS = 5
"""Of all kernels; shorter ones have zeros at both ends."""
EDGE = TAPS // 2
GAP = 2 * EDGE
LINE = 16
"""Numbers that a processor loads and stores together; what is made begins with such a lot."""
LEAD = LINE + EDGE
"""Columns before the first frame."""
VECTOR = 8
"""Numbers that most loops make at a time; those over a single row make a line."""
BLOCK = 2048
"""Numbers of a row that are made at a time, so that those of all rows read stay at hand."""
SUMS = frozenset({"contract", "reassoc", "nsz"})
"""What the compiler may do to sums whose order is free."""


@compiled()
def whole(n: int, size: int) -> int:
    """At least n numbers in lots of this size; a loop is slow on those beyond its last lot."""
    return (n + size - 1) // size * size


@compiled(fastmath={"contract"})
def _add_two(
    made: np.ndarray,
    also: np.ndarray,
    signal: np.ndarray,
    weight: np.ndarray,
    reads: np.ndarray,
    apart: int,
    start: int,
    n: int,
    reverse: bool,
) -> None:
    """Add to n numbers of two rows what they see; `start` is two before the first of them."""
    one, two, three, four = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)
    for j in range(len(reads)):
        x = signal[reads[j, 0], start:]
        a = weight[reads[j, 1] :]
        b = weight[reads[j, 1] + apart :]
        a0, a1, a2, a3, a4 = a[0], a[1], a[2], a[3], a[4]
        b0, b1, b2, b3, b4 = b[0], b[1], b[2], b[3], b[4]
        if reverse:
            a0, a1, a3, a4 = a4, a3, a1, a0
            b0, b1, b3, b4 = b4, b3, b1, b0
        for t in range(np.uint64(n)):  # unsigned: numba is slow where an index may be negative
            p, q, r, s, u = x[t], x[t + one], x[t + two], x[t + three], x[t + four]
            made[t] += a0 * p + a1 * q + a2 * r + a3 * s + a4 * u
            also[t] += b0 * p + b1 * q + b2 * r + b3 * s + b4 * u


@compiled(fastmath={"contract"})
def _add_one(
    made: np.ndarray,
    signal: np.ndarray,
    weight: np.ndarray,
    reads: np.ndarray,
    start: int,
    n: int,
    reverse: bool,
) -> None:
    """The same for a row by itself. In a function with `_add_two`, both would be slower."""
    one, two, three, four = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)
    for j in range(len(reads)):
        x = signal[reads[j, 0], start:]
        a = weight[reads[j, 1] :]
        a0, a1, a2, a3, a4 = a[0], a[1], a[2], a[3], a[4]
        if reverse:
            a0, a1, a3, a4 = a4, a3, a1, a0
        for t in range(np.uint64(n)):
            p, q, r, s, u = x[t], x[t + one], x[t + two], x[t + three], x[t + four]
            made[t] += a0 * p + a1 * q + a2 * r + a3 * s + a4 * u


@compiled()
def _mirror(window: np.ndarray, n_frames: int) -> None:
    """Of one window, which begins two before its first frame."""
    for k in range(1, EDGE + 1):
        window[EDGE - k] = window[EDGE + k]
        window[EDGE + n_frames - 1 + k] = window[EDGE + n_frames - 1 - k]


@compiled()
def _fold(window: np.ndarray, n_frames: int) -> None:
    """The transpose of `_mirror`."""
    for k in range(1, EDGE + 1):
        before, after = EDGE - k, EDGE + n_frames - 1 + k
        window[EDGE + k] += window[before]
        window[EDGE + n_frames - 1 - k] += window[after]
        window[before] = window[after] = 0


@compiled()
def pack_rows(windows: np.ndarray, signal: np.ndarray, mirrored: bool) -> None:
    """(B, C, T) into rows; beyond the ends of windows mirrored frames or zeros."""
    batch, channels, n_frames = windows.shape
    signal[:] = 0
    for c in range(channels):
        for b in range(batch):
            row = signal[c, LEAD - EDGE + b * (n_frames + GAP) :]
            for t in range(n_frames):
                row[EDGE + t] = windows[b, c, t]
            if mirrored:
                _mirror(row, n_frames)


@compiled()
def unpack_rows(signal: np.ndarray, windows: np.ndarray) -> None:
    """The frames of rows as (B, C, T)."""
    batch, channels, n_frames = windows.shape
    for c in range(channels):
        for b in range(batch):
            row = signal[c, LEAD + b * (n_frames + GAP) :]
            for t in range(n_frames):
                windows[b, c, t] = row[t]


@compiled()
def mirror_rows(signal: np.ndarray, batch: int, n_frames: int) -> None:
    """Write what lies beyond the ends of windows."""
    for c in range(len(signal)):
        for b in range(batch):
            _mirror(signal[c, LEAD - EDGE + b * (n_frames + GAP) :], n_frames)


@compiled()
def _rectify(window: np.ndarray, gate: np.ndarray, n: int, slope: float) -> None:
    """Scale by the slope where `gate` is not above zero."""
    for t in range(np.uint64(n)):
        value = window[t]
        window[t] = value if gate[t] > 0 else slope * value


@compiled()
def filter_rows(
    steps: np.ndarray,
    reads: np.ndarray,
    signal: np.ndarray,
    weight: np.ndarray,
    bias: np.ndarray,
    made: np.ndarray,
    gate: np.ndarray,
    slope: float,
    batch: int,
    n_frames: int,
    reverse: bool,
) -> None:
    """Rows of `made`: filtered, folded if reverse, rectified, mirrored if not reverse.

    What is rectified is scaled by the slope where `gate` is not above zero; where it has no rows,
    `made` is its own gate. Steps and reads are a `Plan`'s, or some of its steps.
    """
    pitch, begin = n_frames + GAP, LEAD - EDGE
    stop = begin + batch * pitch
    for start in range(begin, stop, BLOCK):
        length = min(BLOCK, stop - start)
        n, n_one = whole(length, VECTOR), whole(length, LINE)
        for i in range(len(steps)):
            row, count, first, last, apart = steps[i]
            for c in range(row, row + count):
                made[c, start : start + n_one] = bias[c]
            here, seen, before = made[row, start:], reads[first:last], start - EDGE
            if count == 2:
                also = made[row + 1, start:]
                _add_two(here, also, signal, weight, seen, apart, before, n, reverse)
            else:
                _add_one(here, signal, weight, seen, before, n_one, reverse)
    for i in range(len(steps)):
        for c in range(steps[i, 0], steps[i, 0] + steps[i, 1]):
            made[c, :begin] = 0
            made[c, stop:] = 0
            for b in range(batch):
                window = made[c, begin + b * pitch :]
                if reverse:
                    _fold(window, n_frames)
                if slope != 1:
                    deciding = gate[c] if len(gate) else made[c]
                    deciding = deciding[begin + b * pitch :]
                    _rectify(window[EDGE:], deciding[EDGE:], n_frames, slope)
                if not reverse:
                    _mirror(window, n_frames)


@compiled(fastmath=SUMS)
def weight_gradients(
    steps: np.ndarray,
    reads: np.ndarray,
    signal: np.ndarray,
    gradient: np.ndarray,
    made: np.ndarray,
    n: int,
) -> None:
    """Sums over n frames of products; beyond the ends of windows the gradient is zero."""
    one, two, three, four = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)
    begin = LEAD - EDGE
    n = whole(n, VECTOR)
    for i in range(len(steps)):
        row, count, first, last, apart = steps[i]
        g, h = gradient[row, begin:], gradient[row + count - 1, begin:]
        for j in range(first, last):
            x = signal[reads[j, 0], begin - EDGE :]
            a0 = a1 = a2 = a3 = a4 = b0 = b1 = b2 = b3 = b4 = np.float32(0)
            for t in range(np.uint64(n)):
                p, q, r, s, u = x[t], x[t + one], x[t + two], x[t + three], x[t + four]
                a0 += g[t] * p
                a1 += g[t] * q
                a2 += g[t] * r
                a3 += g[t] * s
                a4 += g[t] * u
                b0 += h[t] * p
                b1 += h[t] * q
                b2 += h[t] * r
                b3 += h[t] * s
                b4 += h[t] * u
            at = reads[j, 1]
            own = made[at:]
            own[0], own[1], own[2], own[3], own[4] = a0, a1, a2, a3, a4
            if count == 2:
                own = made[at + apart :]
                own[0], own[1], own[2], own[3], own[4] = b0, b1, b2, b3, b4


@compiled(fastmath=SUMS)
def score_rows(
    signal: np.ndarray,
    slopes: np.ndarray,
    seeds: np.ndarray,
    slope: float,
    gradient: np.ndarray,
) -> np.ndarray:
    """Scores without bias, (B,); writes the gradient of their sum weighted by `seeds`.

    Slopes are (1 or B, C, T). The gradient is that of what came before the last rectifier.
    """
    n_frames = slopes.shape[2]
    scores = np.zeros(len(seeds), dtype=np.float32)
    for c in range(len(signal)):
        gradient[c] = 0
        for b in range(len(seeds)):
            start = LEAD + b * (n_frames + GAP)
            x, made = signal[c, start:], gradient[c, start:]
            weights = slopes[min(b, len(slopes) - 1), c]
            total = np.float32(0)
            for t in range(np.uint64(n_frames)):
                total += x[t] * weights[t]
                value = seeds[b] * weights[t]
                made[t] = value if x[t] > 0 else slope * value
            scores[b] += total
    return scores


@compiled(fastmath=SUMS)
def penalty_gradient(
    gradient: np.ndarray,
    batch: int,
    n_frames: int,
    weight: float,
    per_frame: bool,
    scale: float,
) -> None:
    """From the gradient that the penalty is on to that of the penalty, in place.

    The penalty is (scale |g| - 1)^2, the mean over frames or of a window at once; of all windows
    the sum, times `weight`. Where g is zero any direction would do, and none is taken.
    """
    if per_frame:
        weight = weight / n_frames
    factor = np.empty(n_frames, dtype=np.float32)
    for b in range(batch):
        start = LEAD + b * (n_frames + GAP)
        factor[:] = 0
        for c in range(len(gradient)):
            g = gradient[c, start:]
            for t in range(np.uint64(n_frames)):
                factor[t] += g[t] * g[t]
        if not per_frame:
            factor[:] = factor.sum()
        for t in range(n_frames):
            norm = np.sqrt(factor[t])
            factor[t] = 2 * weight * scale * (scale * norm - 1) / norm if norm > 0 else 0
        for c in range(len(gradient)):
            g = gradient[c, start:]
            for t in range(np.uint64(n_frames)):
                g[t] *= factor[t]


@compiled(fastmath=SUMS)
def sums_over_time(signal: np.ndarray, seeds: np.ndarray, often: np.ndarray) -> np.ndarray:
    """(B, C, K): sums over time by each of `often`, (K, T), times the window's seed."""
    taps, n_frames = often.shape
    made = np.empty((len(seeds), len(signal), taps), dtype=np.float32)
    for b in range(len(seeds)):
        for c in range(len(signal)):
            x = signal[c, LEAD + b * (n_frames + GAP) :]
            for k in range(taps):
                weights = often[k]
                total = np.float32(0)
                for t in range(np.uint64(n_frames)):
                    total += x[t] * weights[t]
                made[b, c, k] = seeds[b] * total
    return made
