"""Pictures: motions with their hand speed and speech (PNG, SVG or PDF), and features of a sound."""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib
import matplotlib.figure
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse, Polygon

from audio_features import FeatureTrack, LogMel, Wave
from audio_features.atomic import atomic_write
from gesturekit.viewer.drawn_body import drawn_bodies
from gesturekit.viewer.figure import LEFT, MIDDLE, RIGHT, Figure
from gesturekit.viewer.page_data import Playable, as_wave
from gesturekit.viewer.scene import SkinnedBody, still
from gesturekit.wording import printable

if TYPE_CHECKING:
    from gesturekit.motion import Motion

COLOURS = {MIDDLE: "#d9d2c5", LEFT: "#e88a62", RIGHT: "#5d97bf"}
"""What each side of the body is painted with."""
_NOSE = "#a89d88"
_SPEEDS = ("#c8643a", "#3d7d5e", "#6a5fae", "#57616c")
"""Colours of the motions' hand speeds, as in the page."""
_METADATA = {
    "png": {"Software": "gesturekit"},
    "svg": {"Creator": "gesturekit", "Date": None},
    "pdf": {"Creator": "gesturekit", "CreationDate": None},
}
_REPRODUCIBLE: dict[Any, Any] = {"svg.hashsalt": "gesturekit"}
"""Settings with which the same motion makes the same bytes."""
_INCHES_PER_FIGURE = 1.3
_ROW_INCHES = 2.9
_STILL = 600
"""Pixels of the pictures of a skinned body."""
SOFT = "#6b7785"
_DPI = 110
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


def write_picture(
    motion: Motion | Mapping[str, Motion],
    path: str | os.PathLike[str],
    audio: Playable | None = None,
    body: str | None = None,
    *,
    frames: int = 10,
    title: str | None = None,
) -> None:
    """Draw the figure from the front at evenly spaced times, and its hand speed.

    With sound, log-mel and energy of the speech too, on the same time axis.

    Args:
        motion: what to draw; or {label: motion} for several, one below the other.
        path: the .png, .svg or .pdf file to write.
        audio: the speech that belongs to it, a file or a `Wave`; it starts with the motion.
        body: "mannequin" (by default), "human", "skeleton" or the path of a VRM avatar; see
            `gesturekit.viewer.drawn_body`.
        frames: how many times the figure is drawn.
        title: the heading; the file's stem by default.

    Raises:
        AudioError: `audio` is not sound.
        FormatError: an unknown body.
        MotionError: no motion.
    """
    wave, shown = as_wave(audio), drawn_bodies(motion, body)
    figures = {label: drawn.figure for label, drawn in shown.items()}
    seconds = max(drawn.motion.duration for drawn in shown.values())
    seconds = max(seconds, wave.duration if wave else 0.0)
    bodies = [_ROW_INCHES] * len(figures)
    heights = [1.1, 1.2, *bodies] if wave else [*bodies, 1.0]
    size = (max(6.0, _INCHES_PER_FIGURE * frames), sum(heights) + 0.9)
    canvas, rows = new_canvas(size, Path(path).stem if title is None else title, heights)
    time_axis = rows[-1]
    if wave:
        _speech(rows.pop(0), wave)
    _speed(rows.pop(0 if wave else -1), figures, wave)
    draws = []
    for k, (axes, (label, drawn)) in enumerate(zip(rows, shown.items(), strict=True)):
        skinned = SkinnedBody(drawn, drawn.skins[0], k) if drawn.skins else None
        draws.append(_figures(axes, drawn.figure, label, (frames, seconds), skinned))
    # Bodies that reach out of their rows make these smaller, and are drawn again in their sizes.
    for _ in range(2):
        canvas.draw_without_rendering()
        for draw in draws:
            draw()
        time_axis.set_xlim(0, seconds)
    canvas.set_layout_engine("none")
    kind = Path(path).suffix[1:].lower()
    with atomic_write(path) as temporary, matplotlib.rc_context(_REPRODUCIBLE):
        canvas.savefig(temporary, format=kind, metadata=_METADATA[kind])


