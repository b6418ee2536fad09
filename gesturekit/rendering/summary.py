"""Summary page of a folder of results: pictures, durations, speeds, failures."""

from __future__ import annotations

import base64
import html
import math
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from audio_features.atomic import write_text
from gesturekit.errors import GestureKitError
from gesturekit.jobs.records import STATE, Status, all_records
from gesturekit.jobs.result import Result
from gesturekit.motion.motion import Motion
from gesturekit.progress import time_in_words
from gesturekit.viewer.pictures import write_picture
from gesturekit.wording import counted, printable

PAGE = "summary.html"
"""Name of the page in the folder of state, which a run of many items writes at its end."""
PICTURES = 6
_SHOWN_FAILURES = 1000
_SHOWN_SECONDS = 60.0
_BARS = 24
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2em auto; max-width: 72em; padding: 0 1em; }
table { border-collapse: collapse; } td, th { padding: .2em .8em .2em 0; text-align: left;
vertical-align: top; } figure { display: inline-block; margin: 0 1em 1em 0; width: 31%; }
figure img { width: 100%; } figcaption { overflow-wrap: anywhere; } svg { height: 8em; }
h2 { margin-top: 1.6em; } .n { text-align: right; font-variant-numeric: tabular-nums; }
"""


def write_summary(out: Path, status: Status, path: Path) -> None:
    """Write the summary page of the results in a folder, as one HTML file.

    Args:
        out: output folder of the work.
        status: its state.
        path: the page; an existing one is replaced.

    Raises:
        OSError: the page cannot be written.
        FormatError: a record was written by a newer version.
    """
    done = [result for result in all_records(out / STATE) if result.status == "done"]
    done.sort(key=lambda result: result.id)
    title = html.escape(printable(out.name or str(out)))
    speeds = [result.sound / result.seconds for result in done if result.seconds > 0]
    faces = faces_in_words(done)
    lines = [
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f"<style>{_STYLE}</style></head>\n<body><h1>{title}</h1>",
        f"<p>{counted(status.items, 'item')}: {status.done} done "
        f"({time_in_words(status.sound)} of sound), {len(status.failed)} failed, "
        f"{len(status.left)} left.</p>\n<p>Speed of the last ten minutes of work: "
        f"{status.items_per_minute:.1f} items a minute, {status.real_time_factor:.1f} times real "
        "time.</p>",
        *([f"<p>{html.escape(printable(faces))}.</p>"] if faces else []),
        *_histogram("Seconds of sound", [result.sound for result in done]),
        *_histogram("Speed, times real time", speeds),
        *_failures(status),
        *_pictures(out, done),
        "</body></html>\n",
    ]
    write_text(path, "\n".join(lines))


def faces_in_words(results: Iterable[Result]) -> str:
    """Return how many results have faces by rules, and what these were made from; "" for none."""
    files = (next(iter(result.made.values()), {}) for result in results)
    ways: Counter[str] = Counter()
    for made in (file.get("made_with", {}) for file in files):
        if way := made.get("face"):
            given = way == "phones" and "transcript" in made
            ways[f"{way}, with a transcript given" if given else way] += 1
    parts = [f"{counted(count, 'item')} from {way}" for way, count in sorted(ways.items())]
    return f"Faces by rules, not recorded: {', '.join(parts)}" if parts else ""


def _histogram(title: str, values: list[float]) -> Iterator[str]:
    """Yield a histogram with logarithmic classes, as SVG, and its quantiles."""
    positive = np.array([value for value in values if 0 < value < math.inf])
    if len(positive) < 2:
        return
    low, high = positive.min(), max(positive.max(), positive.min() * 1.01)
    counts, _ = np.histogram(np.log(positive), bins=_BARS, range=(np.log(low), np.log(high)))
    yield f'<h2>{title}</h2>\n<svg viewBox="0 0 {10 * _BARS} 100" role="img">'
    for index, count in enumerate(counts):
        height = 100 * count / counts.max()
        yield (
            f'<rect x="{10 * index}" y="{100 - height:.1f}" width="9" height="{height:.1f}" '
            f'fill="#5d97bf"><title>{count}</title></rect>'
        )
    values = [low, high, *np.quantile(positive, [0.1, 0.5, 0.9])]
    # Two digits, without the powers of ten that `.2g` writes from 100 on.
    low, high, q10, q50, q90 = (f"{float(f'{value:.2g}'):,g}" for value in values)
    yield (
        f"</svg>\n<p>{low} to {high} (logarithmic); 10 % below {q10}, "
        f"half below {q50}, 90 % below {q90}</p>"
    )


def _failures(status: Status) -> Iterator[str]:
    if not status.failed:
        return
    yield '<h2>Failures</h2>\n<table><tr><th class="n">Items</th><th>Reason</th></tr>'
    for reason, count, _ in status.reasons():
        yield f'<tr><td class="n">{count}</td><td>{html.escape(printable(reason))}</td></tr>'
    yield "</table>\n<details><summary>Each item</summary><table>"
    for item in status.failed[:_SHOWN_FAILURES]:
        aside = ", put aside" if item.is_aside else ""
        name, error = (html.escape(printable(str(text))) for text in (item.id, item.error))
        yield f"<tr><td>{name}</td><td>{error} ({item.failures}x{aside})</td></tr>"
    yield "</table></details>"
    if len(status.failed) > _SHOWN_FAILURES:
        yield f"<p>and {len(status.failed) - _SHOWN_FAILURES} more: gesturekit jobs --failed</p>"


def _pictures(out: Path, done: list[Result]) -> Iterator[str]:
    """Yield pictures of results evenly spread over the items."""
    inside = out.resolve()
    spread = np.unique(np.linspace(0, len(done) - 1, min(PICTURES, len(done))).astype(int))
    yield "<h2>Results</h2>"
    with tempfile.TemporaryDirectory(prefix="gesturekit-") as folder:
        picture = Path(folder) / "picture.png"
        for result in (done[index] for index in spread):
            names = [name for name in result.made if name.endswith((".npz", ".bvh"))]
            file = out / names[0] if names else out
            # A record is a file like any other: it may name anything.
            if not names or not file.resolve().is_relative_to(inside):
                continue
            try:
                motion = Motion.load(file)
                if motion.duration > _SHOWN_SECONDS:
                    motion = motion.trim(0.0, _SHOWN_SECONDS)
                write_picture(motion, picture, frames=8, title="")
            except (GestureKitError, OSError):
                continue  # moved away, or edited since
            data = base64.b64encode(picture.read_bytes()).decode()
            name = html.escape(printable(result.id))
            yield (
                f'<figure><img alt="{name}" src="data:image/png;base64,{data}">'
                f"<figcaption>{name}, {result.sound:.1f} s</figcaption></figure>"
            )
