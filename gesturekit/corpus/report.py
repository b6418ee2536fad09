"""The result of `prepare`, and its text form."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gesturekit.corpus.alignment import pooled
from gesturekit.corpus.checks import Problem, printed
from gesturekit.corpus.manifest import SPLITS, Item, Manifest
from gesturekit.formats.sources import SPEECH_SUFFIXES, unreadable_media
from gesturekit.wording import counted, listed

if TYPE_CHECKING:
    from gesturekit.corpus.recording import Recording


@dataclass(frozen=True)
class Report:
    """The result of `prepare`.

    Attributes:
        manifest: the usable items.
        recordings: their recordings, with frame rate, skeleton, sample rate.
        problems: all problems; recordings with errors are left out.
        left_over: unused files: speech without motion, motion without speech, and files of
            unsupported formats.
    """

    manifest: Manifest
    recordings: tuple[Recording, ...]
    problems: tuple[Problem, ...]
    left_over: tuple[Path, ...]

    @property
    def is_complete(self) -> bool:
        """True if nothing was left out."""
        return not self.left_over and all(p.severity != "error" for p in self.problems)

    def __str__(self) -> str:
        return "\n".join([*self.table(), *self.problem_lines()])

    def table(self) -> list[str]:
        """Return the contents of the corpus, one fact per line."""
        return [f"{name:<13} {value}" for name, value in self.rows()]

    def rows(self) -> list[tuple[str, str]]:
        """Return the contents of the corpus as (label, text) pairs."""
        manifest = self.manifest
        rows = [
            ("paired", _by_split(manifest.paired())),
            ("speech alone", _by_split(manifest.unpaired())),
            ("motion alone", _by_split(manifest.motion_alone())),
            ("takes", self._takes()),
            ("frame rates", counts(f"{r.fps:.6g} fps" for r in self._moving)),
            ("body heights", self._heights()),
            ("body shapes", self._shapes()),
            ("joints", counts(str(r.skeleton.n_joints) for r in self._moving if r.skeleton)),
            ("sample rates", counts(f"{r.sample_rate} Hz" for r in self.recordings if r.audio)),
            ("speakers", _labels([r.speaker for r in self.recordings])),
            ("styles", _labels([r.style for r in self.recordings])),
            ("side files", self._side_files()),
            ("shift", self._shift()),
            ("left out", self._left_out()),
        ]
        return [(name, value) for name, value in rows if value]

    def _takes(self) -> str:
        """Return the number of takes if some recordings are of one take."""
        count = len({recording.take for recording in self.recordings})
        return str(count) if count < len(self.recordings) else ""

    def _left_out(self) -> str:
        """Return the numbers of recordings with errors and of unused files, or ""."""
        errors = {p.file or p.message for p in self.problems if p.severity == "error"}
        broken = [f"{counted(len(errors), 'recording')} with errors"] if errors else []
        alone = [f"{counted(len(self.left_over), 'file')} not used"] if self.left_over else []
        return ", ".join(broken + alone)

    def problem_lines(self) -> list[str]:
        """Return all problems with their files, then the unused files by folder."""
        folders: dict[tuple[Path, str], list[Path]] = defaultdict(list)
        for path in self.left_over:
            is_speech = path.suffix.lower() in SPEECH_SUFFIXES
            what = "speech without motion" if is_speech else "motion without speech"
            folders[path.parent, unreadable_media(path) or what].append(path)
        lines = printed(self.problems)
        for (folder, what), paths in sorted(folders.items()):
            option = "--unpaired" if what.startswith("speech") else "--unpaired-motion"
            names = listed([path.name for path in paths], 3)
            usable = f"{what} in {folder}: {names} (to use it alone: {option} {folder})"
            other = f"{folder}: {names}: {what}"
            lines.append(f"left out: {other if unreadable_media(paths[0]) else usable}")
        return lines

    def _side_files(self) -> str:
        """Return the kinds of tables beside the recordings: "words from .TextGrid (3)"."""
        beside = (table for recording in self.recordings for table in recording.conditions.items())
        return counts(f"{name} from {file.suffix}" for name, file in beside)

    def _heights(self) -> str:
        heights = sorted(r.height for r in self.recordings if r.height is not None)
        ends = dict.fromkeys(f"{height:.3g}" for height in [*heights[:1], *heights[-1:]])
        return f"{' to '.join(ends)} m" if ends else ""

    def _shapes(self) -> str:
        """Return the number of body shapes if there are several, and what training does."""
        count = len({r.skeleton.body_shape for r in self._moving if r.skeleton})
        unnamed = any(recording.speaker is None for recording in self._moving)
        who = " (recordings without a speaker count as one person's)" if unnamed else ""
        return f"{count}; training uses the mean of each speaker's{who}" if count > 1 else ""

    def _shift(self) -> str:
        """Return the shift between sound and motion, or "" if they say nothing."""
        each = [r.correlation for r in self.recordings if r.correlation is not None]
        every = pooled(each)
        if every is None or not every.is_clear:
            return ""
        return f"{every}" if every.is_notable else f"in time: {every}"

    @property
    def _moving(self) -> list[Recording]:
        return [recording for recording in self.recordings if recording.fps is not None]


def amount(items: Collection[Item]) -> str:
    """Return "3 recordings", or "1 recording in 2 parts" if items share one."""
    n_recordings = len({(item.audio, item.motion) for item in items})
    parts = f" in {len(items)} parts" if len(items) != n_recordings else ""
    return counted(n_recordings, "recording") + parts


def _by_split(items: Collection[Item]) -> str:
    by_split: dict[str, list[float]] = defaultdict(list)
    for item in items:
        by_split[item.split].append(item.duration)
    if not by_split:
        return ""
    every = [duration for durations in by_split.values() for duration in durations]
    parts = ", ".join(
        f"{split} {len(by_split[split])} ({_length(sum(by_split[split]))})"
        for split in SPLITS
        if split in by_split
    )
    return f"{amount(items)}, {_length(sum(every))}: {parts}"


def _length(seconds: float) -> str:
    return f"{seconds:.1f} s" if seconds < 100 else f"{seconds / 60:.1f} min"


def _labels(values: Collection[str | None]) -> str:
    """Return the labels with their numbers of recordings."""
    return counts(value or "not named" for value in values) if any(values) else "none named"


def counts(values: Iterable[Any]) -> str:
    """Return different values with their numbers, the most frequent first."""
    most_first = sorted(
        Counter(value for value in values if value is not None).items(),
        key=lambda entry: (-entry[1], entry[0]),
    )
    return listed([f"{value} ({count})" for value, count in most_first], 12)
