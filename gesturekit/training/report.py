"""Report of a run: a page with its losses, metrics and samples that reloads itself."""

from __future__ import annotations

import html
import math
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from audio_features.atomic import write_text

PAGE = "report.html"
REFRESH = 10
"""Seconds after which a browser reads the page of a running training again."""
_MOST_POINTS = 500
"""Points of a curve on the page; of more, every other one is dropped."""
_MOST_SAMPLES = 100
_WIDTH, _HEIGHT = 320, 120
_LOG_SCALE = 50.0
"""Ratio of the largest to the least value from which an axis is logarithmic."""
_TITLES = {
    "loss": "Losses",
    "evaluation": "Samples for training recordings",
    "held_out": "On held-out recordings",
    "recorded": "On training recordings",
}
_OF_METRICS = ("evaluation", "held_out", "recorded")
_NO_LOSSES = ("seconds_per_iteration", "learning_rate")
_STYLE = """
:root { color-scheme: light dark; --ink: #26303b; --soft: #6b7785; --line: #d5dae0; --room: #f6f7f8;
  --panel: #fff; --light: 42%; font: 15px/1.4 system-ui, sans-serif; color: var(--ink); }
@media (prefers-color-scheme: dark) { :root { --ink: #e4e8ec; --soft: #9aa6b2; --line: #3a444e;
  --room: #181d23; --panel: #242b33; --light: 62%; } }
body { margin: 0 auto; padding: 16px 22px 40px; max-width: 1100px; background: var(--room); }
h1 { font-size: 20px; margin: 0; overflow-wrap: anywhere; }
h2 { font-size: 16px; margin: 26px 0 8px; }
p { color: var(--soft); margin: 4px 0; } p b { color: var(--ink); } a { color: inherit; }
.charts { display: grid; grid-template-columns: repeat(auto-fill, minmax(260px, 1fr)); gap: 12px; }
figure { margin: 0; padding: 8px 12px; background: var(--panel); border: 1px solid var(--line);
  border-radius: 10px; }
figcaption { display: flex; justify-content: space-between; gap: 10px; font-size: 13px; }
figcaption span, small { color: var(--soft); font-size: 12px; }
svg { display: block; width: 100%; height: 120px; margin: 4px 0; }
polyline { fill: none; stroke-width: 1.6; vector-effect: non-scaling-stroke; }
ul { columns: 160px; padding-left: 18px; }
"""

Curve = list[tuple[int, float]]
Section = dict[str, dict[str, Curve]]
"""Curves by the title of their chart and their label."""


def write_report(folder: Path, lines: Sequence[dict[str, Any]], *, is_running: bool) -> None:
    """Write the page of a run from the lines of its `metrics.jsonl` and the pages in `samples/`."""
    # A page to look at is not worth ending a training for.
    with suppress(OSError):
        write_text(folder / PAGE, _page(folder, lines, is_running))


def _page(folder: Path, lines: Sequence[dict[str, Any]], is_running: bool) -> str:
    curves = _curves(lines)
    step = max((line["step"] for line in lines), default=0)
    verdicts = [line["verdict"] for line in lines if line.get("verdict")]
    name = html.escape(folder.resolve().name)
    reload = f'<meta http-equiv="refresh" content="{REFRESH}">' if is_running else ""
    is_finished = (folder / "model" / "config.yaml").is_file()
    state = "running" if is_running else "finished" if is_finished else "stopped"
    clock = time.strftime("%Y-%m-%d %H:%M:%S")
    sections = [*_TITLES, *(section for section in curves if section not in _TITLES)]
    body = "".join(_section(section, curves[section]) for section in sections if section in curves)
    verdict = f"<p><b>Measured {html.escape(verdicts[-1])}</b></p>\n" if verdicts else ""
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; '
        f"style-src 'unsafe-inline'\">{reload}<title>{name}: step {step}</title>"
        f"<style>{_STYLE}</style></head>\n<body><h1>{name}</h1>"
        f"{verdict}<p>{state}, step {step}, written {clock}</p>\n"
        f"{body}{_samples(folder)}</body></html>\n"
    )


