"""Rendering a minute of speech to BVH, compared with real time: in process and as a new process.

Also 10 s of speech by the first command after an installation, with empty caches. The speech is the
bundled recording, repeated with varying loudness. "other" is the duration of the speech, so the
ratio is the real-time factor.

`--device cuda` renders many sounds of 10 s instead, with a diffusion model of the published size,
in 100 and in 12 steps; "other" is the duration of all sounds. The weights are those after one
update: the cost does not depend on them.
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
from harness import arguments, gpu_peak, report, timed

import audio_features as af
import gesturekit as gk
from gesturekit.corpus import prepare
from gesturekit.systems import bundled_speech

SECONDS = 60.0
CLIP, FEW = 10.0, 12
RECIPE = Path(__file__).resolve().parents[1] / "recipes/diffusion_speech/config.yaml"


def main() -> None:
    options = arguments(__doc__.splitlines()[0], takes_device=True)
    if options.device != "cpu":
        report(many(options.device, 8 if options.quick else 64), options.json)
        return
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


def many(device: str, count: int) -> dict[str, dict[str, float | str]]:
    """Seconds to render many sounds, by one process and by two."""
    figures = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        model = gk.load(_trained(folder, device), device=device)
        sounds = _sounds(folder / "sounds", count)
        for steps in (None, FEW):
            for workers in (1, 2):
                out = folder / f"{steps}_{workers}"

                def work(out=out, steps=steps, workers=workers) -> None:
                    made = gk.render(
                        model, sounds, out, steps=steps, workers=workers, existing="replace"
                    )
                    assert all(outcome.error is None for outcome in made)

                model.generate(sounds[0], steps=steps)
                (spent,) = timed(work, 1)
                same = all(
                    path.read_bytes() == (folder / f"{steps}_1" / path.name).read_bytes()
                    for path in out.glob("*.bvh")
                )
                figures[f"render_many_{steps or 100}_{workers}"] = {
                    "ours": spent,
                    "other": count * CLIP,
                    "ratio": count * CLIP / spent,
                    "note": f"{count} sounds of {CLIP:g} s, {steps or 100} steps, {workers} "
                    f"process(es){', same bytes as one' * same * (workers > 1)}"
                    f"{gpu_peak(lambda s=steps: model.generate(sounds[0], steps=s))}; "
                    "other: real time",
                }
    return figures


def _trained(folder: Path, device: str) -> Path:
    """A diffusion model of the published size, after one update."""
    (take,) = _sounds(folder / "takes", 1)
    gk.load("demo").generate(take).save(take.with_suffix(".bvh"))
    prepare([folder / "takes"], folder / "corpus.jsonl", holdout=0.0)
    return gk.train(
        RECIPE,
        corpus=str(folder / "corpus.jsonl"),
        out=str(folder / "run"),
        device=device,
        styles=None,
        training={"updates": 1, "batch": 1},
    )


def _sounds(folder: Path, count: int) -> list[Path]:
    """Sounds of 10 s of the bundled recording, each of another loudness."""
    spoken = af.Wave.load(bundled_speech())
    samples = np.resize(spoken.samples, round(CLIP * spoken.sample_rate))
    folder.mkdir()
    paths = [folder / f"{k:03}.wav" for k in range(count)]
    for k, path in enumerate(paths):
        soundfile.write(path, samples * (0.5 + 0.5 * k / count), spoken.sample_rate)
    return paths


if __name__ == "__main__":
    main()
