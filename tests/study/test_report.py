"""Report of a study: the facts of its sentences, tables and figures."""

import json
import re

import pytest

from gesturekit.evaluation import Answer, Answers
from gesturekit.study import analyse_study, write_study_report
from gesturekit.study.report import conclusions, p_text, reservations, write_json


def study(answers: list[Answer], rounds: int = 20, **options):
    return analyse_study(Answers(tuple(answers), **options), rounds=rounds)


def three_systems(style: str = "", raters: int = 8) -> list[Answer]:
    """a beats b always; b and c are equal; a wins more often against c, but c more clearly."""
    found = []
    for r in range(raters):
        own = [Answer(f"r{r}", "1", "a", "b", 2), Answer(f"r{r}", "1", "b", "c", 1 - 2 * (r % 2))]
        own += [Answer(f"r{r}", "1", "a", "c", score) for score in (1, 1, 1, -2, -2)]
        found += [Answer(a.user, a.clip, a.left, a.right, a.score, (), style) for a in own]
    return found


# All eight raters agree on two of the three pairs: p = 2 / 2⁸, three times that by Holm's method.
# Wilson: 8 of 8 is 1 / (1 + 1.96² / 8) or more; 16 of 40 by statsmodels. 4 of 8 have the variance
# 1 / 28 over raters and t = 2.365, so that they count as 4.81 answers.
FACTS = [
    ["Order", r"\bc\W+a\W+b\b"],
    [r"\bc\b.* preferred .*\ba\b", "40 %", "26", "55", r"\.023"],
    [r"\ba\b.* preferred .*\bb\b", "100 %", "68", r"\.023"],
    ["No difference", r"\bb\b", r"\bc\b", "50 %", "17", "83", r"\b1\.0"],
]


def say(lines: list[str], facts: list[list[str]]) -> bool:
    """Return whether a line holds all facts of each list."""
    return all(any(all(re.search(f, line) for f in one) for line in lines) for one in facts)


def test_conclusions_on_preferences_hold_all_figures():
    found = study(three_systems(), excluded={"x": "failed 2 of 2 attention checks"})
    first = [r"\b56 answers", r"\b8 raters", r"\b1\b.*segment", r"\b1 rater\b"]
    assert say(conclusions(found), [first, *FACTS]) and found.by_style == {}


def test_each_style_is_concluded_on_apart():
    one_style = study(three_systems("old"))
    assert one_style.by_style == {} and say(conclusions(one_style), FACTS)
    more = [Answer(f"r{k}", "1", "b", "a", 1 - k, (), "sad") for k in range(2)]
    found = study([*three_systems("old"), *more])
    lines = conclusions(found)
    assert list(found.by_style) == ["old", "sad"]
    old = [line for line in lines if line.startswith("old: ")]
    assert say(old, FACTS)
    # Means 1 and 0: t = 1 with 1 degree of freedom. A single rater has a preference: no interval.
    assert say(lines, [["sad", r"\bb\b", r"\ba\b", "100 %", r"\.5"]])


def mismatch(name: str, scores: list[int]) -> list[Answer]:
    return [Answer(f"r{k}", f"c{k}", name, f"{name}_Mismatched", s)
            for k, s in enumerate(scores)]  # fmt: skip


def test_conclusions_on_alignment_hold_all_figures():
    answers = [*mismatch("a", [2] * 8), *mismatch("b", [-1] * 8), *mismatch("d", [0])]
    lines = conclusions(study(answers))
    # The sign test 2 / 2⁸ of two systems with a test, by Holm's method twice that, and of their
    # difference.
    facts = [
        *([r"\ba\b", "better", "100 %", r"\.016"], [r"\bd\b", "not", "50 %", "no test"]),
        *([r"\bb\b", "worse", r"\b0 %", r"\.016"], ["differ", r"\ba\b", r"\bb\b", r"\.008"]),
    ]
    assert say(lines, facts)
    alike = conclusions(study([*mismatch("a", [1, 1]), *mismatch("b", [1, -1])]))
    assert say(alike, [["No difference"]])
    single = conclusions(study(mismatch("a", [1, 1])))
    assert not say(single, [["difference"]]), "a single system differs from none"


def test_what_limits_the_conclusions_is_named():
    """Fifteen raters and ten segments are enough; some less of either are not."""

    def limits(raters: int, clips: int, left: int = 0) -> list[str]:
        found = study(
            [Answer(f"r{r}", f"c{c}", "a", "b", 1 if r < left else 1 - 2 * ((r + c) % 2))
             for r in range(raters) for c in range(clips)],
            notes=("1 line left out",), has_checks=True,
        )  # fmt: skip
        noted, *lines = reservations(found)
        assert "1 line left out" in noted
        return lines

    assert limits(16, 10) == []
    for raters, clips, fact in ((8, 10, "8 raters"), (16, 4, "4 .*segments"), (1, 10, "rater")):
        (limit,) = limits(raters, clips)
        assert re.search(rf"\b{fact}", limit)
    # 110 of 160 are 69 %, with a standard error of 6 % over raters; 85 are 53 %.
    assert say(limits(16, 10, left=6), [["69 %", "left"], [r"\br0\b", "10 of 10"]])
    assert not say(limits(16, 10, left=1), [["left"]])


