"""gesturekit study on the command line, and the report that it writes."""

import csv
import html
import json
import re
from pathlib import Path

import pytest

from gesturekit.evaluation import GENEA_COLUMNS, Answer


@pytest.fixture
def run(gesturekit):
    """run(*arguments): exit code, output and errors of gesturekit study."""
    return lambda *arguments: gesturekit("study", *arguments)


def write(path: Path, answers: list[Answer], failed: dict[str, int]) -> Path:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([*GENEA_COLUMNS, "checks", "checks_failed"])
        for a in answers:
            winner = "tie" if not a.score else "model_a" if a.score > 0 else "model_b"
            strong = "" if not a.score else str(abs(a.score) == 2)
            names = (a.user, a.clip, a.left, a.right)
            writer.writerow([*names, winner, strong, "{}", "", 2, failed.get(a.user, 0)])
    return path


def test_a_study_is_analysed_into_words_figures_and_a_page(simulate, tmp_path, run):
    answers = simulate([1.0, 0.0, -1.0], raters=20, answers=12)
    names = {"a": "ours", "b": "base é <script>alert(1)</script>", "c": "third"}
    answers = [Answer(a.user, a.clip, names[a.left], names[a.right], a.score) for a in answers]
    path = write(tmp_path / "all answers.csv", answers, {"r00007": 1})
    report, figures = tmp_path / "report.html", tmp_path / "figures.json"
    code, out, err = run("analyse", path, "--out", report, "--json", figures, "--rounds", 30)
    assert code == 0
    assert {str(report), str(figures)} <= {*err.splitlines()}, "beside what a pipe reads"
    assert all(re.search(rf"\b{fact}\b", out) for fact in ("19 raters", "36", "1 rater"))
    (line,) = (line for line in out.splitlines() if all(name in line for name in names.values()))
    assert line.index("ours") < line.index(names["b"]) < line.index("third"), "the best first"
    assert any("ours" in x and names["b"] in x and ".001" in x for x in out.splitlines())
    page = report.read_text(encoding="utf-8")
    assert "<script" not in page and "&lt;script&gt;" in page
    assert not re.search(r"(src|href)=\"(?!data:)", page) and "data:image/svg+xml" in page
    assert "r00007" in page and "1 of 2" in page
    assert "<td>" in page and '"yes">p &lt; .001<' in page and "p < .001" not in page
    found = json.loads(figures.read_text())
    assert [s["name"] for s in found["preference"]["systems"]] == list(names.values())
    assert len(found["preference"]["pairs"]) == 3
    code, _, err = run("analyse", path, "--out", report)
    assert code == 2 and "report.html" in err
    code, out, _ = run("analyse", path, "--rounds", 30, "--failed-checks", 0)
    assert code == 0 and "20 raters" in out and re.search(r"\b0 raters", out)


def test_ratings_of_sliders_are_analysed_by_the_same_command(tmp_path, run):
    """Two raters agree on a over b, 30 and 10; b and c differ by 20 and -20; one fails a check."""
    lines = ["rater,system,clip,question,value,seconds,checks,checks_failed,comment"]
    for user, values, failed in (
        ("u", (70, 40, 20), 0),
        ("v", (60, 50, 70), 0),
        ("w", (0, 9, 9), 1),
    ):
        for clip in "xy":
            said = '"<b>,""fine"""' if user == "u" else ""
            lines += [f"{user},{s},{clip},natural?,{v},9,2,{failed},{said}"
                      for s, v in zip("abc", values, strict=True)]  # fmt: skip
    path = tmp_path / "ratings.csv"
    path.write_text("\n".join(lines), encoding="utf-8")
    report, figures = tmp_path / "report.html", tmp_path / "figures.json"
    done = run("analyse", path, "--out", report, "--json", figures, "--rounds", 30).ok()
    assert all(fact in done.out for fact in ("12 comparisons", "2 raters", "1 rater excluded"))
    found = json.loads(figures.read_text())
    assert found["comments"] == {"u": '<b>,"fine"'} and list(found["excluded"]) == ["w"]
    means = {s["name"]: (s["merit"]["value"], s["n"]) for s in found["preference"]["systems"]}
    assert means == {"a": (65, 4), "b": (45, 4), "c": (45, 4)}
    pairs = {(p["a"], p["b"]): (p["mean"], p["counts"]) for p in found["preference"]["pairs"]}
    assert pairs["a", "b"] == (20, [0, 4, 0, 0, 0]) and pairs["b", "c"] == (0, [0, 2, 0, 2, 0])
    # Means of c by rater are 20 and 70: 25 is their standard error, and t is 12.706.
    (of_c,) = (s["merit"] for s in found["preference"]["systems"] if s["name"] == "c")
    assert (of_c["low"], of_c["high"]) == pytest.approx((45 - 317.65, 45 + 317.65), abs=0.01)
    page = report.read_text(encoding="utf-8")
    cells = [re.findall(r"<t[hd]>([^<]*)", row) for row in re.findall(r"<tr.*?</tr>", page)]
    assert any(row[:4] == ["b : c", "2", "0", "2"] and row[5] == "+0.00" for row in cells)
    assert any(row[:4] == ["Pair", "Higher", "Equal", "Lower"] for row in cells)
    assert any(row[:3] == ["c", "4", "45.00 "] for row in cells)
    assert "<b>" not in page and '<b>,"fine"' in html.unescape(page)
    assert "Mean rating" in page and "<b>" not in page
    # Two questions are not mixed.
    both = [*lines, *(line.replace("natural", "fitting") for line in lines[1:])]
    path.write_text("\n".join(both), encoding="utf-8")
    run("analyse", path, "--json", figures, "--rounds", 5, "--existing", "replace").ok()
    found = json.loads(figures.read_text())
    assert found["preference"] is None and list(found["by_style"]) == ["fitting?", "natural?"]
    path.write_text("rater,system,clip,value\nu,a,x,1\nu,b,y,2\n")
    run("analyse", path).fails(2, "two systems")
    lines = ["rater,system,clip,value", *(f"u,s{k},x,{k}" for k in range(2500))]
    path.write_text("\n".join(lines))
    run("analyse", path).fails(2, "3123750 comparisons")


