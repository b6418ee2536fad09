"""Rendering a minute of speech to BVH, compared with real time: in process and as a new process.

Also 10 s of speech by the first command after an installation, with empty caches. The speech is the
bundled recording, repeated with varying loudness. "other" is the duration of the speech, so the
ratio is the real-time factor.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import soundfile
from harness import arguments, report, timed

import audio_features as af
import gesturekit as gk
from gesturekit.systems import bundled_speech

SECONDS = 60.0


def main() -> None:
    options = arguments(__doc__.splitlines()[0])
    runs = 3 if options.quick else 10
    spoken = af.Wave.load(bundled_speech())
    wanted = round(SECONDS * spoken.sample_rate)
    again = np.resize(spoken.samples, wanted)
    loudness = 0.7 + 0.3 * np.sin(np.arange(wanted) / spoken.sample_rate)
    with tempfile.TemporaryDirectory() as folder:
        wav, bvh = Path(folder) / "minute.wav", Path(folder) / "minute.bvh"
        soundfile.write(wav, again * loudness, spoken.sample_rate)
        model = gk.load("demo")
        model.generate(wav).save(bvh)

        warm = statistics.median(timed(lambda: model.generate(wav).save(bvh), runs))
        command = [sys.executable, "-m", "gesturekit", "render", str(wav)]
        command += ["--model", "demo", "--out", folder, "--existing", "replace"]
        cold = statistics.median(
            timed(lambda: subprocess.run(command, check=True, capture_output=True), runs)
        )
        short = Path(folder) / "short.wav"
        soundfile.write(short, (again * loudness)[: 10 * spoken.sample_rate], spoken.sample_rate)
        caches = {"NUMBA_CACHE_DIR": folder, "GESTUREKIT_CACHE": folder}
        command[command.index(str(wav))] = str(short)
        (first,) = timed(
            lambda: subprocess.run(
                command, check=True, capture_output=True, env={**os.environ, **caches}
            ),
            1,
        )
    figures = {
        "render_in_process": {
            "ours": warm,
            "other": SECONDS,
            "ratio": SECONDS / warm,
            "note": "60 s of speech to BVH; other: real time",
        },
        "render_cold_command": {
            "ours": cold,
            "other": SECONDS,
            "ratio": SECONDS / cold,
            "note": "the same by `gesturekit render`, imports included; other: real time",
        },
        "render_first_command": {
            "ours": first,
            "other": 10.0,
            "ratio": 10.0 / first,
            "note": "10 s of speech by `gesturekit render`, all caches empty; other: real time",
        },
    }
    report(figures, options.json)


if __name__ == "__main__":
    main()
