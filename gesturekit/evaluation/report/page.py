"""The report: one self-contained HTML file with tables, plots and a player.

`page/report.html` holds its sentences and tables; this module computes what they show.
"""

from __future__ import annotations

import html
import json
import os
import re
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from audio_features import AudioFeaturesError
from audio_features.atomic import write_text
from gesturekit.errors import GestureKitError
from gesturekit.evaluation.definitions import (
    DEFINITIONS,
    FRECHET,
    HEADLINE,
    PATCHES,
    SPEECH,
    Definition,
    shown_in,
)
from gesturekit.evaluation.measuring.clips import load_clip
from gesturekit.evaluation.pairs import WINDOW_SECONDS, grouped
from gesturekit.evaluation.report import text
from gesturekit.evaluation.report.plots import RECORDING, all_plots, colour
from gesturekit.evaluation.results import (
    NOT_ASKED,
    ClipResult,
    Evaluation,
    Interval,
    MetricResult,
    ModelResult,
)
from gesturekit.evaluation.statistics.paired import Row
from gesturekit.evaluation.statistics.questions import same_verdicts
from gesturekit.motion import Motion
from gesturekit.viewer import player_data, player_shell
from gesturekit.viewer.pages import plots_section, script_json
from gesturekit.wording import counted, listed

EACH = 2
"""Largest number of best and of worst clips that are shown."""
SECONDS = 180.0
"""Seconds of a clip that are shown, at most: a page with four clips of two figures has 8 MB."""
_PAGE = Path(__file__).parent / "page"
_OPEN = (HEADLINE, SPEECH, PATCHES, FRECHET)  # groups of the papers' tables; the rest is folded
_MOST_CLIPS = 300


def write_report(
    evaluation: Evaluation,
    path: str | os.PathLike[str],
    *,
    title: str | None = None,
    command: str | None = None,
    body: str | None = None,
) -> None:
    """Write the report of an evaluation.

    Args:
        evaluation: the result of `evaluate`.
        path: the .html file to write.
        title: the heading; by default the models and the reference.
        command: the command line that made the report.
        body: of the figures in the player: "mannequin" (by default), "human", "skeleton" or the
            path of a VRM avatar; see `gesturekit.viewer.drawn_body`.

    Raises:
        GestureKitError: the player has not been bundled.
        FormatError: an unknown body, or an avatar that cannot be read.

    Examples:
        >>> gk.load("demo").generate(seconds=3).save(folder / "recorded" / "a.bvh")
        >>> evaluation = gk.evaluate(folder / "recorded", folder / "recorded", protocol="multires")
        >>> write_report(evaluation, folder / "report.html", title="A recording against itself")
        >>> "<title>A recording against itself" in (folder / "report.html").read_text("utf-8")
        True
    """
    evaluation = _with_short_names(evaluation)
    models, groups = evaluation.models, text.rows_by_group(evaluation)
    names = listed([model.label for model in models], 12)
    shown = _best_and_worst(evaluation, body)
    patch_metrics, recording_rows = _by_recording(evaluation)
    values = dict(
        evaluation=evaluation,
        models=models,
        title=title or f"{names} against the recordings in {evaluation.reference.name}",
        same_verdicts=same_verdicts(models),
        warnings=_warnings(evaluation),
        shown=shown,
        shown_seconds=f"{SECONDS:g}",
        questions=_questions(models, groups.get(HEADLINE, [])),
        groups=groups,
        open_groups=_OPEN,
        patch_metrics=patch_metrics,
        recording_rows=recording_rows,
        plots=Markup(plots_section(all_plots(evaluation))),
        agreement="\n".join(text.agreement_lines(evaluation)).strip(),
        clip_rows=[(i, clip) for i, m in enumerate(models) for clip in m.clips[:_MOST_CLIPS]],
        command=command,
        settings=json.dumps(evaluation.settings, ensure_ascii=False),
        shell=Markup(script_json(player_shell() if shown else "")),
        clips=Markup(script_json([{k: clip[k] for k in ("title", "motion")} for clip in shown])),
        script=Markup((_PAGE / "clips.js").read_text("utf-8")),
    )
    write_text(path, _environment().get_template("report.html").render(values))


def _environment() -> jinja2.Environment:
    """Return the environment of the page: all text loses its folders."""
    environment = text.templates(_PAGE)
    environment.finalize = lambda value: without_folders(value) if type(value) is str else value
    environment.globals |= {"arrows": text.ARROWS, "colour": colour, "counted": counted}
    environment.tests["contains"] = lambda names, name: name in names
    environment.filters |= {
        "number": text.number,
        "bounds": text.bounds,
        "spread": text.spread_in_words,
        "level": text.level_in_words,
        "remarks": text.remarks,
        "shared_remarks": text.shared_remarks,
        "px": "{:.1f}".format,
    }
    return environment


def without_folders(line: str) -> str:
    """Return a text with the name alone of each absolute path: the page is made to be mailed."""
    for place in (Path.cwd(), Path.home()):  # these may have spaces in them
        if place.name:
            line = line.replace(f"{place}/", "")
    return re.sub(r"(?<![\w/.<:~])/(?:[^\s/'\"<>:,;&]+/)+", "", line)


def _with_short_names(evaluation: Evaluation) -> Evaluation:
    """Return an evaluation whose models have no folders in their names."""
    labels = [without_folders(model.label) for model in evaluation.models]
    if len(set(labels)) < len(labels):
        labels = [f"{label} ({i})" for i, label in enumerate(labels, 1)]
    models = [replace(m, label=label) for m, label in zip(evaluation.models, labels, strict=True)]
    return replace(evaluation, models=models)


