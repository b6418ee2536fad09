"""BVH files that we write are read back as they are: any size, unit and rate, whoever reads."""

from dataclasses import replace

import bvhio
import numpy as np
import pytest

from gesturekit.formats import read_bvh, write_bvh
from gesturekit.formats.conventions import METRES
from gesturekit.motion import Motion

RATES = (23.976, 59.94, 1 / 3, 30.0, 30000 / 1001, 60000 / 1001, 7.1234567, 119.88, 100000.0)


def of_height(motion: Motion, metres: float) -> Motion:
    scaled = motion.scaled(metres / 1.7)
    return replace(scaled, translation=scaled.translation + [0.1 * metres / 1.7, 0, 0])


def same(one: Motion, two: Motion, size: float) -> None:
    order = [two.skeleton.index(name) for name in one.skeleton.names]
    np.testing.assert_allclose(two.positions()[:, order] / size, one.positions() / size, atol=2e-5)


@pytest.mark.parametrize("unit", sorted(METRES))
@pytest.mark.parametrize("height", [0.05, 1.7, 100.0])
def test_a_figure_of_any_size_in_any_unit_is_read_back_at_its_size(gesture, tmp_path, unit, height):
    motion = of_height(gesture(0.3), height)
    write_bvh(motion, tmp_path / "a.bvh", unit=unit)
    again = read_bvh(tmp_path / "a.bvh")
    same(motion, again, height)
    info = again.info
    assert (info["unit"], info["up"], info["forward"], info["guessed"]) == (unit, "y", "z", ())


def test_any_frame_rate_is_read_back_exactly(gesture, tmp_path):
    rates = [*RATES, *np.random.default_rng(0).uniform(0.5, 240, 12).round(3)]
    for fps in rates:
        write_bvh(replace(gesture(0.1), fps=fps), tmp_path / "a.bvh")
        assert read_bvh(tmp_path / "a.bvh").fps == fps


def test_a_file_that_another_program_wrote_anew_is_detected_again(gesture, tmp_path):
    """bvhio keeps names, and writes all numbers in its own form; here in metres instead of cm."""
    write_bvh(gesture(0.3), tmp_path / "a.bvh", unit="m")
    bvhio.writeBvh(str(tmp_path / "b.bvh"), bvhio.readAsBvh(str(tmp_path / "a.bvh")))
    again = read_bvh(tmp_path / "b.bvh")
    assert again.info["unit"] == "m" and again.info["guessed"] == ()
    same(gesture(0.3), again, 1.7)
    write_bvh(of_height(gesture(0.3), 8.7), tmp_path / "a.bvh")
    bvhio.writeBvh(str(tmp_path / "b.bvh"), bvhio.readAsBvh(str(tmp_path / "a.bvh")))
    assert read_bvh(tmp_path / "b.bvh").info["guessed"] == ("unit",)


def test_arguments_override_the_mark(gesture, tmp_path):
    motion = of_height(gesture(0.3), 0.34)
    write_bvh(motion, tmp_path / "a.bvh", unit="cm")
    inches = read_bvh(tmp_path / "a.bvh", unit="inch")
    same(of_height(gesture(0.3), 0.34 * 2.54), inches, 0.34)
    assert read_bvh(tmp_path / "a.bvh", up="z").info["up"] == "z"
    assert read_bvh(tmp_path / "a.bvh", forward="x").info["forward"] == "x"
