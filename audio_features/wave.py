"""Wave: one validated channel of sound at the sample rate of its file."""

from __future__ import annotations

import hashlib
import math
import os
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from numbers import Real
from pathlib import Path

import numpy as np
import soxr
from numpy.typing import ArrayLike

from audio_features.archive import open_archive, read_number_table
from audio_features.errors import AudioError
from audio_features.sound_file import (
    CANCELLING,
    interpolated,
    numbers,
    one_channel,
    open_sound,
    read_channel,
)

MIN_SECONDS = Fraction(25, 1000)
"""Shortest sound accepted: 400 samples at 16 kHz, the input of one WavLM frame."""
SAMPLE_RATES = (4_000, 768_000)
"""Lowest and highest sample rate accepted, in Hz."""
SILENCE_DBFS = -75.0
"""Active level below which a clip counts as silent."""
ACTIVE_RANGE_DB = 20.0
"""A frame is active when its power is within this range of the mean power of active frames."""
SPEECH_LEVEL_DBFS = -23.0
"""Default active level of `Wave.at_level` (the target of EBU R128)."""

_FULL_SCALE = 0.999  # 16-bit files clip at 32767/32768, resampled ones a little lower
_UNLIMITED = 2.0  # with a higher peak, a floating-point file was not clipped at full scale
_DC_OFFSET = 0.01
_BLOCK = 1 << 20  # samples processed at a time, which bounds the memory for long files


def stands_for_sound(path: str | os.PathLike[str]) -> bool:
    """Return whether a file has features in place of sound: npz or csv (`FeatureTrack.load`)."""
    return os.fspath(path).lower().endswith((".npz", ".csv"))


def exact_rate(fps: float | Fraction) -> Fraction:
    """Convert a frame rate to a fraction, so that frame counts are exact.

    Floats are rounded to the nearest fraction with a denominator of at most 1001: 25.0 is 25,
    29.97 is 2997/100, and the float 30000/1001 is NTSC's own 30000/1001.

    Raises AudioError if `fps` is not a positive, finite number.

    Examples:
        >>> af.exact_rate(25.0), af.exact_rate(29.97), af.exact_rate(30000 / 1001)
        (Fraction(25, 1), Fraction(2997, 100), Fraction(30000, 1001))
    """
    rate = Fraction(fps).limit_denominator(1001) if math.isfinite(fps) else Fraction(0)
    if rate <= 0:
        raise AudioError(f"fps is {fps!r}: give a positive number of frames per second")
    return rate


_SILENCE_RATE = 16000


