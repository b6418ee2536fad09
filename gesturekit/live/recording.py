"""Recording of a stream: its motion in any format that is written, and the sound beside it."""

from __future__ import annotations

import tempfile
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import soundfile

from audio_features.atomic import atomic_write
from gesturekit.errors import ConfigError
from gesturekit.formats.registry import writer_of
from gesturekit.live.runner import Step
from gesturekit.motion import Motion


class Recording:
    """Sink that writes a file of all motion at the end.

    Until then frames lie in a temporary file beside it, so that hours take no memory.

    Args:
        path: file to write.
        sample_rate: of the sound, which is written as a .wav of the same name; None without.

    Raises:
        FormatError: no motion is written to such a file.
        OSError: the folder cannot be written to.
    """

    def __init__(self, path: Path, sample_rate: int | None = None) -> None:
        writer_of(path, ())
        path.parent.mkdir(parents=True, exist_ok=True)
        self._path, self._first = path, None
        with ExitStack() as files:
            self._frames = files.enter_context(tempfile.TemporaryFile(dir=path.parent))
            self._sound = None
            if sample_rate is not None:
                wav = files.enter_context(atomic_write(path.with_suffix(".wav")))
                self._sound = files.enter_context(
                    soundfile.SoundFile(wav, "w", sample_rate, 1, "PCM_16")
                )
            self._files = files.pop_all()

    def put(self, step: Step) -> None:
        """Append a step."""
        if self._sound is not None:
            self._sound.write(step.samples)
        if step.motion is not None:
            self._first = self._first or step.motion[:1]
            _rows(step.motion).tofile(self._frames)

    def close(self) -> None:
        """Write the files; the sound is whole even if the motion cannot be written.

        Raises:
            ConfigError: there was no motion.
            OSError: the disk is full.
        """
        with self._files:
            if self._first is None:
                raise ConfigError(f"{self._path}: nothing to record, as no sound came")
            motion = self._recorded(self._first)
        motion.save(self._path)

    def _recorded(self, first: Motion) -> Motion:
        """Return all motion, whose numbers stay on disk; `first` is its first frame."""
        rows = np.memmap(self._frames, np.float64, "r").reshape(-1, _rows(first).shape[1])
        n_joints = first.skeleton.n_joints
        ends = 3 + 4 * n_joints
        turns = rows[:, 3:ends].reshape(len(rows), n_joints, 4)
        starts = range(ends, rows.shape[1], 3)
        moving = {name: rows[:, at : at + 3] for name, at in zip(first.joint_translations, starts)}
        return Motion(first.skeleton, turns, rows[:, :3], first.fps, moving)


def _rows(motion: Motion) -> np.ndarray:
    """Return a motion's numbers as rows (T, D), one a frame."""
    turns = motion.rotations.reshape(motion.n_frames, -1)
    return np.concatenate([motion.translation, turns, *motion.joint_translations.values()], axis=1)
