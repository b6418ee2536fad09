"""Figures that are made into SVG, kept to be examined."""

import matplotlib.figure
import pytest


def kept_figures(monkeypatch: pytest.MonkeyPatch) -> list:
    """Return a list to which each figure is appended that matplotlib writes from now on."""
    figures, save = [], matplotlib.figure.Figure.savefig

    def kept(figure, *args, **options):
        figures.append(figure)
        return save(figure, *args, **options)

    monkeypatch.setattr(matplotlib.figure.Figure, "savefig", kept)
    return figures


def points(axes) -> list[tuple[list[float], list[float]]]:
    """Return x and y of all lines and marks that were drawn, rounded."""
    return [
        tuple([round(float(v), 9) for v in values] for values in line.get_data())
        for line in axes.lines
    ]
