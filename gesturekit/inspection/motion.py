"""Summary of a motion: rig with body parts, axes, frame rate, movement, defects."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gesturekit.corpus.checks import MAX_JITTER_SHARE, reference_pose
from gesturekit.formats.conversion import describe_axes, load_with_warnings
from gesturekit.formats.gltf.vrm import avatar_facts
from gesturekit.formats.plausibility import plausibility_warnings
from gesturekit.inspection.summary import Summary, size, span
from gesturekit.inspection.tree import tree
from gesturekit.motion.contacts import CONTACT_SPEED, contact_labels, foot_points
from gesturekit.motion.defects import (
    find_jumps,
    find_pops,
    format_speed,
    frozen_runs,
    jitter_share,
    speed_limit,
)
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import SIDES, is_upper_body, known_part_labels
from gesturekit.motion.parts.body_size import body_scale
from gesturekit.motion.rotations import rotation_angles
from gesturekit.motion.skeleton import Skeleton
from gesturekit.viewer.figure import Figure
from gesturekit.wording import counted, listed

_STILL = np.deg2rad(0.5)
"""Rotation from the first frame up to which a joint counts as not moving, radians."""
_GLTF = (".glb", ".gltf", ".vrm", ".vrma")
_STANDS = 1e-4
"""Range up to which a root counts as not travelling, metres on the reference body."""


def inspect_motion(path: Path, *, parts: Mapping[str, str] | None, **options: Any) -> Summary:
    """Summarise a motion file, or a folder with one file per frame.

    Args:
        path: a motion that `Motion.load` reads.
        parts: body parts assigned by hand, {"left_elbow": "Joint12"}.
        options: options of the reader, such as `up`.

    Raises:
        FormatError: it cannot be read.
        MotionError: `parts` names a missing joint.
    """
    motion, warnings = load_with_warnings(path, options, parts)
    skeleton = motion.skeleton
    labels, unknown = known_part_labels(skeleton)
    figure = Figure.of(motion)
    facts: dict[str, Any] = {
        "path": str(path),
        "format": "EasyMocap" if path.is_dir() else path.suffix.lower()[1:],
        "bytes": _bytes(path),
        "frames": motion.n_frames,
        "fps": motion.fps,
        "seconds": motion.duration,
        **{
            key: motion.info[key]
            for key in ("unit", "up", "forward", "guessed")
            if key in motion.info
        },
        "facing_degrees": np.rad2deg(figure.front),
        "height": figure.height,
        "floor": figure.floor,
        "joints": list(skeleton.names),
        "parts": labels,
        **_movement(motion, figure, labels),
        **_feet(motion, labels),
        "upper_body_only": is_upper_body(skeleton),
        **(avatar_facts(path) if path.suffix.lower() in _GLTF else {}),
    }
    problems = [
        *warnings,
        *plausibility_warnings(motion, options),
    ]
    problems += [*([unknown] if unknown else []), *_defects(motion)]
    what = "avatar" if facts.get("vrm") else "motion"
    return Summary(
        kind="motion",
        title=f"{path}: {what}, {facts['format']}, {size(facts['bytes'])}",
        facts=facts,
        rows=tuple(_rows(motion, facts, labels, figure.speed_of)),
        drawing=partial(tree, skeleton, labels),
        problems=tuple(problems),
    )


def _movement(motion: Motion, figure: Figure, labels: Mapping[str, str]) -> dict[str, Any]:
    skeleton = motion.skeleton
    still = _STANDS * body_scale(skeleton)
    turned = rotation_angles(motion.rotations[:1], motion.rotations).max(axis=0) > _STILL
    travelling = [skeleton.names[0]] if np.ptp(motion.translation, axis=0).max() > still else []
    travelling += motion.joint_translations
    body = next((name for name in skeleton.names if labels.get(name) == "pelvis"), None)
    body = body or (travelling or skeleton.names)[0]
    ground = motion.positions()[:, skeleton.index(body)][:, [0, 2]]
    return {
        "turning_joints": [name for name, moves in zip(skeleton.names, turned) if moves],
        "travelling_joints": travelling,
        "path_length": float(np.linalg.norm(np.diff(ground, axis=0), axis=1).sum()),
        "displacement": float(np.linalg.norm(ground[-1] - ground[0])),
        "hand_speed_mean": float(figure.hand_speed.mean()),
        "hand_speed_max": float(figure.hand_speed.max()),
    }


def _feet(motion: Motion, labels: Mapping[str, str]) -> dict[str, Any]:
    """Return the fraction of frames in which each foot is in contact; empty if feet are unknown."""
    points = foot_points(motion.skeleton)
    if not points:
        return {}
    contacts = contact_labels(motion)
    sides = np.array([labels.get(point.joint, "").partition(" ")[0] for point in points])
    shares = {
        side: float(contacts[:, sides == side].any(axis=1).mean())
        for side in SIDES
        if side in sides
    }
    return {"contact_share": shares}


def _defects(motion: Motion) -> list[str]:
    found = []
    jumps = find_jumps(motion)
    if jumps is not None:
        found.append(
            f"{counted(len(jumps.frames), 'jump')} ({speed_limit(jumps.limit)}), the fastest "
            f"{format_speed(jumps.speed)} of {jumps.joint}: {_at(jumps.frames, motion.fps)}"
        )
    if pops := find_pops(motion, jumps):
        far = f", the largest {np.rad2deg(pops.angle):.0f}° of" if pops.angle else " of"
        found.append(
            f"{counted(len(pops.frames), 'pop')} away and back{far} {pops.joint}: "
            f"{_at(pops.frames, motion.fps)}"
        )
    if (share := jitter_share(motion)) > MAX_JITTER_SHARE:
        found.append(f"joints tremble from frame to frame in {100 * share:.0f} % of the time")
    for first, stop in frozen_runs(motion):
        found.append(
            f"nothing moves from {first / motion.fps:.2f} to {stop / motion.fps:.2f} s "
            f"(frames {first} to {stop - 1})"
        )
    start, end = reference_pose(motion)
    if start == motion.n_frames > 1:
        found.append("it is in its rest pose or a T-pose all the time")
    elif (start or end) and motion.n_frames > 1:
        where = [f"the first {counted(start, 'frame')}"] if start else []
        where += [f"the last {counted(end, 'frame')}"] if end else []
        found.append(f"rest pose or T-pose: {' and '.join(where)}")
    return found


def _at(frames: Sequence[int], fps: float) -> str:
    shown = listed([f"{frame} ({frame / fps:.2f} s)" for frame in frames], 4)
    return f"frame{'s' * (len(frames) > 1)} {shown}"


def _rows(
    motion: Motion, facts: Mapping[str, Any], labels: Mapping[str, str], speed_of: str
) -> list[tuple[str, str]]:
    skeleton, info = motion.skeleton, motion.info
    rows = [
        (
            "time",
            f"{span(motion.duration)}: {counted(motion.n_frames, 'frame')} at {motion.fps:.6g} fps"
            + (f" (Frame Time: {info['frame_time']})" if "frame_time" in info else ""),
        ),
        ("axes", _axes(facts)),
        ("body", f"{facts['height']:.2f} m {_measured(facts)}, {_counted(skeleton, labels)}"),
        ("moves", _moves(motion, facts)),
    ]
    if facts["format"] == "bvh":
        rows.insert(3, ("channels", _channels(motion)))
    if motion.n_frames > 1:
        hands = speed_of == "hand speed"
        who = "both together, relative to the pelvis" if hands else "mean of all joints"
        rows.append(
            (
                "hands" if hands else "speed",
                f"{facts['hand_speed_mean']:.2f} m/s on average, {facts['hand_speed_max']:.2f} "
                f"at most ({who})",
            )
        )
    if facts.get("contact_share"):
        shares = ", ".join(f"{k} {100 * v:.0f} %" for k, v in facts["contact_share"].items())
        slow = format_speed(CONTACT_SPEED * body_scale(skeleton))
        rows.append(("feet", f"stand still (heel or toe below {slow}): {shares} of the frames"))
        rows.append(("floor", f"the soles of standing feet are at Y = {facts['floor']:.2f} m"))
    if facts["upper_body_only"]:
        rows.append(("legs", "no legs: upper body only; contacts and foot metrics are left out"))
    if "meshes" in facts:
        rows += _contents(facts)
    if info.get("renamed"):
        pairs = [f"{new} (was {old})" for new, old in info["renamed"].items()]
        rows.append(("renamed", f"names that repeat: {listed(pairs)}"))
    return rows


def _contents(facts: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return rows on the meshes, animations and avatar of a glTF file."""
    animations = facts["animations"]
    named = f": {listed(animations)}" if animations else ""
    words = [counted(facts["meshes"], "mesh", "meshes"), counted(len(animations), "animation")]
    rows = [("contents", f"{', '.join(words)}{named}")]
    bones = facts["humanoid"]
    if facts["vrm"]:
        about = [f"VRM {facts['vrm']}", f"{counted(bones, 'humanoid bone')}"]
        about += [facts["name"]] if facts["name"] else []
        about += [f"by {facts['authors']}"] if facts["authors"] else []
        rows.append(("avatar", ", ".join(about)))
        rows.append(("licence", facts["licence"] or "none named"))
    elif bones:
        rows.append(("avatar", f"{counted(bones, 'bone')} with Mixamo's names: --body can draw it"))
    return rows