def _plain(label: str) -> str:
    """Return a label that matplotlib's legends show, and in which it finds no formulas."""
    return label.lstrip("_").replace("$", r"\$")


def _speech(axes: Axes, wave: Wave) -> None:
    track = LogMel(n_mels=40).extract(wave)
    axes.imshow(
        track.values.T,
        origin="lower",
        aspect="auto",
        extent=(0, wave.duration, 0, 1),
        cmap="Blues",
    )
    axes.set_yticks([])
    name_row(axes, "speech, log-mel")


def _speed(axes: Axes, figures: Mapping[str, Figure], wave: Wave | None) -> None:
    top = max(max(1.08 * each.top_speed, 0.06 * each.height) for each in figures.values())
    name = next(iter(figures.values())).speed_of
    if wave:
        at = np.arange(0, wave.duration, 0.02)
        loudness = np.log(wave.rms(at) + 1e-4)
        low, high = np.quantile(loudness, [0.05, 0.995])
        shape = np.clip((loudness - low) / max(high - low, 1e-3), 0, 1)
        axes.fill_between(at, 0, shape * top, color="#c9d3dc", linewidth=0)
        colour = " (orange)" if len(figures) == 1 else ""
        name_row(axes, f"{name}, m/s{colour}, over the energy of speech (grey)")
    else:
        name_row(axes, f"{name}, m/s")
    # Line styles tell figures of one colour apart.
    inks = itertools.product(("-", "--", ":"), _SPEEDS)
    for (label, figure), (line, ink) in zip(figures.items(), itertools.cycle(inks)):
        times = np.arange(len(figure.points)) / figure.fps
        if not wave:
            axes.fill_between(times, 0, figure.hand_speed, color=ink, alpha=0.15, linewidth=0)
        axes.plot(times, figure.hand_speed, line, color=ink, linewidth=1.4, label=_plain(label))
    if len(figures) > 1:
        # Beside the title: within the axes it would lie over the curves.
        style = {"fontsize": 8, "frameon": False, "labelcolor": SOFT, "ncols": 4}
        axes.legend(loc="lower right", bbox_to_anchor=(1, 1), borderaxespad=0, **style)
    axes.set_ylim(0, top)


def _figures(
    axes: Axes, figure: Figure, label: str, grid: tuple[int, float], body: SkinnedBody | None
) -> Callable[[], None]:
    """Return what draws the figure along the axis, each time centred on its own time.

    `grid` is how many times it is drawn, and the seconds of the axis.
    """
    frames, seconds = grid
    n_frames = len(figure.points)
    low, high = -0.05 * figure.extent, 1.09 * figure.extent
    axes.set_yticks([])
    words = "from the front" if body else "from the front; its left is orange"
    name_row(axes, f"{label}{': ' if label else ''}{words}")
    axes.axhline(0, color="#d5dae0", linewidth=1)
    times = (np.arange(frames) + 0.5) * seconds / frames
    times = times[times * figure.fps < n_frames]
    shown = {
        float(time): int(time * figure.fps)
        for time in (times if len(times) else [n_frames / figure.fps / 2])
    }
    images = {time: still(body, frame, _STILL) for time, frame in shown.items()} if body else {}

    def draw() -> None:
        for artist in (*axes.patches, *axes.images):
            artist.remove()
        # The axis counts seconds, the body metres: a metre is this many seconds wide.
        box = axes.get_window_extent()
        wide = (seconds / box.width) * (box.height / (high - low))
        for time, frame in shown.items():
            if body is None:
                _figure(axes, figure, frame, time, wide)
                continue
            image, (left, right, bottom, top) = images[time]
            place = (time + wide * left, time + wide * right, bottom, top)
            axes.imshow(image, extent=place, aspect="auto", zorder=3, clip_on=False)
        axes.set_ylim(low, high)  # imshow fits the axes to each picture

    return draw


