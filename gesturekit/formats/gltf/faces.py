"""Faces in glTF files: names of morph targets; values, names and nodes of VRM's expressions.

Source: the specifications of VRMC_vrm 1.0, VRMC_vrm_animation 1.0 and VRM 0.x; names of targets are
a convention of exporters.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from gesturekit.formats.gltf.file import Gltf
from gesturekit.motion.face import ARKIT, FaceTrack, is_smplx, values_of

VMC_NAMES = {
    **{"aa": "A", "ih": "I", "ou": "U", "ee": "E", "oh": "O"},
    **{"blink": "Blink", "blinkLeft": "Blink_L", "blinkRight": "Blink_R"},
    **{"happy": "Joy", "angry": "Angry", "sad": "Sorrow", "relaxed": "Fun"},
    **{"surprised": "Surprised", "neutral": "Neutral"},
}
"""VRM 1.0's preset expressions, and their names in VRM 0.x, which programs expect over VMC."""
_GAZE = ("lookUp", "lookDown", "lookLeft", "lookRight")
"""Presets that no .vrma file may animate."""
_VOWELS = ("aa", "ih", "ou", "ee", "oh")
_OF_MOUTH = ("jawOpen", "mouthFunnel", "mouthPucker", "mouthStretchLeft", "mouthStretchRight")
_OF_EYES = {"blinkLeft": "eyeBlinkLeft", "blinkRight": "eyeBlinkRight"}


def target_names(gltf: Gltf, node: dict[str, Any]) -> tuple[list[str], int]:
    """Return the names of the morph targets of a node's mesh, and the number of the targets."""
    mesh = gltf.item("meshes", node["mesh"]) if "mesh" in node else {}
    names = gltf.values(gltf.object(mesh, "extras"), "targetNames")
    first = gltf.items("primitives", mesh)[:1]  # all have as many
    return list(map(str, names)), sum(len(gltf.values(each, "targets")) for each in first)


def expressions_of(face: FaceTrack) -> dict[str, np.ndarray]:
    """Return the values (T,), in [0, 1], of expressions: presets first, then channels by name.

    Presets that the face lacks are made of ARKit's channels. With o = jawOpen - mouthClose (at
    least 0), w the mean of mouthStretchLeft and -Right, f = mouthFunnel and p = mouthPucker: aa is
    o (1 - max(w, f, p)), ih is w (1 - o), ee is w o, ou is p and oh is f; their sum is limited
    to 1. SMPL-X coefficients are no expressions.
    """
    if is_smplx(face):
        return {}
    given = dict(zip(face.names, face.values.clip(0, 1).T))
    mouth = values_of(face, [*_OF_MOUTH, "mouthClose"]).clip(0, 1)
    opened, funnel, pucker, left, right, closed = mouth.T
    opened = np.maximum(opened - closed, 0)
    wide = (left + right) / 2
    others = np.maximum.reduce([wide, funnel, pucker])
    shares = opened * (1 - others), wide * (1 - opened), pucker, wide * opened, funnel
    vowels = np.array(shares) / np.maximum(sum(shares), 1)
    made = dict(zip(_VOWELS, vowels)) if given.keys() & set(_OF_MOUTH) else {}
    made |= {preset: given[name] for preset, name in _OF_EYES.items() if name in given}
    return {name: values for name, values in (made | given).items() if name not in _GAZE}


def without_derived(names: Iterable[str]) -> list[str]:
    """Return names of expressions; beside ARKit's, without presets that are made of them."""
    names = list(names)
    derived = (*_VOWELS, *_OF_EYES) if set(names) & set(ARKIT) else ()
    return [name for name in names if name not in derived]


def expression_nodes(gltf: Gltf) -> dict[str, int]:
    """Return the node of each expression of a .vrma file, whose x is the value.

    Raises:
        FormatError: a node that does not exist.
    """
    extension = gltf.object(gltf.object(gltf.json, "extensions"), "VRMC_vrm_animation")
    groups, n_nodes = gltf.object(extension, "expressions"), len(gltf.items("nodes"))
    return {
        name: gltf.whole(gltf.object(entries, name).get("node"), n_nodes, f"node of {name[:60]!r}")
        for entries in (gltf.object(groups, kind) for kind in ("preset", "custom"))
        for name in entries
    }
