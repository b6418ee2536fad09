"""BVH reading, writing and forward kinematics, compared with bvhio and plain numpy.

The rig has 75 joints at 60 fps. bvhio stores a pose object per joint and frame, so it gets a few
seconds of motion; reading ten minutes is compared with numpy.loadtxt of the same numbers.
"""

from __future__ import annotations

import io
import subprocess
import sys
import tempfile
from pathlib import Path

import bvhio
import numpy as np
import torch
from harness import arguments, compare, report
from scipy.spatial.transform import Rotation

from gesturekit.formats import read_bvh, write_bvh
from gesturekit.formats.bvh_parser import Lines, parse_rows
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.rotations import matrix_from_quaternion
from gesturekit.motion.torch_kinematics import ForwardKinematics

N_JOINTS, FPS = 75, 60.0
AS_IT_IS = {"unit": "cm", "up": "y", "forward": "z"}


def gesturing(n_frames: int) -> Motion:
    """Joints that sway by some tens of degrees, each at its own pace."""
    rng = np.random.default_rng(0)
    # Spine, limbs and fingers: chains of five to a dozen joints.
    parents = (-1, *(j - 1 if j % 6 else int(rng.integers(0, j)) for j in range(1, N_JOINTS)))
    skeleton = Skeleton(
        tuple(f"joint{j}" for j in range(N_JOINTS)), parents, rng.normal(0, 0.08, (N_JOINTS, 3))
    )
    time = np.arange(n_frames)[:, None, None] / FPS
    pace, phase = rng.uniform(0.2, 2.0, (N_JOINTS, 3)), rng.uniform(0, 6, (N_JOINTS, 3))
    angles = 0.4 * np.sin(2 * np.pi * pace * time + phase)
    turns = Rotation.from_euler("xyz", angles.reshape(-1, 3)).as_quat()
    path = np.cumsum(rng.normal(0, 0.002, (n_frames, 3)), axis=0) + [0, 0.9, 0]
    return Motion(skeleton, turns.reshape(n_frames, N_JOINTS, 4), path, FPS)


PEAK = """
import sys
from pathlib import Path
from scipy.spatial.transform import Rotation
from gesturekit.formats import read_bvh
def peak():
    return int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]) // 1024
before = peak()
read_bvh(sys.argv[1])
print(peak() - before)
"""


def peak(path: Path) -> str:
    """Megabytes by which reading grows a fresh process, the motion it returns included."""
    child = [sys.executable, "-c", PEAK, str(path)]
    return subprocess.run(child, capture_output=True, text=True, check=True).stdout.strip()


def bvhio_positions(root: bvhio.Joint, n_frames: int) -> np.ndarray:
    joints = [joint for joint, _, _ in root.layout()]
    places = np.empty((n_frames, len(joints), 3))
    for frame in range(n_frames):
        root.loadPose(frame)
        for j, joint in enumerate(joints):
            places[frame, j] = joint.PositionWorld
    return places


def plain_positions(motion: Motion) -> np.ndarray:
    """Forward kinematics as one writes it in numpy: matrices, one joint after the other."""
    n_frames, n_joints = motion.rotations.shape[:2]
    local = Rotation.from_quat(motion.rotations.reshape(-1, 4)).as_matrix()
    local = local.reshape(n_frames, n_joints, 3, 3)
    turned, places = np.empty_like(local), np.empty((n_frames, n_joints, 3))
    turned[:, 0], places[:, 0] = local[:, 0], motion.translation
    for j, parent in enumerate(motion.skeleton.parents[1:], start=1):
        turned[:, j] = turned[:, parent] @ local[:, j]
        places[:, j] = places[:, parent] + turned[:, parent] @ motion.skeleton.offsets[j]
    return places


def main() -> None:
    options = arguments(__doc__.splitlines()[0])
    runs = 2 if options.quick else 5
    long, short = (9_000 if options.quick else 36_000), (240 if options.quick else 600)
    figures = {}
    with tempfile.TemporaryDirectory() as name:
        path, other_path = Path(name) / "a.bvh", Path(name) / "b.bvh"
        motion = gesturing(long)
        write_bvh(motion, path)
        rows = path.read_text().split("Frame Time:")[1].split("\n", 1)[1]
        figures["read_long"] = compare(
            lambda: read_bvh(path, **AS_IT_IS),
            lambda: np.loadtxt(io.StringIO(rows)),
            runs,
            f"{long} frames of {N_JOINTS} joints, +{peak(path)} MB at most; other: numpy.loadtxt "
            "of the numbers",
        )
        figures["numbers_long"] = compare(
            lambda: parse_rows(Lines(io.StringIO(rows), path), long, 3 * N_JOINTS + 3),
            lambda: np.loadtxt(io.StringIO(rows)),
            runs,
            f"the numbers of the same {long} frames alone; other: numpy.loadtxt",
        )
        motion = motion[:short]
        write_bvh(motion, path)
        root = bvhio.readAsHierarchy(str(path))
        note = f"{short} frames of {N_JOINTS} joints; other: bvhio"
        figures["read"] = compare(
            lambda: read_bvh(path, **AS_IT_IS),
            lambda: bvhio.readAsHierarchy(str(path)),
            runs,
            note,
        )
        figures["write"] = compare(
            lambda: write_bvh(motion, path),
            lambda: bvhio.writeHierarchy(str(other_path), root, 1 / FPS, short),
            runs,
            note,
        )
        motion = read_bvh(path, **AS_IT_IS)  # in bvhio's order of joints
        apart = np.abs(bvhio_positions(root, 10) - 100 * motion.positions()[:10]).max()
        if apart > 1e-3:
            raise SystemExit(f"bvhio's joints are {apart:.1e} cm from ours: nothing to compare")

        def theirs() -> np.ndarray:
            return bvhio_positions(root, short)

        figures["fk_numpy"] = compare(motion.positions, theirs, runs, note)
        if np.abs(plain_positions(motion) - motion.positions()).max() > 1e-9:
            raise SystemExit("plain numpy puts joints elsewhere: nothing to compare")
        plain_note = f"{short} frames of {N_JOINTS} joints; other: matrices in plain numpy"
        figures["fk_plain"] = compare(
            motion.positions, lambda: plain_positions(motion), runs, plain_note
        )
        for device in ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]:
            kinematics = ForwardKinematics(motion.skeleton.parents, motion.skeleton.offsets)
            kinematics = kinematics.to(device)
            matrices = matrix_from_quaternion(motion.rotations)
            turns = torch.from_numpy(matrices).float().to(device)
            places = torch.from_numpy(motion.translation).float().to(device)
            work = on_device(kinematics, turns, places)
            figures[f"fk_torch_{device}"] = compare(work, theirs, runs, note)
    report(figures, options.json)


def on_device(kinematics: ForwardKinematics, turns: torch.Tensor, places: torch.Tensor):
    def work() -> None:
        with torch.no_grad():
            kinematics(turns, places)
            if turns.is_cuda:
                torch.cuda.synchronize()

    return work


if __name__ == "__main__":
    main()
