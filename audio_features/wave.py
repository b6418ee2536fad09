"""Wave: one validated channel of sound at the sample rate of its file, which libsndfile decodes.

libsndfile silently shortens a file that ends early (an interrupted copy or download). It knows most
of what such a file's header declares, and writes it to a log, which is compared here.
"""

from __future__ import annotations

import hashlib
import io
import math
import os
import re
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from numbers import Real
from pathlib import Path
from typing import Any, Literal

import numpy as np
import soundfile
import soxr
from numpy.typing import ArrayLike

from audio_features.archive import open_archive, read_number_table
from audio_features.errors import AudioError

MIN_SECONDS = Fraction(25, 1000)
"""Shortest sound accepted: 400 samples at 16 kHz, the input of one WavLM frame."""
SAMPLE_RATES = (4_000, 768_000)
"""Lowest and highest sample rate accepted, in Hz."""
SILENCE_DBFS = -75.0
"""Active level below which a clip counts as silent."""
ACTIVE_RANGE_DB = 20.0
"""A frame is active when its power is within this range of the mean power of active frames."""
SPEECH_LEVEL_DBFS = -23.0
"""Active level of `Wave.at_level` (the target of EBU R128)."""

_FULL_SCALE = 0.999  # 16-bit files clip at 32767/32768, resampled ones a little lower
_UNLIMITED = 2.0  # with a higher peak, a floating-point file was not clipped at full scale
_DC_OFFSET = 0.01
_BLOCK = 1 << 20  # values processed at a time, which bounds the memory for long files
_SILENCE_RATE = 16000

_CANCELLED = 0.1
"""Channels cancel if their mean has less than this share of the power that one of them alone,
beside silent ones, would give it."""
_FEW_FAULTY = 0.01
"""Share of samples that may be NaN or infinite; they are interpolated."""

_CHECKED = ("WAV", "WAVEX", "RF64", "FLAC", "OGG", "MP3", "MPEG", "AIFF", "AU", "NIST")
"""Formats of libsndfile in which a truncated file is recognised."""
_UNCHECKED_BYTES = 256 << 20
"""Bytes of samples that a file of any size may hold."""
_EXPANSION = {"OGG": 256, "MP3": 64, "MPEG": 64}
"""Largest ratio of the bytes of more samples to the size of the file: what Opus at 6 kbit/s and MP3
at 24 kbit/s have at 48 kHz. Other formats keep every sample, for which 20 is plenty."""
_UNKNOWN_SIZES = {0xFFFFFFFF, 0x7FFFFFFF, 0x7FFFF000, 0x7FFFFFFE, 0xFFFFFFFE}
"""Placeholder sizes of programs that write to a pipe (ffmpeg, sox)."""
_LONGEST_PAGE = 65_307  # bytes of an Ogg page
_IS_LAST = 4  # flag of the last Ogg page
# Samples that encoder and decoder of an MP3 may drop at the ends (codec delays, the last frame).
_SLACK = 4 * 1152

