"""Recorded motion that is played in pieces, chosen by the drawn state of movement.

A model plays its fingers and its face so, if they were recorded and are not modelled. The recipe
`retrieval`, a baseline, plays whole bodies, without a network.

Pieces are chosen one after another, so that a stream can do it too: the next piece is the one whose
recorded state is nearest to the drawn one, that goes on from the pose that is shown, and that was
not shown lately.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from gesturekit.motion.face import FaceTrack
from gesturekit.motion.motion import Motion
from gesturekit.motion.rotations import quaternion_from_sixd, sixd_from_quaternion
from gesturekit.multires.motion_vector import MultiresRepresentation
from gesturekit.training.model_folder import ModelParts
from gesturekit.wording import counted, roughly

_FRAMES_AT_ONCE = 1024
"""Frames decoded in one call, which bounds the memory of long motions."""
_STILL = 0.01
"""Standard deviation of a rotation's six numbers below which a joint does not move."""


@dataclass(frozen=True)
class PassiveChannels:
    """Fingers and other joints that move in the recordings but are not modelled, and the face.

    Attributes:
        joints: names of the F joints.
        face: names of the E channels of the face.
    """

    joints: tuple[str, ...] = ()
    face: tuple[str, ...] = ()

    @property
    def is_empty(self) -> bool:
        """True without such joints and without a face."""
        return not self.joints and not self.face

    @classmethod
    def find(cls, motions: Sequence[Motion], modelled: Sequence[str]) -> PassiveChannels:
        """Find the channels that move in the motions of one rig but are not modelled.

        Faces by rules are no recordings, and left out.
        """
        moving = []
        for j, name in enumerate(motions[0].skeleton.names):
            if name not in modelled:
                sixd = [sixd_from_quaternion(motion.rotations[:, j]) for motion in motions]
                if np.concatenate(sixd).std(axis=0).max() > _STILL:
                    moving.append(name)
        faces = [motion.face for motion in motions]
        recorded = {face.names if face and face.origin == "recorded" else () for face in faces}
        return cls(tuple(moving), recorded.pop() if len(recorded) == 1 else ())

    def encode(self, motion: Motion) -> np.ndarray:
        """Return (T, 6 F + E) float32 rotations and face channels."""
        index = [motion.skeleton.index(name) for name in self.joints]
        rows = sixd_from_quaternion(motion.rotations[:, index]).reshape(motion.n_frames, -1)
        if self.face and motion.face is not None:
            rows = np.concatenate([rows, motion.face.values], axis=1)
        return rows.astype(np.float32)

    def applied(self, motion: Motion, values: Callable[[slice], np.ndarray]) -> Motion:
        """Return the motion (T frames) with these channels.

        Args:
            motion: on the rig.
            values: returns the channels (N, 6 F + E) of a range of its frames.
        """
        rotations = motion.rotations.copy()
        index = [motion.skeleton.index(name) for name in self.joints]
        face = np.empty((motion.n_frames, len(self.face)))
        for start in range(0, motion.n_frames, _FRAMES_AT_ONCE):
            frames = slice(start, min(start + _FRAMES_AT_ONCE, motion.n_frames))
            rows = values(frames).astype(float)
            if index:
                sixd = rows[:, : 6 * len(index)].reshape(len(rows), len(index), 6)
                rotations[frames, index] = quaternion_from_sixd(sixd)
            face[frames] = rows[:, 6 * len(index) :]
        track = FaceTrack(self.face, face) if self.face else motion.face
        return replace(motion, rotations=rotations, face=track)


_POINTS = 8
"""Means over a piece by which states are compared."""
_USED, _CHANCE = 2.0, 0.5
"""Weight of the uses of the same part of a recording, and scale of the Gumbel noise."""
_FORGETTING = 0.9
"""Decay of the count of uses with each piece."""


_WHOLE = 2.0, 0.4, 24.0, 3.0
_PASSIVE = 4.0, 0.8, 12.0, 40.0
"""Seconds of a piece and of the cross-fade into it, which belongs to both pieces; and weights of
mean squared differences, in standard deviations: of states, and of poses in the cross-fade.

Fingers have to be as calm as recorded, and hardly to move at given times: each cross-fade adds
movement. Chosen on ZeroEGGS 067, by the quantiles of the fingers' angular speed."""


