"""The summary page of a folder of results, from journals and files made by hand."""

import html
import re

import pytest
from outputs import status

from gesturekit.jobs import STATE, FailedItem, Journal, Result, Task
from gesturekit.rendering import summary


@pytest.fixture
def page(tmp_path):
    """page(results, status): the page of these results."""
    out = tmp_path / "out<1>"
    (out / STATE).mkdir(parents=True)

    def write(results: list[Result], **state: object) -> str:
        journal = Journal(out / STATE, 1, 1, run="r", settings={}, about={})
        for result in results:
            journal.finish(result)
        journal.close()
        summary.write_summary(out, status(**state), tmp_path / "page.html")
        return (tmp_path / "page.html").read_text(encoding="utf-8")

    write.out = out
    return write


def done(name: str, sound: float, seconds: float = 0.0, *files: str) -> Result:
    digests = {file: {"sha256": "", "size": 1, "mtime_ns": 0} for file in files}
    return Result(Task(name), "done", sound=sound, seconds=seconds, digests=digests)


def bars(text: str) -> dict[int, tuple[float, int]]:
    """Return {left edge: (height, count)} of the bars of a histogram that are seen."""
    found = re.findall(
        r'<rect x="(\d+)" y="([\d.]+)" [^>]*?height="([\d.]+)"[^>]*><title>(\d+)</title>', text
    )
    assert len(found) % 24 == 0 and all(float(y) + float(h) == 100 for _, y, h, _ in found)
    return {int(x): (float(h), int(count)) for x, _, h, count in found if int(count)}


def test_failures_are_listed_by_reason_and_one_by_one(page):
    failed = [FailedItem("a<b>", "no <sound> in a<b>", 3), FailedItem("ç", "no <sound> in ç", 2)]
    failed += [FailedItem(f"{k}", "other", 1) for k in range(999)]
    text = page([done(name, 3.0) for name in ("a<b>", "ok", "ok", "ok2")], failed=failed)
    assert "<sound>" not in text and "a<b>" not in text  # names are no markup
    rows = {}
    for row in re.findall("<tr>(.*?)</tr>", text, re.DOTALL):
        cells = re.findall("<td.*?>(.*?)</td>", row, re.DOTALL)
        rows |= {html.unescape(cells[0]): html.unescape(cells[-1])} if cells else {}
    assert rows["999"] == "other"
    assert "no <sound>" in rows["a<b>"] and "3x" in rows["a<b>"] and "2x" in rows["ç"]
    assert "997" in rows and "998" not in rows and "1 more" in text
    assert "10 % below 3" in text and sum(n for _, n in bars(text).values()) == 2, (
        "one failed later, one was done twice"
    )
    assert "more: gesturekit" not in page([], failed=failed[:1000])
    assert "Failures" not in page([])
