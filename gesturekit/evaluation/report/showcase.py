"""Clips shown in the report: best and worst of the first model, next to their recordings."""

from __future__ import annotations

from dataclasses import dataclass

from audio_features import AudioFeaturesError
from gesturekit.errors import GestureKitError
from gesturekit.evaluation.definitions import DEFINITIONS, shown_in
from gesturekit.evaluation.measuring.clips import load_clip, load_wave
from gesturekit.evaluation.pairs import WINDOW_SECONDS
from gesturekit.evaluation.report.plots import RECORDING, colour
from gesturekit.evaluation.results import ClipResult, Evaluation, ModelResult
from gesturekit.motion import Motion
from gesturekit.viewer import player_data

EACH = 2
"""Largest number of best and of worst clips."""
SECONDS = 180.0
"""Seconds of a clip that are shown, at most: a page with four clips of two figures has 8 MB."""


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
    model = evaluation.models[0]
    key = next((k for k in shown_in("ranking") if all(k in c.metrics for c in model.clips)), None)
    if key is None:
        return []
    definition = DEFINITIONS[key]
    ranked = sorted(
        model.clips, key=lambda clip: clip.metrics[key], reverse=definition.better == "higher"
    )
    each = min(EACH, max(1, len(ranked) // 2))
    chosen = [("Best" if i == 0 else f"Best, {i + 1}", c) for i, c in enumerate(ranked[:each])]
    if len(ranked) > 1:
        worst = ranked[::-1][:each]
        chosen += [("Worst" if i == 0 else f"Worst, {i + 1}", c) for i, c in enumerate(worst)]
    shown = []
    for label, clip in chosen:
        try:
            data = _data(evaluation, clip, body)
        except (GestureKitError, AudioFeaturesError, OSError):
            continue
        detail = f"{clip.pair.name}: {definition.name.lower()} {clip.metrics[key]:.2f}"
        title, cut = f"{label}: {clip.pair.name}", clip.seconds > SECONDS
        shown.append(Shown(label, detail, title, definition.name, data, cut))
    return shown


def _data(evaluation: Evaluation, result: ClipResult, body: str | None) -> str:
    clip = load_clip(result.pair, evaluation.fps)
    motions = {evaluation.models[0].label: _start(clip.generated)}
    for model in evaluation.models[1:]:
        other = _same(model, result)
        if other is not None:
            motions[model.label] = _start(load_clip(other.pair, evaluation.fps).generated)
    motions["recording"] = _start(clip.recording)
    wave = None
    if result.pair.audio is not None:
        start = (result.pair.window or 0) * WINDOW_SECONDS
        wave = load_wave(result.pair.audio).slice(start, min(SECONDS, result.seconds))
    colours = {m.label: colour(i) for i, m in enumerate(evaluation.models)}
    return player_data(motions, wave, colours={**colours, "recording": RECORDING}, body=body)


def _same(model: ModelResult, result: ClipResult) -> ClipResult | None:
    return next((clip for clip in model.clips if clip.pair.name == result.pair.name), None)


def _start(motion: Motion) -> Motion:
    return motion[: round(SECONDS * motion.fps)]
