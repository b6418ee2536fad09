"""Tables of events: what they mean, and how hostile ones are refused."""

import pytest

from gesturekit.errors import FormatError
from gesturekit.formats.tables import Event, load_events


def test_events_come_in_order_of_time_whatever_the_order_of_rows_and_columns(tmp_path):
    file = tmp_path / "a.events.csv"
    file.write_text("name, duration ,time\nkick,,2.5\n\npunch left,0.25,1\n", encoding="utf-8-sig")
    assert load_events(file) == (Event(1.0, "punch left", 0.25), Event(2.5, "kick", 0.0))
    file.write_text("time,name\n0,nod\n")
    assert load_events(file) == (Event(0.0, "nod"),)
    file.write_text("time,name\n")
    assert load_events(file) == ()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (b"", "time,name"),
        (b"time,nome\n1,a\n", "line 1.*'nome'"),
        (b"time,name\n1,a\nsoon,b\n", "line 3.*'soon'"),
        (b"time,name\nnan,a\n", "line 2.*'nan'"),
        (b"time,name,duration\n1,a,-2\n", "line 2.*'-2'"),
        (b"time,name\n1,\n", "line 2.*name"),
        (b"time,name\n1,a\x07\n", "line 2.*name"),
        (b"time,name\n1," + b"a" * 1000 + b"\n", "line 2.*name"),
        (b'time,name\n1,"a\n', "line 2"),
        (b"time,name\n" + b"0,a\n" * (1 << 23) + b"0,a\n", "32 MiB"),
    ],
)
def test_an_invalid_table_of_events_is_one_clear_error(tmp_path, text, says):
    file = tmp_path / "bad.csv"
    file.write_bytes(text)
    with pytest.raises(FormatError, match=f"{file}.*{says}") as caught:
        load_events(file)
    assert "\n" not in str(caught.value)
