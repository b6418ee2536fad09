"""Recording of a stream: its motion in any format that is written, and the sound beside it."""

from __future__ import annotations

import struct
import tempfile
import wave
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

import numpy as np

from gesturekit.errors import ConfigError, GestureKitError
from gesturekit.formats.fbx import blender_command
from gesturekit.formats.npz import frames_header, frames_rows, read_frames
from gesturekit.formats.registry import writer_of
from gesturekit.live.runner import Step


def partial_of(path: Path) -> Path:
    """Return the file that holds the frames of a recording until it is whole, beside a .wav."""
    return path.with_name(f"{path.stem}_{path.suffix[1:]}_partial.frames")


class Recording:
    """Sink that writes a file of all motion at the end.

    Until then frames and sound are in the files of `partial_of`, as they came. They stay if the
    disk is full or the process is killed, and both can be read.

    Args:
        path: file to write.
        sample_rate: of the sound, which is written as a .wav of the same name; None without.

    Raises:
        FormatError: no motion is written to such a file, or it needs Blender, which is not found.
        OSError: the folder cannot be written to.
    """

    def __init__(self, path: Path, sample_rate: int | None = None) -> None:
        writer_of(path, ())
        if path.suffix.lower() == ".fbx":
            blender_command(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=path.parent).close()
        self._path, self._rate, self._partial = path, sample_rate, partial_of(path)
        self._frames: BinaryIO | None = None
        self._sound: wave.Wave_write | None = None
        self._is_cut = False

    def put(self, step: Step) -> None:
        """Append a step.

        Raises:
            ConfigError: the disk is full; the message names what was kept.
        """
        try:
            if self._rate is not None and len(step.samples):
                self._append_sound(step.samples, self._rate)
            if step.motion is not None:
                if self._frames is None:
                    self._frames = self._partial.open("wb")
                    self._frames.write(frames_header(step.motion))
                self._frames.write(frames_rows(step.motion))
                self._frames.flush()
        except (OSError, struct.error) as error:  # struct's: a .wav of 4 GiB
            raise self._cut(error) from None

    def close(self) -> None:
        """Write the files.

        Raises:
            ConfigError: there was no motion, or the files cannot be written; in that case the
                message names what was kept.
        """
        if self._is_cut:
            return
        for file in self._files():
            file.close()
        sound = self._partial.with_suffix(".wav")
        if self._frames is None:
            sound.unlink(missing_ok=True)
            raise ConfigError(f"{self._path}: nothing to record, as no sound came")
        try:
            read_frames(self._partial).save(self._path)
            if self._sound is not None:
                sound.replace(self._path.with_suffix(".wav"))
        except (OSError, GestureKitError) as error:
            raise self._cut(error) from None
        self._partial.unlink()

    def _append_sound(self, samples: np.ndarray, rate: int) -> None:
        """Write samples as 16 bits; the header counts them at once, so that the file is whole."""
        if self._sound is None:
            self._sound = wave.open(str(self._partial.with_suffix(".wav")), "wb")  # noqa: SIM115
            self._sound.setparams((1, 2, rate, 0, "NONE", ""))
        whole = np.clip(np.rint(samples * 32768), -32768, 32767)
        self._sound.writeframes(whole.astype("<i2").tobytes())

    def _files(self) -> list[BinaryIO | wave.Wave_write]:
        return [file for file in (self._frames, self._sound) if file is not None]

    def _cut(self, error: Exception) -> ConfigError:
        """End the recording, and return an error that names what there is of it."""
        self._is_cut = True
        for file in self._files():
            with suppress(OSError, struct.error):  # of what it could not write
                file.close()
        kept = [self._partial, self._partial.with_suffix(".wav")]
        names = " and ".join(str(file) for file in kept if file.exists())
        reason = error.strerror if isinstance(error, OSError) else error
        return ConfigError(
            f"{self._path}: {reason}; {names} hold what came until then: "
            f"gesturekit convert {self._partial} {self._path.name}"
        )
