"""What a study's report says: its sentences, tables and figures, word by word."""

import json
import re
from pathlib import Path

import pytest

from gesturekit.evaluation import Answer, Answers
from gesturekit.study import analyse_study, write_study_report
from gesturekit.study.analysis.report import write_json
from gesturekit.study.analysis.result import conclusions, reservations


def study(answers: list[Answer], rounds: int = 40, **options):
    return analyse_study(Answers(tuple(answers), **options), rounds=rounds)


def three_systems(style: str = "", raters: int = 8) -> list[Answer]:
    """a beats b always; b and c are equal; a wins more often against c, but c more clearly."""
    found = []
    for r in range(raters):
        own = [Answer(f"r{r}", "1", "a", "b", 2), Answer(f"r{r}", "1", "b", "c", 1 - 2 * (r % 2))]
        own += [Answer(f"r{r}", str(k), "a", "c", s) for k, s in enumerate((1, 1, 1, -2, -2))]
        found += [Answer(a.user, a.clip, a.left, a.right, a.score, (), style) for a in own]
    return found


# All eight raters agree on two of the three pairs: p = 2 / 2⁸, three times that by Holm's method.
# Wilson: 8 of 8 is 1 / (1 + 1.96² / 8) or more; 16 of 40 and 4 of 8 by statsmodels.
FACTS = [
    "Order .*: c, a, b",
    r"c is preferred to a: .*40 % \[26, 55\], p = .023",
    r"a is preferred to b: .*100 % \[68, 100\], p = .023",
    r"No difference .*b and c .*50 % \[22, 78\], p = 1.000.* not show",
]


def say(lines: list[str], facts: list[str]) -> bool:
    return len(lines) == len(facts) and all(map(re.search, facts, lines))


def test_conclusions_on_preferences_hold_all_figures():
    found = study(three_systems(), excluded={"x": "failed 2 of 2 attention checks"})
    first = "56 answers .*8 raters .*5 speech segments.*1 rater excluded"
    assert say(conclusions(found), [first, *FACTS]) and found.by_style == {}


def test_each_style_is_concluded_on_apart():
    one_style = study(three_systems("old"))
    assert one_style.by_style == {} and say(conclusions(one_style)[1:], FACTS)
    more = [Answer(f"r{k}", "1", "b", "a", 1 - k, (), "sad") for k in range(2)]
    found = study([*three_systems("old"), *more])
    lines = conclusions(found)
    assert list(found.by_style) == ["old", "sad"]
    old = [line for line in lines if line.startswith("old: ")]
    assert say(old, FACTS)
    # Means 1 and 0: t = 1 with 1 degree of freedom. Wilson of 1 of 1: 1 / (1 + 1.96²) or more.
    assert re.search(r"sad: No difference .*b and a .*100 % \[21, 100\], p = .500", lines[-1])


def mismatch(name: str, scores: list[int]) -> list[Answer]:
    return [Answer(f"r{k}", f"c{k % 3}", name, f"{name}_Mismatched", s)
            for k, s in enumerate(scores)]  # fmt: skip


def test_conclusions_on_alignment_word_by_word():
    answers = [*mismatch("a", [2] * 8), *mismatch("b", [-1] * 8), *mismatch("d", [0])]
    lines = conclusions(study(answers))
    # The sign test 2 / 2⁸ of two systems with a test, by Holm's method twice that.
    facts = [
        *(r"a: .*better .*100 % \[100, 100\], p = .016", "d: .*not tell .*50 %, no test.*50 %"),
        *(r"b: .*worse .* 0 % \[0, 0\], p = .016", r"Systems differ .*a and b \(p < .001\)"),
    ]
    assert say(lines[1:], facts)
    (*_, last) = conclusions(study([*mismatch("a", [1, 1]), *mismatch("b", [1, -1])]))
    assert re.search("No difference .*alignment .*Barnard", last)
    assert len(conclusions(study(mismatch("a", [1, 1])))) == 2, "a single system differs from none"


def test_what_limits_the_conclusions_is_named():
    """Ten segments and fifteen raters are enough; one less of either is not."""

    def limits(raters: int, clips: int, left: int = 0) -> list[str]:
        found = study(
            [Answer(f"r{r}", f"c{c}", "a", "b", 1 if r < left else 1 - 2 * ((r + c) % 2))
             for r in range(raters) for c in range(clips)],
            notes=("1 line left out",), has_checks=True,
        )  # fmt: skip
        lines = reservations(found)
        assert lines[0] == "1 line left out."
        return lines[1:]

    assert limits(16, 10) == limits(15, 10) == [] and say(limits(14, 10), ["14 raters are few"])
    assert say(limits(15, 9), ["9 speech segments: "]) and say(limits(1, 10), ["single rater: "])
    assert limits(2, 10)[0].startswith("2 raters are few")
    # Wilson: 95 of 160 are 59 %, from 51.6 % to 66.7 %; 90 are 56 %, from 48.5 %.
    assert say(limits(16, 10, left=3), [r"59 % \[52, 67\] .*left"])
    assert limits(16, 10, left=2) == []


