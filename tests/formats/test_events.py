"""Tables of events: what they mean, and how hostile ones are refused."""

from __future__ import annotations

import pytest

from gesturekit.errors import FormatError
from gesturekit.formats.tables.events import Event, load_events


def test_events_come_in_order_of_time_whatever_the_order_of_rows_and_columns(tmp_path):
    file = tmp_path / "a.events.csv"
    file.write_text("name, duration ,time\nkick,,2.5\n\npunch left,0.25,1\n", encoding="utf-8-sig")
    assert load_events(file) == (Event(1.0, "punch left", 0.25), Event(2.5, "kick", 0.0))
    file.write_text("time,name\n0,nod\n")
    assert load_events(file) == (Event(0.0, "nod"),)
    file.write_text("time,name\n")
    assert load_events(file) == ()
    names = ["a" * 80, *(f"e{k}" for k in range(999))]
    file.write_text("time,name\n" + "".join(f"604800,{name}\n" for name in names))
    assert sorted(event.name for event in load_events(file)) == sorted(names)
    blank = b" " * 131_071 + b"\n"
    file.write_bytes((b"time,name\n0,nod\n" + 64 * blank)[: 8 << 20])
    assert load_events(file) == (Event(0.0, "nod"),), "of 8 MB"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (b"", "empty; a table begins with the line time,name"),
        (b"time,nome\n1,a\n", "line 1: column 'nome'; did you mean name?"),
        (b"time,duration\n1,2\n", "line 1: no column name"),
        (b"time,name,time\n1,a,1\n", "line 1: two columns 'time'"),
        (b"time,name\n1,a\nsoon,b\n", "line 3: time is 'soon'"),
        (b"time,name\nnan,a\n", "line 2: time is 'nan'"),
        (b"time,name\n-1,a\n", "line 2: time is '-1'"),
        (b"time,name\n1e300,a\n", "line 2: time is '1e300'"),
        (b"time,name,duration\n1,a,-2\n", "line 2: duration is '-2'"),
        (b"time,name\n1\n", "line 2: 1 values; expected 2 (time,name)"),
        (b"time,name\n1,\n", "line 2: name is ''"),
        (b"time,name\n1," + b"a" * 100 + b"\n", "expected 1 to 80 printable characters"),
        (b'time,name\n1,"a\n', "not a CSV table"),
        (b"time,name\n1,\xff\n", "cannot be read as text"),
        (b"time,name\n" + b"".join(b"1,e%d\n" % i for i in range(1002)), "1000 different names"),
        (b"time,name\n" + b"0,a\n" * (1 << 21) + b"0,a\n", "over 8 MB"),
    ],
)
def test_an_invalid_table_of_events_is_one_clear_error(tmp_path, text, says):
    file = tmp_path / "bad.csv"
    file.write_bytes(text)
    with pytest.raises(FormatError) as caught:
        load_events(file)
    assert says in str(caught.value) and str(file) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_there(tmp_path):
    for path, says in ((tmp_path / "none.csv", "no such file"), (tmp_path, "not a regular file")):
        with pytest.raises(FormatError, match=says):
            load_events(path)
