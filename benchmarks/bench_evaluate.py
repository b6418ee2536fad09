"""Evaluation of three models, five samples of each of 200 recordings of 10 s, and a rerun.

Motion and speech are made on the spot: band-limited random rotations of the demo's rig, and cuts of
the bundled speech at random loudness. "ours" is the first evaluation of three models; "other" is
the rerun with a fourth model, which measures that one alone. Also prints the peak memory of all
processes together.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import soundfile
from harness import arguments, report, with_children
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

import audio_features as af
import gesturekit as gk
from gesturekit.motion import Motion, Skeleton
from gesturekit.systems import bundled_speech

SECONDS, FPS, SAMPLES = 10.0, 30.0, 5


def random_motion(skeleton: Skeleton, reach: float, seed: int) -> Motion:
    """Return 10 s of band-limited random rotations; arms move most."""
    rng = np.random.default_rng(seed)
    n = round(SECONDS * FPS)
    turn = gaussian_filter1d(rng.standard_normal((n, skeleton.n_joints, 3)), 8, axis=0)
    arms = [any(part in name for part in ("Arm", "Hand")) for name in skeleton.names]
    turn *= np.where(arms, 2.5 * reach, 0.4 * reach)[:, None]
    angles = turn.reshape(-1, 3)
    rotations = Rotation.from_rotvec(angles).as_quat().reshape(n, skeleton.n_joints, 4)
    place = np.cumsum(rng.normal(0.0, 1e-3, (n, 3)), axis=0) * (1.0, 0.0, 1.0) + (0.0, 0.95, 0.0)
    return Motion(skeleton, rotations, place, FPS)


def write_models(folder: Path, recordings: int, models: int) -> None:
    """Write recordings with sound, and the samples of each model."""
    skeleton = gk.load("demo").skeleton
    speech = af.Wave.load(bundled_speech())
    length = round(SECONDS * speech.sample_rate)
    for name in ("recordings", *(f"model{k}" for k in range(models))):
        (folder / name).mkdir()
    for i in range(recordings):
        rng = np.random.default_rng(i)
        start = rng.integers(0, len(speech.samples))
        samples = np.roll(speech.samples, -start)[:length] * rng.uniform(0.3, 1.0)
        path = folder / "recordings" / f"clip{i:03d}"
        soundfile.write(path.with_suffix(".wav"), samples, speech.sample_rate)
        random_motion(skeleton, 1.0, 1000 * i).save(path.with_suffix(".npz"))
        for k in range(models):
            for s in range(1, SAMPLES + 1):
                motion = random_motion(skeleton, 0.7 + 0.1 * k, 1000 * i + 10 * k + s)
                motion.save(folder / f"model{k}" / f"clip{i:03d}_s{s}.npz")


def evaluated(folder: Path, models: int) -> tuple[float, float]:
    """Evaluate models by the command; return seconds and the peak of all its processes, GB."""
    command = [sys.executable, "-m", "gesturekit", "evaluate", str(folder / "model0")]
    command += [str(folder / "recordings"), "--audio", str(folder / "recordings")]
    for k in range(1, models):
        command += ["--compare", str(folder / f"model{k}")]
    command += ["--out", str(folder / "report.html"), "--json", str(folder / "report.json")]
    start = time.perf_counter()
    process = subprocess.Popen(
        command,
        env={**os.environ, "GESTUREKIT_CACHE": str(folder / "cache")},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    peak = [0.0]
    watch = threading.Thread(target=_watch, args=(process, peak), daemon=True)
    watch.start()
    if process.wait() != 0:
        raise SystemExit(f"gesturekit evaluate ended with {process.returncode}")
    return time.perf_counter() - start, peak[0]


def _watch(process: subprocess.Popen[bytes], peak: list[float]) -> None:
    while process.poll() is None:
        peak[0] = max(peak[0], sum(map(_memory, with_children(process.pid))) / 1e9)
        time.sleep(0.5)


def _memory(pid: int) -> int:
    """Return the proportional set size of a process, bytes: shared pages count once."""
    try:
        text = Path(f"/proc/{pid}/smaps_rollup").read_text()
    except OSError:
        return 0
    return sum(1024 * int(line.split()[1]) for line in text.splitlines() if line[:4] == "Pss:")


def main() -> None:
    options = arguments(__doc__.splitlines()[0])
    recordings = 10 if options.quick else 200
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_models(folder, recordings, 4)
        first, peak = evaluated(folder, 3)
        again, _ = evaluated(folder, 4)
    print(f"peak memory of all processes: {peak:.2f} GB")
    note = f"{recordings} recordings x {SAMPLES} samples x 3 models; other: a fourth model added"
    figures = {"ours": first, "other": again, "ratio": again / first, "note": note}
    report({"evaluate": figures}, options.json)


if __name__ == "__main__":
    main()
