"""CSV files of the app Live Link Face: times of rows, what is missing, what is refused."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import gesturekit as gk
from gesturekit.errors import FormatError
from gesturekit.formats import read_live_link
from gesturekit.motion.face import ARKIT, smplx_face

HEAD = "Timecode,BlendShapeCount,JawOpen,EyeBlinkLeft,HeadYaw"


def table(path: Path, *rows: str, head: str = HEAD) -> Path:
    path.write_text("\n".join([head, *rows, ""]))
    return path


def second(number: int, rate: int, value: float) -> list[str]:
    """Rows of one second: jaw open by a value that grows by 1 a second, and still lids."""
    return [f"10:59:{number:02d}:{k:02d}.000,61,{value + k / rate},0.5,-0.3" for k in range(rate)]


@pytest.mark.parametrize("rate", [24, 25, 30, 50, 60])
def test_rows_are_put_on_frames_by_their_timecodes(tmp_path, rate):
    path = table(tmp_path / "a.csv", *second(58, rate, 0), "10:59:59:00.000,61,1,0.5,0")
    face = read_live_link(path, 10, 10)
    assert face.names == ("jawOpen", "eyeBlinkLeft")  # the head's angles are left out
    np.testing.assert_allclose(face.values[:, 0], np.arange(10) / 10, atol=1e-9)
    np.testing.assert_allclose(face.values[:, 1], 0.5)


def test_lost_rows_midnight_parts_of_frames_and_any_columns(tmp_path):
    """Between the rows lie 1.5 frames, half a second, and 59 frames; one has no face."""
    rows = ["0,x,23:59:59:30.000", "0.5,x,23:59:59:31.500", ",x,23:59:59:40.000"]
    rows += ["1,x,0:0:0;00", "0,x,0:0:0;59"]
    path = table(tmp_path / "a.csv", *rows, head="jawopen,Mine, Timecode")
    face = read_live_link(path, 40, 60)
    expected = np.interp(np.arange(60) / 40, [0, 0.025, 0.5, 0.5 + 59 / 60], [0, 0.5, 1, 0])
    np.testing.assert_allclose(face.values[:, 0], expected, atol=1e-9)


def test_a_face_of_another_length_is_held_or_cut(tmp_path):
    path = table(tmp_path / "a.csv", *second(1, 30, 0), *second(2, 30, 1))
    with pytest.warns(UserWarning, match=r"a\.csv.* 2\.00 s.* 3\.00 s: its last values are held"):
        face = read_live_link(path, 30, 90)
    assert face.values[59:, 0].tolist() == [1] * 31
    with pytest.warns(UserWarning, match=r"1\.00 s: the rest is left out"):
        assert len(read_live_link(path, 30, 30)) == 30


HOSTILE = {
    "empty": ("", "Timecode"),
    "no timecode": ("Time,JawOpen\n1,2\n", "Timecode"),
    "no channel": ("Timecode,HeadYaw\n00:00:00:00,1\n", "EyeBlinkLeft"),
    "no rows": (HEAD + "\n", "no row"),
    "not finite": (HEAD + "\n00:00:00:00,61,nan,0,0\n", "line 2: .*2 finite numbers"),
    "huge": (HEAD + "\n00:00:00:00,61,0,1e308,0\n", "line 2: .*finite"),
    "no number": (HEAD + "\n00:00:00:00,61,0,0,0\n00:00:00:01,61,0,x,0\n", "line 3: .*finite"),
    "short": (HEAD + "\n00:00:00:00,61,0\n", "line 2: .*finite"),
    "time": (HEAD + "\n0.25,61,0,0,0\n", "line 2: Timecode is '0.25'"),
    "frames": (HEAD + "\n00:00:00:120,61,0,0,0\n", "line 2: Timecode is '00:00:00:120'"),
    "backwards": (HEAD + "\n00:00:09:00,61,0,0,0\n00:00:08:00,61,0,0,0\n", "row 2 is before"),
    "bytes": (b"\xff\xfe\x00", "not a CSV table"),
    "one long cell": (HEAD + "\n" + "9" * 200_000, "not a CSV table"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_other_tables_are_refused_in_one_line(tmp_path, case):
    content, says = HOSTILE[case]
    path = tmp_path / "a.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(FormatError, match=says) as error:
        read_live_link(path, 30, 30)
    assert str(error.value).startswith(str(path)) and len(str(error.value)) < len(str(path)) + 100


@pytest.mark.parametrize("fps", [12.0, 25.0, 30000 / 1001, 60.0, 100.0])
def test_what_is_written_has_the_columns_of_the_app_and_is_read_again(gesture, tmp_path, fps):
    motion = gesture(1.2, fps)
    values = np.random.default_rng(0).uniform(0, 1, (motion.n_frames, 53))
    motion = replace(motion, face=gk.FaceTrack((*ARKIT, "mine"), values))
    with pytest.warns(UserWarning, match="mine"):
        motion.save(tmp_path / "a.csv")
    with pytest.warns(UserWarning, match="(?=.*b.csv).*rules"):
        rules = gk.FaceTrack(("jawOpen",), values[:, :1], "rules")
        replace(motion, face=rules).save(tmp_path / "b.csv")
    head, first, second, *_ = (tmp_path / "a.csv").read_text().splitlines()
    names = head.split(",")
    assert names[:3] == ["Timecode", "BlendshapeCount", "EyeBlinkLeft"] and len(names) == 63
    assert names[16:21] == ["JawForward", "JawRight", "JawLeft", "JawOpen", "MouthClose"]
    assert names[53:56] == ["TongueOut", "HeadYaw", "HeadPitch"]
    assert first.startswith("00:00:00:00.000,61,") and first.endswith(",0.000000" * 9)
    assert second.startswith(f"00:00:00:{60 / fps:06.3f},61,")
    face = read_live_link(tmp_path / "a.csv", fps, motion.n_frames)
    for name in ARKIT:
        np.testing.assert_allclose(face.channel(name), motion.face.channel(name), atol=2e-3)


def test_a_motion_without_arkits_channels_has_no_csv(gesture, tmp_path):
    motion = gesture(0.5)
    for other in (motion, replace(motion, face=smplx_face(np.ones((15, 10))))):
        with pytest.raises(FormatError, match=re.escape(str(tmp_path / "a.csv"))):
            other.save(tmp_path / "a.csv")
    assert not list(tmp_path.iterdir())
