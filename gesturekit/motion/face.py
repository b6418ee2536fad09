"""Face tracks: named channels over time, such as ARKit's blendshapes or SMPL-X coefficients."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.skeleton import checked

MAX_CHANNELS = 1000

_SIDED = """
    browDown browOuterUp cheekSquint eyeBlink eyeLookDown eyeLookIn eyeLookOut eyeLookUp eyeSquint
    eyeWide jaw mouth mouthDimple mouthFrown mouthLowerDown mouthPress mouthSmile mouthStretch
    mouthUpperUp noseSneer
"""
_MIDDLE = """
    browInnerUp cheekPuff jawForward jawOpen mouthClose mouthFunnel mouthPucker mouthRollLower
    mouthRollUpper mouthShrugLower mouthShrugUpper tongueOut
"""
_BY_SIDE = [name + side for name in _SIDED.split() for side in ("Left", "Right")]
ARKIT = tuple(sorted([*_MIDDLE.split(), *_BY_SIDE]))
"""Names of ARKit's 52 blendshapes, sorted; Left and Right are the person's own."""


@dataclass(frozen=True, eq=False)
class FaceTrack:
    """Values of E named face channels for each frame; frame k belongs to frame k of the motion.

    Attributes:
        names: E different names. ARKit's (`ARKIT`) are blendshapes with values in [0, 1];
            `smplx_names(E)` are SMPL-X coefficients, which have no bounds; others are kept as
            they are.
        values: (T, E) float64. Values of ARKit's channels are limited to [0, 1].
        origin: "recorded", or "rules" for a face that was computed from speech by rules.

    Raises:
        MotionError: shapes that do not match, values that are not finite, a name twice or empty,
            or another origin.

    Examples:
        >>> face = gk.FaceTrack(("jawLeft", "jawRight"), [[0.2, 0.0], [1.5, 0.0]])
        >>> face.mirror().values.tolist()
        [[0.0, 0.2], [0.0, 1.0]]
    """

    names: tuple[str, ...]
    values: np.ndarray
    origin: str = "recorded"

    def __post_init__(self) -> None:
        names = tuple(map(str, self.names))
        if len(set(names)) != len(names) or not all(names):
            raise MotionError("names of face channels must differ, and none be empty")
        if len(names) > MAX_CHANNELS:
            raise MotionError(f"{len(names)} face channels; expected at most {MAX_CHANNELS}")
        if self.origin not in ("recorded", "rules"):
            raise MotionError(f"origin {self.origin!r} of a face; expected recorded or rules")
        values = checked("face", self.values, (None, len(names)), "frame")
        limited = [i for i, name in enumerate(names) if name in ARKIT]
        if limited and ((part := values[:, limited]) != (inside := part.clip(0, 1))).any():
            values = values.copy()
            values[:, limited] = inside
        object.__setattr__(self, "names", names)
        object.__setattr__(self, "values", values)

    def __len__(self) -> int:
        return len(self.values)

    def channel(self, name: str) -> np.ndarray:
        """Return the (T,) values of one channel.

        Raises:
            MotionError: no such channel.
        """
        if name not in self.names:
            raise MotionError(f"no face channel {name!r}; there are {', '.join(self.names[:60])}")
        return self.values[:, self.names.index(name)]

    def changed(self, change: Callable[[np.ndarray], np.ndarray]) -> FaceTrack:
        """Return the face at other frames; `change` makes values (T', E) of values (T, E)."""
        return replace(self, values=change(self.values))

    def mirror(self) -> FaceTrack:
        """Return the face with left and right exchanged.

        A channel named Left or Right takes the values of its counterpart; others are kept, and
        SMPL-X coefficients too, because they have no known sides.
        """
        other = {"Left": "Right", "Right": "Left"}
        twins = [re.sub("Left|Right", lambda side: other[side[0]], name) for name in self.names]
        sources = [twin if twin in self.names else name for name, twin in zip(self.names, twins)]
        return replace(self, values=self.values[:, [self.names.index(name) for name in sources]])


def values_of(face: FaceTrack, names: Iterable[str]) -> np.ndarray:
    """Return the values (T, N) of N channels, 0 for those that a face lacks."""
    given = dict(zip(face.names, face.values.T))
    return np.stack([given.get(name, np.zeros(len(face))) for name in names], axis=1)


def smplx_names(n_coefficients: int) -> tuple[str, ...]:
    """Return the names of SMPL-X face coefficients, "expression0" to "expression99"."""
    return tuple(f"expression{i}" for i in range(n_coefficients))


def smplx_face(values: np.ndarray) -> FaceTrack:
    """Return SMPL-X face coefficients (T, E) as a face."""
    return FaceTrack(smplx_names(np.shape(values)[-1]), values)


def is_smplx(face: FaceTrack) -> bool:
    """Return whether a face has SMPL-X coefficients."""
    return face.names == smplx_names(len(face.names))


def joined_faces(faces: Sequence[FaceTrack | None]) -> FaceTrack | None:
    """Return the frames of several faces; None unless all have the same channels."""
    first = faces[0]
    if first is None or any(face is None or face.names != first.names for face in faces):
        return None
    values = np.concatenate([face.values for face in faces if face is not None])
    origins = {face.origin for face in faces if face is not None}
    return FaceTrack(first.names, values, "rules" if "rules" in origins else "recorded")
