"""Measure path following, foot skate and stepping rate of a locomotion model.

    python recipes/diffusion_locomotion/measure.py runs/walks/model [--out folder]

The paths are not those of `prepare.py`: straight, circular, accelerating, and winding. For each
path, one line gives the largest distance of the root from the smoothed path; foot skate with and
without foot locking, as a ratio to that of a rule-based walk (`walker.py`) on the same path; and
steps per second of both walks. The last line is the correlation of stepping rate and path speed
over all steps.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from prepare import FPS
from steps import stepping_rates
from walker import MARGIN, Gait, walk

import gesturekit as gk
from gesturekit.diffusion.conditions import smooth_path
from gesturekit.evaluation.metrics.physical import foot_skate
from gesturekit.motion.root_path import RootPath

SECONDS = 12.0


def laid(speed, turn) -> RootPath:
    """Return a path of given speed (m/s) and turn (rad/s), functions of time from -MARGIN on."""
    time = np.arange(round((SECONDS + 2 * MARGIN) * FPS)) / FPS - MARGIN
    headings = np.cumsum(turn(time) + 0 * time) / FPS
    way = np.stack([np.sin(headings), np.cos(headings)], axis=-1)
    return RootPath(np.cumsum((speed(time) + 0 * time)[:, None] * way, axis=0) / FPS, headings, FPS)


def paths() -> dict[str, RootPath]:
    """Return the test paths by name, each `SECONDS` long plus a margin at both ends."""
    found = {f"straight, {v} m/s": laid(lambda t, v=v: v, lambda t: 0) for v in (0.5, 1.0, 1.5)}
    for v, radius in ((0.8, 2.0), (1.3, 2.5)):
        found[f"circle, {v} m/s"] = laid(lambda t, v=v: v, lambda t, w=v / radius: w)
    ramp = laid(lambda t: 0.4 + 1.3 * np.clip(t / SECONDS, 0, 1), lambda t: 0)
    found["ramp, 0.4 to 1.7 m/s"] = ramp
    for v in (0.7, 1.2):
        found[f"winding, {v} m/s"] = laid(
            lambda t, v=v: v, lambda t: 0.6 * np.sin(2 * np.pi * t / 5)
        )
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", type=Path)
    parser.add_argument("--steps", type=int, help="denoising steps (all)")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="where to write the walks")
    options = parser.parse_args(arguments)
    model = gk.load(options.model)
    margin, every = round(MARGIN * FPS), []
    print(
        "path                   off path mm  skate locked  as it is  by rule m/s  steps/s  by rule"
    )
    for number, (name, way) in enumerate(paths().items()):
        path = way.slice(margin, way.n_frames - margin)
        ruled = walk(way, Gait()).resample(model.fps)
        request = {"path": path, "steps": options.steps, "seed": number, "fps": model.fps}
        raw = model.generate(**request, foot_lock=False)
        motion = model.generate(**request)
        followed = smooth_path(path, model.fps)
        root = motion.positions()[:, model.representation.root][:, [0, 2]]
        off = np.linalg.norm(root - followed.positions, axis=-1).max()
        rates, speeds = stepping_rates(raw, followed)
        every.append((rates, speeds))
        usual = foot_skate(ruled)
        print(
            f"{name:22s} {1000 * off:11.4f} {foot_skate(motion) / usual:13.2f} "
            f"{foot_skate(raw) / usual:9.2f} {usual:12.4f} {_mean(rates):8.2f} "
            f"{_mean(stepping_rates(ruled, followed)[0]):8.2f}",
            flush=True,
        )
        if options.out is not None:
            options.out.mkdir(parents=True, exist_ok=True)
            stem = options.out / name.replace(", ", "_").replace(" m/s", "").replace(" ", "_")
            motion.save(f"{stem}.bvh")
            picture(motion, followed, f"{stem}.png")
    rates, speeds = (np.concatenate(values) for values in zip(*every, strict=True))
    print(f"{len(rates)} steps, r(rate, speed) = {np.corrcoef(rates, speeds)[0, 1]:.3f}")


def _mean(rates: np.ndarray) -> float:
    return float(rates.mean()) if len(rates) else 0.0


def picture(motion: gk.Motion, path: RootPath, file: str, frames: int = 14) -> None:
    """Draw some strides from the side, and the height of the toes over time."""
    figure, (side, feet) = plt.subplots(2, 1, figsize=(14, 7), height_ratios=(3, 1))
    places, names = motion.positions(), motion.skeleton.names
    chosen = motion.n_frames // 2 + 4 * np.arange(frames)
    chosen = chosen[chosen < motion.n_frames]
    way = np.concatenate([[0.0], np.cumsum(path.speeds[:-1])]) / path.fps
    for frame in chosen:
        angle = path.headings[frame]
        from_root = places[frame] - places[frame, 0] * [1, 0, 1]
        ahead = from_root[:, 0] * np.sin(angle) + from_root[:, 2] * np.cos(angle)
        at = ahead + 2.5 * (way[frame] - way[chosen[0]])
        for joint, parent in enumerate(motion.skeleton.parents):
            if parent >= 0:
                name = names[joint]
                colour = "C1" if "Left" in name else "C0" if "Right" in name else "0.3"
                side.plot(at[[parent, joint]], from_root[[parent, joint], 1], color=colour)
    side.axhline(0.0, color="0.7")
    side.set_aspect("equal")
    side.set_title("every 4th frame, distances stretched by 2.5; left leg orange")
    time = np.arange(motion.n_frames) / motion.fps
    for name, colour in (("LeftToeBase", "C1"), ("RightToeBase", "C0")):
        feet.plot(time, places[:, motion.skeleton.index(name), 1], color=colour, label=name)
    feet.set_ylabel("m over the floor")
    feet.legend()
    figure.savefig(file, dpi=70, bbox_inches="tight")
    plt.close(figure)


if __name__ == "__main__":
    main()
