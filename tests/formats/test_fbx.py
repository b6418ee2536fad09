"""FBX files, with a script in the place of Blender."""

import os
import shutil
import warnings
from pathlib import Path

import pytest
from gltf_files import GltfFile, arm

from gesturekit.errors import FormatError
from gesturekit.motion import Motion

pytestmark = pytest.mark.skipif(os.name == "nt", reason="scripts of a shell")
# Copies the .glb file that it takes for the other, says a rate, and keeps its arguments.
COPIES = """#!/bin/sh
echo "$@" > {log}
while [ "$1" != -- ]; do shift; done
cp "$2" "$3"
case "$3" in *.glb) printf 25.0 > "${{3%.glb}}.txt";; esac
"""


@pytest.fixture
def blender(tmp_path, monkeypatch):
    """Return a function that makes a text the program."""
    program = tmp_path / "bin" / "blender"
    program.parent.mkdir()
    monkeypatch.delenv("GESTUREKIT_BLENDER", raising=False)
    monkeypatch.setenv("PATH", f"{program.parent}:/bin:/usr/bin")

    def become(text: str) -> Path:
        program.write_text(text)
        program.chmod(0o755)
        return program

    return become


def test_a_motion_passes_blender_at_30_frames_a_second_and_keeps_its_own_rate(
    tmp_path, blender, gesture
):
    """Its script counts frames; the rate is passed beside the file."""
    blender(COPIES.format(log=tmp_path / "log"))
    motion = gesture(0.4).resample(25.0)
    motion.save(tmp_path / "a.fbx")
    said = (tmp_path / "log").read_text().split()
    assert {"--background", "25.0"} <= set(said)
    assert any(one.endswith(".py") and Path(one).is_file() for one in said)
    shutil.copy(tmp_path / "a.fbx", tmp_path / "b.glb")
    copied = Motion.load(tmp_path / "b.glb")
    assert (copied.fps, copied.n_frames) == (30, motion.n_frames)
    again = Motion.load(tmp_path / "a.fbx")
    assert (again.fps, again.n_frames) == (25, motion.n_frames)
    assert again.info["source"] == str(tmp_path / "a.fbx")
    assert Motion.load(tmp_path / "a.fbx", fps=50).n_frames == 2 * motion.n_frames


def test_warnings_and_errors_name_the_users_file(tmp_path, blender):
    blender(COPIES.format(log=tmp_path / "log"))
    path = GltfFile([{}], [[0]]).save(tmp_path / "a.fbx")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(UserWarning, match=str(path)):
            Motion.load(path)
    path.write_bytes(b"x")
    with pytest.raises(FormatError, match=f"{path}.*glTF"):
        Motion.load(path)
    arm().save(path)
    with pytest.raises(FormatError, match=f"{path}.*'miles'"):
        Motion.load(path, unit="miles")
    with pytest.raises(FormatError, match=f"{path}.*'x'"):
        Motion.load(path, animation="x")


def test_what_blender_says_is_in_the_error(tmp_path, blender):
    (tmp_path / "a.fbx").write_bytes(b"x")
    blender("#!/bin/sh\necho reading >&2\necho no such version: 6100 >&2\nexit 1\n")
    with pytest.raises(FormatError, match=r"a\.fbx.*no such version: 6100"):
        Motion.load(tmp_path / "a.fbx")