@dataclass(frozen=True, eq=False)
class Wave:
    """One channel of sound.

    Args:
        samples: (N,) floats, full scale is ±1; stored as float32.
        sample_rate: Hz, 4,000 to 768,000.
        source: origin of the sound for messages, usually a path.
        offset: time of the first sample in `source`, seconds.
        words: file with the words of `source`; None for the one beside it, see `load_words`.
        repairs: changes that `load` or `from_array` made to a faulty sound, in phrases.

    Raises AudioError if the samples are not one finite channel of at least 25 ms.

    Examples:
        Three seconds at 16 kHz, and their frames at 29.97 frames per second:

        >>> wave = af.Wave(np.zeros(48000), 16000)
        >>> wave
        Wave(3.00 s at 16000 Hz)
        >>> wave.n_frames(29.97)
        90
        >>> len(wave.resample(8000).samples)
        24000
    """

    samples: np.ndarray
    sample_rate: int
    source: str | None = None
    offset: float = 0.0
    words: str | os.PathLike[str] | None = None
    repairs: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        name = self.source or "samples"
        samples = np.asarray(self.samples)
        if samples.ndim != 1 or samples.dtype.kind != "f":
            held = f"shape {samples.shape} of {samples.dtype}"
            raise AudioError(f"{name}: {held}, expected one channel (N,) of floats to ±1")
        object.__setattr__(self, "samples", np.ascontiguousarray(samples, dtype=np.float32))
        object.__setattr__(self, "sample_rate", checked_rate(self.sample_rate, name))
        if Fraction(len(samples), self.sample_rate) < MIN_SECONDS:
            held = f"{len(samples)} samples at {self.sample_rate} Hz"
            ms, least = 1000 * self.duration, 1000 * float(MIN_SECONDS)
            raise AudioError(f"{name}: {held} are {ms:.1f} ms: give at least {least:.0f} ms")
        finite = np.isfinite(self.samples)
        if not finite.all():
            bad = int(np.argmin(finite))
            where = f"sample {bad} ({bad / self.sample_rate:.3f} s) is {self.samples[bad]}"
            raise AudioError(f"{name}: {where}: export the sound again without it")

    def __repr__(self) -> str:
        source = "" if self.source is None else f" of {self.source!r}"
        if self.offset:
            source += f" from {self.offset:g} s"
        return f"Wave({self.duration:.2f} s at {self.sample_rate} Hz{source})"

    @classmethod
    def load(
        cls,
        path: str | os.PathLike[str],
        *,
        start: float = 0.0,
        duration: float | None = None,
        channel: int | None = None,
        max_seconds: float = 4 * 3600,
    ) -> Wave:
        """Read a sound file: wav, flac, ogg (vorbis, opus), mp3, aiff, au, NIST SPHERE.

        A file of features (`stands_for_sound`) gives silence of its length, for which `Files` takes
        its features.

        Args:
            path: the file; any sample rate, any number of channels.
            start: start of the segment to read, in seconds.
            duration: its length in seconds; None reads to the end, and a segment that extends
                past the end is cut there.
            channel: channel to read, counted from 1 as in sox and audio editors (1 is the left
                one); by default the mean of all, or the loudest one if they cancel in the mean
                (one of two is inverted). Give it if two speakers share a stereo file.
            max_seconds: longest segment that is read into memory.

        Memory depends on the length of the segment (4 bytes per sample), not on the channels.

        Raises AudioError for a missing, unreadable, truncated, damaged, empty or too short file,
        a missing channel, and more than 1 % of samples that are not finite; fewer are interpolated.
        The length in the header is compared with the decoded sound, so that no truncated file is
        accepted silently; only an MP3 may hold no length.
        """
        name = os.fspath(path)
        if stands_for_sound(name):
            return _silence_of(name, max_seconds).slice(start, duration)
        with open_sound(name) as file:
            rate = checked_rate(file.samplerate, name)
            first, count = _segment(name, file.frames, rate, start, duration, max_seconds)
            samples, used = read_channel(file, name, first, count, channel)
        repairs = [CANCELLING.format(used)] if used != channel else []
        samples = interpolated(samples, rate, repairs)
        return cls(samples, rate, name, float(start), repairs=tuple(repairs))

    @classmethod
    def from_array(
        cls, samples: ArrayLike, sample_rate: int | None, source: str | None = None
    ) -> Wave:
        """Make a wave of an array as returned by librosa, soundfile, torchaudio or transformers.

        Args:
            samples: (N,), or (C, N) or (N, C), which are averaged over the C channels (the
                shorter axis). A numpy array, a list, or a torch tensor on any device. Floats
                have full scale ±1; integers of 8 to 32 bits are scaled by their range.
            sample_rate: Hz.
            source: as in `Wave`.

        Faults are repaired as by `load`. Raises AudioError without a rate, and for arrays that are
        not sound.
        """
        name = source or "samples"
        values = numbers(samples, name)
        if sample_rate is None:
            raise AudioError(f"{name}: an array without rate: give sample_rate, such as 16000")
        rate, repairs = checked_rate(sample_rate, name), []
        if values.ndim == 2:
            values, used = one_channel(values)
            repairs = [CANCELLING.format(used)] if used is not None else []
        values = interpolated(values, rate, repairs)
        return cls(values, rate, source, repairs=tuple(repairs))

    @property
    def duration(self) -> float:
        """Length in seconds."""
        return len(self.samples) / self.sample_rate

    def n_frames(self, fps: float | Fraction) -> int:
        """Return the number of frames at `fps`: floor(duration·fps + ½), in exact arithmetic."""
        return math.floor(
            Fraction(len(self.samples), self.sample_rate) * exact_rate(fps) + Fraction(1, 2)
        )

    def resample(self, sample_rate: int) -> Wave:
        """Resample the sound (soxr HQ) to ceil(N·new/old) samples."""
        if sample_rate == self.sample_rate:
            return self
        sample_rate = checked_rate(sample_rate, "sample_rate")
        samples = soxr.resample(self.samples, self.sample_rate, sample_rate, quality="HQ")
        # soxr's length may differ by one from the ceiling; frame counts must not depend on that.
        n = -(-len(self.samples) * sample_rate // self.sample_rate)
        samples = np.pad(samples[:n], (0, max(0, n - len(samples))))
        return replace(self, samples=samples, sample_rate=sample_rate)

    def slice(self, start: float, duration: float | None = None) -> Wave:
        """Cut out `duration` seconds from `start`, or up to the end of the sound."""
        name = self.source or "samples"
        first, count = _segment(
            name, len(self.samples), self.sample_rate, start, duration, math.inf
        )
        part = self.samples[first : first + count]
        return replace(self, samples=part, offset=self.offset + first / self.sample_rate)

    def rms(self, times: np.ndarray, window: float = 0.05) -> np.ndarray:
        """Compute the root mean square around given times, about the clip's mean (no DC offset).

        Args:
            times: (M,) seconds, ascending; centres of the windows.
            window: length in seconds; windows are cut at the ends of the sound.

        Returns (M,) float64; 0 for windows completely outside the sound.
        """
        n = len(self.samples)
        centres = np.asarray(times, dtype=np.float64) * self.sample_rate
        if np.any(np.diff(centres) < 0):
            raise AudioError("times must ascend: sort them first")
        half = window * self.sample_rate / 2
        first = np.clip(np.rint(centres - half), 0, n).astype(np.int64)
        last = np.clip(np.rint(centres + half), 0, n).astype(np.int64)
        power = np.zeros(len(centres))
        done = 0
        while done < len(centres):
            stop = int(np.searchsorted(first, first[done] + _BLOCK, side="left"))
            origin, end = first[done], last[stop - 1]
            energy = np.zeros(end - origin + 1)
            block = self.samples[origin:end].astype(np.float64) - self._mean
            np.cumsum(np.square(block, out=block), out=energy[1:])
            length = np.maximum(last[done:stop] - first[done:stop], 1)
            power[done:stop] = energy[last[done:stop] - origin] - energy[first[done:stop] - origin]
            power[done:stop] /= length
            done = stop
        return np.sqrt(np.maximum(power, 0.0))

    def active(self, hop: float = 0.01) -> np.ndarray:
        """Detect speech on frames of 25 ms centred every `hop` seconds.

        A frame is active if its power is at most 20 dB below the mean power of the active
        frames. The set is found by starting from all frames and removing quieter ones until it
        no longer changes. This is the gating of EBU R128 and ITU-T P.56 without an absolute
        gate: the same sound at another level has the same active frames. A clip whose active
        level is below -75 dBFS has none.

        Returns (n_frames(1/hop),) bool.
        """
        return self._activity(hop)[0]

    def active_level(self) -> float:
        """Return the RMS of the active frames in dBFS (0 is a full-scale square wave), or -inf."""
        return self._level

    @property
    def is_silent(self) -> bool:
        """True if no frame is active: digital silence, or noise below -75 dBFS."""
        return self._level == -math.inf

    def faults(self) -> list[str]:
        """Describe audible faults of the recording in phrases; empty for a good recording.

        Faults are silence, clipping (three or more consecutive samples at full scale), and a DC
        offset of at least 1 % of full scale. None of them is an error: acoustic features remove
        level and offset, and silence gives idle motion.
        """
        faults = []
        if self.is_silent:
            faults.append(f"silence: no speech above {SILENCE_DBFS:.0f} dBFS")
        level = np.abs(self.samples)
        peak = float(level.max())
        full = level >= _FULL_SCALE
        flat = np.flatnonzero(full[2:] & full[1:-1] & full[:-2])  # third in a run
        if len(flat) and peak <= _UNLIMITED:
            where = f"the first at {flat[0] / self.sample_rate:.2f} s: record at a lower level"
            faults.append(f"clipped: {len(flat)} samples at full scale, {where}")
        # Floats may have another full scale than 1, for example 32768.
        offset = self._mean / (peak if peak > _UNLIMITED else 1.0)
        if abs(offset) >= _DC_OFFSET:
            faults.append(f"DC offset of {100 * offset:+.1f} % of full scale: high-pass it")
        return faults

    def at_level(self, dbfs: float = SPEECH_LEVEL_DBFS) -> Wave:
        """Scale the active level to `dbfs` and remove the DC offset; silence is unchanged."""
        if self.is_silent:
            return self
        gain = 10.0 ** ((dbfs - self._level) / 20.0)
        samples = self.samples * np.float32(gain)
        samples -= np.float32(gain * self._mean)
        return replace(self, samples=samples)

    @cached_property
    def digest(self) -> str:
        """Hexadecimal sha256 of the sample rate and the samples."""
        found = hashlib.sha256(f"{self.sample_rate} ".encode())
        found.update(self.samples.data)
        return found.hexdigest()

    @cached_property
    def _mean(self) -> float:
        return float(np.mean(self.samples, dtype=np.float64))

    @cached_property
    def _level(self) -> float:
        return self._activity(0.01)[1]

    def _activity(self, hop: float) -> tuple[np.ndarray, float]:
        """Return the active frames (M,) bool and their level in dBFS."""
        times = np.arange(self.n_frames(1 / Fraction(hop).limit_denominator(1000))) * hop
        power = np.square(self.rms(times, window=0.025))
        active = power > 0.0
        while active.any():
            louder = power >= power[active].mean() * 10.0 ** (-ACTIVE_RANGE_DB / 10.0)
            if np.array_equal(louder, active):
                break
            active = louder
        level = 10.0 * math.log10(power[active].mean()) if active.any() else -math.inf
        if level < SILENCE_DBFS:
            return np.zeros_like(active), -math.inf
        return active, level


def checked_rate(rate: int, name: str) -> int:
    """Return a sample rate as int; raise AudioError unless it is a whole number in range."""
    low, high = SAMPLE_RATES
    if not isinstance(rate, Real) or not low <= rate <= high or int(rate) != rate:
        raise AudioError(f"{name}: sample rate {rate!r} Hz, expected an integer, {low} to {high}")
    return int(rate)


def _segment(
    name: str, n: int, rate: int, start: float, duration: float | None, max_seconds: float
) -> tuple[int, int]:
    """Return the first sample and the number of samples of a segment given in seconds."""
    if not 0 <= start < math.inf or not (duration is None or 0 < duration < math.inf):
        raise AudioError(f"{name}: start is {start} s, duration {duration} s: give seconds from 0")
    first = round(start * rate)
    if first >= n > 0:
        raise AudioError(f"{name}: start is {start} s but the sound ends at {n / rate:.3f} s")
    count = n - first if duration is None else min(n - first, round(duration * rate))
    if count > max_seconds * rate:
        limit = f"{count / rate:.1f} s of sound exceed the limit of {max_seconds:g} s"
        raise AudioError(f"{name}: {limit}: give start and duration, or max_seconds")
    return first, count


def _silence_of(path: str, max_seconds: float) -> Wave:
    """Return silence as long as the features in a file; raise AudioError for another file."""
    if path.lower().endswith(".csv"):
        times = read_number_table(Path(path), AudioError)[:, 0]
    else:
        with open_archive(path, AudioError) as archive:
            times = archive.numbers("times").ravel()
    seconds = float(times[-1] + np.median(np.diff(times))) if len(times) > 1 else 0.0
    if not 0 < seconds <= max_seconds:
        raise AudioError(
            f"{path}: features up to {seconds:g} s, at most {max_seconds:g} s are read"
        )
    return Wave(np.zeros(round(seconds * _SILENCE_RATE), np.float32), _SILENCE_RATE, path)
