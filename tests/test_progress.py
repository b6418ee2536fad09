"""The output that a user reads while a command works: bars, durations, counts and lists."""

import io
import re
import time

from gesturekit.progress import Progress, time_in_words
from gesturekit.wording import counted, did_you_mean, drawn, listed, printable, roughly


def test_short_tasks_print_nothing_to_a_log_file():
    file = io.StringIO()
    assert list(Progress([1, 2, 3], file=file, unit="file")) == [1, 2, 3]
    assert file.getvalue() == ""


def test_a_terminal_gets_a_bar_that_disappears():
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    file = Terminal()
    for _ in Progress([1, 2, 3], file=file, desc="Rendering", mininterval=0):
        time.sleep(0.002)  # a bar appears after a millisecond
    written = file.getvalue()
    assert "Rendering" in written and "\n" not in written
    assert written.rpartition("\r")[0].rpartition("\r")[2].strip() == ""


def test_durations_in_words():
    words = {0.44: "0.4 s", 9.96: "10 s", 60: "1 min 0 s", 3599: "59 min 59 s", 7384: "2 h 3 min"}
    assert {seconds: time_in_words(seconds) for seconds in words} == words
    rounded = {0.2: "1 s", 40: "40 s", 89: "89 s", 90: "2 min", 5399: "90 min", 5400: "1.5 h"}
    assert {seconds: roughly(seconds) for seconds in rounded} == rounded


def test_counts_and_lists_in_words():
    assert [counted(n, "mesh", "meshes") for n in (0, 1, 2)] == ["0 meshes", "1 mesh", "2 meshes"]
    assert counted(2, "file") == "2 files"
    assert re.fullmatch("a, b, c, .*1.*", listed(list("abcdefg"))), "and how many more"
    assert printable("a\x1bb\udcffc é") == "a?b?c é"
    assert "speed" in did_you_mean("sped", ["speed", "size"])
    assert did_you_mean("xyz", ["speed", "size"]) == ""
    assert "39%" in drawn(0.5), "1 - exp(-1/2)"
