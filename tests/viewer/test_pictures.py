"""Pictures must show the motion they were given."""

from pathlib import Path

import matplotlib.colors
import matplotlib.figure
import matplotlib.image
import numpy as np
import pytest
from PIL import Image
from rigs import rig_of
from scipy.spatial.transform import Rotation

from audio_features import Wave
from gesturekit.errors import FormatError, MotionError
from gesturekit.motion import Motion
from gesturekit.viewer import LEFT, MIDDLE, RIGHT, DrawnBody, write_picture
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


def test_nothing_and_two_bodies_at_once_are_refused(tmp_path):
    with pytest.raises(MotionError, match="no motion"):
        write_picture({}, tmp_path / "a.png")
    with pytest.raises(FormatError, match="a body or a body model"):
        DrawnBody.of(a_swing(0.5), "human", tmp_path / "SMPL_NEUTRAL.npz")


def test_each_figure_shows_its_own_moment(tmp_path):
    write_picture(a_swing(0.0), tmp_path / "still.png", frames=4)
    write_picture(a_swing(1.2), tmp_path / "moving.png", frames=4)
    assert np.ptp(widths(tmp_path / "still.png", 4)) <= 2
    assert np.ptp(widths(tmp_path / "moving.png", 4)) > 20


def test_a_plot_is_the_picture_of_the_file(tmp_path):
    sound = Wave(np.zeros(48_000, np.float32), 16_000)
    options = {"audio": sound, "frames": 3, "title": "swing", "body": "skeleton"}
    a_swing(1.2).save(tmp_path / "a.png", **options)
    plot = a_swing(1.2).plot(**options)
    np.testing.assert_array_equal(plot, Image.open(tmp_path / "a.png"))
    other = a_swing(1.2).plot(**options | {"title": "jump"})
    assert not np.array_equal(plot, other), "its title"


@pytest.mark.parametrize("kind", ["png", "svg", "pdf"])
def test_files_name_us_and_no_time_of_writing(tmp_path, kind):
    write_picture(a_swing(1.0), tmp_path / f"a.{kind.upper()}", frames=1)
    data = (tmp_path / f"a.{kind.upper()}").read_bytes()
    assert b"gesturekit" in data
    assert b"dc:date" not in data and b"CreationDate" not in data


def test_the_picture_with_sound_has_the_speech_on_it(tmp_path):
    samples = np.random.default_rng(0).normal(0, 0.1, 48_000).astype(np.float32)
    write_picture(a_swing(1.0), tmp_path / "without.png")
    write_picture(a_swing(1.0), tmp_path / "with.png", audio=Wave(samples, 16_000))
    without, with_sound = (
        matplotlib.image.imread(tmp_path / name) for name in ("without.png", "with.png")
    )
    assert with_sound.shape[0] > without.shape[0]


@pytest.fixture
def drawn(tmp_path, monkeypatch):
    """drawn(motion, **options): the axes of the picture that was written."""
    kept, save = [], matplotlib.figure.Figure.savefig

    def saved(figure, *arguments, **options):
        kept.append(figure)
        save(figure, *arguments, **options)

    monkeypatch.setattr(matplotlib.figure.Figure, "savefig", saved)

    def draw(motion, **options):
        write_picture(motion, tmp_path / "x.png", **options)
        return kept[-1].axes

    draw.kept, draw.path = kept, tmp_path / "x.png"
    return draw


def outlines(axes) -> list[np.ndarray]:
    """Return the outline (N, 2) of each painted part, seconds and metres."""
    return [patch.get_xy()[:-1] for patch in axes.patches]


def test_people_are_seen_from_the_front_wherever_they_stand_and_face(drawn, gesture):
    motion = gesture(1.0, 30.0)
    before = outlines(drawn(motion, frames=3)[0])
    yaw = Rotation.from_euler("y", 2.0)
    rotations = motion.rotations.copy()
    rotations[:, 0] = (yaw * Rotation.from_quat(rotations[:, 0])).as_quat()
    path = yaw.apply(motion.translation) + [3.0, 0.5, -2.0]
    elsewhere = Motion(motion.skeleton, rotations, path, motion.fps)
    axes = drawn(elsewhere, frames=3)[0]
    after = outlines(axes)
    assert len(before) == len(after)
    for one, other in zip(before, after):
        assert other == pytest.approx(one, abs=1e-3)
    colours = [matplotlib.colors.to_hex(patch.get_facecolor()) for patch in axes.patches]
    middles = np.array([shape[:, 0].mean() for shape in after])
    first = middles < 1 / 3
    left, right = (
        middles[first & (np.array(colours) == COLOURS[side])].mean() for side in (LEFT, RIGHT)
    )
    # The first one is drawn at a sixth of the second; its left is at our right.
    assert right < 1 / 6 < left and left - 1 / 6 == pytest.approx(1 / 6 - right, abs=0.02)
    # The head is on top, with a nose over it.
    tops = [shape[:, 1].max() for shape in after]
    assert COLOURS[MIDDLE] == colours[int(np.argmax(tops))]
    (nose,) = {colour for colour in colours if colour not in COLOURS.values()}
    assert colours.count(nose) == 3
