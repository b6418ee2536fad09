"""A body model for tests."""

from typing import Any

import numpy as np

from gesturekit.motion import Skeleton

RING = 8  # vertices around a bone


def body_of_tubes(rig: Skeleton, pelvis: np.ndarray) -> dict[str, Any]:
    """The arrays of an SMPL-like model: a tube around each bone, and a box for each foot."""
    joints = np.zeros((rig.n_joints, 3))
    joints[0] = pelvis
    for j, parent in enumerate(rig.parents[1:], start=1):
        joints[j] = joints[parent] + rig.offsets[j]
    vertices, weights, faces, centred = [], [], [], {0: []}

    def add(place: np.ndarray, **shares: float) -> int:
        vertices.append(place)
        row = np.zeros(rig.n_joints)
        for joint, share in shares.items():
            row[int(joint[1:])] += share
        weights.append(row)
        return len(vertices) - 1

    def ring(centre: np.ndarray, axis: np.ndarray, radius: float, **shares: float) -> list[int]:
        side = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
        side /= np.linalg.norm(side)
        other = np.cross(axis, side)
        turn = 2 * np.pi * np.arange(RING) / RING
        spokes = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * other
        return [add(centre + radius * spoke, **shares) for spoke in spokes]

    for j, parent in enumerate(rig.parents[1:], start=1):
        bone = joints[j] - joints[parent]
        length = np.linalg.norm(bone)
        axis = bone / length
        radius = 0.008 if length < 0.05 else 0.32 * length if length < 0.2 else 0.065
        rings = []
        for at, thick, own in ((0.0, 0.8, 0.0), (0.3, 1.0, 0.0), (0.7, 0.9, 0.1), (1.0, 0.7, 0.5)):
            shares = {f"j{parent}": 1 - own, f"j{j}": own}
            rings.append(ring(joints[parent] + at * bone, axis, thick * radius, **shares))
        centred.setdefault(j, rings[-1])
        centred[0] = centred[0] or rings[0]
        for low, high in zip(rings, rings[1:]):
            for k in range(RING):
                a, b, c, d = low[k], low[(k + 1) % RING], high[k], high[(k + 1) % RING]
                faces += [(a, b, c), (b, d, c)]
        for end, flip in ((rings[0], True), (rings[-1], False)):
            for k in range(1, RING - 1):
                corner = (end[0], end[k], end[k + 1])
                faces.append(corner[::-1] if flip else corner)
    feet = []
    for side, out in (("left", 1), ("right", -1)):
        ankle, foot = rig.index(f"{side}_ankle"), rig.index(f"{side}_foot")
        floor = joints[foot, 1] - 0.02
        corners = []
        for height in (0.0, 0.05):
            for x, z, joint in ((-0.03, 0.09, foot), (0.05, 0.06, foot), (0.0, -0.06, ankle)):
                base = joints[foot] if joint == foot else joints[ankle]
                place = np.array([base[0] + out * x, floor + height, base[2] + z])
                corners.append(add(place, **{f"j{joint}": 1.0}))
        feet += corners[:3]  # big toe, small toe, heel
        a, b, c, d, e, f = corners
        box = [
            (a, b, c),
            (d, f, e),
            (a, d, e),
            (a, e, b),
            (b, e, f),
            (b, f, c),
            (c, f, d),
            (c, d, a),
        ]
        faces += [face if out < 0 else face[::-1] for face in box]
    skin = np.array(vertices)
    regressor = np.zeros((rig.n_joints, len(skin)))
    for j, around in centred.items():
        regressor[j, around] = 1 / len(around)
    rng = np.random.default_rng(0)
    shapes = rng.normal(0, 0.002, (len(skin), 3, 20))
    shapes[..., 0] = 0.05 * (skin - pelvis)  # the first coefficient makes the body larger
    return {
        "v_template": skin,
        "f": np.array(faces, dtype=np.uint32),
        "weights": np.array(weights),
        "shapedirs": shapes,
        "posedirs": rng.normal(0, 0.0003, (len(skin), 3, 9 * (rig.n_joints - 1))),
        "J_regressor": regressor,
        "kintree_table": np.array([[2**32 - 1, *rig.parents[1:]], range(rig.n_joints)]),
        "feet": np.array(feet),
    }
