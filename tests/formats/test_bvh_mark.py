"""BVH files that we write are read back as they are: any size, unit and rate, whoever reads."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import bvhio
import numpy as np
import pytest

from gesturekit.formats import METRES, read_bvh, write_bvh
from gesturekit.motion import Motion

RATES = (23.976, 59.94, 1 / 3, 30.0, 30000 / 1001, 60000 / 1001, 7.1234567, 119.88, 100000.0)


def of_height(motion: Motion, metres: float) -> Motion:
    scaled = motion.scaled(metres / 1.7)
    return replace(scaled, translation=scaled.translation + [0.1 * metres / 1.7, 0, 0])


def same(one: Motion, two: Motion, size: float) -> None:
    order = [two.skeleton.index(name) for name in one.skeleton.names]
    np.testing.assert_allclose(two.positions()[:, order] / size, one.positions() / size, atol=2e-5)


@pytest.mark.parametrize("unit", sorted(METRES))
@pytest.mark.parametrize("height", [0.05, 0.34, 1.7, 8.7, 100.0])
def test_a_figure_of_any_size_in_any_unit_is_read_back_at_its_size(gesture, tmp_path, unit, height):
    motion = of_height(gesture(0.3), height)
    write_bvh(motion, tmp_path / "a.bvh", unit=unit)
    again = read_bvh(tmp_path / "a.bvh")
    same(motion, again, height)
    info = again.info
    assert (info["unit"], info["up"], info["forward"], info["guessed"]) == (unit, "y", "z", ())


def test_any_frame_rate_is_read_back_exactly(gesture, tmp_path):
    rates = [*RATES, *np.random.default_rng(0).uniform(0.5, 240, 40).round(3)]
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


def blender_places(path: Path) -> tuple[dict[str, list[float]], float, int]:
    """OFFSETs, Frame Time and rows as io_anim_bvh takes them: words of lines that have any."""
    lines = [words for words in map(str.split, path.read_text().splitlines()) if words]
    assert lines[0] == ["HIERARCHY"]
    places, at = {}, 1
    while lines[at] != ["MOTION"]:
        if lines[at][0].lower() in ("root", "joint"):
            offset, channels = lines[at + 2], lines[at + 3]
            assert offset[0] == "OFFSET" and channels[0] == "CHANNELS"
            assert len(offset) == 4 and len(channels) == 2 + int(channels[1])
            places[" ".join(lines[at][1:])] = [float(word) for word in offset[1:]]
        at += 1
    return places, float(lines[at + 2][2]), len(lines) - at - 3


@pytest.mark.parametrize("unit", sorted(METRES))
def test_other_readers_see_an_offset_of_zero_and_the_frame_time(gesture, tmp_path, unit):
    motion = replace(gesture(0.3), fps=23.976)
    write_bvh(motion, tmp_path / "a.bvh", unit=unit)
    bvh = bvhio.readAsBvh(str(tmp_path / "a.bvh"))
    assert tuple(bvh.Root.Offset) == (0, 0, 0) and bvh.FrameTime == 1 / 23.976
    places, frame_time, n_rows = blender_places(tmp_path / "a.bvh")
    assert places["Hips"] == [0, 0, 0] and frame_time == 1 / 23.976 and n_rows == motion.n_frames
    assert list(places) == [joint.Name for joint, _, _ in bvh.Root.layout()]
