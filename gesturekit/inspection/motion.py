"""Summary of a motion: rig with body parts, axes, frame rate, movement, defects."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gesturekit.corpus.checks import MAX_JITTER_SHARE, reference_pose
from gesturekit.formats.conventions import plausibility_warnings
from gesturekit.formats.gltf.vrm import avatar_facts
from gesturekit.formats.sources import describe_axes, load_with_warnings
from gesturekit.inspection.summary import Summary, span
from gesturekit.motion.contacts import contact_labels, foot_points
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
    skeleton, figure = motion.skeleton, Figure.of(motion)
    labels, unknown_parts = known_part_labels(skeleton)
    form = "EasyMocap" if path.is_dir() else path.suffix.lower()[1:]
    facts: dict[str, Any] = {
        "path": str(path),
        "format": form,
        "frames": motion.n_frames,
        "fps": motion.fps,
        "facing_degrees": math.degrees(figure.front),
        "height": figure.height,
        "floor": figure.floor,
        "joints": list(skeleton.names),
        "face": list(motion.face.names) if motion.face else [],
        "parts": labels,
        **_movement(motion, figure, labels),
        "contact_share": {},
    }
    if foot_points(skeleton):
        feet = zip(SIDES, np.split(contact_labels(motion), 2, axis=1))
        facts["contact_share"] = {side: float(on.any(axis=1).mean()) for side, on in feet}
    rows = _rows(motion, facts, figure)
    if path.suffix.lower() in _GLTF:
        rows |= _contents(avatar_facts(path))
    problems = [*warnings, *plausibility_warnings(motion, options)]
    problems += [*([unknown_parts] if unknown_parts else []), *_defects(motion)]
    title = f"{path}: {'avatar' if 'licence' in rows else 'motion'}, {form}"
    return Summary("motion", title, facts, rows, problems, tree(skeleton, labels))


def _movement(motion: Motion, figure: Figure, labels: Mapping[str, str]) -> dict[str, Any]:
    skeleton = motion.skeleton
    still = _STANDS * body_scale(skeleton)
    turned = rotation_angles(motion.rotations[:1], motion.rotations).max(axis=0) > _STILL
    travelling = [skeleton.names[0]] if np.ptp(motion.translation, axis=0).max() > still else []
    travelling += motion.joint_translations
    pelvis = [name for name, label in labels.items() if label == "pelvis"]
    body = [*pelvis, *travelling, *skeleton.names][0]
    ground = motion.positions()[:, skeleton.index(body)][:, [0, 2]]
    return {
        "turning_joints": [name for name, moves in zip(skeleton.names, turned) if moves],
        "travelling_joints": travelling,
        "path_length": float(np.linalg.norm(np.diff(ground, axis=0), axis=1).sum()),
        "displacement": float(np.linalg.norm(ground[-1] - ground[0])),
        "hand_speed_mean": float(figure.hand_speed.mean()),
        "hand_speed_max": float(figure.hand_speed.max()),
    }


def _rows(motion: Motion, facts: Mapping[str, Any], figure: Figure) -> dict[str, str]:
    skeleton, turn = motion.skeleton, round(facts["facing_degrees"])
    side = ("+Z", "+X", "-Z", "-X")[round(turn / 90) % 4]
    axes = [*describe_axes(motion.info, " (guessed)"), f"the body faces {side} ({turn}° about Y)"]
    n_ends = sum(map(len, skeleton.end_sites.values()))
    joints = counted(skeleton.n_joints, "joint")
    moves = f"{len(facts['turning_joints'])} of {joints} turn"
    if facts["travelling_joints"]:
        moves += f"; {listed(facts['travelling_joints'], 4)} changes place; the body goes "
        moves += f"{facts['path_length']:.1f} m and ends {facts['displacement']:.1f} m away"
    speeds = f"{facts['hand_speed_mean']:.2f} m/s on average, {facts['hand_speed_max']:.2f} at most"
    shares = [f"{side} {100 * share:.0f} %" for side, share in facts["contact_share"].items()]
    feet = f"in contact in {', '.join(shares)} of the frames; floor at Y = {figure.floor:.2f} m"
    frames, face = counted(motion.n_frames, "frame"), ""
    if track := motion.face:
        origin = "made by rules from speech" if track.origin == "rules" else track.origin
        face = f"{counted(len(track.names), 'channel')}, {origin}: {listed(track.names, 4)}"
    return {
        "time": f"{span(motion.duration)}: {frames} at {motion.fps:.6g} fps",
        "axes": ", ".join(axes),
        "body": f"{figure.height:.2f} m, {joints}, {counted(n_ends, 'end site')}",
        "moves": moves,
        figure.speed_of: speeds if motion.n_frames > 1 else "",
        "feet": feet if shares else "",
        "legs": "none: upper body only" if is_upper_body(skeleton) else "",
        "face": face,
    }


def _contents(facts: Mapping[str, Any]) -> dict[str, str]:
    """Return rows on the meshes, animations and avatar of a glTF file."""
    meshes, bones = counted(facts["meshes"], "mesh", "meshes"), facts["humanoid"]
    rows = {"contents": f"{meshes}; animations: {listed(facts['animations']) or 'none'}"}
    if facts["vrm"]:
        about = [f"VRM {facts['vrm']}", f"{counted(bones, 'humanoid bone')}", facts["name"]]
        about += [f"by {facts['authors']}" if facts["authors"] else ""]
        rows |= {"avatar": ", ".join(filter(None, about)), "licence": facts["licence"] or "none"}
    elif bones:
        rows["avatar"] = f"{counted(bones, 'bone')} with Mixamo's names: --body can draw it"
    return rows


def _defects(motion: Motion) -> Iterator[str]:
    jumps = find_jumps(motion)
    if jumps is not None:
        yield (
            f"{counted(len(jumps.frames), 'jump')} ({speed_limit(jumps.limit)}), the fastest "
            f"{format_speed(jumps.speed)} of {jumps.joint}: {_at(jumps.frames, motion.fps)}"
        )
    if pops := find_pops(motion, jumps):
        far = f", the largest {np.rad2deg(pops.angle):.0f}°" if pops.angle else ""
        pop = f"{counted(len(pops.frames), 'pop')} away and back{far}"
        yield f"{pop} of {pops.joint}: {_at(pops.frames, motion.fps)}"
    if (share := jitter_share(motion)) > MAX_JITTER_SHARE:
        yield f"joints tremble from frame to frame in {100 * share:.0f} % of the time"
    for first, stop in frozen_runs(motion):
        seconds = f"{first / motion.fps:.2f} to {stop / motion.fps:.2f} s"
        yield f"nothing moves from {seconds} (frames {first} to {stop - 1})"
    start, end = reference_pose(motion)
    if start == motion.n_frames > 1:
        yield "it is in its rest pose or a T-pose all the time"
    elif motion.n_frames > 1:
        ends = {"first": start, "last": end}
        where = [f"the {name} {counted(n, 'frame')}" for name, n in ends.items() if n]
        if where:
            yield f"rest pose or T-pose: {' and '.join(where)}"


def _at(frames: Sequence[int], fps: float) -> str:
    return f"frame {listed([f'{frame} ({frame / fps:.2f} s)' for frame in frames], 4)}"


def tree(skeleton: Skeleton, labels: Mapping[str, str]) -> list[str]:
    """Return a drawing of the rig: one line a limb, below the limb it hangs on, parts in brackets.

    Args:
        skeleton: the rig.
        labels: {joint name: part}; empty if parts cannot be identified.
    """
    lines, waiting = list[str](), [(0, "")]
    while waiting:
        joint, indent = waiting.pop()
        chain, children = [joint], list(skeleton.children(joint))
        while len(children) == 1:
            chain += children
            children = list(skeleton.children(children[0]))
        names = [skeleton.names[joint] for joint in chain]
        parts = [labels.get(name, "") for name in names]
        # Neighbours of one part have one label.
        is_last = [part not in ("", "other", after) for part, after in zip(parts, [*parts[1:], ""])]
        words = [f"{n} [{p}]" if last else n for n, p, last in zip(names, parts, is_last)]
        below = [skeleton.names[j] for j in skeleton.descendants(chain[-1])] if children else []
        if below and all(labels.get(name) in ("finger", "end") for name in below):
            words.append(f"{len(below)} joints of fingers")
            children = []
        lines.append(indent + " > ".join(words))
        waiting += [(child, f"{indent}  ") for child in reversed(children)]
    return lines
