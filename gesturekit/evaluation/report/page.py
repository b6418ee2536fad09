"""The report: one self-contained HTML file with tables, plots and a player.

`page/report.html` holds its sentences and tables; this module computes what they show.
"""

from __future__ import annotations

import html
import json
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path

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
from gesturekit.evaluation.measuring.clips import load_clip, load_wave
from gesturekit.evaluation.pairs import WINDOW_SECONDS
from gesturekit.evaluation.report import rows
from gesturekit.evaluation.report.plots import RECORDING, all_plots, colour
from gesturekit.evaluation.report.text import agreement_lines
from gesturekit.evaluation.results import (
    NOT_ASKED,
    ClipResult,
    Evaluation,
    Interval,
    MetricResult,
    ModelResult,
)
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
    models, groups = evaluation.models, rows.rows_by_group(evaluation)
    names = listed([model.label for model in models], 12)
    shown = best_and_worst(evaluation, body)
    patch_metrics, recording_rows = _by_recording(evaluation)
    values = dict(
        evaluation=evaluation,
        models=models,
        title=title or f"{names} against the recordings in {evaluation.reference.name}",
        below_verdicts=[*same_verdicts(models), *_glossary(evaluation)],
        facts=_facts(evaluation),
        warnings=_warnings(evaluation),
        shown=shown,
        shown_seconds=f"{SECONDS:g}",
        questions=_questions(models, groups.get(HEADLINE, [])),
        groups=groups,
        open_groups=_OPEN,
        patch_metrics=patch_metrics,
        recording_rows=recording_rows,
        plots=Markup(plots_section(all_plots(evaluation))),
        agreement="\n".join(agreement_lines(evaluation)).strip(),
        clip_rows=[(i, clip) for i, m in enumerate(models) for clip in m.clips[:_MOST_CLIPS]],
        command=command,
        settings=json.dumps(evaluation.settings, ensure_ascii=False),
        player=_player(shown),
    )
    write_text(path, _templates().get_template("report.html").render(values))


def _player(shown: Sequence[Shown]) -> dict[str, Markup]:
    """Return style and scripts of the page, and the data of its player."""
    clips = [{"title": html.escape(clip.title), "motion": clip.motion} for clip in shown]
    return {
        "style": Markup((_PAGE / "style.css").read_text("utf-8")),
        "script": Markup((_PAGE / "clips.js").read_text("utf-8")),
        "shell": Markup(script_json(player_shell() if shown else "")),
        "clips": Markup(script_json(clips)),
    }


@cache
def _templates() -> jinja2.Environment:
    """Return the environment of the page: all text is escaped, and loses its folders."""
    templates = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_PAGE),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
        finalize=lambda value: without_folders(value) if type(value) is str else value,
    )
    templates.globals |= {"colour": colour, "counted": counted}
    templates.tests["contains"] = lambda names, name: name in names
    templates.filters |= {
        "number": rows.number,
        "bounds": rows.bounds,
        "spread": rows.spread_in_words,
        "level": rows.level_in_words,
        "remarks": rows.remarks,
    }
    return templates


def without_folders(text: str) -> str:
    """Return a text with the name alone of each absolute path: the page is made to be mailed."""
    for place in (Path.cwd(), Path.home()):  # these may have spaces in them
        if place.name:
            text = text.replace(f"{place}/", "")
    return re.sub(r"(?<![\w/.<:~])/(?:[^\s/'\"<>:,;&]+/)+", "", text)


def _with_short_names(evaluation: Evaluation) -> Evaluation:
    """Return an evaluation whose models have no folders in their names."""
    labels = [without_folders(model.label) for model in evaluation.models]
    if len(set(labels)) < len(labels):
        labels = [f"{label} ({i})" for i, label in enumerate(labels, 1)]
    models = [replace(m, label=label) for m, label in zip(evaluation.models, labels, strict=True)]
    return replace(evaluation, models=models)


def _glossary(evaluation: Evaluation) -> Iterator[str]:
    """Yield what a verdict's terms mean that no reader knows from elsewhere."""
    if any("reach" in model.verdict for model in evaluation.models):
        yield (
            "Reach is the size of the space that the wrists move in, relative to the body; the "
            "speaker's is that of the recordings."
        )


def _facts(evaluation: Evaluation) -> Iterator[str]:
    if evaluation.protocol:
        yield f"protocol {evaluation.protocol}"
    yield counted(len({clip.pair.stem for clip in evaluation.models[0].clips}), "recording")
    yield evaluation.basis.rstrip(".")
    yield f"seed {evaluation.settings['seed']}"


