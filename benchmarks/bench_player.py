"""Frames of the HTML player on a software renderer, compared with those that are wanted.

Ten minutes of speech with 72 joints at 30 fps, 1280 x 720, headless Chromium on SwiftShader,
playing with sound. "Other" is the longest time a frame may take: a ratio above 1 is faster. The
notes give the processor time of all processes of the browser, which other work changes less.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from bench_video import with_fingers
from harness import arguments, report

import audio_features as af
import gesturekit as gk
from gesturekit.viewer import write_html

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "builders"))
from chromium import Browser  # noqa: E402

WANTED = {"mannequin": 30.0, "human": 15.0}
"""Frames per second."""
FINGER = (0.06, 0.03, 0.02, 0.02, 0.01)
WARM = 2.5  # seconds that are not counted
FRAMES = """new Promise((done) => {
  const times = [];
  requestAnimationFrame(function draw(now) {
    times.push(now);
    if (now - times[0] < %d) requestAnimationFrame(draw);
    else done([times.length - 1, (now - times[0]) / 1000]);
  });
})"""


def processor_seconds(root: int) -> float:
    """Return the processor time of a process and all below it (Linux)."""
    parents, spent = {}, {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rsplit(")", 1)[1].split()
            except OSError:  # it has ended
                continue
            parents[int(entry.name)] = int(fields[1])
            spent[int(entry.name)] = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    ours = {root}
    while more := {child for child, parent in parents.items() if parent in ours} - ours:
        ours |= more
    return sum(spent[pid] for pid in ours)


def main() -> None:
    options = arguments(__doc__)
    seconds = 4.0 if options.quick else 15.0
    minute = gk.load("demo").generate(seconds=60.0, seed=0).resample(30.0)
    motion = with_fingers(gk.Motion(
        minute.skeleton,
        np.concatenate([minute.rotations, minute.rotations[::-1]] * 5),
        np.concatenate([minute.translation, minute.translation[::-1]] * 5),
        minute.fps,
    ), FINGER)  # fmt: skip
    noise = np.random.default_rng(0).normal(0, 0.1, int(motion.duration * 16_000))
    wave = af.Wave(noise.astype(np.float32), 16_000)
    figures = {}
    with tempfile.TemporaryDirectory() as folder:
        browser = Browser(Path(folder))
        for body, wanted in WANTED.items():
            page = Path(folder) / f"{body}.html"
            write_html(motion, page, audio=wave, body=body)
            browser.open(page.as_uri(), width=1280, height=720)
            browser.wait("document.documentElement.dataset.state == 'ready'", 60)
            browser.run("player.seek(100), player.play()")
            time.sleep(WARM)
            before = processor_seconds(browser.process.pid)
            n_frames, took = browser.run(FRAMES % (1000 * seconds))
            spent = processor_seconds(browser.process.pid) - before
            rate, each = n_frames / took, 1e3 * spent / n_frames
            figures[f"player_{body}"] = {
                "ours": took / n_frames,
                "other": 1 / wanted,
                "ratio": rate / wanted,
                "note": f"{motion.skeleton.n_joints} joints, {rate:.0f} frames a second; "
                f"{each:.0f} ms of processor a frame; "
                f"load {os.getloadavg()[0]:.1f}",
            }
        browser.close()
    report(figures, options.json)


if __name__ == "__main__":
    main()