def _warnings(evaluation: Evaluation) -> Iterator[str]:
    """Yield warnings on intervals, and the notes of models, each once."""
    yield from (f"{warning}." for warning in text.interval_warnings(evaluation))
    notes: list[tuple[str, str]] = []
    for model in evaluation.models:
        if left_out := sum(item.what == "clip" for item in model.excluded):
            note = f"left out: {counted(left_out, 'clip')}; the reasons are below"
            notes.append((note, model.label))
        notes += [(note, model.label) for note in model.notes]
    for note, labels in grouped(notes).items():
        yield f"{', '.join(labels)}: {note}." if len(evaluation.models) > 1 else f"{note}."


def _questions(models: Sequence[ModelResult], headline: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the questions that head the page, each with its heading; none without answers.

    Each has {label: score} (`results`), the label of the bold score (`best`), and the function that
    places values on a line (`x`). A broken motion has no score, and does not stretch the lines of
    the others.
    """
    best = {row.definition.key: row.best for row in headline}
    answered = [model for model in models if model.answers]
    questions = []
    for answers in zip(*(model.answers for model in answered), strict=True):
        key, states = answers[0].key, [answer.state for answer in answers]
        asked = [m for m, state in zip(answered, states) if state != NOT_ASKED and key in m.metrics]
        results = {model.label: model.metrics[key] for model in asked}
        questions.append(dict(
            text=answers[0].question, results=results, best=best.get(key),
            has_intervals=any(result.interval.low is not None for result in results.values()),
            x=_places(results.values()),
        ))  # fmt: skip
    return questions


def _places(results: Collection[MetricResult]) -> Callable[[float], float]:
    """Return the function of values to their places in pixels, 6 to 254 of 260.

    All scores and levels of the results lie on the line.
    """
    levels = [level for result in results for level in result.levels]
    ends = [level.value + sign * (level.spread or 0.0) for level in levels for sign in (-1, 1)]
    ends += [result.interval.value for result in results if result.informative]
    low, high = min([0.0, *ends]), max([1e-6, *ends])
    return lambda value: 6.0 + 248.0 * (value - low) / (high - low)


def _by_recording(
    evaluation: Evaluation,
) -> tuple[list[Definition], list[tuple[str, int, dict[str, Interval]]]]:
    """Return the patch metrics, and (recording, index of the model, {key: mean over samples}).

    Without samples there are no rows; see eq. 18.
    """
    rows = [
        (stem, i, values)
        for i, model in enumerate(evaluation.models)
        for stem, values in model.by_recording.items()
    ]
    sampled = any(interval.n > 1 for _, _, values in rows for interval in values.values())
    if not sampled and evaluation.protocol != "multires":
        return [], []
    patches = [d for d in evaluation.definitions() if d.group == PATCHES]
    known = [d for d in patches if any(d.key in values for _, _, values in rows)]
    return known, sorted(rows, key=lambda row: row[:2])


def _best_and_worst(evaluation: Evaluation, body: str | None) -> list[dict[str, Any]]:
    """Return best and worst clips of the first model, with other models' clips of the same name.

    Each is a text for its button (`label`) and one below (`detail`), the heading and the JSON of
    the player (`title`, `motion`), the metric by which it is ranked, and whether it is cut. Files
    that no longer exist are skipped. `body` is as in `gesturekit.viewer.drawn_body`.
    """
    clips = evaluation.models[0].clips
    key = next((k for k in shown_in("ranking") if all(k in c.metrics for c in clips)), None)
    if key is None:
        return []
    definition = DEFINITIONS[key]
    ranked = sorted(clips, key=lambda c: c.metrics[key], reverse=definition.better == "higher")
    each = min(EACH, max(1, len(ranked) // 2))
    ends = [("Best", ranked[:each]), ("Worst", ranked[::-1][:each] if len(ranked) > 1 else [])]
    shown = []
    for end, at, clip in ((end, at, clip) for end, some in ends for at, clip in enumerate(some)):
        name, label = clip.pair.name, f"{end}, {at + 1}" if at else end
        try:
            data = _player_data(evaluation, clip, body)
        except (GestureKitError, AudioFeaturesError, OSError):
            continue
        shown.append(dict(
            label=label,
            detail=f"{name}: {definition.name.lower()} {clip.metrics[key]:.2f}",
            title=html.escape(f"{label}: {name}"),
            motion=data,
            ranked_by=definition.name,
            is_cut=clip.seconds > SECONDS,
        ))  # fmt: skip
    return shown


def _player_data(evaluation: Evaluation, clip: ClipResult, body: str | None) -> str:
    """Return the JSON of the player: all models' clips of one name, the recording, its sound."""
    motions: dict[str, Motion] = {}
    for model in evaluation.models:
        same = next((other for other in model.clips if other.pair.name == clip.pair.name), None)
        if same is not None:
            motions[model.label] = load_clip(same.pair, evaluation.fps).generated
    motions["recording"] = load_clip(clip.pair, evaluation.fps).recording
    motions = {label: m[: round(SECONDS * m.fps)] for label, m in motions.items()}
    wave = None
    if clip.pair.audio is not None:
        start = (clip.pair.window or 0) * WINDOW_SECONDS
        wave = clip.pair.audio.load_wave().slice(start, min(SECONDS, clip.seconds))
    colours = {m.label: colour(i) for i, m in enumerate(evaluation.models)}
    return player_data(motions, wave, colours={**colours, "recording": RECORDING}, body=body)
