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
        manifest, recordings = self.manifest, self.recordings
        moving = [r for r in recordings if r.fps is not None]
        skeletons = [r.skeleton for r in moving if r.skeleton]
        heights = sorted(r.height for r in recordings if r.height is not None)
        ends = dict.fromkeys(f"{height:.3g}" for height in [*heights[:1], *heights[-1:]])
        takes, shapes = ({r.take for r in recordings}, {s.body_shape for s in skeletons})
        unnamed = any(r.speaker is None for r in moving)
        who = " (recordings without a speaker count as one person's)" if unnamed else ""
        mean = f"{len(shapes)}; training uses the mean of each speaker's{who}"
        sides = [side for r in recordings for side in r.conditions.items()]
        shift = pooled([r.correlation for r in recordings if r.correlation is not None])
        errors = {p.file or p.message for p in self.problems if p.severity == "error"}
        left_out = [f"{counted(len(errors), 'recording')} with errors"] if errors else []
        left_out += [f"{counted(len(self.left_over), 'file')} not used"] if self.left_over else []
        rows = {
            "paired": _by_split(manifest.paired()),
            "speech alone": _by_split(manifest.unpaired()),
            "motion alone": _by_split(manifest.motion_alone()),
            "takes": str(len(takes)) if len(takes) < len(recordings) else "",
            "frame rates": counts(f"{r.fps:.6g} fps" for r in moving),
            "body heights": f"{' to '.join(ends)} m" if ends else "",
            "body shapes": mean if len(shapes) > 1 else "",
            "joints": counts(str(skeleton.n_joints) for skeleton in skeletons),
            "sample rates": counts(f"{r.sample_rate} Hz" for r in recordings if r.audio),
            "speakers": _labels([r.speaker for r in recordings]),
            "styles": _labels([r.style for r in recordings]),
            "side files": counts(f"{name} from {file.suffix}" for name, file in sides),
            "shift": "",
            "left out": ", ".join(left_out),
        }
        if shift is not None and shift.is_clear:
            rows["shift"] = f"{shift}" if shift.is_notable else f"in time: {shift}"
        return [(name, value) for name, value in rows.items() if value]

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


def amount(items: Collection[Item]) -> str:
    """Return "3 recordings", or "1 recording in 2 parts" if items share one."""
    n_recordings = len({(item.audio, item.motion) for item in items})
    parts = f" in {len(items)} parts" if len(items) != n_recordings else ""
    return counted(n_recordings, "recording") + parts


def _by_split(items: Collection[Item]) -> str:
    seconds: dict[str, float] = defaultdict(float)
    for item in items:
        seconds[item.split] += item.duration
    numbers = Counter(item.split for item in items)
    lengths = [f"{s} {numbers[s]} ({_length(seconds[s])})" for s in SPLITS if s in numbers]
    every = _length(sum(item.duration for item in items))
    return f"{amount(items)}, {every}: {', '.join(lengths)}" if items else ""


def _length(seconds: float) -> str:
    return f"{seconds:.1f} s" if seconds < 100 else f"{seconds / 60:.1f} min"


def _labels(values: Collection[str | None]) -> str:
    """Return the labels with their numbers of recordings."""
    return counts(value or "not named" for value in values) if any(values) else "none named"


def counts(values: Iterable[Any]) -> str:
    """Return different values with their numbers, the most frequent first."""
    numbers = Counter(value for value in values if value is not None)
    most_first = sorted(numbers.items(), key=lambda entry: (-entry[1], entry[0]))
    return listed([f"{value} ({count})" for value, count in most_first], 12)