def _warnings(evaluation: Evaluation) -> Iterator[str]:
    yield from (f"{warning}." for warning in rows.interval_warnings(evaluation))

    def notes(model: ModelResult) -> Iterator[str]:
        if left_out := sum(item.what == "clip" for item in model.excluded):
            yield f"left out: {counted(left_out, 'clip')}; the reasons are below"
        yield from model.notes

    several = len(evaluation.models) > 1
    said = rows.by_text((note, model.label) for model in evaluation.models for note in notes(model))
    for note, labels in said.items():
        yield f"{', '.join(labels)}: {note}." if several else f"{note}."


@dataclass(frozen=True)
class Question:
    """A column of the three questions, whose scores have places on one line, in pixels.

    Attributes:
        text: its heading.
        results: {label of a model: its score}.
        best: index of the model whose score is bold, or None.
    """

    text: str
    results: dict[str, MetricResult]
    best: int | None
    WIDTH, MARGIN = 260, 6

    @property
    def has_intervals(self) -> bool:
        """True if a score has an interval."""
        return any(result.interval.low is not None for result in self.results.values())

    @cached_property
    def ends(self) -> tuple[float, float]:
        """Values at both ends of the line, between which all scores and levels lie."""
        results = self.results.values()
        levels = [level for result in results for level in result.levels]
        ends = [level.value + sign * (level.spread or 0.0) for level in levels for sign in (-1, 1)]
        ends += [result.interval.value for result in results if result.informative]
        return min([0.0, *ends]), max([1e-6, *ends])

    def width(self, difference: float) -> str:
        """Return the length of a difference of values."""
        low, high = self.ends
        return f"{(self.WIDTH - 2 * self.MARGIN) * difference / (high - low):.1f}"

    def x(self, value: float, beside: float = 0.0) -> str:
        """Return the place of a value, and of `beside` added to it."""
        low, high = self.ends
        share = (value + beside - low) / (high - low)
        return f"{self.MARGIN + (self.WIDTH - 2 * self.MARGIN) * share:.1f}"


def _questions(models: Sequence[ModelResult], headline: Sequence[rows.Row]) -> list[Question]:
    """Return the questions that head the page; none without answers.

    A broken motion has no scores there, and does not stretch the lines of the others.
    """
    best = {row.definition.key: row.best for row in headline}
    answered = [model for model in models if model.answers]
    questions = []
    for answers in zip(*(model.answers for model in answered), strict=True):
        key, states = answers[0].key, [answer.state for answer in answers]
        asked = [m for m, state in zip(answered, states) if state != NOT_ASKED and key in m.metrics]
        results = {model.label: model.metrics[key] for model in asked}
        questions.append(Question(answers[0].question, results, best.get(key)))
    return questions


def _by_recording(
    evaluation: Evaluation,
) -> tuple[list[Definition], list[tuple[str, int, dict[str, Interval]]]]:
    """Return the patch metrics, and (recording, index of the model, {key: mean over samples}).

    Without samples there are no rows; see eq. 18.
    """
    models = {i: m for i, m in enumerate(evaluation.models) if m.by_recording}
    tables = [values for model in models.values() for values in model.by_recording.values()]
    sampled = any(interval.n > 1 for values in tables for interval in values.values())
    if not sampled and evaluation.protocol != "multires":
        return [], []
    patches = [d for d in evaluation.definitions() if d.group == PATCHES]
    stems = sorted({stem for model in models.values() for stem in model.by_recording})
    return (
        [d for d in patches if any(d.key in values for values in tables)],
        [(s, i, model.by_recording.get(s, {})) for s in stems for i, model in models.items()],
    )


@dataclass(frozen=True)
class Shown:
    """A clip to show.

    Attributes:
        label: text of its button.
        detail: text below: the value it is ranked by.
        title: heading of the player.
        ranked_by: name of the metric.
        motion: JSON for the player.
        is_cut: True if the clip is longer than what is shown.
    """

    label: str
    detail: str
    title: str
    ranked_by: str
    motion: str
    is_cut: bool = False


def best_and_worst(evaluation: Evaluation, body: str | None = None) -> list[Shown]:
    """Return best and worst clips of the first model, with other models' clips of the same name.

    Files that no longer exist are skipped. `body` is as in `gesturekit.viewer.drawn_body`.
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
        label = f"{end}, {at + 1}" if at else end
        try:
            data = _player_data(evaluation, clip, body)
        except (GestureKitError, AudioFeaturesError, OSError):
            continue
        detail = f"{clip.pair.name}: {definition.name.lower()} {clip.metrics[key]:.2f}"
        title, cut = f"{label}: {clip.pair.name}", clip.seconds > SECONDS
        shown.append(Shown(label, detail, title, definition.name, data, cut))
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
        wave = load_wave(clip.pair.audio).slice(start, min(SECONDS, clip.seconds))
    colours = {m.label: colour(i) for i, m in enumerate(evaluation.models)}
    return player_data(motions, wave, colours={**colours, "recording": RECORDING}, body=body)