def rows_of(page: str) -> list[str]:
    """Return the text of the rows of all tables."""
    return [re.sub(r"</?\w[^>]*>", " ", row) for row in re.findall(r"<tr.*?</tr>", page, re.DOTALL)]


def test_the_rows_of_a_report_hold_all_figures(tmp_path):
    answers = [Answer(a.user, a.clip, a.left, a.right, a.score, ("<i>",)) for a in three_systems()]
    answers += mismatch("a", [2] * 8) + mismatch("b", [-1] * 8)
    found = study(answers, rounds=123, excluded={"<x>": "failed 2 of 2 attention checks"})
    write_study_report(found, tmp_path / "x.html", title="Me & you")
    page = (tmp_path / "x.html").read_text(encoding="utf-8")
    assert "Me &amp; you" in page
    elo = {system.name: f"{system.elo.value:.0f}" for system in found.preference.systems}
    facts = [
        # Scores of a rater: a 2 + 3 of 6 answers; c 4 or 5 of 6; b 0 or 1 of 2.
        *(("a", 48, 0.83, elo["a"]), ("b", 16, 0.25, elo["b"]), ("c", 48, 0.75, elo["c"])),
        *(("a", "c", 24, 16, 60, 45, 74, ".023"), ("b", "c", 4, 50, 17, 83)),
        # Matched motion of a: 8 clearly; of b never.
        *(("a", 8, 100, ".016"), ("b", 0, ".016"), ("a", "b", ".008")),
        *(("&lt;i&gt;", 56), ("&lt;x&gt;", "2 of 2")),
    ]
    whole = [[rf"(?<!\w){re.escape(str(fact))}(?!\w)" for fact in one] for one in facts]
    assert say(rows_of(page), whole)


def test_all_figures_are_written_and_undefined_ones_are_null(tmp_path):
    more = [Answer(f"r{k}", "1", "b", "a", 1 - k, ("x",), "sad") for k in range(2)]
    answers = [*three_systems("old"), *more, *mismatch("m", [1])]
    found = study(answers, rounds=7, excluded={"é": "failed"})
    write_json(found, tmp_path / "x.json")
    figures = json.loads((tmp_path / "x.json").read_text(encoding="utf-8"))
    sad = figures["by_style"]["sad"]
    # Scores 1 and 0 against 0 and 0: F = 0.25 / 0.25 with 1 and 2 degrees of freedom.
    assert [sad["anova"][k] for k in "fp"] == pytest.approx([1, 0.42265], abs=1e-5)
    assert sad["anova"]["df"] == [1, 2]
    (pair,) = sad["pairs"]
    assert (pair["a"], pair["b"], pair["counts"]) == ("b", "a", [0, 1, 1, 0, 0])
    assert (pair["raters"], pair["mean"], pair["p"]) == (2, 0.5, pytest.approx(0.5))
    assert sad["systems"][0]["merit"].items() >= {"value": 0.5, "low": 0, "high": 1}.items()
    (score,) = figures["alignment"]["systems"]
    assert score["score"]["value"] == 1 and score["score"]["low"] is score["p"] is None
    simple = ("format", "answers", "raters", "clips", "excluded", "reasons", "rounds", "seed")
    assert [figures[key] for key in simple] == [1, 59, 8, 2, {"é": "failed"}, {"x": 2}, 7, 0]
    assert figures["conclusions"] == conclusions(found)


def test_raters_who_do_not_look_are_named():
    def given(user: str, seconds: float, scores: list[int]) -> list[Answer]:
        return [Answer(user, f"c{k}", "a", "b", s, (), "", seconds) for k, s in enumerate(scores)]

    mixed = [1, -1, 2, 0, -2, 1, 0, -1, 1, 2]
    careful = [answer for user in "uvw" for answer in given(user, 20.0, mixed)]
    lines = reservations(
        study([*careful, *given("fast", 4.0, mixed), *given("left", 15.0, [2] * 10)])
    )
    assert say(lines, [[r"\bfast\b", r"\b4 s", r"\b20 s"], [r"\bleft\b", "10 of 10"]])
    assert not say(reservations(study(careful)), [["answer"]])


def test_systems_that_were_never_compared_are_named():
    apart = [Answer(f"r{k}", "1", *pair, 1) for k in range(3) for pair in (("a", "b"), ("c", "d"))]
    lines = " ".join(reservations(study(apart)))
    assert re.search(r"Never compared: a and c, a and d, b and c, b and d\.", lines)
    assert re.search(r"common rating: a, b; c, d\.", lines)
    joined = " ".join(reservations(study([*apart, Answer("r0", "1", "b", "c", 1)])))
    assert "Never compared: a and c, a and d, b and d." in joined and "common" not in joined


def test_p_values_are_written_as_in_papers():
    written = {0.0004: "p < .001", 0.0016: "p = .002", 0.0412: "p = .041", 1.0: "p = 1.000"}
    assert {p: p_text(p) for p in written} == written and p_text(float("nan")) == "no test"
