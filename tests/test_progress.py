import io
import time

import gesturekit.progress
from gesturekit.progress import Progress, time_in_words
from gesturekit.wording import counted as counted_of
from gesturekit.wording import did_you_mean, drawn, listed, printable, roughly


def counted(seconds_per_item, items=5, **options):
    """Return the log file after some items, with a simulated clock."""
    now = [0.0]
    file = io.StringIO()
    bar = Progress(iter(range(items)), file=file, unit="file", **{"total": items} | options)
    bar._time = lambda: now[0]
    bar.start_t = bar.last_print_t = 0.0
    bar._next_line = gesturekit.progress.SECONDS_BETWEEN_LINES
    bar.mininterval = 0.0
    for _ in bar:
        now[0] += seconds_per_item
    return file.getvalue()


def test_a_log_file_gets_whole_lines_with_count_and_time_left():
    lines = counted(16.0, desc="Rendering", smoothing=0).splitlines()
    assert len(lines) in (4, 5)
    assert lines[0] == "Rendering:  20%, 1 of 5 files, 00:16 passed, 01:04 left"
    # At least 10 s from line to line: every second item of 6 s.
    lines = counted(6.0, items=8).splitlines()
    assert [line.split(", ")[1] for line in lines] == [
        "2 of 8 files",
        "4 of 8 files",
        "6 of 8 files",
        "8 of 8 files",
    ]
    assert len(counted(10.0, items=3).splitlines()) == 3


def test_a_log_file_gets_no_carriage_return():
    assert "\r" not in counted(12.0)


def test_short_tasks_print_nothing_to_a_log_file():
    assert counted(0.1) == ""


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
    words = {
        0.44: "0.4 s",
        9.94: "9.9 s",
        9.96: "10 s",
        59.4: "59 s",
        60: "1 min 0 s",
        65: "1 min 5 s",
        3599: "59 min 59 s",
        3600: "1 h 0 min",
        7384: "2 h 3 min",
    }
    assert {seconds: time_in_words(seconds) for seconds in words} == words
    rounded = {0.2: "1 s", 40: "40 s", 89: "89 s", 90: "2 min", 5399: "90 min", 5400: "1.5 h"}
    assert {seconds: roughly(seconds) for seconds in rounded} == rounded


def test_counts_and_lists_in_words():
    assert counted_of(1, "file") == "1 file"
    assert counted_of(0, "file") == "0 files" and counted_of(2, "mesh", "meshes") == "2 meshes"
    assert listed(list("abcdef")) == "a, b, c, d, e, f"
    assert listed(list("abcdefg")) == "a, b, c, d, e, f and 1 more"
    assert listed(list("abc"), 2) == "a, b and 1 more"
    assert printable("a\x1bb\udcffc é") == "a?b?c é"
    assert did_you_mean("sped", ["speed", "size"]) == "did you mean speed?"
    assert did_you_mean("xyz", ["speed", "size"]) == ""
    # 1 - exp(-1/2) and 1 - exp(-12).
    assert (drawn(0.5), drawn(12.0)) == (
        "0.5 times (39% at least once)",
        "12 times (100% at least once)",
    )


def test_the_unit_is_pluralised():
    assert " 1 of 1 file, " in counted(16.0, items=1)
    assert counted(16.0, total=None).splitlines()[1].startswith("2 files")