def _figure(axes: Axes, figure: Figure, frame: int, time: float, wide: float) -> None:
    x, _, z = figure.points[frame, 0]
    points = figure.points[frame] - [x, figure.floor, z]
    # Seen from where the body faces: the viewer's right is the body's left.
    cos, sin = np.cos(figure.front), np.sin(figure.front)
    right = points[:, 0] * cos - points[:, 2] * sin
    depth = points[:, 0] * sin + points[:, 2] * cos
    flat = np.stack([right, points[:, 1]], axis=1)
    place = np.array([wide, 1.0])
    shapes = []
    for limb in figure.limbs:
        a, b = limb.ends
        outline = _taper(flat[a], flat[b], limb.radii, limb.width)
        # Fingers are too thin for a border.
        border = 0.6 if limb.radii[0] > 0.01 * figure.height else 0.0
        shapes.append((depth[a] + depth[b], outline, COLOURS[limb.side], border))
    if figure.head:
        base, top, face = figure.head
        size, up, looks = figure.head_size, flat[top] - flat[base], flat[face] - flat[base]
        centre = flat[base] + 0.4 * up
        angle = np.degrees(np.arctan2(-up[0], up[1]))
        skull = Ellipse(centre, 0.68 * size, 0.92 * size, angle=angle).get_verts()
        shapes.append((2 * depth[base], np.asarray(skull), COLOURS[MIDDLE], 0.6))
        if depth[face] > depth[base]:
            nose = Ellipse(centre + 0.36 * looks, 0.12 * size, 0.26 * size, angle=angle)
            shapes.append((np.inf, np.asarray(nose.get_verts()), _NOSE, 0.0))
    # The farthest first, as a painter does.
    for order, (_, outline, colour, border) in enumerate(sorted(shapes, key=lambda s: s[0])):
        patch = Polygon(outline * place + [time, 0], facecolor=colour, clip_on=False)
        patch.set(edgecolor="white", linewidth=border, zorder=3 + order / 1000)
        axes.add_patch(patch)


def _taper(a: np.ndarray, b: np.ndarray, radii: tuple[float, float], width: float) -> np.ndarray:
    """Return the outline (N, 2) of a limb from `a` to `b`, `width` times wider than its radii."""
    along = (b - a) / max(float(np.linalg.norm(b - a)), 1e-9)
    aside = width * np.array([-along[1], along[0]])
    half = np.linspace(-np.pi / 2, np.pi / 2, 9)[:, None]
    cap = np.cos(half) * along + np.sin(half) * aside
    return np.concatenate([b + radii[1] * cap, a - radii[0] * cap])


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
            scale = "" if name in _ONE_SCALE else ", each against its own mean and spread"
            _image(axes, track, columns, f"{name}, {len(columns)} columns{scale}", bool(scale))
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


def new_canvas(
    size: tuple[float, float], title: str, heights: Sequence[float]
) -> tuple[matplotlib.figure.Figure, list[Axes]]:
    """Return a figure of this size in inches, and its rows of these relative heights."""
    canvas = matplotlib.figure.Figure(figsize=size, dpi=_DPI, layout="constrained")
    style = {"ha": "left", "fontsize": 13, "color": "#26303b", "parse_math": False}
    canvas.suptitle(printable(title), x=0.012, **style)
    rows = canvas.subplots(len(heights), sharex=True, height_ratios=heights)
    for axes in rows:
        axes.tick_params(labelsize=8, colors=SOFT, length=2)
        for name, spine in axes.spines.items():
            spine.set_visible(name == "bottom")
            spine.set_color("#d5dae0")
    rows[-1].set_xlabel("seconds", fontsize=9, color=SOFT)
    return canvas, list(rows)


def name_row(axes: Axes, text: str) -> None:
    """Write the title of a row."""
    axes.set_title(text, loc="left", fontsize=9, color=SOFT, pad=3, parse_math=False)
