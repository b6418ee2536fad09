"""Pictures must show the motion they were given."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import matplotlib.colors
import matplotlib.image
import numpy as np
from rigs import rig_of
from scipy.spatial.transform import Rotation

from audio_features import Wave
from gesturekit.motion import Motion
from gesturekit.viewer import write_picture
from gesturekit.viewer.anatomy import MIDDLE
from gesturekit.viewer.pictures import COLOURS


def a_swing(amplitude: float) -> Motion:
    bones = {"root": (None, (0.0, 0.0, 0.0)), "arm": ("root", (0.0, 1.0, 0.0))}
    skeleton = rig_of(bones, end_sites={"arm": (np.array([0.0, 0.6, 0.0]),)})
    turn = np.zeros((90, 2, 3))
    turn[:, 1, 2] = amplitude * np.sin(np.arange(90) / 5)
    rotations = Rotation.from_rotvec(turn.reshape(-1, 3)).as_quat().reshape(90, 2, 4)
    return Motion(skeleton, rotations, np.zeros((90, 3)), 30.0)


def body_of(path: Path) -> np.ndarray:
    """Return (H, W) bool: where a picture shows the middle of a body."""
    image = matplotlib.image.imread(path)[:, :, :3]
    return np.abs(image - matplotlib.colors.to_rgb(COLOURS[MIDDLE])).max(axis=2) < 0.02


def widths(path: Path, n: int) -> list[int]:
    """How many pixels wide each of `n` figures in a row is."""
    found = []
    for part in np.array_split(body_of(path), n, axis=1):
        across = np.flatnonzero(part.any(axis=0))
        found.append(int(across[-1] - across[0]))
    return found


def test_each_figure_shows_its_own_moment(tmp_path):
    write_picture(a_swing(0.0), tmp_path / "still.png", frames=4)
    write_picture(a_swing(1.2), tmp_path / "moving.png", frames=4)
    assert np.ptp(widths(tmp_path / "still.png", 4)) <= 2
    assert np.ptp(widths(tmp_path / "moving.png", 4)) > 20


def test_a_motion_too_short_for_the_first_time_is_drawn_in_its_middle(tmp_path):
    short = {"long": a_swing(0.0), "short": a_swing(0.0)[:3]}
    write_picture(short, tmp_path / "a.png")
    body = body_of(tmp_path / "a.png")
    assert body[len(body) // 2 : 3 * len(body) // 4].any()


def test_more_motions_than_colours_have_speeds_of_their_own(tmp_path):
    figure = a_swing(1.0)[:30]
    write_picture({f"take {k}": figure for k in range(8)}, tmp_path / "a.svg")
    drawn = re.findall(
        r'clip-path[^>]*style="(fill: none; [^"]*)"', (tmp_path / "a.svg").read_text()
    )
    assert len({style for style in drawn if "stroke-width: 1.4" in style}) == 8


def test_a_rig_of_one_joint_is_as_tall_as_its_end(tmp_path):
    ends = {"root": (np.array([0.0, 1.0, 0.0]),)}
    lone = rig_of({"root": (None, (0.0, 0.0, 0.0))}, end_sites=ends)
    still = np.tile([0.0, 0.0, 0.0, 1.0], (90, 1, 1))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        write_picture(Motion(lone, still, np.zeros((90, 3)), 30.0), tmp_path / "a.png", frames=4)
    assert np.ptp(widths(tmp_path / "a.png", 4)) <= 2


def test_the_picture_with_sound_has_the_speech_on_it(tmp_path):
    samples = np.random.default_rng(0).normal(0, 0.1, 48_000).astype(np.float32)
    write_picture(a_swing(1.0), tmp_path / "without.png")
    write_picture(a_swing(1.0), tmp_path / "with.png", audio=Wave(samples, 16_000))
    without, with_sound = (
        matplotlib.image.imread(tmp_path / name) for name in ("without.png", "with.png")
    )
    assert with_sound.shape[0] > without.shape[0]


def test_silence_and_titles_of_any_kind_are_drawn(tmp_path):
    silence = Wave(np.zeros(16_000, dtype=np.float32), 16_000)
    write_picture(a_swing(0.2), tmp_path / "t.png", title=r"$\frac{unclosed $ \q")
    write_picture(a_swing(0.2), tmp_path / "s.png", audio=silence)
    assert (tmp_path / "s.png").stat().st_size > 1_000
