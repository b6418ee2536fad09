import io

import gesturekit.progress
from gesturekit.progress import Progress


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


def test_a_log_file_gets_no_carriage_return():
    assert "\r" not in counted(12.0)


def test_short_tasks_print_nothing_to_a_log_file():
    assert counted(0.1) == ""


def test_the_unit_is_pluralised():
    assert " 1 of 1 file, " in counted(16.0, items=1)
    assert counted(16.0, total=None).splitlines()[1].startswith("2 files")
