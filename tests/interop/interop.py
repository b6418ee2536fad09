"""Files we wrote, opened in Blender and three.js: do the joints stand where we put them?

    make interop

makes an environment for Blender's module `bpy` (1.6 GB, some minutes the first time) and runs
this. BVH files go through the importers of both; BVH and npz with their sound go through our
add-on, onto a new armature and onto one with other bone axes, scale and place. Exits 1 where a
joint is more than 0.01 cm away, the frame rate is another, or the sound is not in its place.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import soundfile
from scipy.spatial.transform import Rotation

import gesturekit as gk
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.skeleton import ROTATION_ORDERS

ROOT = Path(__file__).resolve().parents[2]
PLAYER = ROOT / "gesturekit" / "viewer" / "player"
SHARED_DATA = ROOT.parent / "shared" / "data"
RECORDINGS = (
    "paired/zeggs_067_Speech_2/067_Speech_2_x_1_0.bvh",
    "motion/aitviewer/sample.bvh",
    "motion/reactidle/012_genuine.bvh",
    "motion/bandai/dataset-2_wave-both-hands_normal_001.bvh",
)
N_FRAMES = 110
TOLERANCE = 0.01  # cm


def motions() -> Iterator[tuple[str, Motion]]:
    """Of the bundled model, of a rig with everything odd, and of recordings where they are."""
    yield "demo", gk.load("demo").generate(ROOT / "gesturekit/models/demo/speech.wav", seed=0)
    yield "odd", odd_motion()
    for name in RECORDINGS:
        if (SHARED_DATA / name).exists():
            yield Path(name).parent.name, Motion.load(SHARED_DATA / name)


def odd_motion() -> Motion:
    """Every rotation order, joints that move, a frame rate that is not a whole number."""
    rng = np.random.default_rng(0)
    n = 40
    skeleton = Skeleton(
        names=tuple(f"ns:bone {j}.L" if j % 7 == 3 else f"bone{j}" for j in range(n)),
        parents=(-1, *(int(rng.integers(max(0, j - 4), j)) for j in range(1, n))),
        offsets=rng.normal(0, 0.15, (n, 3)),
        end_sites={"bone39": (np.array([0.0, 0.05, 0.0]),)},
        rotation_orders=tuple(ROTATION_ORDERS[j % 6] for j in range(n)),
    )
    turns = Rotation.random(N_FRAMES * n, random_state=0).as_quat().reshape(N_FRAMES, n, 4)
    places = rng.normal(0, 0.2, (3, N_FRAMES, 3))
    moving = {skeleton.names[4]: places[1], skeleton.names[20]: places[2]}
    return Motion(skeleton, turns, places[0] + [0, 1, 0], 30000 / 1001, moving)


def main(bpy_python: str) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        written: dict[Path, Motion] = {}
        for stem, motion in motions():
            path = folder / f"{stem}.bvh"
            written[path] = replace(motion[:N_FRAMES], info={})
            written[path].save(path)
        files = [str(path) for path in written]
        here = Path(__file__).parent
        bad = through_addon(bpy_python, here, written)
        run(bpy_python, here / "blender_positions.py", *files)
        run(node(), here / "three_positions.mjs", PLAYER / "node_modules" / "three", *files)
        for path, motion in written.items():
            for tool in ("blender", "three"):
                found = json.loads(path.with_suffix(f".{tool}.json").read_text())
                names = Motion.load(path).skeleton.names
                if "names" in found:  # Blender has an order and blanks of its own
                    known = {name.replace(" ", "_"): name for name in names}
                    names = [known[name] for name in found["names"]]
                apart = worst(motion, names, found["frames"])
                same_rate = abs(found["fps"] / motion.fps - 1) < 1e-6
                bad |= apart > TOLERANCE or not same_rate
                print(
                    f"{path.stem:24} {tool:8} {motion.skeleton.n_joints:3} joints "
                    f"{motion.n_frames:3} frames: {apart:.1e} cm apart at most, "
                    f"{found['fps']:.6f} fps (ours {motion.fps:.6f})"
                )
    if bad:
        sys.exit("Some joints are over 0.01 cm away, or frame rates differ.")


def through_addon(bpy_python: str, here: Path, written: dict[Path, Motion]) -> bool:
    """Import BVH and npz files with their sound by the add-on; return whether any is wrong."""
    addon = ROOT / "build" / "gesturekit_motion.zip"
    files = {}
    for path, motion in written.items():
        rate = 16_000
        silence = np.zeros(round(rate * motion.n_frames / motion.fps))
        soundfile.write(path.with_suffix(".wav"), silence, rate)
        motion.save(path.with_suffix(".npz"))
        files |= {path: motion, path.with_suffix(".npz"): motion}
    os.environ["BLENDER_USER_RESOURCES"] = str(next(iter(files)).parent / "blender")
    run(bpy_python, here / "blender_addon.py", addon, *files)
    bad = False
    for path, motion in files.items():
        known = {name.replace(" ", "_"): name for name in motion.skeleton.names}
        for kind in ("addon", "rig"):
            found = json.loads(path.with_name(f"{path.name}.{kind}.json").read_text())
            names = [known[name.replace(" ", "_")] for name in found["names"]]
            apart = worst(motion, names, 100 * np.array(found["frames"]))
            wav = [path.with_suffix(".wav").name, 1.0]
            silent = found["sound"] is None
            same_rate = abs(found["fps"] / motion.fps - 1) < 1e-6
            bad |= apart > TOLERANCE or not same_rate or not (silent or [wav] == found["sound"])
            sound = "not tested, Blender's module has none" if silent else found["sound"]
            print(
                f"{path.name:24} {kind:8} {apart:.1e} cm apart at most, "
                f"{found['fps']:.6f} fps, sound {sound}"
            )
    return bad


def worst(motion: Motion, names: list[str], frames: object) -> float:
    """The largest distance between our joints and theirs, cm."""
    theirs = np.array(frames)
    ours = 100 * motion.positions()[:, [motion.skeleton.index(name) for name in names]]
    if ours.shape != theirs.shape:
        sys.exit(f"frames, joints and axes are {theirs.shape} instead of {ours.shape}")
    return float(np.linalg.norm(theirs - ours, axis=-1).max())


def node() -> str:
    """Node.js, with three.js in the player's folder."""
    sys.path.insert(0, str(PLAYER))
    import bundle

    found = bundle.find_node()
    if found is None:
        sys.exit(f"No Node.js {bundle.OLDEST_NODE} or newer found.")
    if not (PLAYER / "node_modules" / "three").exists():
        run(*found[1], "ci", "--ignore-scripts", "--no-audit", "--no-fund", cwd=PLAYER)
    return found[0]


def run(*command: object, cwd: Path | None = None) -> None:
    done = subprocess.run(
        [str(word) for word in command], cwd=cwd, capture_output=True, text=True, check=False
    )
    if done.returncode:
        sys.exit(f"{command[0]} {command[1]} failed:\n{done.stdout[-2000:]}{done.stderr[-2000:]}")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: interop.py PYTHON-THAT-HAS-BPY   (or: make interop)")
    main(sys.argv[1])
