"""Recordings as motion vectors and conditions, with all their variants.

Variants of a recording are its phases (`augmentation.phases`) and a mirrored copy of each.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gesturekit.corpus.item import Item, file_fingerprint
from gesturekit.corpus.styles import style_track
from gesturekit.diffusion.conditions import Conditions, smooth_path
from gesturekit.diffusion.config import DiffusionConfig
from gesturekit.diffusion.motion_vector import DeltaRepresentation
from gesturekit.diffusion.training.augmentation import mirror_condition, phase_item, phases
from gesturekit.diffusion.training.corpus import UnpairedRig
from gesturekit.diffusion.training.data import TrainingSequence
from gesturekit.errors import CorpusError, MotionError
from gesturekit.formats.tables import Event
from gesturekit.motion.mirroring import can_be_mirrored
from gesturekit.motion.motion import Motion
from gesturekit.motion.root_path import RootPath, follow_path
from gesturekit.training.recordings import Rig


@dataclass(frozen=True)
class Take:
    """A recording, or a phase of it, with its inputs beside speech."""

    name: str
    motion: Motion
    path: RootPath | None
    events: tuple[Event, ...]
    style: str | None


@dataclass(frozen=True, eq=False)
class VariantArrays:
    """Makes arrays (N, X + W): motion vectors, not normalised, and conditions beside speech.

    The variants of a recording follow one another: its phases, then their mirrored copies. They are
    the same rows in memory and on disk.

    Attributes:
        config: of the run.
        rig: of the corpus, or of unpaired motion.
        representation: of motion.
        conditions: the layout of conditions, without speech.
    """

    config: DiffusionConfig
    rig: Rig | UnpairedRig
    representation: DeltaRepresentation
    conditions: Conditions

    @property
    def is_paired(self) -> bool:
        """Return False for unpaired motion, which has no conditions but its path."""
        return isinstance(self.rig, Rig)

    def take(self, item: Item, motion: Motion) -> Take:
        """Return a recording with its inputs; with path condition, it is moved onto its path.

        Args:
            item: the recording, or a phase of it.
            motion: its motion at the model's frame rate.
        """
        path = None
        if self.config.path:
            path = self._path(item, motion)
            motion = follow_path(motion, path, self.representation.root)
        has_events = self.config.events and self.is_paired
        events = item.load_events() if has_events else ()
        return Take(item.id, motion, path, events, self._style(item))

    def rows(self, take: Take) -> np.ndarray:
        """Return motion vectors and conditions (T, X + W) float32 of a recording."""
        n_frames, fps = take.motion.n_frames, self.config.fps
        vectors = self._encode(take, take.motion, take.path)
        style = None
        if take.style is not None:
            style = style_track(self.conditions.styles, take.style, n_frames, fps)
        path = None if take.path is None else take.path.scaled(1 / self.representation.scale)
        condition = self.conditions.encode(
            n_frames, fps, path=path, events=take.events, style=style
        )
        return np.concatenate([vectors.astype(np.float32), condition], axis=1)

    def mirrored_rows(self, take: Take, rows: np.ndarray) -> np.ndarray:
        """Return the rows (T, X + W) float32 of the mirrored copy.

        Args:
            take: the recording.
            rows: its own.
        """
        path = None if take.path is None else take.path.mirror()
        vectors = self._encode(take, take.motion.mirror(), path)
        columns = self.conditions.columns
        condition = mirror_condition(
            rows[:, vectors.shape[1] :],
            path=columns["path"],
            path_offset=self.conditions.path_mean / self.conditions.path_scale,
            events=columns["events"],
            event_names=self.conditions.events,
        )
        return np.concatenate([vectors.astype(np.float32), condition], axis=1)

    def sequence(self, name: str, rows: np.ndarray, speech: np.ndarray) -> TrainingSequence:
        """Return training data in memory, as long as the shorter of motion and speech.

        Args:
            name: of the recording or variant.
            rows: (T, X + W).
            speech: (T', S) features.
        """
        n_frames, width = min(len(rows), len(speech)), self.representation.n_features
        motion = np.ascontiguousarray(rows[:n_frames, :width])
        condition = np.concatenate([speech[:n_frames], rows[:n_frames, width:]], axis=1)
        return TrainingSequence(name, motion, condition, self.is_paired)

    def is_mirrored(self, style: str | None) -> bool:
        """Return whether recordings of a style have mirrored copies."""
        styles = self.config.styles
        handed = styles is not None and styles.is_handed(style)
        wanted = self.config.augmentation.mirror and not handed
        return wanted and can_be_mirrored(self.representation.skeleton)

    def origin(self, item: Item) -> dict[str, Any]:
        """Return all that the rows of an item depend on."""
        known, conditions, style = self.representation, self.conditions, self._style(item)
        used = [("path", self.config.path), ("events", self.config.events)]
        tables = [name for name, is_used in used if is_used and self.is_paired]
        return {
            **self.rig.origin(item),
            "vectors": [list(known.joints), known.makes_root, known.scale],
            "references": [known.side.tolist(), known.references.tolist()],
            "conditions": conditions.to_values(),
            "path": [conditions.path_mean.tolist(), conditions.path_scale.tolist()],
            "tables": {
                name: file_fingerprint(item.conditions[name])
                for name in tables
                if name in item.conditions
            },
            "style": style,
            "settings": [self.config.fps, self.is_mirrored(style), self.is_paired],
        }

    def make(self, item: Item) -> tuple[np.ndarray, dict[str, Any]]:
        """Encode the variants of an item."""
        recorded = self.rig.load(item)
        found = phases(recorded, self.config.fps)
        takes = [
            self.take(phase_item(item, k, phase.start), phase.motion)
            for k, phase in enumerate(found)
        ]
        rows = [self.rows(take) for take in takes]
        about = {
            "id": item.id,
            "fps": recorded.fps,
            "seconds": recorded.duration,
            "starts": [phase.start for phase in found],
            "lengths": list(map(len, rows)),
            "mirrored": self.is_mirrored(self._style(item)),
        }
        if about["mirrored"]:
            pairs = zip(takes, list(rows), strict=True)
            rows += [self.mirrored_rows(take, own) for take, own in pairs]
        return np.concatenate(rows), about

    def _style(self, item: Item) -> str | None:
        return item.style if self.conditions.styles and self.is_paired else None

    def _path(self, item: Item, motion: Motion) -> RootPath:
        """Return the path of the item's table, or the smoothed root path of the motion."""
        fps, n_frames, scale = self.config.fps, motion.n_frames, self.representation.scale
        own = self.representation.path_of(motion)
        given = item.load_path(fps, n_frames, scale) if self.is_paired else None
        path = smooth_path(given or own, fps, n_frames)
        # A table may have another origin; a model only gets the displacements of a path.
        apart = (own.positions - path.positions).mean(axis=0)
        return replace(path, positions=path.positions + apart)

    def _encode(self, take: Take, motion: Motion, path: RootPath | None) -> np.ndarray:
        """Return motion vectors (T, X)."""
        try:
            return self.representation.encode(motion, path)
        except MotionError as error:
            raise CorpusError(f"{self.config.corpus}: item {take.name}: {error}") from None
