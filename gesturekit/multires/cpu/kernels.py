"""Compiled kernels of the CPU engine.

Signals are (C, width) float32 arrays: each channel's windows stand one after another, as
`engine.Packing` lays them out. All kernels are in this file, as numba's cache does not notice
that a function in another file has changed. "contract" allows fused multiply-adds; `SUMS` also
allows any order of the sums over time, which vectorises them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gesturekit.compiled import compiled

TAPS = 5
"""Kernel size of all convolutions; shorter kernels are padded with zeros at both ends."""
PADDING = TAPS // 2
"""Columns before and after each window, for reflected frames or zeros."""
LINE = 16
"""Floats in a cache line; packed windows start at a multiple of it."""
START = LINE + PADDING
"""Column of the first frame."""
VECTOR = 8
"""Multiple that loops over two channels are rounded up to; those over one are rounded to LINE."""
TILE = 2048
"""Columns computed at a time, so that the tiles of all input channels stay in the cache."""
SUMS = frozenset({"contract", "reassoc", "nsz"})
"""LLVM fast-math flags of kernels that sum over time."""


class Plan(NamedTuple):
    """Connections of a sparse convolution, in the order in which output channels are computed.

    Attributes:
        steps: (S, 5) int64, one or two output channels each: the first channel, their number, the
            first and the last + 1 of their `inputs`, and the distance in the weights between the
            two channels' kernels.
        inputs: (N, 2) int64: an input channel, and the position of its kernel in the weights.
    """

    steps: np.ndarray
    inputs: np.ndarray


Shape = tuple[int, int]
"""Number of the packed windows, and frames of each."""
Rectifier = tuple[np.floating, np.ndarray]
"""Leaky rectifier after a convolution: slope of negative values, 1 for none, and array (C, width)
by which it scales where that is not above 0; (0, width) for the output itself."""


@compiled()
def round_up(n: int, multiple: int) -> int:
    """Return n rounded up, so that a vectorised loop has no slow remainder."""
    return (n + multiple - 1) // multiple * multiple


@compiled(fastmath={"contract"})
def _accumulate_pair(
    outputs: tuple[np.ndarray, np.ndarray],
    signal: np.ndarray,
    weight: np.ndarray,
    inputs: np.ndarray,
    distance: int,
    start: int,
    n: int,
    reverse: bool,
) -> None:
    """Add the convolution of `inputs` (M, 2; see `Plan`) to n columns of two output channels.

    `signal` (C, width) is read from column `start`, PADDING before the first output. `weight` (N,)
    holds kernels of TAPS numbers, `distance` apart for the two channels. `reverse` applies the taps
    in reverse order, for the gradient.
    """
    one, two, three, four = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)
    first, second = outputs
    for j in range(len(inputs)):
        x = signal[inputs[j, 0], start:]
        a = weight[inputs[j, 1] :]
        b = weight[inputs[j, 1] + distance :]
        a0, a1, a2, a3, a4 = a[0], a[1], a[2], a[3], a[4]
        b0, b1, b2, b3, b4 = b[0], b[1], b[2], b[3], b[4]
        if reverse:
            a0, a1, a3, a4 = a4, a3, a1, a0
            b0, b1, b3, b4 = b4, b3, b1, b0
        for t in range(np.uint64(n)):  # unsigned: numba is slow where an index may be negative
            p, q, r, s, u = x[t], x[t + one], x[t + two], x[t + three], x[t + four]
            first[t] += a0 * p + a1 * q + a2 * r + a3 * s + a4 * u
            second[t] += b0 * p + b1 * q + b2 * r + b3 * s + b4 * u


@compiled(fastmath={"contract"})
def _accumulate_single(
    output: np.ndarray,
    signal: np.ndarray,
    weight: np.ndarray,
    inputs: np.ndarray,
    start: int,
    n: int,
    reverse: bool,
) -> None:
    """Do the same for one output channel; as one function with the pair both would be slower."""
    one, two, three, four = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)
    for j in range(len(inputs)):
        x = signal[inputs[j, 0], start:]
        a = weight[inputs[j, 1] :]
        a0, a1, a2, a3, a4 = a[0], a[1], a[2], a[3], a[4]
        if reverse:
            a0, a1, a3, a4 = a4, a3, a1, a0
        for t in range(np.uint64(n)):
            p, q, r, s, u = x[t], x[t + one], x[t + two], x[t + three], x[t + four]
            output[t] += a0 * p + a1 * q + a2 * r + a3 * s + a4 * u


@compiled()
def _reflect(window: np.ndarray, n_frames: int) -> None:
    """Write the reflected frames of one window, which starts PADDING before its first frame."""
    for k in range(1, PADDING + 1):
        window[PADDING - k] = window[PADDING + k]
        window[PADDING + n_frames - 1 + k] = window[PADDING + n_frames - 1 - k]


@compiled()
def _fold(window: np.ndarray, n_frames: int) -> None:
    """Apply the transpose of `_reflect`."""
    for k in range(1, PADDING + 1):
        before, after = PADDING - k, PADDING + n_frames - 1 + k
        window[PADDING + k] += window[before]
        window[PADDING + n_frames - 1 - k] += window[after]
        window[before] = window[after] = 0


@compiled()
def reflect_windows(signal: np.ndarray, shape: Shape) -> None:
    """Write the reflected frames of all windows of a signal (C, width)."""
    batch, n_frames = shape
    for c in range(len(signal)):
        for b in range(batch):
            _reflect(signal[c, START - PADDING + b * (n_frames + 2 * PADDING) :], n_frames)


@compiled()
def _rectify(window: np.ndarray, gate: np.ndarray, n: int, slope: float) -> None:
    """Scale n frames of a window (>= n,) by the slope where `gate` (>= n,) is not above zero."""
    for t in range(np.uint64(n)):
        value = window[t]
        window[t] = value if gate[t] > 0 else slope * value


@compiled()
def convolve(
    plan: Plan,
    signal: np.ndarray,
    weight: np.ndarray,
    bias: np.ndarray,
    output: np.ndarray,
    rectifier: Rectifier,
    shape: Shape,
    reverse: bool,
) -> None:
    """Compute the output channels of a plan: convolution, rectifier, reflected ends.

    Args:
        plan: all steps of a convolution, or some of them.
        signal: (C_in, width), padded by reflection, or by zeros with `reverse`.
        weight: (N,) kernels of TAPS numbers.
        bias: (C_out,).
        output: (C_out, width), written.
        rectifier: applied to the output.
        shape: of the windows.
        reverse: compute the transpose: kernels are reversed, and the gradient of reflected frames
            is added to the frames that they repeat.
    """
    steps, inputs = plan
    slope, gate = rectifier
    batch, n_frames = shape
    pitch, begin = n_frames + 2 * PADDING, START - PADDING
    stop = begin + batch * pitch
    for start in range(begin, stop, TILE):
        length = min(TILE, stop - start)
        n, n_single = round_up(length, VECTOR), round_up(length, LINE)
        for i in range(len(steps)):
            channel, count, first, last, distance = steps[i]
            for c in range(channel, channel + count):
                output[c, start : start + n_single] = bias[c]
            own, seen, before = output[channel, start:], inputs[first:last], start - PADDING
            if count == 2:
                pair = (own, output[channel + 1, start:])
                _accumulate_pair(pair, signal, weight, seen, distance, before, n, reverse)
            else:
                _accumulate_single(own, signal, weight, seen, before, n_single, reverse)
    for i in range(len(steps)):
        for c in range(steps[i, 0], steps[i, 0] + steps[i, 1]):
            output[c, :begin] = 0
            output[c, stop:] = 0
            for b in range(batch):
                window = output[c, begin + b * pitch :]
                if reverse:
                    _fold(window, n_frames)
                if slope != 1:
                    decides = gate[c] if len(gate) else output[c]
                    decides = decides[begin + b * pitch :]
                    _rectify(window[PADDING:], decides[PADDING:], n_frames, slope)
                if not reverse:
                    _reflect(window, n_frames)


@compiled(fastmath=SUMS)
def weight_gradients(
    plan: Plan, signal: np.ndarray, gradient: np.ndarray, output: np.ndarray, n: int
) -> None:
    """Compute the gradients of a plan's weights.

    Args:
        plan: all steps of a convolution, or some of them.
        signal: (C_in, width), its input, padded by reflection.
        gradient: (C_out, width), of its output, padded by zeros.
        output: (N,), written.
        n: columns of all windows.
    """
    steps, inputs = plan
    one, two, three, four = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)
    begin = START - PADDING
    n = round_up(n, VECTOR)
    for i in range(len(steps)):
        channel, count, first, last, distance = steps[i]
        g, h = gradient[channel, begin:], gradient[channel + count - 1, begin:]
        for j in range(first, last):
            x = signal[inputs[j, 0], begin - PADDING :]
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
            at = inputs[j, 1]
            own = output[at:]
            own[0], own[1], own[2], own[3], own[4] = a0, a1, a2, a3, a4
            if count == 2:
                own = output[at + distance :]
                own[0], own[1], own[2], own[3], own[4] = b0, b1, b2, b3, b4


@compiled(fastmath=SUMS)
def score(
    features: np.ndarray,
    weights: np.ndarray,
    score_gradients: np.ndarray,
    slope: float,
    gradient: np.ndarray,
) -> np.ndarray:
    """Return the score of each window without bias, (B,), and write the gradient of the features.

    Args:
        features: (C, width), output of the last layer's rectifier.
        weights: (1 or B, C, T), see `LevelDiscriminator.score_weights`.
        score_gradients: (B,) gradient of the loss with respect to each score.
        slope: negative slope of the last rectifier.
        gradient: (C, width), written: the gradient of the last rectifier's input, zero-padded.
    """
    n_frames = weights.shape[2]
    scores = np.zeros(len(score_gradients), dtype=np.float32)
    for c in range(len(features)):
        gradient[c] = 0
        for b in range(len(score_gradients)):
            start = START + b * (n_frames + 2 * PADDING)
            x, own = features[c, start:], gradient[c, start:]
            weight = weights[min(b, len(weights) - 1), c]
            total = np.float32(0)
            for t in range(np.uint64(n_frames)):
                total += x[t] * weight[t]
                value = score_gradients[b] * weight[t]
                own[t] = value if x[t] > 0 else slope * value
            scores[b] += total
    return scores


@compiled(fastmath=SUMS)
def penalty_gradient(
    gradient: np.ndarray, shape: Shape, weight: float, per_frame: bool, scale: float
) -> None:
    """Replace the input gradients g of scores by the derivative of eq. 13 with respect to them.

    The penalty is `weight` times the sum over windows of (scale ||g|| - 1)^2, or of its mean over
    frames. Where g is zero the derivative is taken as zero.

    Args:
        gradient: (D, width), overwritten.
        shape: of the windows.
        weight: see above.
        per_frame: take the norm of each frame instead of that of a window.
        scale: see above.
    """
    batch, n_frames = shape
    if per_frame:
        weight = weight / n_frames
    factor = np.empty(n_frames, dtype=np.float32)
    for b in range(batch):
        start = START + b * (n_frames + 2 * PADDING)
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
def score_kernel_gradients(
    features: np.ndarray, score_gradients: np.ndarray, tap_frequencies: np.ndarray
) -> np.ndarray:
    """Return the gradient of the score's kernel from each window, (B, C, taps).

    Args:
        features: (C, width).
        score_gradients: (B,) gradient of the loss with respect to each score.
        tap_frequencies: (taps, T), see `discriminator.tap_frequencies`.
    """
    taps, n_frames = tap_frequencies.shape
    made = np.empty((len(score_gradients), len(features), taps), dtype=np.float32)
    for b in range(len(score_gradients)):
        for c in range(len(features)):
            x = features[c, START + b * (n_frames + 2 * PADDING) :]
            for k in range(taps):
                weights = tap_frequencies[k]
                total = np.float32(0)
                for t in range(np.uint64(n_frames)):
                    total += x[t] * weights[t]
                made[b, c, k] = score_gradients[b] * total
    return made
