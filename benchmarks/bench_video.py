"""mp4 videos of a minute of speech, with sound, compared with the minute itself.

"other" is the duration of the motion: a ratio above 1 is faster than real time. 62 joints with
fingers at 30 fps; encoding is included, and the compilation of the kernels is not.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np
from harness import arguments, report

import audio_features as af
import gesturekit as gk
from gesturekit.motion import Skeleton
from gesturekit.viewer import write_video

FINGERS = 5
FPS = 30.0


def with_fingers(
    motion: gk.Motion, lengths: tuple[float, ...] = (0.07, 0.035, 0.025, 0.02)
) -> gk.Motion:
    """Return the motion on a rig with five fingers of so many joints on each hand."""
    rig = motion.skeleton
    names, parents, offsets = list(rig.names), list(rig.parents), list(rig.offsets)
    for side in ("Left", "Right"):
        hand = next(j for j, name in enumerate(names) if name.lower() == f"{side}hand".lower())
        way = offsets[hand] / np.linalg.norm(offsets[hand])
        for finger in range(FINGERS):
            above = hand
            for joint, length in enumerate(lengths):
                aside = np.array([0, 0, 0.018 * (finger - 2) if joint == 0 else 0.0])
                names.append(f"{side}Finger{finger}_{joint}")
                parents.append(above)
                offsets.append(length * way + aside)
                above = len(names) - 1
    skeleton = Skeleton(tuple(names), tuple(parents), np.array(offsets))
    more = np.zeros((motion.n_frames, len(names) - rig.n_joints, 4))
    more[..., 3] = 1
    rotations = np.concatenate([motion.rotations, more], axis=1)
    return gk.Motion(skeleton, rotations, motion.translation, motion.fps)


def main() -> None:
    options = arguments(__doc__)
    seconds = 10.0 if options.quick else 60.0
    motion = with_fingers(gk.load("demo").generate(seconds=seconds, seed=0)).resample(FPS)
    noise = np.random.default_rng(0).normal(0, 0.1, int(seconds * 16_000)).astype(np.float32)
    wave = af.Wave(noise, 16_000)
    figures = {}
    with tempfile.TemporaryDirectory() as folder:
        write_video(motion.trim(0, 0.5), Path(folder) / "warm.mp4")  # compiles
        for size in ("720p", "1080p"):
            begun, used = time.perf_counter(), time.process_time()
            write_video(motion, Path(folder) / "x.mp4", audio=wave, size=size)
            took, used = time.perf_counter() - begun, time.process_time() - used
            note = (
                f"{motion.skeleton.n_joints} joints, {motion.n_frames / took:.0f} frames a second; "
                f"drawing takes {1e3 * used / motion.n_frames:.0f} ms of a core a frame"
            )
            figures[f"video_{size}"] = {
                "ours": took,
                "other": seconds,
                "ratio": seconds / took,
                "note": note,
            }
    report(figures, options.json)


if __name__ == "__main__":
    main()
