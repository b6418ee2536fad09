"""Scale invariance of checks and labels: if rig and path are scaled, results do not change."""

import re
from pathlib import Path

import numpy as np
import pytest
from rigs import PERSON, QUADRUPED, Bones, rig_of
from scipy.spatial.transform import Rotation

from gesturekit.corpus.recording import Recording, examine
from gesturekit.errors import MotionError
from gesturekit.inspection.motion import inspect_motion
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.contacts import contact_labels
from gesturekit.motion.parts import find_parts

SCALES = {0.1: "mm", 10.0: "inch"}

SNAKE: Bones = {f"Bone{k}": (f"Bone{k - 1}" if k else None, (0.0, 0.0, 0.1)) for k in range(20)}
CRAB: Bones = {
    "Shell": (None, (0.0, 0.2, 0.0)),
    **{
        f"{side}{row}_{k}": (f"{side}{row}_{k - 1}" if k else "Shell", (x, 0.05 - 0.07 * k, z))
        for side, x in (("L", 0.2), ("R", -0.2))
        for row, z in enumerate((-0.1, 0.0, 0.1, 0.2))
        for k in range(3)
    },
}
ARM: Bones = {
    "Shoulder": (None, (0.0, 1.4, 0.0)),
    "Elbow": ("Shoulder", (0.3, 0.0, 0.0)),
    "Wrist": ("Elbow", (0.25, 0.0, 0.0)),
}
RIGS = {"person": PERSON, "snake": SNAKE, "crab": CRAB, "arm": ARM, "quadruped": QUADRUPED}


def flawed(skeleton: Skeleton) -> Motion:
    """Return 3 s with every defect: a rest pose, a jump, pops, jitter and frozen frames."""
    n_frames = 180
    time = np.arange(n_frames)[:, None, None] / 60
    phase = np.random.default_rng(3).uniform(0, 6, (skeleton.n_joints, 3))
    angles = 0.2 * np.sin(2 * np.pi * 0.6 * time + phase)
    angles[:10] = 0.0
    angles[40, 1, 0] += 1.0
    translation = np.stack([0.3 * np.sin(time[:, 0, 0]), 0 * time[:, 0, 0] + 0.9] * 2, axis=1)[
        :, :3
    ]
    translation[60:] += [0.5, 0.0, 0.0]
    translation[70] += [0.0, 0.1, 0.0]
    translation[75:100:2] += [0.01, 0.0, 0.0]
    angles[110:175], translation[110:175] = angles[110], translation[110]
    rotations = Rotation.from_euler("xyz", angles.reshape(-1, 3)).as_quat()
    return Motion(skeleton, rotations.reshape(n_frames, -1, 4), translation, 60.0)


def judged(motion: Motion, path: Path, **options: str) -> dict[str, object]:
    """Return all checks and labels of a motion, without speeds and lengths in the messages."""
    motion.save(path, **options)
    read = options if path.suffix == ".bvh" else {}

    def unsized(text: str) -> str:
        text = re.sub(r"[\d.]+ m(/s)?\b", "#", text.replace(str(path), ""))
        return text.replace(", # on a body of #", "")

    problems = inspect_motion(path, parts=None, **read).problems
    # "makes the body ..." depends on the unit option, not on the motion.
    found = {"inspect": [unsized(text) for text in problems if "makes the body" not in text]}
    if not read:
        recording, problems = examine(Recording(id="a", motion=path), 0.5)
        found["prepare"] = [(p.severity, unsized(p.text)) for p in problems]
        found["used"] = recording and (recording.start, recording.stop)
    try:
        found["parts"] = find_parts(motion.skeleton)
        found["contacts"] = contact_labels(motion).tolist()
    except MotionError as error:
        found["parts"] = unsized(str(error))
    return found


@pytest.mark.parametrize("name", RIGS)
def test_rigs_of_any_kind_are_checked_alike_at_any_size(name, tmp_path):
    motion = flawed(rig_of(RIGS[name]))
    expected = judged(motion, tmp_path / "clip.npz")
    written = judged(motion, tmp_path / "clip.bvh", unit="cm")
    for scale, unit in SCALES.items():
        assert judged(motion.scaled(scale), tmp_path / "clip.npz") == expected, scale
        assert judged(motion.scaled(scale), tmp_path / "clip.bvh", unit=unit) == written, unit
    defects = ("jump", "pop", "tremble", "nothing", "rest")
    assert name != "person" or all(map(" ".join(expected["inspect"]).__contains__, defects))
