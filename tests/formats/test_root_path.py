"""Paths from files: tables that people write, tables that are broken, and motions."""

from pathlib import Path

import numpy as np
import pytest

from gesturekit.errors import FormatError, ModelError
from gesturekit.formats.tables import as_root_path, load_root_path
from gesturekit.motion.root_path import RootPath


def table(folder: Path, text: str | bytes) -> Path:
    path = folder / "path.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_a_table_with_headings(tmp_path):
    rows = "\n".join(f"{k / 30:.4f},{0.1 * k},{-0.2 * k},{170 + k}" for k in range(31))
    path = load_root_path(table(tmp_path, f"time,x,z,heading\n{rows}\n"))
    assert path.fps == 30.0, "rounded times"
    assert path.positions[-1] == pytest.approx([3.0, -6.0])
    assert np.degrees(path.headings) == pytest.approx(np.arange(170.0, 201.0), abs=1e-3)


def test_headings_are_unwrapped_from_180_to_minus_180(tmp_path):
    text = "time,x,z,heading\n0,0,0,170\n0.5,0,0,-170\n1,0,0,-150\n"
    path = load_root_path(table(tmp_path, text)).resample(30.0)
    assert np.degrees(np.ptp(path.headings)) == pytest.approx(40.0, abs=1e-6)


@pytest.mark.parametrize("separator", [b",", b";", b"\t"])
def test_columns_stand_in_any_order_and_a_path_looks_where_it_goes(tmp_path, separator):
    text = b"\xef\xbb\xbfZ, x ,Time\r\n0,0,0\r\n\r\n0,1,1\r\n0,2,2\r\n"
    path = load_root_path(table(tmp_path, text.replace(b",", separator)))
    assert path.fps == pytest.approx(1.0)
    assert path.positions == pytest.approx(np.array([[0, 0], [1, 0], [2, 0]]))
    assert path.headings == pytest.approx(np.pi / 2)


def test_a_few_rows_at_uneven_times_are_laid_out_by_true_time(tmp_path):
    text = "time,x,z\n0,0,0\n4,0,4\n5,0,4\n5.5,1,4\n"
    path = load_root_path(table(tmp_path, text))
    made = path.resample(30.0)
    at = np.arange(made.n_frames) / 30
    assert made.positions[:, 1] == pytest.approx(np.interp(at, [0, 4], [0, 4]), abs=1e-9)
    assert made.positions[-1, 0] == pytest.approx(1.0)


def test_a_motion_file_is_a_path_too(tmp_path, gesture):
    motion = gesture(2.0)
    motion.translation[:, 2] = 1.3 * motion.times
    for name in ("walk.bvh", "walk.npz"):
        motion.save(tmp_path / name)
        path = load_root_path(tmp_path / name)
        own = RootPath.of(motion)
        assert path.fps == pytest.approx(30.0)
        assert np.abs(path.positions - own.positions).max() < 1e-5
        assert np.abs(path.headings - own.headings).max() < 1e-5


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "time,x,z"),
        ("0,1,1\n1,2,2\n", "line 1(?=.*'0').*time,x,z"),
        ("time,x\n0,1\n1,2\n", r"line 1.*\bz\b"),
        ("time,x,z,headng\n0,1,1,0\n1,2,2,0\n", "(?=.*headng).*heading"),
        ("time,x,z\n0,1,1\n1,nan,2\n", "line 3.*'nan'"),
        ("time,x,z\n0,1,1\n1,2\n", r"line 3(?=.*\b2\b).*\b3\b"),
        ("time,x,z\n0,1,1\n1,2,2\n1,3,3\n", "line 4.*time"),
        ("time,x,z\n0,1,1\n2,2,2\n\n1,3,3\n", r"line 5.*\b2\b"),
        ("time,x,z\n0,1,1\n0.001,2,2\n1.9e5,3,3\n", "190000 s"),
        (b"time,x,z\n\xff\xfe,1,1\n", "utf"),
    ],
)
def test_a_broken_table_is_a_one_line_error_with_its_place(tmp_path, text, said):
    with pytest.raises(FormatError, match=f"path.csv.*{said}") as caught:
        load_root_path(table(tmp_path, text))
    assert "\n" not in str(caught.value)


def test_files_that_are_no_paths(tmp_path):
    with pytest.raises(FormatError, match="nowhere.csv"):
        load_root_path(tmp_path / "nowhere.csv")
    (tmp_path / "path.txt").write_text("time,x,z\n")
    with pytest.raises(FormatError, match=r"\.txt.*(?=.*\.csv).*time,x,z"):
        load_root_path(tmp_path / "path.txt")


def test_paths_are_given_in_any_form(tmp_path, gesture):
    motion = gesture(1.0)
    own = RootPath.of(motion)
    motion.save(tmp_path / "walk.npz")
    assert as_root_path(own) is own
    for given in (motion, tmp_path / "walk.npz", str(tmp_path / "walk.npz")):
        assert as_root_path(given).positions == pytest.approx(own.positions)
    with pytest.raises(ModelError, match="(?=.*int).*RootPath"):
        as_root_path(3)
