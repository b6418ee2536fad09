"""Foot locking of 10 s of motion, compared with 500 steps of gradient descent on all joints.

"other" is the usual post-processing of single-clip models: each contact span is pinned at its mean
position, blended over 5 frames, and 500 steps of Adam fit all joints to the pinned feet by forward
kinematics, regularised towards the initial pose (weights 0.1 on rotations, 0.01 on positions). Both
use the same contact labels. The note gives foot skate: the mean speed of the foot points in frames
labelled as contact. The motions are the bundled model's, without and with a drift of 0.1 m/s.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import torch
from harness import arguments, report, timed

import gesturekit as gk
from gesturekit.motion.contacts import contact_labels, foot_points, foot_positions
from gesturekit.motion.rotations import quaternion_from_sixd, sixd_from_quaternion
from gesturekit.motion.torch_kinematics import ForwardKinematics, sixd_to_matrix
from gesturekit.postprocess import lock_feet

SECONDS = 10.0
STEPS = 500
BLEND = 5


def skate(motion: gk.Motion, labels: np.ndarray) -> float:
    """Mean speed of the foot points on contact frames, m/s."""
    speed = np.linalg.norm(np.diff(foot_positions(motion), axis=0), axis=-1) * motion.fps
    return float(speed[labels[1:] > 0.5].mean())


def pinned(feet: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """(T, F, 3) foot points (T, F, 3), each contact span at its mean place, blended in and out."""
    goal = feet.copy()
    for point in range(feet.shape[1]):
        standing = np.concatenate([[0], labels[:, point] > 0.5, [0]]).astype(int)
        for start, stop in np.flatnonzero(np.diff(standing)).reshape(-1, 2):
            place = feet[start:stop, point].mean(axis=0)
            goal[start:stop, point] = place
            for k in range(1, BLEND + 1):
                share = 1 - k / (BLEND + 1)
                for frame, edge in ((start - k, start), (stop - 1 + k, stop - 1)):
                    if 0 <= frame < len(feet) and not labels[frame, point] > 0.5:
                        goal[frame, point] += share * (place - feet[edge, point])
    return goal


def fitted(motion: gk.Motion, labels: np.ndarray, steps: int) -> gk.Motion:
    """All joints fitted to the pinned feet by Adam (rate 1e-3), for foot points at joints."""
    joints = [motion.skeleton.index(point.joint) for point in foot_points(motion.skeleton)]
    fk = ForwardKinematics(motion.skeleton.parents, motion.skeleton.offsets)
    first = torch.from_numpy(sixd_from_quaternion(motion.rotations)).float()
    root = torch.from_numpy(motion.translation).float()
    goal = torch.from_numpy(pinned(foot_positions(motion), labels)).float()
    sixd, place = first.clone().requires_grad_(), root.clone().requires_grad_()
    optimiser = torch.optim.Adam([sixd, place], lr=1e-3)
    for _ in range(steps):
        positions = fk(sixd_to_matrix(sixd), place)
        loss = (positions[:, joints] - goal).square().mean()
        loss = loss + 0.1 * (sixd - first).square().mean() + 0.01 * (place - root).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return replace(
        motion,
        rotations=quaternion_from_sixd(sixd.detach().double().numpy()),
        translation=place.detach().double().numpy(),
    )


def main() -> None:
    options = arguments(__doc__.splitlines()[0])
    torch.set_num_threads(1)
    motion = gk.load("demo").generate(seconds=SECONDS, seed=0, foot_lock=False)
    labels = contact_labels(motion)
    drifting = replace(
        motion, translation=motion.translation + motion.times[:, None] * [0.1, 0.0, 0.0]
    )
    runs = 3 if options.quick else 7
    figures: dict[str, dict[str, float | str]] = {}
    for name, clip in (("demo", motion), ("drift", drifting)):
        locked = lock_feet(clip, labels)
        times = timed(lambda clip=clip: lock_feet(clip, labels), runs)
        start = time.perf_counter()
        fit = fitted(clip, labels, STEPS)
        other = time.perf_counter() - start
        ours = float(np.median(times))
        figures[f"foot_lock_{name}"] = {
            "ours": ours,
            "other": other,
            "ratio": other / ours,
            "note": f"{clip.n_frames} frames, {clip.skeleton.n_joints} joints; foot skate "
            f"{skate(clip, labels):.4f} m/s, ours {skate(locked, labels):.4f}, other "
            f"{skate(fit, labels):.4f}",
        }
    report(figures, options.json)


if __name__ == "__main__":
    main()
