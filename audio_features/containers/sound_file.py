"""Reading a sound file block by block, and holding it to what its header promised."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import soundfile

from audio_features.containers import Promise, ffmpeg_line, read_promise
from audio_features.errors import AudioError

_BLOCK = 1 << 20  # numbers (samples times channels) decoded at a time, so that memory is bounded

Stretch = Callable[[int, int], tuple[int, int]]
"""(samples a channel, rate) to (first sample, number of samples) of what is wanted."""


def read_sound(name: str, stretch: Stretch, channel: int | None) -> tuple[np.ndarray, int]:
    """One channel, or the mean of all: (N,) float32 and the sample rate.

    Args:
        name: path of the file.
        stretch: which samples are wanted; raises where there are none.
        channel: counted from 1; None for the mean of all channels.

    Raises AudioError where the file is missing, is no sound, is damaged or ends too soon.
    """
    if not Path(name).is_file():
        what = "not a regular file" if Path(name).exists() else "no such file"
        raise AudioError(f"{name}: {what}: give the path of a sound file")
    try:
        if Path(name).stat().st_size == 0:
            raise AudioError(f"{name}: the file is empty (0 bytes): export it again")
        promise = read_promise(name)
        with _opened(name, promise) as file:
            _check_length(file, name, promise)
            first, count = stretch(file.frames, file.samplerate)
            return _read(file, name, promise, first, count, channel), file.samplerate
    except (soundfile.LibsndfileError, OSError, TypeError, UnicodeError) as error:
        # TypeError is what soundfile says to files named .raw; UnicodeError to names that are
        # no text.
        reason = str(error).removeprefix(f"Error opening {name!r}: ").rstrip(".")
        raise AudioError(
            f"{name}: cannot be read as sound ({reason}): "
            f"give a wav, flac, ogg or mp3 file, or run {ffmpeg_line(name)}"
        ) from error
    except MemoryError as error:
        raise AudioError(f"{name}: too long for this machine's memory: split it") from error


class _Unsized(io.FileIO):
    """A wav whose length is 0 for "unknown", shown with the 0xFFFFFFFF that libsndfile knows."""

    def __init__(self, name: str, at: int) -> None:
        super().__init__(name)
        self._at = at

    def readinto(self, buffer: bytearray | memoryview) -> int:
        """Fill the buffer, with the four bytes of the length changed."""
        start = self.tell()
        count = super().readinto(buffer)
        for at in range(max(self._at, start), min(self._at + 4, start + count)):
            memoryview(buffer)[at - start] = 0xFF
        return count


def _opened(name: str, promise: Promise) -> soundfile.SoundFile:
    if promise.unsized_at is None:
        return soundfile.SoundFile(name)
    return soundfile.SoundFile(io.BufferedReader(_Unsized(name, promise.unsized_at)))


def _check_length(file: soundfile.SoundFile, name: str, promise: Promise) -> None:
    if promise.frames is not None and promise.frames != file.frames:
        raise AudioError(
            f"{name}: damaged: the header declares {promise.frames} samples a channel, "
            f"{file.frames} can be found: copy or export the file again"
        )


def _read(
    file: soundfile.SoundFile,
    name: str,
    promise: Promise,
    first: int,
    count: int,
    channel: int | None,
) -> np.ndarray:
    if channel is not None and not 1 <= channel <= file.channels:
        raise AudioError(f"{name}: channel {channel}: the file has {file.channels}, counted from 1")
    whole = first == 0 and count == file.frames
    digest = hashlib.md5(usedforsecurity=False) if whole and promise.md5 else None
    samples = np.empty(count, dtype=np.float32)
    if first:
        file.seek(first)
    done = 0
    while done < count:
        block = file.read(
            min(count - done, max(1, _BLOCK // file.channels)), dtype="float32", always_2d=True
        )
        if len(block) == 0:
            break
        here = samples[done : done + len(block)]
        if channel is None:
            np.mean(block, axis=1, out=here)
        else:
            here[:] = block[:, channel - 1]
        if digest is not None:
            digest.update(_integers(block, promise.md5[1]))
        done += len(block)
    if file.format in ("MP3", "MPEG"):  # a stream that only estimates its length
        least = promise.least if whole else 0
    else:
        least = count
    if done < least:
        raise AudioError(
            f"{name}: truncated: the header declares {first + least} samples a channel, "
            f"only {first + done} can be read: copy or export the file again"
        )
    if digest is not None and digest.digest() != promise.md5[0]:
        raise AudioError(
            f"{name}: damaged: the sound is not what its MD5 in the header says: "
            "copy or export the file again"
        )
    return samples[:done]


def _integers(block: np.ndarray, bits: int) -> bytes:
    """Decoded samples as FLAC's MD5 takes them: signed little-endian integers, interleaved."""
    integers = np.rint(block * np.float32(1 << (bits - 1))).astype("<i4")
    size = bits // 8
    return integers.view(np.uint8).reshape(*block.shape, 4)[..., :size].tobytes()