def _axes(facts: Mapping[str, Any]) -> str:
    """Describe the axes of the file, and the heading of the body after reading."""
    words = describe_axes(facts, " (guessed)")
    if (facts.get("up", "y"), facts.get("forward", "z")) != ("y", "z"):
        words.append("read as Y up, Z forward")
    turn = round(facts["facing_degrees"])
    side = ("+Z", "+X", "-Z", "-X")[round(turn / 90) % 4]
    words.append(f"the body faces {side} ({turn}° about Y) on average")
    return ", ".join(words)


def _measured(facts: Mapping[str, Any]) -> str:
    """Return what the height of the body means, in words."""
    return "as a whole person, by its arms" if facts["upper_body_only"] else "from sole to crown"


def _counted(skeleton: Skeleton, labels: Mapping[str, str]) -> str:
    kinds = Counter(labels.get(name, "") for name in skeleton.names)
    n_ends = sum(map(len, skeleton.end_sites.values()))
    words = [counted(skeleton.n_joints, "joint")]
    words += [
        f"{kinds[kind]} {plural}"
        for kind, plural in (("finger", "of fingers"), ("face", "of the face"), ("end", "ends"))
        if kinds[kind]
    ]
    return ", ".join([*words, *([counted(n_ends, "end site")] if n_ends else [])])


def _channels(motion: Motion) -> str:
    orders = Counter(motion.skeleton.rotation_orders).most_common()
    others = "".join(f", {order} on {counted(n, 'joint')}" for order, n in orders[1:])
    moving = [motion.skeleton.names[0], *motion.joint_translations]
    return f"angles {orders[0][0]}{others}; positions of {listed(moving, 4)}"


def _moves(motion: Motion, facts: Mapping[str, Any]) -> str:
    names, turning = motion.skeleton.names, set(facts["turning_joints"])
    still = [name for name in names if name not in turning]
    words = [f"{len(turning)} of {len(names)} joints turn"]
    if still and turning:
        words[0] += f" (not {listed(still, 4)})"
    travelling = facts["travelling_joints"]
    if travelling:
        words.append(
            f"{listed(travelling, 4)} change{'s' if len(travelling) == 1 else ''} place; the body "
            f"goes {facts['path_length']:.1f} m and ends {facts['displacement']:.1f} m from where "
            "it began"
        )
    else:
        words.append("nothing changes place")
    return "; ".join(words)


def _bytes(path: Path) -> int:
    if path.is_dir():
        return sum(file.stat().st_size for file in path.iterdir() if file.is_file())
    return path.stat().st_size
