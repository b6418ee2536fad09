"""Finger chains of each hand, identified by joint names."""

from __future__ import annotations

import re

from gesturekit.motion.parts import BodyParts
from gesturekit.motion.skeleton import Skeleton

FINGERS = ("thumb", "index", "middle", "ring", "little")
_WORDS = {
    "thumb": r"thumb",
    "index": r"index",
    "middle": r"middle|mid(?![a-z])",
    "ring": r"ring(?![a-z])",
    "little": r"pink(?:y|ie)|little",
}
_BY_NUMBER = re.compile(r"finger[ _]?([0-4])")
"""Names of 3ds Max, counted from the thumb: Finger0, Finger01, Finger02, Finger1, ..."""
_IN_THE_PALM = re.compile(r"metacarpal|carpal|_mc(?![a-z])")


def finger_chains(skeleton: Skeleton, parts: BodyParts, side: str) -> dict[str, tuple[int, ...]]:
    """Return finger to its joints from the knuckle outwards, for the fingers that are found.

    Bones within the palm (metacarpals) are left out, except that of the thumb.
    """
    wrist = parts.arms[side].wrist
    if wrist is None:
        return {}
    chains: dict[str, list[int]] = {}
    for joint in skeleton.descendants(skeleton.index(wrist)):
        kind = _kind(skeleton.names[joint])
        if kind is None:
            continue
        chain = chains.setdefault(kind, [])
        # Side branches (nails, helpers) are not part of the chain.
        if not chain or skeleton.parents[joint] == chain[-1]:
            chain.append(joint)
    return {kind: tuple(chains[kind]) for kind in FINGERS if kind in chains}


def _kind(name: str) -> str | None:
    """Return the finger that a joint name belongs to."""
    name = name.rsplit(":", 1)[-1].lower()
    for kind, words in _WORDS.items():
        if re.search(words, name):
            return None if kind != "thumb" and _IN_THE_PALM.search(name) else kind
    numbered = _BY_NUMBER.search(name)
    return FINGERS[int(numbered[1])] if numbered else None
