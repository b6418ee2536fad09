"""Synthetic walk along a path, without foot skate, with more steps at higher speed.

The phase of the gait counts steps. A foot that lands stays in place, rolls over its toes and swings
to its next position two steps later. The hips follow the path, as high as both legs reach. Two-bone
inverse kinematics gives the rotations of hips and knees. Pelvis, spine and arms swing with the
phase.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d, minimum_filter1d
from scipy.spatial.transform import Rotation

from gesturekit.motion.ik import two_bone_ik
from gesturekit.motion.motion import Motion
from gesturekit.motion.root_path import RootPath

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "demo"))
from rig import bend, mirrored, skeleton  # noqa: E402

MARGIN = 3.0
"""Seconds of the path before and after a walk, in which its first and last steps begin and end."""

_DOUBLE_SUPPORT = 0.2  # share of a step with both feet on the floor
_WIDTH = 0.085  # metres from the path to an ankle
_ANKLE_HEIGHT = 0.08
_TOE = np.array([0.0, -0.06, 0.13])  # relative to the ankle; the foot rolls over it
_HEEL = np.array([0.0, -_ANKLE_HEIGHT, -0.02])
_TOES_OUT = np.radians(7.0)
_HIP = np.array([0.09, -0.04, 0.0])
_REACH = 0.97 * (0.42 + 0.40)  # of a leg that is slightly bent
_TALLEST = 0.92  # metres, hips over the floor


@dataclass(frozen=True)
class Gait:
    """Individual variation between walkers: factors with mean 1."""

    cadence: float = 1.0
    arms: float = 1.0
    lift: float = 1.0


def step_rate(speed: np.ndarray) -> np.ndarray:
    """Return steps per second at a speed in m/s; at higher speed, steps are longer and more."""
    return 1.85 * np.sqrt(np.maximum(speed, 0.05))


def walk(path: RootPath, gait: Gait) -> Motion:
    """Return a walk along a path, without the `MARGIN` at both ends.

    The path should face its direction, at 0.2 to 2 m/s, and turn gently.
    """
    n, fps = path.n_frames, path.fps
    speed = gaussian_filter1d(path.speeds, 0.2 * fps)
    phase = np.cumsum(gait.cadence * step_rate(speed)) / fps
    pace = np.clip(speed, 0.0, 2.0)
    swing, cosine = np.sin(np.pi * phase), np.cos(np.pi * phase)
    # At phase 0 the left foot lands in front; at 1 the right one does.
    pelvis_yaw = -0.09 * pace * cosine
    pelvis = Rotation.from_euler(
        "YXZ",
        np.stack([path.headings + pelvis_yaw, 0.02 + 0.02 * pace, 0.035 * pace * swing], axis=-1),
    )
    ankles, feet, toes = zip(
        *(_foot(path, phase, pace, side, gait) for side in (0, 1)), strict=True
    )
    hips = _hips(path, pelvis, ankles)

    rig = skeleton()
    rotations = np.zeros((n, rig.n_joints, 4))
    rotations[..., 3] = 1.0

    def put(name: str, rotation: Rotation) -> None:
        rotations[:, rig.index(name)] = rotation.as_quat()

    put("Hips", pelvis)
    yaw = 2.0 * -pelvis_yaw
    for name in ("Spine", "Spine1", "Spine2"):
        put(name, bend(_angles(0.01 * pace, yaw / 3, -0.02 * pace * swing)))
    ahead = np.interp(np.arange(n) + 0.5 * fps, np.arange(n), path.headings) - path.headings
    ahead = gaussian_filter1d(np.clip(ahead, -0.6, 0.6), 0.15 * fps)
    for name in ("Neck", "Head"):
        put(name, bend(_angles(-0.02 * pace, (ahead - yaw - pelvis_yaw) / 2, 0.0 * pace)))
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        forward = gait.arms * (0.04 - 0.28 * pace * sign * cosine)
        upper = Rotation.from_euler("X", -forward[:, None]) * Rotation.from_euler("Z", -1.32)
        fold = 0.25 + 0.12 * pace + 0.5 * np.maximum(forward, 0)
        elbow = Rotation.from_euler("Y", -fold[:, None])
        for name, rotation in (("Arm", upper), ("ForeArm", elbow)):
            put(side + name, rotation if sign > 0 else mirrored(rotation))
    motion = Motion(rig, rotations, hips, fps)
    for side, ankle, foot, toe in zip(("Left", "Right"), ankles, feet, toes, strict=True):
        motion.rotations[:, rig.index(side + "ToeBase")] = toe.as_quat()
        _reach(motion, side, ankle, foot, path)
    margin = round(MARGIN * fps)
    return motion[margin : n - margin]


def _foot(
    path: RootPath, phase: np.ndarray, pace: np.ndarray, side: int, gait: Gait
) -> tuple[np.ndarray, Rotation, Rotation]:
    """Return ankle positions (T, 3) and rotations of foot and toes; side 0 is left."""
    frames = np.arange(path.n_frames)
    steps = np.arange(int(phase[0]) - 2, int(phase[-1]) + 3)
    steps = steps[steps % 2 == side]
    # Each step lands beside the position of the body halfway through its stance.
    at = np.interp(steps + 0.5 + _DOUBLE_SUPPORT / 2, phase, frames)
    x, z, heading = (np.interp(at, frames, v) for v in (*path.positions.T, path.headings))
    sign = 1.0 if side == 0 else -1.0
    x, z = x + sign * _WIDTH * np.cos(heading), z - sign * _WIDTH * np.sin(heading)
    heading = heading + sign * _TOES_OUT
    k = np.clip((np.floor(phase - side).astype(int) // 2 * 2 + side - steps[0]) // 2, 0, None)
    k = np.minimum(k, len(steps) - 2)
    since = phase - steps[k]  # steps since this foot landed: it lands again at 2
    swing = np.clip((since - 1 - _DOUBLE_SUPPORT) / (1 - _DOUBLE_SUPPORT), 0.0, 1.0)
    way = swing**3 * (10 - 15 * swing + 6 * swing**2)  # minimum jerk
    yaw = heading[k] + way * (heading[k + 1] - heading[k])
    # Radians, toes down is positive: up at landing, flat, the heel off, and up again in the air.
    strike, push = 0.22 * np.minimum(pace, 1.5), 0.22 + 0.33 * np.minimum(pace, 1.6)
    landing = -strike * (1 - _smooth(since / 0.15))
    heel_off = push * _smooth((since - 0.75) / (0.25 + _DOUBLE_SUPPORT))
    pitch = np.where(swing > 0, push - (push + strike) * _smooth(swing / 0.85), landing + heel_off)
    foot = Rotation.from_euler("YX", np.stack([yaw, pitch], axis=-1))
    level = Rotation.from_euler("Y", yaw[:, None])
    ground = np.stack(
        [x[k] + way * (x[k + 1] - x[k]), 0 * way, z[k] + way * (z[k + 1] - z[k])], axis=-1
    )
    flat = ground + [0.0, _ANKLE_HEIGHT, 0.0]
    over_toe = flat + level.apply(_TOE) - foot.apply(_TOE)
    over_heel = flat + level.apply(_HEEL) - foot.apply(_HEEL)
    ankle = np.where((pitch > 0)[:, None], over_toe, over_heel)
    ankle[:, 1] += gait.lift * (0.03 + 0.03 * pace) * np.sin(np.pi * swing) ** 2
    # The toes stay flat while the heel is off.
    toes = Rotation.from_euler("X", -np.maximum(pitch, 0.0)[:, None])
    return ankle, foot, toes


def _hips(path: RootPath, pelvis: Rotation, ankles: tuple[np.ndarray, ...]) -> np.ndarray:
    """Return hip positions (T, 3) on the path, as high as both legs reach."""
    hips = np.stack([path.positions[:, 0], np.zeros(path.n_frames), path.positions[:, 1]], axis=-1)
    highest = np.full(path.n_frames, _TALLEST)
    for sign, ankle in zip((1.0, -1.0), ankles, strict=True):
        joint = pelvis.apply(_HIP * [sign, 1.0, 1.0])
        away = np.linalg.norm((ankle - hips - joint)[:, [0, 2]], axis=-1)
        over = np.sqrt(np.maximum(_REACH**2 - away**2, 0.3**2))
        highest = np.minimum(highest, ankle[:, 1] + over - joint[:, 1])
    width = 0.05 * path.fps
    lowest = minimum_filter1d(highest, 2 * round(1.5 * width) + 1)
    hips[:, 1] = gaussian_filter1d(lowest, width)
    return hips


def _reach(motion: Motion, side: str, ankle: np.ndarray, foot: Rotation, path: RootPath) -> None:
    """Turn one leg of a motion in place so that its foot reaches its target."""
    rig = motion.skeleton
    joints = [rig.index(side + name) for name in ("UpLeg", "Leg", "Foot")]
    forward = np.stack([np.sin(path.headings), 0 * path.headings, np.cos(path.headings)], axis=-1)
    turned = motion.global_rotations()
    above = turned[:, [rig.parents[j] for j in joints[:2]]]
    motion.rotations[:, joints[:2]] = two_bone_ik(
        motion.positions()[:, joints], ankle, motion.rotations[:, joints[:2]], above, pole=forward
    )
    shin = Rotation.from_quat(motion.global_rotations()[:, joints[1]])
    motion.rotations[:, joints[2]] = (shin.inv() * foot).as_quat()


def _smooth(x: np.ndarray) -> np.ndarray:
    """Smoothstep from 0 to 1 for x from 0 to 1."""
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3 - 2 * x)


def _angles(pitch: np.ndarray, yaw: np.ndarray, roll: np.ndarray) -> np.ndarray:
    """Stack angles (T,) to (T, 3), as `rig.bend` expects them."""
    return np.stack([pitch, yaw, roll], axis=-1)