def tables(path: Path) -> dict[str, list[list[str]]]:
    text = path.read_text(encoding="utf-8")
    found = {}
    for part in text.split("<section><h2>")[1:]:
        rows = re.findall(r"<tr>(.*?)</tr>", part, re.DOTALL)
        found[part.partition("</h2>")[0]] = [
            re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row) for row in rows
        ]
    return found


def test_the_tables_of_a_report_hold_all_figures(tmp_path):
    answers = [Answer(a.user, a.clip, a.left, a.right, a.score, ("<i>",)) for a in three_systems()]
    answers += mismatch("a", [2] * 8) + mismatch("b", [-1] * 8)
    found = study(answers, rounds=123, excluded={"<x>": "failed 2 of 2 attention checks"})
    write_study_report(found, tmp_path / "x.html", title="Me & you")
    page = (tmp_path / "x.html").read_text(encoding="utf-8")
    shown = tables(tmp_path / "x.html")
    assert "<title>Me &amp; you</title>" in page
    systems = {row[0]: row[1:] for row in shown["Systems"]}
    # Scores of a rater: a 2 + 3 of 6 answers; c 4 or 5 of 6; b 0 or 1 of 2.
    assert [systems[name][0] for name in "abc"] == ["48", "16", "48"]
    assert [systems[name][1][:4] for name in "abc"] == ["0.83", "0.25", "0.75"]
    assert [systems[s.name][2].split()[0] for s in found.preference.systems] == [
        f"{s.elo.value:.0f}" for s in found.preference.systems
    ]
    pairs = {row[0]: re.sub("<[^>]+>", "", "|".join(row[1:8])) for row in shown["Pairs"]}
    assert pairs["a : c"] == "0|24|0|0|16|60 [45, 74]|p = .023"
    assert pairs["b : c"] == "0|4|0|4|0|50 [22, 78]|p = 1.000"
    # Matched motion of a: 8 clearly; of b never.
    alignment = {row[0]: row[1:] for row in shown["Alignment with speech"]}
    assert alignment["a"][:5] == ["8", "0", "0", "0", "0"] and "p = .016" in alignment["a"][7]
    assert alignment["b"][5].startswith("0.0 ")
    assert alignment["a : b"][0] == "p < .001"
    assert shown["Reasons given"][1:] == [["&lt;i&gt;", "56"]]
    assert shown["Excluded raters"][1:] == [["&lt;x&gt;", "failed 2 of 2 attention checks"]]


def test_all_figures_are_written_and_undefined_ones_are_null(tmp_path):
    more = [Answer(f"r{k}", "1", "b", "a", 1 - k, ("x",), "sad") for k in range(2)]
    answers = [*three_systems("old"), *more, *mismatch("m", [1])]
    found = study(answers, rounds=7, excluded={"é": "failed"})
    write_json(found, tmp_path / "x.json")
    figures = json.loads((tmp_path / "x.json").read_text(encoding="utf-8"))
    sad = figures["by_style"]["sad"]
    # Scores 1 and 0 against 0 and 0: F = 0.25 / 0.25 with 1 and 2 degrees of freedom.
    assert sad["anova"] == {"f": pytest.approx(1), "p": pytest.approx(0.42265, abs=1e-5),
                            "df": [1, 2]}  # fmt: skip
    (pair,) = sad["pairs"]
    assert (pair["a"], pair["b"], pair["counts"]) == ("b", "a", [0, 1, 1, 0, 0])
    assert (pair["raters"], pair["mean"], pair["p"]) == (2, 0.5, pytest.approx(0.5))
    assert sad["systems"][0]["merit"] == {"value": 0.5, "low": 0, "high": 1}
    (score,) = figures["alignment"]["systems"]
    assert score["score"] == {"value": 1, "low": None, "high": None} and score["p"] is None
    simple = ("format", "answers", "raters", "clips", "excluded", "reasons", "rounds", "seed")
    assert [figures[key] for key in simple] == [1, 59, 8, 6, {"é": "failed"}, {"x": 2}, 7, 0]
    assert figures["conclusions"] == conclusions(found)