_CONTRADICTION = re.compile(r"^ *(.*?) *: (\d+) \(should be (\d+)\)", re.MULTILINE)
_RF64_FRAMES = re.compile(r"frame count (\d+) does not match value from 'ds64' chunk of (\d+)")


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
        samples, problem = np.asarray(self.samples), ""
        if samples.ndim != 1 or samples.dtype.kind != "f":
            held = f"shape {samples.shape} of {samples.dtype}"
            raise AudioError(f"{name}: {held}, expected one channel (N,) of floats to ±1")
        object.__setattr__(self, "samples", np.ascontiguousarray(samples, dtype=np.float32))
        object.__setattr__(self, "sample_rate", checked_rate(self.sample_rate, name))
        finite = np.isfinite(self.samples)
        if Fraction(len(samples), self.sample_rate) < MIN_SECONDS:
            held = f"{len(samples)} samples at {self.sample_rate} Hz"
            ms, least = 1000 * self.duration, 1000 * float(MIN_SECONDS)
            problem = f"{held} are {ms:.1f} ms: give at least {least:.0f} ms"
        elif not finite.all():
            bad = int(np.argmin(finite))
            where = f"sample {bad} ({bad / self.sample_rate:.3f} s) is {self.samples[bad]}"
            problem = f"{where}: export the sound again without it"
        if problem:
            raise AudioError(f"{name}: {problem}")

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
        with _open_sound(name) as file:
            rate = checked_rate(file.samplerate, name)
            first, count = _segment(name, file.frames, rate, start, duration, max_seconds)
            samples, used = _read_channel(file, name, first, count, channel)
        return _repaired(samples, rate, name, float(start), used if used != channel else None)

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
        values, used = _numbers(samples, name), None
        if sample_rate is None:
            raise AudioError(f"{name}: an array without rate: give sample_rate, such as 16000")
        if values.ndim == 2:
            channels = values.T if values.shape[0] <= values.shape[1] else values
            values = channels.mean(axis=1)
            used = _instead_of_mean(_moments(channels, values), len(channels))
            values = values if used is None else channels[:, used - 1]
        return _repaired(values, checked_rate(sample_rate, name), source, 0.0, used)

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
        n = len(self.samples)
        first, count = _segment(name, n, self.sample_rate, start, duration, math.inf)
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
        ends = (np.rint(centres + side) for side in (-half, half))
        first, last = (np.clip(end, 0, n).astype(np.int64) for end in ends)
        power = np.zeros(len(centres))
        done = 0
        while done < len(centres):
            stop = int(np.searchsorted(first, first[done] + _BLOCK, side="left"))
            origin, now = first[done], slice(done, stop)
            block = self.samples[origin : last[stop - 1]].astype(np.float64) - self._mean
            energy = np.append(0.0, np.cumsum(np.square(block, out=block)))
            power[now] = energy[last[now] - origin] - energy[first[now] - origin]
            done = stop
        return np.sqrt(np.maximum(power / np.maximum(last - first, 1), 0.0))

    def active(self) -> np.ndarray:
        """Detect speech on frames of 25 ms centred every 10 ms.

        A frame is active if its power is at most 20 dB below the mean power of the active
        frames. The set is found by starting from all frames and removing quieter ones until it
        no longer changes. This is the gating of EBU R128 and ITU-T P.56 without an absolute
        gate: the same sound at another level has the same active frames. A clip whose active
        level is below -75 dBFS has none.

        Returns (n_frames(100),) bool.
        """
        return self._activity[0]

    def active_level(self) -> float:
        """Return the RMS of the active frames in dBFS (0 is a full-scale square wave), or -inf."""
        return self._activity[1]

    @property
    def is_silent(self) -> bool:
        """True if no frame is active: digital silence, or noise below -75 dBFS."""
        return self._activity[1] == -math.inf

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

    def at_level(self) -> Wave:
        """Scale the active level to -23 dBFS and remove the DC offset; silence is unchanged."""
        if self.is_silent:
            return self
        gain = 10.0 ** ((SPEECH_LEVEL_DBFS - self.active_level()) / 20.0)
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
    def _activity(self) -> tuple[np.ndarray, float]:
        """The active frames (M,) bool and their level in dBFS."""
        times = np.arange(self.n_frames(100)) * 0.01
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
    count = n - first if duration is None else min(n - first, round(duration * rate))
    problem = ""
    if first >= n > 0:
        problem = f"start is {start} s but the sound ends at {n / rate:.3f} s"
    elif count > max_seconds * rate:
        limit = f"{count / rate:.1f} s of sound exceed the limit of {max_seconds:g} s"
        problem = f"{limit}: give start and duration, or max_seconds"
    if problem:
        raise AudioError(f"{name}: {problem}")
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
        limit = f"at most {max_seconds:g} s are read"
        raise AudioError(f"{path}: features up to {seconds:g} s, {limit}")
    return Wave(np.zeros(round(seconds * _SILENCE_RATE), np.float32), _SILENCE_RATE, path)


