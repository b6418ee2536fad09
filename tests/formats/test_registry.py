"""The registry of motion formats keeps what it promises, entry by entry."""

from dataclasses import replace
from inspect import signature

import numpy as np
import pytest

from gesturekit.errors import FormatError
from gesturekit.formats.fbx import blender_command
from gesturekit.formats.registry import FORMATS, Format, load_function
from gesturekit.motion import Motion
from gesturekit.motion.face import FaceTrack
from gesturekit.motion.rotations import rotation_angles

OF_ANOTHER_RIG = ".vrma"
BOTH = [
    entry for entry in FORMATS if entry.reader and entry.writer and entry.suffix != OF_ANOTHER_RIG
]
WRITTEN_ALONE = [entry for entry in FORMATS if entry.writer and not entry.reader]


def named(entries: list[Format]) -> list[pytest.param]:
    return [pytest.param(entry, id=entry.suffix) for entry in entries]


@pytest.mark.parametrize("entry", named(BOTH))
def test_what_is_written_is_read_again(entry, gesture, tmp_path):
    if entry.suffix == ".fbx":
        try:
            blender_command(tmp_path)
        except FormatError:
            pytest.skip("Blender not found")
    motion = gesture(1.0)
    face = FaceTrack(("jawOpen", "mine"), [[k / 30, 0.25] for k in range(30)], "rules")
    replace(motion, face=face).save(tmp_path / f"a{entry.suffix}")
    again = Motion.load(tmp_path / f"a{entry.suffix}")
    if entry.suffix == ".bvh":
        assert again.face is None
    else:
        assert again.face.names == face.names
        assert again.face.origin == ("recorded" if entry.suffix == ".fbx" else "rules")
        np.testing.assert_allclose(again.face.values, face.values, atol=1e-6)
    assert (again.fps, again.skeleton.names) == (motion.fps, motion.skeleton.names)
    assert rotation_angles(again.rotations, motion.rotations).max() < 1e-4
    np.testing.assert_allclose(again.positions(), motion.positions(), atol=1e-4)


@pytest.mark.parametrize("entry", named(WRITTEN_ALONE))
def test_what_is_only_written_is_refused_by_name_when_read(entry, tmp_path):
    (tmp_path / f"a{entry.suffix}").write_bytes(b"x")
    with pytest.raises(FormatError, match=f"{entry.suffix}.* .bvh"):
        Motion.load(tmp_path / f"a{entry.suffix}")


@pytest.mark.parametrize("entry", named(list(FORMATS)))
def test_options_that_commands_offer_are_those_of_reader_and_writer(entry):
    for place, offered in ((entry.reader, entry.reads), (entry.writer, entry.writes)):
        if place is not None:
            assert offered <= signature(load_function(place)).parameters.keys()
