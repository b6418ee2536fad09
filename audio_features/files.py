"""Features that a user computed, read from files that lie beside the sounds or in a folder."""

from __future__ import annotations

import logging
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import soundfile

from audio_features.errors import FeatureError, WeightsError, check_values
from audio_features.track import NO_NUMBER, FeatureTrack, bad_value
from audio_features.wave import Wave, stands_for_sound

SLACK = 0.5
"""Seconds by which features may end before the sound, in addition to two of their frames."""
_MOST_COLUMNS = 1 << 16

log = logging.getLogger(__name__)


class Files:
    """Features from a file for each sound: npz or csv (`FeatureTrack.load`), or npy with a rate.

    The file of SOUND.wav is SOUND with the suffix, beside the sound or in a folder. A folder has
    the structure of the folder of sounds, or holds all files side by side. Values (T, D) are taken
    by their true times: `times` (T,) in seconds, or `start + k / rate` for row k of an npy. An
    array (D,) holds for the whole sound. Silence that is no file has zeros.

    Args:
        dim: D, the number of columns.
        suffix: end of the file's name, such as ".hubert.npy"; by default ".npy" with a rate, else
            ".npz".
        rate: rows per second of an npy.
        start: time of its first row, in seconds from the start of the sound file.
        centred: whether each clip's own mean is removed, as for an encoder of speech. False keeps
            what a clip's mean says, such as an emotion.
        folder: folder of the files; None for beside the sounds. It is no part of the spec.

    Raises FeatureError for settings out of range, and WeightsError for a missing folder.

    Examples:
        Two columns at 4 rows per second, of which the second row is at 0.25 s:

        >>> np.save(folder / "talk.npy", [[0, 0], [4, 8], [0, 0]])
        >>> wave = af.Wave(np.zeros(12000), 16000, source=str(folder / "talk.wav"))
        >>> af.Files(2, rate=4).extract(wave).at([0.125, 0.25]).values
        array([[2., 4.],
               [4., 8.]], dtype=float32)
    """

    worth_caching = False  # the sound does not determine the file

    def __init__(
        self,
        dim: int = 0,
        suffix: str | None = None,
        rate: float | None = None,
        start: float = 0.0,
        centred: bool = False,
        folder: str | os.PathLike[str] | None = None,
    ) -> None:
        suffix = (".npz" if rate is None else ".npy") if suffix is None else suffix
        is_name = isinstance(suffix, str) and Path(f"a{suffix}").name == f"a{suffix}"
        is_kind = is_name and suffix.lower().endswith((".npz", ".csv", ".npy")) and suffix[0] == "."
        self._is_npy = is_kind and suffix.lower().endswith(".npy")
        is_rate = isinstance(rate, int | float) and 1e-3 <= rate <= 1e6
        is_time = isinstance(start, int | float) and math.isfinite(start)
        is_size = isinstance(dim, int) and 1 <= dim <= _MOST_COLUMNS
        values = (
            ("dim", dim, is_size, "the number of columns (dim: 64, files:64)"),
            ("suffix", suffix, is_kind, ".npz, .csv, .npy or .NAME.npy"),
            ("rate", rate, is_rate or not self._is_npy, f"rows per second of {suffix} (--rate 50)"),
            ("start", start, is_time, "seconds"),
            ("centred", centred, isinstance(centred, bool), "true or false"),
        )
        check_values(FeatureError, "files: ", values)
        self.dim, self.suffix, self.rate, self.start = dim, suffix, rate, start
        self.folder = None if folder is None else Path(folder)
        if self.folder is not None and not self.folder.is_dir():
            raise WeightsError(f"{folder}: no such folder: give the folder of the *{suffix} files")
        self.names = tuple(f"files{suffix}_{i}" for i in range(dim))
        self.centred = (centred,) * dim
        self.spec: dict[str, Any] = {"kind": "files", "dim": dim, "suffix": suffix}
        given = {"rate": rate, "start": start or None, "centred": centred or None}
        self.spec |= {name: value for name, value in given.items() if value is not None}

    def find(self, sound: str | os.PathLike[str]) -> Path | None:
        """Return the file of a sound; None if there is none.

        In a folder, of the files that fit, the one with the longest common path counts: of
        data/s1/talk.wav first s1/talk.npy, then talk.npy. A file of features in place of the sound
        (`stands_for_sound`) is itself the file, unless the suffix has a name (.NAME.npz) or is npy.
        """
        if stands_for_sound(sound) and self.suffix.lower() in (".npz", ".csv"):
            return Path(sound)
        beside = Path(os.path.abspath(sound)).with_suffix(self.suffix)  # noqa: PTH100 (keeps links)
        if self.folder is None:
            return beside if beside.is_file() else None
        parts = beside.parts[1:]
        places = (self.folder.joinpath(*parts[i:]) for i in range(len(parts)))
        return next((place for place in places if place.is_file()), None)

    def extract(self, wave: Wave) -> FeatureTrack:
        """Read the features of the part of its file that a wave is: values (T, D).

        Raises FeatureError, which names the file and the sound, if there is no file, if it is
        damaged, has another number of columns, or ends before the sound.
        """
        if wave.source is None and wave.is_silent:
            return FeatureTrack(np.zeros((1, self.dim)), np.zeros(1), self.spec, self.names)
        path = None if wave.source is None else self.find(wave.source)
        if path is None:
            name = Path(wave.source or "STEM.wav").with_suffix(self.suffix).name
            where = "beside it" if self.folder is None else f"in {self.folder}"
            npy = "" if self._is_npy else " (an npy needs a rate)"
            missing = f"no file of features {name} {where}{npy}: compute it, or name its folder"
            raise FeatureError(f"{wave.source}: {missing} (folder:, --weights files=FOLDER)")
        try:
            return self._part(*self._read(path), wave, path)
        except (OSError, FeatureError) as error:
            reason = str(error).removeprefix(f"{path}: ")
            raise FeatureError(f"{path}, features of {wave.source}: {reason}") from error

    def _read(self, path: Path) -> tuple[np.ndarray, np.ndarray]:
        """Return values (T, D), which an npy leaves on disk, and times (T,)."""
        if not self._is_npy:
            track = FeatureTrack.load(path)
            values, times, shape = track.values, track.times, track.values.shape
        else:
            values, times = open_npy(path), np.empty(0)
            shape = values.shape
            if values.dtype.kind not in "fiub":
                raise FeatureError(f"holds {values.dtype}, not numbers: save plain numbers")
            if values.ndim == 1:
                values = values[None]
            if values.ndim == 2 and values.shape[0] == self.dim != values.shape[1]:
                values = values.T  # (D, T), as librosa has it
        if values.ndim != 2 or values.shape[1] != self.dim or not len(values):
            raise FeatureError(f"shape {shape}: expected (T, {self.dim}), T > 0")
        if self._is_npy and self.rate is not None:
            times = self.start + np.arange(len(values)) / self.rate
        return values, times

    def _part(self, values: np.ndarray, times: np.ndarray, wave: Wave, path: Path) -> FeatureTrack:
        """Return the rows within the wave and the ones beside it, in the wave's own time.

        The last time is compared with the end of the sound: a wrong rate must not pass.
        """
        slack = SLACK + 2 * float(np.median(np.diff(times[:1000]))) if len(times) > 1 else math.inf
        start, end = wave.offset, wave.offset + wave.duration
        if times[-1] < end - slack or times[0] > start + slack:
            rows = f"its {len(times)} rows are from {times[0]:.2f} to {times[-1]:.2f} s"
            sound = f"the sound from {start:.2f} to {end:.2f} s"
            raise FeatureError(f"{rows}, {sound}: check the rate and the file")
        if times[-1] > end + slack and times[-1] > (whole := _length(wave)) + slack:
            text = "%s: its rows end at %.2f s, the sound %s at %.2f s; check the rate"
            log.warning(text, path, times[-1], wave.source, whole)
        first = max(0, int(np.searchsorted(times, start, side="right")) - 1)
        rows_of_wave = slice(first, int(np.searchsorted(times, end)) + 1)
        part = values[rows_of_wave]
        if (bad := bad_value(part)) is not None:
            row, column = bad
            raise FeatureError(f"row {first + row}, column {column}: {part[bad]:g} {NO_NUMBER}")
        return FeatureTrack(part, times[rows_of_wave] - start, self.spec, self.names)

    def __repr__(self) -> str:
        return f"Files({self.spec})"


def own_files(extractor: Any, sound: str | os.PathLike[str]) -> list[Path | None]:
    """Return the file of a sound for each `Files` among the extractors of a stack."""
    parts = getattr(extractor, "parts", (extractor,))
    return [part.find(sound) for part in parts if isinstance(part, Files)]


def open_npy(path: Path) -> np.ndarray:
    """Return the array of an npy, which stays on disk; objects are never loaded.

    Raises FeatureError for another file.
    """
    try:
        return np.lib.format.open_memmap(path, mode="r")
    except OSError:
        raise
    except Exception as error:  # numpy's parser of headers raises anything
        raise FeatureError("not a whole npy of plain numbers: write it with numpy.save") from error


def _length(wave: Wave) -> float:
    """Return the seconds of the whole file of a wave, as far as its header says."""
    try:
        return soundfile.info(wave.source).duration
    except (RuntimeError, OSError, ValueError):
        return math.inf
