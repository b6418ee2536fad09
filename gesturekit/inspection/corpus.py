"""Summary of a corpus: a manifest, or a folder of recordings without one."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from gesturekit.corpus.manifest import Manifest
from gesturekit.corpus.preparation import prepare
from gesturekit.corpus.report import Report, amount, counts
from gesturekit.errors import CorpusError, GestureKitError
from gesturekit.formats.sources import VIDEO_SUFFIXES, load
from gesturekit.inspection.summary import Summary, span
from gesturekit.wording import counted, listed

_SHOWN = 5


def inspect_manifest(path: Path) -> Summary:
    """Summarise a manifest and check that its files exist; only the first motion is read.

    Raises:
        CorpusError: it cannot be read.
    """
    manifest = Manifest.load(path)
    reading = (
        ", ".join(f"{name} {value}" for name, value in item.reading.items() if name != "parts")
        for item in manifest
        if item.reading
    )
    rig, broken = _rig(manifest)
    rows = dict(Report(manifest, recordings=(), problems=(), left_over=()).rows())
    rows |= {
        "speakers": counts(item.speaker for item in manifest) or "none named",
        "styles": counts(item.style for item in manifest) or "none named",
        "conditions": counts(name for item in manifest for name in item.conditions),
        "reading": counts(reading),
        "mirrored": counts("yes" for item in manifest if item.mirror),
        "rig": rig,
    }
    return _summary(path, manifest, rows, [*_missing(manifest), *_leaks(manifest), *broken])


def inspect_recordings(
    folder: Path,
    *,
    parts: Mapping[str, str] | None,
    read: Mapping[str, Any] | None,
    progress: Callable[[list[Any]], Iterable[Any]],
) -> Summary:
    """Summarise a folder of recordings as `gesturekit prepare` would find it; reads all of them.

    Args:
        folder: the folder.
        parts: body parts assigned by hand, {"left_elbow": "Joint12"}.
        read: options for reading motion, see `gesturekit.corpus.prepare`.
        progress: wraps the list of recordings while they are read, as tqdm does.

    Raises:
        CorpusError: the folder has no recordings.
    """
    alone: dict[str, Any] = {"unpaired": [folder], "unpaired_motion": [folder], "holdout": 0.0}
    report = prepare([folder], **alone, parts=parts, read=read, progress=progress)
    videos = [path for path in report.left_over if path.suffix.lower() in VIDEO_SUFFIXES]
    left_over = tuple(path for path in report.left_over if path not in videos)
    problems = tuple(dict.fromkeys(report.problems))
    report = replace(report, problems=problems, left_over=left_over)
    if report.is_complete and not report.manifest.items:
        raise CorpusError(f"{folder}: no recordings in it, neither motion nor sound")
    # Splits and labels are assigned by `prepare` only.
    rows = {name: text.split(": train")[0] for name, text in report.rows()}
    names = listed([path.name for path in videos], _SHOWN)
    rows |= {"speakers": "", "styles": "", "videos": f"{names}, not read" if videos else ""}
    return _summary(folder, report.manifest, rows, report.problem_lines())


def _summary(
    path: Path, manifest: Manifest, rows: dict[str, str], problems: Sequence[str]
) -> Summary:
    seconds = sum(item.duration for item in manifest)
    facts = {"path": str(path), "items": len(manifest), "seconds": seconds, **rows}
    title = f"{path}: corpus, {amount(manifest.items)}, {span(seconds)}"
    return Summary("corpus", title, facts, rows, problems)


def _rig(manifest: Manifest) -> tuple[str, list[str]]:
    """Return the rig of the first motion, and the error if it cannot be read."""
    item = next((item for item in manifest if item.motion and item.motion.is_file()), None)
    if item is None or item.motion is None:
        return "", []
    try:
        motion = load(item.motion, item.reading)
    except GestureKitError as error:
        return "", [str(error)]
    joints = counted(motion.skeleton.n_joints, "joint")
    return f"{joints}, {motion.fps:.6g} fps (of recording {item.id})", []


def _missing(manifest: Manifest) -> Iterator[str]:
    files = {path for item in manifest for path in (item.audio, item.motion) if path is not None}
    files.update(path for item in manifest for path in item.conditions.values())
    if gone := sorted(str(path) for path in files if not path.exists()):
        yield f"{counted(len(gone), 'file')} missing: {listed(gone, _SHOWN)}"


def _leaks(manifest: Manifest) -> Iterator[str]:
    """Report overlapping intervals of a file in two splits: held-out data would be trained on."""
    stretches: dict[Path, list[tuple[float, float, str, str]]] = defaultdict(list)
    for item in manifest:
        for path, start in ((item.audio, item.audio_start), (item.motion, item.motion_start)):
            if path is not None:
                stretches[path].append((start, start + item.duration, item.split, item.id))
    for path, pieces in stretches.items():
        pieces.sort()
        for (_, end, split, name), (start, _, other, second) in zip(pieces, pieces[1:]):
            if start < end - 1e-3 and split != other:
                yield f"{path} is in {split} ({name}) and in {other} ({second}) at {start:.2f} s"