@dataclass(frozen=True, eq=False)
class RecordedMotion:
    """Part of a training recording.

    Attributes:
        state: (C + 1, T) channels of the state of movement, and voice activity.
        motion: (D, T) normalised motion vectors; (0, T) where the network makes them.
        passive: (X, T) of the library's `PassiveChannels`.
        speaker: its speaker; None if the corpus names none.
        style: number of its style; 0 without styles.
    """

    state: Tensor
    motion: Tensor
    passive: Tensor
    speaker: str | None
    style: int


class RecordedLibrary:
    """Recorded motion of a model, and the search for its pieces.

    Args:
        fps: frames per second.
        passive: joints and face channels that are not modelled.
        recordings: at least one.

    Attributes:
        is_whole: True if whole bodies are played.
        piece: frames of a piece.
        fade: frames of the cross-fade into a piece.
        hop: frames from one piece to the next.
        played: (N, D + X) float32, all recordings, one after another.
        starts: (S,) the frames at which a piece can begin, numbered across all recordings.
        recording_of: (S,) the recording of each of the `starts`.
        states: (S, (C + 1) P) float32, the state over the piece at each of the `starts`.
    """

    def __init__(
        self, fps: float, passive: PassiveChannels, recordings: tuple[RecordedMotion, ...]
    ) -> None:
        self.fps, self.passive, self.recordings = fps, passive, recordings
        self.is_whole = len(recordings[0].motion) > 0
        choice = _WHOLE if self.is_whole else _PASSIVE
        seconds, fade, self._state_weight, self._break_weight = choice
        lengths = [each.state.shape[1] for each in recordings]
        self.piece = max(1, min(round(seconds * fps), max(lengths)))
        self.fade = min(round(fade * fps), self.piece // 2)
        self.hop = self.piece - self.fade
        usable = [max(0, n - self.piece + 1) for n in lengths]
        first = np.cumsum([0, *lengths])
        self.starts = np.concatenate(
            [a + np.arange(n) for a, n in zip(first, usable, strict=False)]
        )
        self.recording_of = np.repeat(np.arange(len(recordings)), usable)
        self.played = np.concatenate(
            [torch.cat([each.motion, each.passive]).T.numpy() for each in recordings]
        )
        self._sizes = np.maximum(self.played.std(axis=0), 1e-3)
        pooled = np.concatenate([each.state.numpy() for each in recordings], axis=1)
        self._mean = pooled.mean(axis=1, keepdims=True)
        self._deviation = np.maximum(pooled.std(axis=1), 1e-3)[:, None]
        total = (pooled - self._mean) / self._deviation
        total = np.cumsum(np.pad(total, ((0, 0), (1, 0))), axis=1)
        edges = np.unique(np.linspace(0, self.piece, _POINTS + 1).round().astype(int))
        self._edges = [*pairwise(edges.tolist())]
        at = self.starts
        means = [(total[:, at + b] - total[:, at + a]) / (b - a) for a, b in self._edges]
        self.states = np.concatenate(means).T.astype(np.float32)

    def distances(self, state: np.ndarray) -> np.ndarray:
        """Return the cost (S,) of each start for a drawn state (C + 1, piece)."""
        rows = (state - self._mean) / self._deviation
        means = np.concatenate([rows[:, a:b].mean(axis=1) for a, b in self._edges])
        return self._state_weight * np.square(self.states - means).mean(axis=1)

    def breaks(self, shown: int) -> np.ndarray:
        """Return the cost (S,) of each start for the poses after a frame that is shown."""
        span = np.arange(0, max(1, self.fade), max(1, self.fade // 4))
        after = self.played[np.minimum(shown + span, len(self.played) - 1)]
        total = np.zeros(len(self.starts))
        for offset, pose in zip(span, after, strict=True):
            away = (self.played[self.starts + offset] - pose) / self._sizes
            total += np.square(away).mean(axis=1)
        return self._break_weight * total / len(span)

    def allowed(self, speaker: str | None, style: int | None) -> np.ndarray:
        """Return (S,) bool, the starts with this style and speaker, as far as there are any."""
        allowed = np.ones(len(self.starts), bool)
        for name, wanted in (("style", style), ("speaker", speaker)):
            if wanted is not None:
                fits = np.array([getattr(each, name) == wanted for each in self.recordings])
                narrower = allowed & fits[self.recording_of]
                allowed = narrower if narrower.any() else allowed
        return allowed


class Resumable:
    """Part of a stream that can go on from where another one was; its parts are such too."""

    kept: ClassVar[tuple[str, ...]]

    def state(self) -> dict[str, Any]:
        """Return what `restore` needs, as numbers and arrays."""
        parts = {name: getattr(self, name) for name in self.kept}
        return copy.deepcopy(
            {name: p.state() if hasattr(p, "restore") else p for name, p in parts.items()}
        )

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from the `state` of one with the same arguments."""
        for name, value in copy.deepcopy(dict(state)).items():
            if hasattr(part := getattr(self, name), "restore"):
                part.restore(value)
            else:
                setattr(self, name, value)


class PieceSequence(Resumable):
    """Pieces of a motion, chosen one after another.

    Args:
        library: recorded motion.
        rng_of: random generator of a piece, by its number; -1 for where the first one begins.
        speaker: use only this speaker's recordings, if there are any; None for all.
        style: number of the style of each frame, by its number; None for any.

    Attributes:
        is_whole: True if whole bodies are played.
    """

    kept = ("_chosen", "_used")

    def __init__(
        self,
        library: RecordedLibrary,
        rng_of: Callable[[int], torch.Generator],
        speaker: str | None,
        style: Callable[[int], int] | None,
    ) -> None:
        self._library, self._rng_of, self.is_whole = library, rng_of, library.is_whole
        self._speaker, self._style = speaker, style
        # Pieces meet elsewhere with every seed, so that other ones are chosen.
        self._first = int(torch.randint(library.hop, (), generator=rng_of(-1)))
        self._chosen: list[int] = []
        self._used = np.zeros(len(library.starts), np.float32)

    @property
    def next_frame(self) -> int:
        """The frame of the motion with which the next piece begins; the first is below 1."""
        return len(self._chosen) * self._library.hop - self._first

    def choose(self, state: np.ndarray) -> None:
        """Choose the next piece for a drawn state (C + 1, M); its last frame is held."""
        library, number = self._library, len(self._chosen)
        missing = library.piece - state.shape[1]
        if missing > 0:
            state = np.pad(state, ((0, 0), (0, missing)), mode="edge")
        middle = self.next_frame + library.piece // 2
        style = None if self._style is None else self._style(middle)
        uniform = torch.rand(len(library.starts), generator=self._rng_of(number)).double().numpy()
        cost = library.distances(state[:, : library.piece]) + _USED * self._used
        cost += _CHANCE * np.log(-np.log(np.clip(uniform, 1e-12, 1 - 1e-12)))
        if number:
            cost += library.breaks(self._chosen[-1] + library.hop)
        cost[~library.allowed(self._speaker, style)] = np.inf
        best = int(cost.argmin())
        near = np.abs(library.starts - library.starts[best]) < library.piece
        self._used = _FORGETTING * self._used + near
        self._chosen.append(int(library.starts[best]))

    def values(self, frames: np.ndarray) -> np.ndarray:
        """Return all that is played (M, D + X) at frames (M,) of the pieces chosen so far."""
        library = self._library
        piece = np.clip((frames + self._first) // library.hop, 0, len(self._chosen) - 1)
        into = frames + self._first - piece * library.hop
        chosen = np.array(self._chosen)
        last = len(library.played) - 1
        shown = library.played[np.clip(chosen[piece] + into, 0, last)]
        if not library.fade:
            return shown
        share = np.where(piece > 0, np.clip((into + 0.5) / library.fade, 0.0, 1.0), 1.0)
        before = np.clip(chosen[np.maximum(piece - 1, 0)] + into + library.hop, 0, last)
        share = share[:, None].astype(np.float32)
        return share * shown + (1 - share) * library.played[before]

    def with_passive(self, motion: Motion, first: int) -> Motion:
        """Return a motion with the fingers and the face of the pieces from frame `first` on."""
        passive, columns = self._library.passive, len(self._library.recordings[0].motion)

        def values(frames: slice) -> np.ndarray:
            return self.values(np.arange(frames.start, frames.stop) + first)[:, columns:]

        return motion if passive.is_empty else passive.applied(motion, values)


def played_pieces(
    library: RecordedLibrary,
    state: np.ndarray,
    rng_of: Callable[[int], torch.Generator],
    speaker: str | None,
    styles: np.ndarray | None,
) -> PieceSequence:
    """Return the pieces of a whole motion.

    Args:
        library: recorded motion.
        state: (C + 1, T) drawn state and voice activity.
        rng_of: see `PieceSequence`.
        speaker: see `PieceSequence`.
        styles: (T,) number of the style of each frame; None for any.
    """
    last = state.shape[1] - 1
    style = None if styles is None else (lambda frame: int(styles[min(max(frame, 0), last)]))
    pieces = PieceSequence(library, rng_of, speaker, style)
    while pieces.next_frame <= last:
        frames = np.clip(pieces.next_frame + np.arange(library.piece), 0, last)
        pieces.choose(state[:, frames])
    return pieces


_CURVES = ("state", "motion", "passive")


def library_values(library: RecordedLibrary) -> dict[str, Any]:
    """Return the plain values of a library."""
    return {
        "recordings": [[each.speaker, each.style] for each in library.recordings],
        "passive": {"joints": list(library.passive.joints), "face": list(library.passive.face)},
    }


def library_row(library: RecordedLibrary) -> str:
    """Return "30 joints and 50 face channels from 4 min of recordings, 1.2 MB of ..."."""
    passive = library.passive
    what = [counted(len(passive.joints), "joint")] if passive.joints else []
    what += [counted(len(passive.face), "face channel")] if passive.face else []
    size = sum(tensor.numel() for tensor in library_tensors(library).values()) * 4 / 1e6
    seconds = len(library.played) / library.fps
    played = "the whole body" if library.is_whole else " and ".join(what)
    return f"{played} from {roughly(seconds)} of recordings, {size:.1f} MB of model.safetensors"


def library_tensors(library: RecordedLibrary) -> dict[str, Tensor]:
    """Return the tensors of a library by name."""
    return {
        f"recorded.{i}.{name}": getattr(recording, name).contiguous()
        for i, recording in enumerate(library.recordings)
        for name in _CURVES
    }


def load_library(
    parts: ModelParts, representation: MultiresRepresentation, n_channels: int
) -> RecordedLibrary | None:
    """Read what `library_values` and `library_tensors` wrote; None for a model without.

    `n_channels` is the number of channels of the state of movement.

    Raises:
        ValueError: tensors whose shapes do not fit the model, or that are not finite.
    """
    values, tensors = parts.config["recorded"], parts.tensors
    if values is None:
        return None
    passive = PassiveChannels(
        tuple(map(str, values["passive"]["joints"])), tuple(map(str, values["passive"]["face"]))
    )
    for name in passive.joints:
        representation.skeleton.index(name)
    recordings = tuple(
        RecordedMotion(
            **{name: tensors[f"recorded.{i}.{name}"].float() for name in _CURVES},
            speaker=speaker,
            style=int(style),
        )
        for i, (speaker, style) in enumerate(values["recordings"])
    )
    sizes = {
        "state": n_channels + 1,
        "motion": representation.n_features if len(recordings[0].motion) else 0,
        "passive": 6 * len(passive.joints) + len(passive.face),
    }
    for i, recording in enumerate(recordings):
        n_frames = recording.state.shape[-1]
        for name, size in sizes.items():
            curves = getattr(recording, name)
            shape = tuple(curves.shape)
            if shape != (size, n_frames) or not n_frames or not torch.isfinite(curves).all():
                raise ValueError(
                    f"recorded.{i}.{name} has the shape {shape}, not {size} rows of finite numbers"
                )
    return RecordedLibrary(float(parts.config["fps"]), passive, recordings)
