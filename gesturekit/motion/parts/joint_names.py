"""Side of the body and bone from joint names."""

from __future__ import annotations

import re
from collections.abc import Iterable

from gesturekit.motion.skeleton import Skeleton

SIDES = ("left", "right")

_LEFT_WORD = re.compile("left", re.IGNORECASE)
# An "l" at the beginning of a word (start, after a sign or digit, or a capital after a lower-case
# letter): "L_Hip", "b_l_arm", "upper_arm.L", "HandL", "lfemur".
_LEFT_LETTER = re.compile(r"(?<![A-Za-z])[lL]|(?<=[a-z])L(?![a-z])")

# The same for either side, but only as a separate letter: "lfemur" alone has no side.
_SIDE_LETTER = re.compile(r"(?<![A-Za-z])[lLrR](?![a-z])|(?<=[a-z])[LR](?![a-z])")


def named_pairs(skeleton: Skeleton) -> tuple[tuple[str, str], ...]:
    """Return (left, right) names of joints that differ only by the side, in order."""
    pairs = []
    names = set(skeleton.names)
    for name in skeleton.names:
        for other in _right_names(name):
            if other in names and other != name:
                pairs.append((name, other))
                break
    return tuple(pairs)


def _right_names(name: str) -> Iterable[str]:
    """Yield possible names of the right counterpart, if `name` is a left joint."""
    for match in _LEFT_WORD.finditer(name):
        right = {"left": "right", "LEFT": "RIGHT"}.get(match[0], "Right")
        yield name[: match.start()] + right + name[match.end() :]
    for match in _LEFT_LETTER.finditer(name):
        right = "R" if match[0] == "L" else "r"
        yield name[: match.start()] + right + name[match.end() :]


def named_side(name: str) -> str:
    """Return the side in a single name, "left" or "right"; "" if it has none."""
    found = {side for side in SIDES if side in name.lower()}
    if not found:
        letters = (match[0].lower() for match in _SIDE_LETTER.finditer(name))
        found = {SIDES["lr".index(letter)] for letter in letters}
    return found.pop() if len(found) == 1 else ""


def bare_name(name: str, side: str) -> str:
    """Return a name in lower case without namespace, side, digits and signs: "forearm"."""
    name = name.rsplit(":", 1)[-1]
    if side and side in name.lower():
        name = re.sub(side, " ", name, flags=re.IGNORECASE)
    elif side:
        letter = side[0]
        marks = rf"(?<![A-Za-z])(?i:{letter})(?![a-z])|(?<=[a-z]){letter.upper()}(?![a-z])"
        name, count = re.subn(marks, " ", name)
        if not count:  # "lfemur", "LHipJoint"
            name = name[1:]
    return re.sub("[^a-z]", "", name.lower())
