"""Warnings about models that are evaluated on what they were trained on."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from gesturekit.wording import counted, listed

if TYPE_CHECKING:
    from gesturekit.evaluation.results import ModelResult


def trained_on(model: ModelResult, name: str) -> str:
    """Return a warning if `name`, a model, was trained on recordings of its evaluation, or ""."""
    from gesturekit.evaluation.pairs import Stretch
    from gesturekit.systems import model_folder
    from gesturekit.training.data.sources import is_trained_on, load_sources

    sources = load_sources(_made_by(model.path) or model_folder(name))
    measured = {clip.pair.stem: clip.pair for clip in model.clips}
    seen = []
    for stem, pair in measured.items():
        if isinstance(pair.reference, Stretch):
            item = pair.reference.item
            stretch = {"start": item.motion_start, "duration": item.duration}
            known = item.split == "train"
            known = known or is_trained_on(sources, item.motion, item.audio, **stretch)
        else:
            known = is_trained_on(sources, pair.reference, pair.audio)
        seen += [stem] if known else []
    if not seen:
        return ""
    return (
        f"the model was trained on {len(seen)} of {counted(len(measured), 'recording')}, or on a "
        f"part of each ({listed(seen, 3)}): the figures do not say how it does on new ones"
    )


def _made_by(rendered: Path) -> Path | None:
    """Return the model folder that the journal of rendered motion names, or None."""
    from gesturekit.rendering.batch import model_of_results

    return model_of_results(rendered)
