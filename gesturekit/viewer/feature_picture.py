"""Feature pictures: a sound's features under one another, on one time axis."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from audio_features import FeatureTrack, LogMel, Wave
from audio_features.atomic import atomic_write
from gesturekit.viewer.canvas import name_row, new_canvas

_LINE = "#c8643a"
_INCHES_PER_SECOND, _WIDEST = 0.7, 40.0
_ONE_SCALE = ("mel", "chroma")
"""Features whose columns share a scale; others are normalised column by column."""
_UNITS = {
    "f0": "semitones from the median",
    "energy": "dB of active speech",
    "onset": "dB",
    "onset_strength": "dB",
    "spectral_flux": "dB",
    "f0_range": "semitones",
    "energy_range": "dB",
}


def draw_features(track: FeatureTrack, path: str | os.PathLike[str], wave: Wave) -> None:
    """Draw the sound (log-mel) and every feature of a track, as a PNG.

    Columns that belong together (mel_0, mel_1, …) are one image, others a line each; pitch is
    drawn where there is one. Bands and pitch classes share a scale; cepstral coefficients and
    hidden states, whose sizes differ a hundredfold, are each shown against their own mean and
    standard deviation.

    Args:
        track: (T, D) on any time base.
        path: the .png file to write.
        wave: the sound that the features are of.
    """
    groups = _groups(track.names)
    heights = [1.2, *(1.0 if len(columns) > 1 else 0.8 for columns in groups.values())]
    width = float(np.clip(_INCHES_PER_SECOND * wave.duration, 8.0, _WIDEST))
    size = (width, 1.15 * sum(heights) + 0.8)
    canvas, rows = new_canvas(size, Path(path).stem, heights)
    _image(rows[0], LogMel(n_mels=40).extract(wave), list(range(40)), "the sound, log-mel")
    for axes, (name, columns) in zip(rows[1:], groups.items()):
        if len(columns) > 1:
            own = "" if name in _ONE_SCALE else ", each against its own mean and spread"
            _image(axes, track, columns, f"{name}, {len(columns)} columns{own}", bool(own))
        else:
            _line(axes, track, columns[0], name)
    rows[-1].set_xlim(0, wave.duration)
    with atomic_write(path) as temporary:
        canvas.savefig(temporary, format="png", metadata={"Software": "gesturekit"})


def _groups(names: tuple[str, ...]) -> dict[str, list[int]]:
    """Group columns whose names differ only in their last number: {common part: columns}."""
    groups: dict[str, list[int]] = {}
    for column, name in enumerate(names):
        groups.setdefault(re.sub(r"_\d+$", "", name), []).append(column)
    return groups


def _image(
    axes: Axes, track: FeatureTrack, columns: list[int], title: str, own_scale: bool = False
) -> None:
    values = track.values[:, columns].T
    if own_scale:
        spread = values.std(axis=1, keepdims=True)
        values = (values - values.mean(axis=1, keepdims=True)) / np.maximum(spread, 1e-6)
    # A lone frame is drawn 20 ms wide.
    half = (track.times[-1] - track.times[0]) / max(len(track.times) - 1, 1) / 2 or 0.01
    low, high = np.quantile(values, [0.01, 0.995])
    axes.imshow(
        values,
        origin="lower",
        aspect="auto",
        extent=(track.times[0] - half, track.times[-1] + half, 0, len(columns)),
        cmap="Blues",
        vmin=low,
        vmax=max(high, low + 1e-6),
    )
    axes.set_yticks([])
    name_row(axes, title)


def _line(axes: Axes, track: FeatureTrack, column: int, name: str) -> None:
    values = track.values[:, column].astype(np.float64)
    if name == "f0" and "voicing" in track.names:
        values[track.values[:, track.names.index("voicing")] < 0.6] = np.nan
    axes.plot(track.times, values, color=_LINE, linewidth=1.0)
    name_row(axes, f"{name}, {_UNITS[name]}" if name in _UNITS else name)
