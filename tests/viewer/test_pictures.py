"""Pictures must show the motion they were given."""

from pathlib import Path

import matplotlib.colors
import matplotlib.image
import numpy as np
import pytest
from PIL import Image
from rigs import rig_of
from scipy.spatial.transform import Rotation

from audio_features import Wave
from gesturekit.errors import FormatError, MotionError
from gesturekit.motion import Motion
from gesturekit.viewer import write_picture
from gesturekit.viewer.drawn_body import DrawnBody
from gesturekit.viewer.figure import LEFT, MIDDLE, RIGHT
from gesturekit.viewer.pictures import COLOURS


def a_swing(amplitude: float) -> Motion:
    bones = {"root": (None, (0.0, 0.0, 0.0)), "arm": ("root", (0.0, 1.0, 0.0))}
    skeleton = rig_of(bones, end_sites={"arm": (np.array([0.0, 0.6, 0.0]),)})
    turn = np.zeros((90, 2, 3))
    turn[:, 1, 2] = amplitude * np.sin(np.arange(90) / 5)
    rotations = Rotation.from_rotvec(turn.reshape(-1, 3)).as_quat().reshape(90, 2, 4)
    return Motion(skeleton, rotations, np.zeros((90, 3)), 30.0)


def painted(image: np.ndarray, side: str) -> np.ndarray:
    """Return (H, W) bool: where a picture shows the middle or a side of a body."""
    return np.abs(image - matplotlib.colors.to_rgb(COLOURS[side])).max(axis=2) < 0.02


def widths(path: Path, n: int) -> list[int]:
    """How many pixels wide each of `n` figures in a row is."""
    image = matplotlib.image.imread(path)[:, :, :3]
    found = []
    for part in np.array_split(painted(image, MIDDLE), n, axis=1):
        across = np.flatnonzero(part.any(axis=0))
        found.append(int(across[-1] - across[0]))
    return found


def test_nothing_and_two_bodies_at_once_are_refused(tmp_path):
    with pytest.raises(MotionError, match="motion"):
        write_picture({}, tmp_path / "a.png")
    with pytest.raises(FormatError, match="body model"):
        DrawnBody.of(a_swing(0.5), "human", tmp_path / "SMPL_NEUTRAL.npz")


def test_each_figure_shows_its_own_moment(tmp_path):
    write_picture(a_swing(0.0), tmp_path / "still.png", frames=3)
    write_picture(a_swing(1.2), tmp_path / "moving.png", frames=3)
    assert np.ptp(widths(tmp_path / "still.png", 3)) <= 2
    assert np.ptp(widths(tmp_path / "moving.png", 3)) > 20


def test_a_plot_is_the_picture_of_the_file(tmp_path):
    options = {"frames": 1, "title": "swing", "body": "skeleton"}
    a_swing(1.2).save(tmp_path / "a.png", **options)
    plot = a_swing(1.2).plot(**options)
    np.testing.assert_array_equal(plot, Image.open(tmp_path / "a.png"))


@pytest.mark.parametrize("kind", ["png", "svg", "pdf"])
def test_files_name_us_and_no_time_of_writing(tmp_path, kind):
    write_picture(a_swing(1.0), tmp_path / f"a.{kind.upper()}", frames=1)
    data = (tmp_path / f"a.{kind.upper()}").read_bytes()
    assert b"gesturekit" in data
    assert b"dc:date" not in data and b"CreationDate" not in data


def test_the_picture_with_sound_has_the_speech_on_it(tmp_path):
    samples = np.random.default_rng(0).normal(0, 0.1, 16_000).astype(np.float32)
    write_picture(a_swing(1.0), tmp_path / "without.png", frames=1)
    write_picture(a_swing(1.0), tmp_path / "with.png", audio=Wave(samples, 16_000), frames=1)
    without, with_sound = (
        matplotlib.image.imread(tmp_path / name) for name in ("without.png", "with.png")
    )
    assert with_sound.shape[0] > without.shape[0]


def test_people_are_seen_from_the_front_wherever_they_stand_and_face(tmp_path, gesture):
    motion = gesture(0.2)
    yaw = Rotation.from_euler("y", 2.0)
    rotations = motion.rotations.copy()
    rotations[:, 0] = (yaw * Rotation.from_quat(rotations[:, 0])).as_quat()
    path = yaw.apply(motion.translation) + [3.0, 0.5, -2.0]
    elsewhere = Motion(motion.skeleton, rotations, path, motion.fps)
    images = []
    for each in (motion, elsewhere):
        write_picture(each, tmp_path / "a.png", frames=1)
        images.append(matplotlib.image.imread(tmp_path / "a.png")[:, :, :3])
    assert np.abs(images[0] - images[1]).mean() < 1e-3
    columns = {side: np.nonzero(painted(images[1], side))[1] for side in (LEFT, MIDDLE, RIGHT)}
    left, middle, right = (columns[side].mean() for side in (LEFT, MIDDLE, RIGHT))
    assert right < middle < left, "its left is at our right"
