"""Steps of a live stream: 40 ms of sound in, the frames that they complete out, on one thread.

"other" is the length of the block, so that the ratio says how much faster than real time a step is.
The notes give the quantiles of a step, the latency, and the time from the loaded model to the first
frame. `gesturekit live --measure` measures the whole command, sinks included.
"""

from __future__ import annotations

import time

import numpy as np
import torch
from harness import arguments, report

import audio_features as af
import gesturekit as gk
from gesturekit.systems import bundled_speech

BLOCK = 0.04


def main() -> None:
    options = arguments("Steps of a live stream.")
    torch.set_num_threads(1)
    model = gk.load("demo")
    wave = af.Wave.load(bundled_speech())
    block = round(BLOCK * wave.sample_rate)
    blocks = np.split(wave.samples, range(block, len(wave.samples), block))
    figures = {}
    for look_ahead in (0.2,) if options.quick else (0.0, 0.1, 0.2, 0.4):
        begun = time.perf_counter()
        stream, first, times = model.stream(wave.sample_rate, look_ahead), None, []
        for _ in range(1 if options.quick else 4):
            for samples in blocks:
                start = time.perf_counter()
                motion = stream.step(samples)
                times.append(time.perf_counter() - start)
                if motion is not None and first is None:
                    first = time.perf_counter() - begun
        median, p95, worst = np.quantile(times[25:], (0.5, 0.95, 1.0))
        figures[f"look-ahead {look_ahead:g} s"] = {
            "ours": float(median),
            "other": BLOCK,
            "ratio": BLOCK / float(median),
            "note": f"p95 {1e3 * p95:.1f} ms, most {1e3 * worst:.1f} ms, "
            f"latency {stream.latency:.3f} s, first frame after {first:.2f} s",
        }
    report(figures, options.json)


if __name__ == "__main__":
    main()
