"""Summary of a corpus: a manifest, or a folder of recordings without one."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from gesturekit.corpus.item import SPLITS, Item
from gesturekit.corpus.manifest import Manifest
from gesturekit.corpus.preparation import prepare
from gesturekit.corpus.report import amount
from gesturekit.errors import CorpusError, GestureKitError
from gesturekit.formats.conversion import load
from gesturekit.formats.sources import VIDEO_SUFFIXES
from gesturekit.inspection.summary import Summary, span
from gesturekit.wording import counted, listed

_SHOWN = 5


def inspect_manifest(path: Path) -> Summary:
    """Summarise a manifest and check that its files exist; only the first motion is read.

    Raises:
        CorpusError: it cannot be read.
    """
    manifest = Manifest.load(path)
    groups = {
        "paired": manifest.paired(),
        "speech_alone": manifest.unpaired(),
        "motion_alone": manifest.motion_alone(),
    }
    facts: dict[str, Any] = {
        "path": str(path),
        "items": len(manifest),
        "seconds": sum(item.duration for item in manifest),
        "splits": {name: _by_split(items) for name, items in groups.items()},
        "speakers": _counts(item.speaker for item in manifest),
        "styles": _counts(item.style for item in manifest),
        "mirrored": sum(item.mirror for item in manifest),
        "conditions": _counts(name for item in manifest for name in item.conditions),
    }
    rows = [
        (name.replace("_", " "), _amount(items)) for name, items in groups.items() if len(items)
    ]
    facts["reading"] = _counts(
        ", ".join(f"{name} {value}" for name, value in item.reading.items() if name != "parts")
        for item in manifest
        if item.reading
    )
    for name in ("speakers", "styles", "conditions", "reading"):
        if facts[name]:
            shown = [f"{value} ({count})" for value, count in facts[name].items()]
            rows.append((name, listed(shown, 12)))
        elif name in ("speakers", "styles"):
            rows.append((name, "none named"))
    if facts["mirrored"]:
        rows.append(("mirrored", f"{facts['mirrored']} of {len(manifest)}"))
    rig, trouble = _rig(manifest)
    if rig:
        facts["rig"] = rig
        joints = counted(rig["joints"], "joint")
        rows.append(("rig", f"{joints}, {rig['fps']:.6g} fps (of recording {rig['of']})"))
    return Summary(
        kind="corpus",
        title=f"{path}: corpus, {amount(manifest.items)}, {span(facts['seconds'])}",
        facts=facts,
        rows=tuple(rows),
        problems=(*_missing(manifest), *_leaks(manifest), *trouble),
    )


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
    report = prepare(
        [folder],
        unpaired=[folder],
        unpaired_motion=[folder],
        holdout=0.0,
        parts=parts,
        read=read,
        progress=progress,
    )
    videos = [path for path in report.left_over if path.suffix.lower() in VIDEO_SUFFIXES]
    report = replace(
        report,
        problems=tuple(dict.fromkeys(report.problems)),
        left_over=tuple(path for path in report.left_over if path not in videos),
    )
    if report.is_complete and not report.manifest.items:
        raise CorpusError(f"{folder}: no recordings in it, neither motion nor sound")
    manifest = report.manifest
    seconds = sum(item.duration for item in manifest)
    facts = {
        "path": str(folder),
        "items": len(manifest),
        "seconds": seconds,
        "paired": len(manifest.paired()),
        "speech_alone": len(manifest.unpaired()),
        "motion_alone": len(manifest.motion_alone()),
        "frame_rates": _counts(r.fps for r in report.recordings),
        "joints": _counts(r.skeleton and r.skeleton.n_joints for r in report.recordings),
        "sample_rates": _counts(r.sample_rate for r in report.recordings),
    }
    # Splits and labels are assigned by `prepare` only.
    rows = [(name, text.split(": train")[0]) for name, text in report.rows()]
    rows = [row for row in rows if row[0] not in ("speakers", "styles")]
    if videos:
        rows.append(("videos", f"{listed([video.name for video in videos], _SHOWN)}, not read"))
    return Summary(
        kind="corpus",
        title=f"{folder}: {amount(manifest.items)}, {span(seconds)}",
        facts=facts,
        rows=tuple(rows),
        problems=tuple(report.problem_lines()),
    )


def _by_split(items: Sequence[Item]) -> dict[str, dict[str, float]]:
    return {
        split: {
            "items": len(chosen),
            "seconds": sum(item.duration for item in chosen),
        }
        for split in SPLITS
        if (chosen := [item for item in items if item.split == split])
    }


def _amount(items: Sequence[Item]) -> str:
    parts = [
        f"{split} {int(part['items'])} ({span(part['seconds'])})"
        for split, part in _by_split(items).items()
    ]
    total = span(sum(item.duration for item in items))
    return f"{amount(items)}, {total}: {', '.join(parts)}"


def _counts(values: Iterable[Any]) -> dict[str, int]:
    known = Counter(str(value) for value in values if value is not None)
    return dict(sorted(known.items(), key=lambda entry: (-entry[1], entry[0])))


def _rig(manifest: Manifest) -> tuple[dict[str, Any], list[str]]:
    """Return the rig of the first motion, and the error if it cannot be read."""
    item = next((item for item in manifest if item.motion and item.motion.is_file()), None)
    if item is None or item.motion is None:
        return {}, []
    try:
        motion = load(item.motion, item.reading)
    except GestureKitError as error:
        return {}, [str(error)]
    names = list(motion.skeleton.names)
    return {"joints": len(names), "names": names, "fps": motion.fps, "of": item.id}, []


def _files(item: Item) -> Iterator[Path]:
    yield from (path for path in (item.audio, item.motion) if path is not None)
    yield from item.conditions.values()


def _missing(manifest: Manifest) -> Iterator[str]:
    gone = sorted({str(path) for item in manifest for path in _files(item) if not path.exists()})
    if gone:
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