@contextmanager
def _open_sound(name: str) -> Iterator[soundfile.SoundFile]:
    """Open a sound file whose header agrees with what is there.

    Raises AudioError if the file is missing, is not a sound file, is damaged or ends too soon; also
    for errors of reading it in the context.
    """
    path, problem = Path(name), ""
    if not path.is_file():
        what = "not a regular file" if path.exists() else "no such file"
        problem = f"{what}: give the path of a sound file"
    elif path.stat().st_size == 0:
        problem = "the file is empty (0 bytes): export it again"
    if problem:
        raise AudioError(f"{name}: {problem}")
    try:
        with soundfile.SoundFile(_with_length(name)) as file:
            if problem := _header_problem(file, name):
                raise AudioError(f"{name}: {problem}")
            yield file
    except (soundfile.LibsndfileError, OSError, TypeError, UnicodeError, MemoryError) as error:
        # soundfile raises TypeError for files named .raw, and UnicodeError for undecodable names.
        head = _bytes_of(name, 0, 8)
        reason = str(error).rpartition(f"{name!r}: ")[2].rstrip(".")
        raw_line = _ffmpeg_line(name, "-f s16le -ar 16000 -ac 1 ")
        ways = f"give a wav, or run {_ffmpeg_line(name)} (raw samples: {raw_line})"
        problem = f"cannot be read as sound ({reason}; it begins with {head!r}): {ways}"
        if head[:1] == b"\x80" and head[1:2] <= b"\x05":
            problem = "a Python pickle, not sound; it could run code and is not read"
        raise AudioError(f"{name}: {problem}") from error


def soundfile_name(path: str | os.PathLike[str]) -> str | bytes:
    """Return a path as soundfile takes it: as bytes if the name is not valid Unicode."""
    name = os.fspath(path)
    try:
        name.encode()
    except UnicodeEncodeError:
        return os.fsencode(name)
    return name