def test_rounds_and_the_seed_of_the_intervals_are_chosen(simulate, tmp_path, run):
    path = write(tmp_path / "a.csv", simulate([0.5, 0.0], raters=5, answers=4), {})
    figures, intervals = tmp_path / "figures.json", []
    for options in (("--rounds", 30), ("--rounds", 31), ("--rounds", 30, "--seed", 1)):
        code, _, _ = run("analyse", path, "--json", figures, *options, "--existing", "replace")
        intervals.append(json.dumps(json.loads(figures.read_text())["preference"]))
    assert code == 0 and len(set(intervals)) == 3
    run("analyse", path, "--rounds", 0).fails(2, "rounds")


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("analyse", "x.csv"), "x.csv"),
        (("analyse", "absent.csv"), "absent.csv"),
        (("build", "absent.yaml"), "absent.yaml"),
        (("power", "--win-rate", "0.5"), "0.5"),
        (("power", "--ties", "1"), "ties"),
        (("power", "--power", "1"), "power"),
        (("power", "--clip-share", "0.96"), "0.96"),
    ],
)
def test_nonsense_is_named_with_code_2(tmp_path, run, arguments, named, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "x.csv").write_text("some,thing\n1,2\n")
    assert run(*arguments).fails(2, named).out == ""


def test_the_size_of_a_study_is_printed(run):
    code, out, _ = run("power", "--win-rate", "0.65", "--systems", "3")
    assert code == 0
    lines = [line.replace(",", "").split() for line in out.splitlines()]
    rows = [[int(cell) for cell in line] for line in lines if line and "".join(line).isdigit()]
    assert len(rows) > 2 and "3 systems" in out and "3 pairs" in out
    assert "10 pairs" in run("power", "--systems", 5).out
    few = run("power", "--clips", 4, "--clip-share", 0.17).out
    assert "4 segments" in few and re.search(r"\b3 +-", few), "no number of raters is enough"
    least = int(re.search(r"more than (\d+)", few)[1])
    enough = run("power", "--clips", 2 * least, "--clip-share", 0.17).out
    assert least > 4 and not re.search(r"\b3 +-", enough) and "more than" not in enough
    needed = [row[2] for row in rows]
    assert needed == sorted(needed, reverse=True)
    for a_rater, of_a_pair, raters, in_all in rows:
        assert a_rater == 3 * of_a_pair and in_all == raters * a_rater


def test_a_page_is_built_and_not_overwritten(tmp_path, run):
    for system in ("a", "b"):
        (tmp_path / system).mkdir()
        for k in range(3):
            (tmp_path / system / f"{k}.mp4").write_bytes(b"video")
    (tmp_path / "study.yaml").write_text("title: x\nsystems: {a: a, b: b}\nlists: 2\n")
    code, out, _ = run("build", tmp_path / "study.yaml", "--out", tmp_path / "out")
    facts = ("3 comparisons", "3 segments", "6 clips", "2 lists")
    assert code == 0 and all(fact in out for fact in facts)
    before = (tmp_path / "out" / "index.html").read_bytes()
    code, _, err = run("build", tmp_path / "study.yaml", "--out", tmp_path / "out")
    assert code == 2 and "index.html" in err
    run("build", tmp_path / "study.yaml", "--out", tmp_path / "out", "--existing", "replace")
    assert (tmp_path / "out" / "index.html").read_bytes() == before
