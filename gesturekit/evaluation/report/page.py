"""The report: one self-contained HTML file with tables, plots and a player."""

from __future__ import annotations

import html
import json
import os
import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from gesturekit.evaluation.report import tables
from gesturekit.evaluation.report.agreement_table import agreement_lines
from gesturekit.evaluation.report.headline import headline, interval_warnings
from gesturekit.evaluation.report.plots import all_plots
from gesturekit.evaluation.report.showcase import SECONDS, Shown, best_and_worst
from gesturekit.evaluation.results import Evaluation
from gesturekit.evaluation.statistics.paired import contests
from gesturekit.evaluation.statistics.questions import same_verdicts
from gesturekit.viewer import player_shell
from gesturekit.viewer.pages import plots_section, script_json, section, write_page
from gesturekit.wording import counted

_HERE = Path(__file__).parent / "page"


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
    names = ", ".join(model.label for model in evaluation.models)
    heading = title or f"{names} against {evaluation.reference.name}"
    shown = best_and_worst(evaluation, body)
    rows = contests(evaluation.models)
    sections = [
        _clips_section(shown, evaluation),
        without_folders(headline(evaluation, rows)),
        without_folders(tables.metrics(evaluation, rows)),
        without_folders(tables.recordings(evaluation)),
        plots_section(all_plots(evaluation)),
        _agreement_section(evaluation),
        without_folders(tables.per_clip(evaluation)),
        without_folders(tables.excluded(evaluation)),
        without_folders(_definitions_section(evaluation, command)),
    ]
    page = {
        "title": html.escape(without_folders(heading)),
        "facts": "".join(f"<span>{html.escape(fact)}</span>" for fact in _facts(evaluation)),
        "verdicts": _paragraphs("verdict", evaluation.verdicts())
        + _paragraphs("facts", [*same_verdicts(evaluation.models), *_glossary(evaluation)]),
        "warnings": _paragraphs("warning", _warnings(evaluation)),
        "sections": "\n".join(filter(None, sections)),
        "footer": html.escape(
            ", ".join(f"{name} {version}" for name, version in evaluation.versions.items())
        ),
        "scripts": _scripts(shown),
    }
    write_page(path, _HERE, page)


def _paragraphs(kind: str, lines: Iterable[str]) -> str:
    """Return each line as a paragraph of a class."""
    shown = (html.escape(without_folders(line)) for line in lines)
    return "".join(f'<p class="{kind}">{line}</p>' for line in shown)


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


def _glossary(evaluation: Evaluation) -> Iterable[str]:
    """Yield what a verdict's terms mean that no reader knows from elsewhere."""
    if any("reach" in model.verdict for model in evaluation.models):
        yield (
            "Reach is the size of the space that the wrists move in, relative to the body; the "
            "speaker's is that of the recordings."
        )


def _facts(evaluation: Evaluation) -> Iterable[str]:
    model = evaluation.models[0]
    recordings = len({clip.pair.stem for clip in model.clips})
    if evaluation.protocol:
        yield f"protocol {evaluation.protocol}"
    yield counted(recordings, "recording")
    yield evaluation.basis.rstrip(".")
    yield f"seed {evaluation.settings['seed']}"


def _warnings(evaluation: Evaluation) -> Iterable[str]:
    yield from (f"{warning}." for warning in interval_warnings(evaluation))
    said: dict[str, list[str]] = {}  # several models may have the same note
    for model in evaluation.models:
        left_out = sum(item.what == "clip" for item in model.excluded)
        if left_out:
            note = f"left out: {counted(left_out, 'clip')}; the reasons are below"
            said.setdefault(note, []).append(model.label)
        for note in model.notes:
            said.setdefault(note, []).append(model.label)
    for note, labels in said.items():
        yield f"{', '.join(labels)}: {note}." if len(evaluation.models) > 1 else f"{note}."


def _agreement_section(evaluation: Evaluation) -> str:
    if evaluation.agreement is None:
        return ""
    notes = "<br>".join(html.escape(f"{note}.") for note in evaluation.agreement.notes)
    table = "\n".join(agreement_lines(evaluation)).strip()
    return section("Agreement with people", notes, f"<pre>{html.escape(table)}</pre>")


def _clips_section(shown: list[Shown], evaluation: Evaluation) -> str:
    if not shown:
        return ""
    buttons = "".join(
        f'<button type="button" aria-pressed="false">{html.escape(clip.label)}'
        f"<small>{html.escape(clip.detail)}</small></button>"
        for clip in shown
    )
    first = html.escape(evaluation.models[0].label)
    lead = (
        f"The best and the worst clips of {first} by {html.escape(shown[0].ranked_by)}, beside "
        "their recordings and with the recordings' sound where it was given. "
        + ("" if not any(clip.is_cut for clip in shown) else f"The first {SECONDS:g} s of each. ")
    )
    return section(
        "Generated and recorded, side by side",
        lead,
        f'<div id="clips-bar">{buttons}</div><iframe id="player" title="Player"></iframe>',
    )


def _definitions_section(evaluation: Evaluation, command: str | None) -> str:
    items = "".join(
        f"<dt>{html.escape(d.name)} <code>{d.key}</code></dt><dd>{html.escape(d.text)}"
        + ("<br><span class=bound>Bound to its frame rate.</span>" if d.fps_bound else "")
        + f"<br><small>{html.escape(d.variant)} · {html.escape(d.source)}</small></dd>"
        for d in evaluation.definitions()
    )
    settings = html.escape(json.dumps(evaluation.settings, ensure_ascii=False))
    made = f"<p>Made by <code>{html.escape(command)}</code></p>" if command else ""
    return section(
        "Definitions and settings",
        "",
        f"{made}<p>Settings: <code>{settings}</code></p>"
        f"<details><summary>What each figure is</summary><dl>{items}</dl></details>",
    )


def _scripts(shown: list[Shown]) -> str:
    if not shown:
        return ""
    clips = [{"title": html.escape(c.title), "motion": c.motion} for c in shown]
    script = (_HERE / "clips.js").read_text(encoding="utf-8")
    return (
        f'<script type="application/json" id="shell">{script_json(player_shell())}</script>'
        f'<script type="application/json" id="clips">{script_json(clips)}</script>'
        f"<script>{script}</script>"
    )
