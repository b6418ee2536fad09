"""Augmented motion obeys physics: speeds, distances, left and right."""

import numpy as np
import pytest

from gesturekit.diffusion import Conditions, DeltaRepresentation
from gesturekit.diffusion.training.batches import source_frames, stretch, stretch_factor
from gesturekit.diffusion.training.loading import mirror_condition
from gesturekit.errors import ConfigError
from gesturekit.motion.root_path import RootPath
from gesturekit.motion.rotations import multiply_quaternions, quaternion_from_rotation_vector
from gesturekit.training.seeds import rng_for


@pytest.fixture
def walk(gesture):
    """Ten seconds along a curve, at a speed that varies about 1 m/s."""
    motion = gesture(10.0)
    time = motion.times
    angle = 0.4 * time + 0.3 * np.sin(time)
    speed = 1.0 + 0.5 * np.sin(1.7 * time)
    places = np.cumsum(np.stack([speed * np.sin(angle), speed * np.cos(angle)], axis=-1) / 30, 0)
    motion.translation[:, [0, 2]] = places
    turn = quaternion_from_rotation_vector(np.outer(angle, [0.0, 1.0, 0.0]))
    motion.rotations[:, 0] = multiply_quaternions(turn, motion.rotations[:, 0])
    return motion


def slower(representation: DeltaRepresentation, values: np.ndarray, factor: float) -> np.ndarray:
    n_frames = int((len(values) - 1) * factor) + 1
    maps = slice(0, representation.height_column)
    steps = representation.root_columns
    return stretch(values, 0.0, n_frames, factor, maps=maps, steps=steps)


@pytest.mark.parametrize("factor", [0.9, 0.97, 1.1])
def test_a_stretched_walk_goes_the_same_way_in_another_time(walk, factor):
    representation = DeltaRepresentation.fit([walk])
    values = representation.encode(walk)
    made = representation.decode(slower(representation, values, factor), 30.0)
    plain = representation.decode(values, 30.0)
    there, here = RootPath.of(made), RootPath.of(plain)
    at = np.arange(made.n_frames) / factor
    for k in (0, 1):
        way = np.interp(at, np.arange(plain.n_frames), here.positions[:, k])
        assert np.abs(there.positions[:, k] - way).max() < 0.01, "of ten metres"
    angle = np.interp(at, np.arange(plain.n_frames), here.headings)
    assert np.abs(there.headings - angle).max() < 1e-3
    far, wanted = (path.speeds.sum() / path.fps for path in (there, here))
    assert far == pytest.approx(wanted, rel=1e-2), "the same distance"
    assert there.speeds.mean() == pytest.approx(here.speeds.mean() / factor, rel=1e-2)


@pytest.mark.parametrize(
    ("factor", "start"), [(0.9, 0.0), (0.9, 0.2), (0.93, 3.7), (1.0, 0.5), (1.1, 0.4)]
)
def test_an_event_of_one_frame_is_never_lost_or_blurred(factor, start):
    """Recordings with the event in each frame in turn, of which the window has 40 or so."""
    end = start + 39 / factor
    for frame in range(int(end) + 2):
        flags = np.zeros((int(end) + 2, 2), np.float32)
        flags[frame] = [1.0, frame % 2]
        made = stretch(flags, start, 40, factor, flags=slice(0, 2))
        (places,) = np.nonzero(made[:, 0])
        # A slower event may be in two frames; one that is skipped moves to the nearest frame.
        assert len(places) <= 1 or (factor > 1 and list(np.diff(places)) == [1])
        assert len(places) or not start <= frame <= end
        assert (np.abs(start + places / factor - frame) <= max(0.5, 0.5 / factor) + 1e-9).all()
        assert set(made.ravel()) <= {0.0, 1.0} and made.dtype == np.float32
        np.testing.assert_array_equal(made[:, 1], made[:, 0] * (frame % 2))


def test_a_share_of_the_windows_is_stretched():
    factors = np.array([stretch_factor(rng_for("test", k), 0.2, 0.1) for k in range(2000)])
    assert np.mean(factors != 1.0) == pytest.approx(0.2, abs=0.03)
    assert factors.min() < 0.91 < 1.09 < factors.max()
    assert 0.9 <= factors.min() <= factors.max() <= 1.1
    assert stretch_factor(rng_for("a"), 1.0, 0.1) == stretch_factor(rng_for("a"), 1.0, 0.1)
    wide = np.array([stretch_factor(rng_for("test", k), 1.0, 0.4) for k in range(500)])
    # Uniform between 0.6 and 1.4: quarters are at 0.8, 1 and 1.2.
    assert np.quantile(wide, [0.25, 0.5, 0.75]) == pytest.approx([0.8, 1.0, 1.2], abs=0.04)


def test_a_window_ends_with_the_last_frame_that_it_needs():
    """40 frames at half speed are 39 / 2 + 1 frames, rounded up."""
    values = np.arange(21.0)[:, None]
    assert (source_frames(40, 2.0), source_frames(40, 0.5), source_frames(40, 1.0)) == (21, 79, 40)
    assert stretch(values, 0.0, 40, 2.0)[:, 0] == pytest.approx(np.arange(40) / 2)
    for start, factor in ((1.0, 2.0), (-0.5, 4.0)):
        with pytest.raises(ValueError, match="21"):
            stretch(values, start, 42, factor)


def test_conditions_are_mirrored_with_the_motion():
    rng = np.random.default_rng(0)
    condition = rng.standard_normal((40, 9))
    names = ("kickLeft", "jump", "kickRight", "PUNCH_R", "PUNCH_L")
    offset = np.array([0.3, -0.1, 2.0])
    layout = Conditions(None, True, names, ("old",), 0.5 * offset, np.full(3, 0.5))
    made = mirror_condition(condition, layout)
    assert made[:, [1, 4, 8]] == pytest.approx(condition[:, [1, 4, 8]])
    raw = condition[:, :3] + offset
    assert made[:, :3] + offset == pytest.approx(raw * [-1, 1, -1])
    assert (made[:, [3, 5, 6, 7]] == condition[:, [5, 3, 7, 6]]).all()
    assert mirror_condition(made, layout) == pytest.approx(condition)
    with pytest.raises(ConfigError, match="(?=.*'kickLeft')(?=.*'kickRight')"):
        mirror_condition(condition, Conditions(events=("kickLeft",)))