def _read_channel(
    file: soundfile.SoundFile, name: str, first: int, count: int, channel: int | None
) -> tuple[np.ndarray, int | None]:
    """Read one channel, or the mean of all: (N,) float32, and the channel.

    Where the channels cancel each other in their mean, the loudest one is read instead.

    Args:
        file: a file of `_open_sound`.
        name: its path, for messages.
        first, count: range of samples.
        channel: counted from 1; None for the mean of all channels.

    Raises AudioError if there is no such channel, or the samples are damaged, or too few or too
    many for the file.
    """
    size, times = Path(name).stat().st_size, _EXPANSION.get(file.format, 20)
    if channel is not None and not 1 <= channel <= file.channels:
        raise AudioError(f"{name}: channel {channel}: the file has {file.channels}, counted from 1")
    if 4 * count > max(_UNCHECKED_BYTES, times * size):
        held = f"{count} samples from a file of {size} bytes, over {times} times the file"
        raise AudioError(f"{name}: {held}: give start and duration, or {_ffmpeg_line(name)}")
    samples, moments, done = np.empty(count, dtype=np.float32), np.zeros((2, 1)), 0
    file.seek(first)
    while done < count:
        block = file.read(min(count - done, _BLOCK // file.channels), "float32", always_2d=True)
        if len(block) == 0:
            break
        values = block.mean(axis=1) if channel is None else block[:, channel - 1]
        if channel is None and file.channels > 1:
            moments = moments + _moments(block, values)
        samples[done : done + len(block)] = values
        done += len(block)
    is_mp3, problem = file.format in ("MP3", "MPEG"), ""
    if done < count - (_SLACK if is_mp3 else 0) and (not is_mp3 or _declares_length(name)):
        declared = f"{first + count} samples a channel"
        problem = _truncated(name, declared, f"{first + done} can be read")
    elif "reports a hole" in file.extra_info:
        problem = "an Ogg page is missing or has a wrong checksum: export it again"
    if problem:
        raise AudioError(f"{name}: {problem}")
    if (used := _instead_of_mean(moments, done)) is not None:
        return _read_channel(file, name, first, count, used)
    return samples[:done], channel


def _header_problem(file: soundfile.SoundFile, name: str) -> str:
    """Say what is wrong with a file by its header and libsndfile's log; "" for a sound one."""
    if file.format not in _CHECKED:
        return f"{file.format} files are not read: run {_ffmpeg_line(name)}"
    log = file.extra_info
    for field, declared, actual in _CONTRADICTION.findall(log):
        if field in ("data", "SSND", "Data Size"):
            if int(declared) not in _UNKNOWN_SIZES:
                return _truncated(name, f"{declared} bytes of sound", f"{actual} are there")
        elif field not in ("RIFF", "FORM", "Riff size"):  # other tags may follow
            why = f"the header contradicts itself: {field} is {declared}, expected {actual}"
            return f"{why}: run {_ffmpeg_line(name)}"
    frames = re.search(_RF64_FRAMES, log)
    if frames is not None and int(frames[1]) < int(frames[2]):
        return _truncated(name, f"{frames[2]} samples a channel", f"{frames[1]} are there")
    if file.format == "NIST":
        declared = re.search(rb"sample_count -i (\d+)", _bytes_of(name, 0, 1024))
        if declared is not None and int(declared[1]) > file.frames:
            return _truncated(name, f"{int(declared[1])} samples", f"{file.frames} are there")
    elif file.format == "OGG":
        # libsndfile takes the last page that is there for the end of the sound.
        last = _bytes_of(name, -_LONGEST_PAGE).rpartition(b"OggS\0")[2]
        if not last[:1] or not last[0] & _IS_LAST:
            return _truncated(name, "more Ogg pages", "the last one does not end the sound")
    elif file.format == "FLAC" and file.frames > 1 << 36:
        return f"a FLAC file of undeclared length: run {_ffmpeg_line(name)}"
    return ""


def _declares_length(name: str) -> bool:
    """Return true if an MP3 has a header with its length, as most encoders write it."""
    head, start = _bytes_of(name, 0, 10), 0
    if head[:3] == b"ID3":
        start = 10 + sum((byte & 0x7F) << shift for byte, shift in zip(head[6:], (21, 14, 7, 0)))
    first = _bytes_of(name, start, 64)
    return b"Xing" in first or b"Info" in first


def _bytes_of(name: str, at: int, count: int = -1) -> bytes:
    """Read bytes from a position in a file; one below 0 counts from its end."""
    with Path(name).open("rb") as file:
        file.seek(max(0, at + Path(name).stat().st_size if at < 0 else at))
        return file.read(count)


class _Unsized(io.FileIO):
    """A wav file whose length 0 ("unknown") is read as 0xFFFFFFFF, which libsndfile understands."""

    def __init__(self, name: str, at: int) -> None:
        super().__init__(name)
        self._at = at

    def readinto(self, buffer: Any) -> int:
        """Fill the buffer, replacing the four bytes of the length."""
        start = self.tell()
        count = super().readinto(buffer)
        for at in range(max(self._at, start), min(self._at + 4, start + count)):
            memoryview(buffer)[at - start] = 0xFF
        return count


def _with_length(name: str) -> str | bytes | io.BufferedReader:
    """Return what soundfile opens: a wav written to a pipe may say that it has no sound."""
    head = _bytes_of(name, 0, 4096)
    order: Literal["big", "little"] = "big" if head[:4] == b"RIFX" else "little"
    at = head.find(b"data\0\0\0\0")
    is_whole = int.from_bytes(head[4:8], order) + 8 == Path(name).stat().st_size
    if head[:3] == b"RIF" and at >= 0 and not is_whole:
        return io.BufferedReader(_Unsized(name, at + 4))
    return soundfile_name(name)


def _truncated(name: str, declared: str, there: str) -> str:
    how = f"copy or export it again, or keep what is there by {_ffmpeg_line(name)}"
    return f"truncated: the header declares {declared}, {there}: {how}"


def _ffmpeg_line(name: str, options: str = "") -> str:
    """Return the ffmpeg command that converts a file to wav."""
    path = Path(name)
    stem = f"{path.stem}_new" if path.suffix.lower() == ".wav" else path.stem
    made = shlex.quote(str(path.with_name(f"{stem}.wav")))
    return f"`ffmpeg {options}-i {shlex.quote(name)} {made}`"


def _moments(channels: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Return the sums (2, C + 1) of values and squares of channels (N, C) and their mean (N,)."""
    values = np.column_stack([channels, mean]).astype(np.float64)
    values[~np.isfinite(values)] = 0.0
    return np.stack([values.sum(axis=0), np.square(values).sum(axis=0)])


def _instead_of_mean(moments: np.ndarray, count: int) -> int | None:
    """Return the loudest channel, from 1, if the channels cancel in the mean, else None."""
    total, squares = moments / max(count, 1)
    *powers, of_mean = squares - np.square(total)
    loudest = int(np.argmax(powers)) if len(powers) > 1 else 0
    if len(powers) > 1 and of_mean < _CANCELLED * powers[loudest] / len(powers) ** 2:
        return loudest + 1
    return None


def _numbers(samples: ArrayLike, name: str) -> np.ndarray:
    """Convert to (N,) or two-dimensional float32 with full scale ±1."""
    if hasattr(samples, "detach") and hasattr(samples, "cpu"):
        # A torch tensor: numpy knows neither bfloat16 nor GPUs.
        tensor = samples.detach().cpu()
        samples = tensor.float() if tensor.is_floating_point() else tensor
    try:
        given: np.ndarray = np.asarray(samples)
    except (TypeError, ValueError) as error:
        raise AudioError(f"{name}: not an array of samples ({error})") from None
    values: np.ndarray = given.reshape(
        [n for n in given.shape if n != 1] or [1]
    )  # a batch of one sound
    if values.dtype == np.int64:  # a list of whole numbers: of the fewest bits that hold them
        fitting = (kind for kind in (np.int16, np.int32) if (values == values.astype(kind)).all())
        values = values.astype(next(fitting, np.int64))
    kind, size, problem = values.dtype.kind, values.dtype.itemsize, ""
    if given.ndim == 0:
        held = type(samples).__name__
        problem = f"{held}, expected an array of samples, or the path of a file"
    elif not values.size or values.ndim > 2:
        problem = f"shape {given.shape}, expected (N,), (C, N) or (N, C)"
    elif kind != "f" and (kind not in "iu" or size > 4):
        problem = f"dtype {values.dtype}, expected floats, or 8 to 32 bit integers"
    if problem:
        raise AudioError(f"{name}: {problem}")
    if kind == "f":
        return values.astype(np.float32)
    half = 2.0 ** (8 * size - 1)
    return ((values - (half if kind == "u" else 0.0)) / half).astype(np.float32)


def _repaired(
    samples: np.ndarray, rate: int, source: str | None, offset: float, used: int | None
) -> Wave:
    """Return a wave whose samples that are not finite, if they are few, are interpolated.

    Args:
        samples: (N,) float32.
        rate, source, offset: see `Wave`.
        used: channel that stands for all, as they cancel each other.
    """
    repairs = []
    if used is not None:
        repairs = [f"the channels cancel each other, one is inverted: channel {used} is used"]
    finite = np.isfinite(samples)
    count = len(samples) - np.count_nonzero(finite)
    if 0 < count <= _FEW_FAULTY * len(samples):
        faulty = np.flatnonzero(~finite)
        where = f"{count} of {len(samples)} samples, the first at {faulty[0] / rate:.3f} s"
        repairs.append(f"NaN or infinite: {where}: they are interpolated")
        samples = samples.copy()
        samples[faulty] = np.interp(faulty, np.flatnonzero(finite), samples[finite])
    return Wave(samples, rate, source, offset, repairs=tuple(repairs))
