"""The summary page of a folder of results, from records and files made by hand."""

import html
import re

import pytest
from outputs import status

from gesturekit.jobs.records import STATE, write_record
from gesturekit.jobs.result import Result, Task
from gesturekit.rendering import summary


@pytest.fixture
def page(tmp_path):
    """page(results, status): the page of these results."""
    out = tmp_path / "out<1>"
    (out / STATE).mkdir(parents=True)

    def write(results: list[Result], **state: object) -> str:
        for result in results:
            write_record(out / STATE, result)
        summary.write_summary(out, status(**state), tmp_path / "page.html")
        return (tmp_path / "page.html").read_text(encoding="utf-8")

    write.out = out
    return write


def done(name: str, sound: float, seconds: float = 0.0, *files: str) -> Result:
    made = {file: {"sha256": "", "size": 1, "mtime_ns": 0} for file in files}
    return Result(Task(name), "done", sound=sound, seconds=seconds, made=made)


def test_failures_are_listed_by_reason_and_one_by_one(page):
    errors = {name: f"no <sound> in {name}" for name in ("a<b>", "ç")}
    errors |= dict.fromkeys(map(str, range(9999)), "other")
    failed = [Result(Task(name), error=error, failures=3) for name, error in errors.items()]
    made = [done(name, 3.0) for name in ("ok", "ok", "ok2")]
    text = page([Result(Task("a<b>"), "failed", sound=3.0), *made], failed=failed)
    assert "<sound>" not in text and "a<b>" not in text  # names are no markup
    words = " ".join(html.unescape(re.sub("<[^>]*>", " ", text)).split())
    assert all(fact in words for fact in ("no <sound> in a<b>", "no <sound> in ç"))
    assert re.search(r"\b9999\b", words), "of one reason"
    left_out = 9999 - (words.count("other") - 1)
    assert left_out > 0 and re.search(rf"\b{left_out}\b", words)
    counts = map(int, re.findall(r"<title>(\d+)</title>", text))
    assert sum(counts) == 2, "one failed later, one was done twice"
    assert "other" not in page([])


def test_it_says_which_faces_were_made_by_rules(page):
    results = [done(name, 3.0, 1.0, f"{name}.npz") for name in "abcd"]
    settings = ({}, {"face": "phones"}, {"face": "phones", "transcript": "hi"}, {"face": "<b>"})
    for result, made_with in zip(results, settings, strict=True):
        result.made[f"{result.id}.npz"]["made_with"] = made_with
    text = page(results)
    assert "Faces by rules, not recorded: 1 item from &lt;b&gt;" in text
    assert "1 item from phones, 1 item from phones, with a transcript given" in text