def _curves(lines: Sequence[dict[str, Any]]) -> dict[str, Section]:
    """Return the curves of each section of the page."""
    sections: dict[str, Section] = defaultdict(lambda: defaultdict(lambda: defaultdict(list)))
    for line in lines:
        kind = line.get("kind", "loss")
        for name, value in line.items():
            is_number = isinstance(value, int | float) and math.isfinite(value)
            if not is_number or name in ("step", "level"):
                continue
            title = name.rpartition("/")[2]
            label = f"level {line['level']}" if "level" in line else ""
            if kind in ("held_out", "recorded"):  # the recording's value and chance share a chart
                metric, _, whose = title.rpartition("_")
                is_ours = whose not in ("recording", "chance")
                title, label = (title, "model") if is_ours else (metric, whose)
            curve = sections["pace" if name in _NO_LOSSES else kind][title][label]
            curve.append((int(line["step"]), float(value)))
            if len(curve) > 2 * _MOST_POINTS:
                del curve[1:-1:2]
    return sections


def _section(name: str, charts: Section) -> str:
    labels = list(dict.fromkeys(label for curves in charts.values() for label in curves))
    titled = ((_in_words(title, name), curves) for title, curves in charts.items())
    drawn = "".join(_chart(title, curves, labels) for title, curves in titled)
    title = html.escape(_TITLES.get(name, name.capitalize()))
    return f'<h2>{title}</h2><div class="charts">{drawn}</div>\n'


def _samples(folder: Path) -> str:
    """Return links to the pages of the samples, the newest first."""
    pages = sorted((folder / "samples").glob("step_*.html"), reverse=True)
    if not pages:
        return ""
    links = "".join(
        f'<li><a href="samples/{html.escape(page.name)}" target="_blank">step '
        f"{html.escape(page.stem.removeprefix('step_').lstrip('0') or '0')}</a></li>"
        for page in pages[:_MOST_SAMPLES]
    )
    return f"<h2>Samples, with their motion</h2><ul>{links}</ul>\n"


def _in_words(name: str, section: str) -> str:
    """Return the title of a chart: the name and unit of a metric, or the words of another value."""
    from gesturekit.evaluation.definitions import DEFINITIONS  # imports all metrics

    known = DEFINITIONS.get(name.removesuffix("_ratio")) if section in _OF_METRICS else None
    if known is None:
        return name.replace("_", " ").capitalize()
    return f"{known.name} / the recording's" if name.endswith("_ratio") else known.title


def _chart(title: str, curves: dict[str, Curve], known: list[str]) -> str:
    """Return one chart with a line for each label, in the colour of its place in `known`.

    A curve of one point has its value as text, not a line.
    """
    drawn = {label: curve for label, curve in curves.items() if len(curve) > 1}
    values = [value for curve in drawn.values() for _, value in curve] or [0.0]
    low, high = min(values), max(values)
    is_log = low > 0 and high / low > _LOG_SCALE
    scaled: Callable[[float], float] = math.log if is_log else float
    steps = [point[0] for curve in (drawn or curves).values() for point in (curve[0], curve[-1])]
    lines, labels = [], []
    for label, curve in curves.items():
        hue = round(205 + 360 * known.index(label) / len(known)) % 360
        colour = f"hsl({hue} 60% var(--light))"
        named = html.escape(f"{label} {curve[-1][1]:.4g}".strip())
        value = "" if label in drawn else f" {curve[-1][1]:.4g}"
        labels += [f'; <b style="color: {colour}">{html.escape(label)}</b>{value}'] if label else []
        if label not in drawn:
            continue
        points = []
        for step, value in curve:
            share = (scaled(value) - scaled(low)) / ((scaled(high) - scaled(low)) or 1.0)
            x = (step - min(steps)) / (max(steps) - min(steps)) * _WIDTH
            points.append(f"{x:.1f},{_HEIGHT - 3 - share * (_HEIGHT - 6):.1f}")
        line = f'<polyline points="{" ".join(points)}" style="stroke: {colour}">'
        lines.append(f"{line}<title>{named}</title></polyline>")
    newest = max(curves.values(), key=lambda curve: curve[-1][0])[-1][1]
    scale, picture = f"step {max(steps)}", ""
    if lines:
        log_scale = ", log scale" if is_log else ""
        scale = f"{low:.3g} to {high:.3g}{log_scale}; steps {min(steps)} to {max(steps)}"
        view = f'viewBox="0 0 {_WIDTH} {_HEIGHT}" preserveAspectRatio="none"'
        picture = f"<svg {view}>{''.join(lines)}</svg>"
    return (
        f"<figure><figcaption><b>{html.escape(title)}</b><span>{newest:.4g}</span></figcaption>"
        f"{picture}<small>{scale}{''.join(labels)}</small></figure>"
    )
