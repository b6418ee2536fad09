"""BEAT's tables of gestures."""

import pytest

from gesturekit.errors import FormatError
from gesturekit.formats.tables import load_semantics


def test_intervals_come_in_the_order_of_the_file(tmp_path):
    file = tmp_path / "a.txt"
    rows = (b"deictic_l\t2.5\t3\t0.5\t0.7\tthere\r\n", b"\n", b"01_beat\t0\t86400\t1\t1\t\xe9\n",
            b"nogesture\t1\t1\t0\t0\n")  # fmt: skip
    file.write_bytes(b"".join(rows))
    assert load_semantics(file) == [(2.5, 3.0, 0.7), (0.0, 86_400.0, 1.0), (1.0, 1.0, 0.0)]


@pytest.mark.parametrize(
    ("row", "says"),
    [
        (b"a\t0\t1\t1\n", "line 2.*'a 0 1 1'"),
        (b"a\t0\tone\t1\t1\n", "line 2.*'a 0 one 1 1'"),
        (b"a\t-0.1\t1\t1\t1\n", "line 2"),
        (b"a\t2\t1\t1\t1\n", "line 2"),
        (b"a\t0\t86400.1\t1\t1\n", "line 2"),
        (b"a\t0\t1\t1\t-0.1\n", "line 2"),
        (b"a\t0\t1\t1\t1.1\n", "line 2"),
        (b"a\tnan\t1\t1\t1\n", "line 2"),
    ],
)
def test_invalid_rows_are_named(tmp_path, row, says):
    file = tmp_path / "a.txt"
    file.write_bytes(b"a\t0\t1\t1\t1\n" + row)
    with pytest.raises(FormatError, match=f"{file}.*{says}"):
        load_semantics(file)


@pytest.mark.parametrize(("more", "says"), [(0, ""), (1, "32 MiB")])
def test_a_table_has_32_megabytes_at_most(tmp_path, more, says):
    """A sparse file of zeros."""
    file = tmp_path / "a.txt"
    with file.open("wb") as out:
        out.truncate((32 << 20) + more)
    with pytest.raises(FormatError, match=f"{file}.*{says}"):
        load_semantics(file)
    with pytest.raises(FormatError, match=str(tmp_path)):
        load_semantics(tmp_path)
