"""Figures that are made into SVG, kept to be examined."""

from __future__ import annotations

from types import ModuleType

import pytest


def kept_figures(monkeypatch: pytest.MonkeyPatch, plots: ModuleType) -> list:
    """Return a list to which each figure is appended that a module makes into SVG from now on."""
    figures, text = [], plots.svg_text

    def kept(figure, *colours):
        figures.append(figure)
        return text(figure, *colours)

    monkeypatch.setattr(plots, "svg_text", kept)
    return figures
