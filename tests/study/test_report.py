"""What a study's report says: its sentences, tables and figures, word by word."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from gesturekit.errors import ConfigError
from gesturekit.evaluation.statistics.answers import Answer, Answers
from gesturekit.study import analyse_study
from gesturekit.study.analysis.report import write_json, write_study_report
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
SENTENCES = [
    "Order by Elo rating, best first: c, a, b.",
    "c is preferred to a: win rate 40 % [26, 55], p = .023.",
    "a is preferred to b: win rate 100 % [68, 100], p = .023.",
    "No difference was found between b and c (50 % [22, 78], p = 1.000). This does not show that "
    "they are equally good.",
]


def test_conclusions_on_preferences_word_by_word():
    found = study(three_systems(), excluded={"x": "failed 2 of 2 attention checks"})
    first = "56 answers of 8 raters on 5 speech segments; 1 rater excluded by attention checks."
    assert conclusions(found) == [first, *SENTENCES] and found.by_style == {}


def test_each_style_is_concluded_on_apart():
    one_style = study(three_systems("old"))
    assert one_style.by_style == {} and conclusions(one_style)[1:] == SENTENCES
    more = [Answer(f"r{k}", "1", "b", "a", 1 - k, (), "sad") for k in range(2)]
    found = study([*three_systems("old"), *more])
    lines = conclusions(found)
    assert list(found.by_style) == ["old", "sad"]
    assert [line for line in lines if line.startswith("old: ")] == [f"old: {s}" for s in SENTENCES]
    # Means 1 and 0: t = 1 with 1 degree of freedom. Wilson of 1 of 1: 1 / (1 + 1.96²) or more.
    assert lines[-2:] == [
        "sad: Order by Elo rating, best first: b, a.",
        "sad: No difference was found between b and a (100 % [21, 100], p = .500). This does not "
        "show that they are equally good.",
    ]


def mismatch(name: str, scores: list[int]) -> list[Answer]:
    return [Answer(f"r{k}", f"c{k % 3}", name, f"{name}_Mismatched", s)
            for k, s in enumerate(scores)]  # fmt: skip


def test_conclusions_on_alignment_word_by_word():
    answers = [*mismatch("a", [2] * 8), *mismatch("b", [-1] * 8), *mismatch("d", [0])]
    lines = conclusions(study(answers))
    # The sign test 2 / 2⁸ of two systems with a test, by Holm's method twice that.
    assert lines[1:4] == [
        "a: its motion fits its speech better than its motion of other speech (alignment 100 % "
        "[100, 100], p = .016).",
        "d: raters did not tell its motion from that of other speech (alignment 50 %, no test; "
        "chance 50 %).",
        "b: its motion fits its speech worse than its motion of other speech (alignment 0 % [0, 0],"
        " p = .016).",
    ]
    assert lines[4:] == [
        "Systems differ in how often their matched motion is preferred: a and b (p < .001)."
    ]
    (*_, last) = conclusions(study([*mismatch("a", [1, 1]), *mismatch("b", [1, -1])]))
    assert last == "No difference between systems in alignment was found (Barnard's test)."
    assert len(conclusions(study(mismatch("a", [1, 1])))) == 2, "a single system differs from none"


@pytest.mark.parametrize("answers", [5, 8])
def test_one_rater_with_many_answers_turns_no_conclusion_around(answers):
    """Ten raters slightly prefer the first one; one clearly prefers the other, again and again.

    Their means are 1 and -2: t = (8 / 11) / (3 / 11) = 2.667, p = .024 with 10 degrees of freedom.
    """
    scores = {**dict.fromkeys(range(10), [1]), 10: [-2] * answers}

    def said(other: str) -> str:
        lines = conclusions(
            study(
                [
                    Answer(f"r{r}", f"c{k}", "a", other, score)
                    for r, own in scores.items()
                    for k, score in enumerate(own)
                ]
            )
        )
        return next(line for line in lines if "p = .024" in line)  # fmt: skip

    assert "fits its speech better" in said("a_Mismatched")
    assert said("b").startswith("a is preferred to b: ")


def test_a_pair_of_nothing_but_ties_has_no_win_rate():
    (*_, last) = conclusions(study([Answer(f"r{r}", "c", "a", "b", 0) for r in range(3)]))
    assert "between a and b (only ties, p = 1.000)" in last


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

    few = "14 raters are few: intervals are rough, and most likely too narrow."
    assert limits(16, 10) == limits(15, 10) == [] and limits(14, 10) == [few]
    assert limits(15, 9) == ["9 speech segments: findings may hold for these clips only."]
    assert limits(1, 10) == [
        "A single rater: no intervals and no tests, so that nothing can be concluded."
    ]
    assert limits(2, 10)[0].startswith("2 raters are few")
    # Wilson: 95 of 160 are 59 %, from 51.6 % to 66.7 %; 90 are 56 %, from 48.5 %.
    side = "59 % [52, 67] of preferences are for the left side: raters favour it, or systems were"
    assert limits(16, 10, left=3) == [f"{side} not shown on both sides equally often."]
    assert limits(16, 10, left=2) == []


def test_a_side_that_wins_too_seldom_is_named_too_and_ties_do_not_count():
    answers = [Answer(f"r{r}", f"c{r}", "a", "b", -1 if r < 16 else 0) for r in range(30)]
    (*_, last) = reservations(study(answers))
    # 0 of 16: up to 1.96² / (16 + 1.96²).
    assert last.startswith("0 % [0, 19] of preferences are for the left side")


def test_groups_that_were_never_compared_are_listed():
    answers = [Answer(f"r{r}", "c", *pair, 1 - r) for pair in ("ab", "cd") for r in range(2)]
    found = study(answers)
    assert reservations(found)[-2:] == [
        "Never compared: a and c, a and d, b and c, b and d.",
        "No comparison connects these groups, so that there is no common rating: a, b; c, d.",
    ]
    assert conclusions(found)[1] == "Order by merit score, best first: a, c, b, d."


def test_a_bootstrap_without_rounds_is_refused():
    with pytest.raises(ConfigError, match="rounds is 0"):
        study(three_systems(), rounds=0)
    assert study(three_systems(), rounds=1).rounds == 1


def test_reasons_are_counted_and_the_most_frequent_comes_first():
    given = [("Smooth",), ("Rhythm", "Smooth"), (), ("Rhythm", "Smooth")]
    answers = [Answer(f"r{k}", "c", "a", "b", 1, names) for k, names in enumerate(given)]
    assert list(study(answers).reasons.items()) == [("Smooth", 3), ("Rhythm", 2)]


def tables(path: Path) -> dict[str, list[list[str]]]:
    """Return the cells of the rows of each section of a report."""
    text = path.read_text(encoding="utf-8")
    found = {}
    for part in text.split("<section><h2>")[1:]:
        rows = re.findall(r"<tr>(.*?)</tr>", part, re.DOTALL)
        found[part.partition("</h2>")[0]] = [
            re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row) for row in rows
        ]
    return found


def test_the_tables_of_a_report_cell_by_cell(tmp_path):
    answers = [Answer(a.user, a.clip, a.left, a.right, a.score, ("<i>",)) for a in three_systems()]
    answers += mismatch("a", [2] * 8) + mismatch("b", [-1] * 8)
    found = study(answers, rounds=1234, excluded={"<x>": "failed 2 of 2 attention checks"})
    write_study_report(found, tmp_path / "x.html", title="Me & you")
    page = (tmp_path / "x.html").read_text(encoding="utf-8")
    shown = tables(tmp_path / "x.html")
    assert list(shown) == [
        "What may be concluded", "Systems", "Pairs", "Alignment with speech", "Plots",
        "Reasons given", "Excluded raters", "Method",
    ]  # fmt: skip
    assert "<title>Me &amp; you</title>" in page and "1,234 rounds" in page and "seed\n0" in page
    systems = {row[0]: row[1:] for row in shown["Systems"]}
    assert systems.pop("System") == ["Answers", "Merit score", "Elo"]
    # Scores of a rater: a 2 + 3 of 6 answers; c 4 or 5 of 6; b 0 or 1 of 2.
    assert systems["a"][:2] == ["48", "0.83 <small>[0.83, 0.83]</small>"]
    assert systems["c"][0] == "48" and systems["c"][1].startswith("0.75 <small>[0.69, 0.8")
    assert systems["b"][0] == "16" and systems["b"][1].startswith("0.25 <small>[0.06, 0.4")
    ratings = {s.name: s.elo for s in found.preference.systems}
    for name, cells in systems.items():
        elo = ratings[name]
        assert cells[2] == f"{elo.value:.0f} <small>[{elo.low:.0f}, {elo.high:.0f}]</small>"
    pairs = {row[0]: row[1:] for row in shown["Pairs"]}
    yes = '<span class="yes">{}</span>'
    assert pairs["a : b"][:7] == [
        "8", "0", "0", "0", "0", "100 <small>[68, 100]</small>", yes.format("p = .023")
    ]  # fmt: skip
    assert pairs["a : c"][:7] == [
        "0", "24", "0", "0", "16", "60 <small>[45, 74]</small>", yes.format("p = .023")
    ]  # fmt: skip
    assert pairs["b : c"][:7] == [
        "0",
        "4",
        "0",
        "4",
        "0",
        "50 <small>[22, 78]</small>",
        "p = 1.000",
    ]
    # Matched motion of a: 8 clearly; of b never.
    alignment = {row[0]: row[1:] for row in shown["Alignment with speech"]}
    assert alignment["a"] == [
        "8", "0", "0", "0", "0", "100.0 <small>[100.0, 100.0]</small>",
        "100 <small>[68, 100]</small>", yes.format("p = .016"),
    ]  # fmt: skip
    assert alignment["b"][:6] == ["0", "0", "0", "8", "0", "0.0 <small>[0.0, 0.0]</small>"]
    assert alignment["a : b"] == ["p < .001", yes.format("p < .001")]
    assert shown["Reasons given"][1:] == [["&lt;i&gt;", "56"]]
    assert shown["Excluded raters"][1:] == [["&lt;x&gt;", "failed 2 of 2 attention checks"]]
    anova = found.preference.anova
    # Two scores of each of 56 answers, three systems.
    assert f"scores: F(2, 109) = {anova.f:.2f}, p = .036." in page


def test_a_report_of_few_answers_leaves_out_what_there_is_not(tmp_path):
    found = study([Answer("r", "c", "a", "b", 2)])
    write_study_report(found, tmp_path / "x.html")
    shown = tables(tmp_path / "x.html")
    assert list(shown) == ["What may be concluded", "Systems", "Pairs", "Plots", "Method"]
    assert shown["Systems"][1][:3] == ["a", "1", "2.00"] and "small" not in shown["Systems"][1][3]
    assert shown["Pairs"][1][6:] == ["100 <small>[21, 100]</small>", "no test", "no test"]
    assert "ANOVA of merit" not in (tmp_path / "x.html").read_text(encoding="utf-8")
    write_study_report(study(mismatch("a", [0, 0])), tmp_path / "y.html")
    (_, cells) = tables(tmp_path / "y.html")["Alignment with speech"]
    assert cells[6:] == ["50.0 <small>[50.0, 50.0]</small>", "–", "p = 1.000"]


def test_a_report_has_sections_of_every_style(tmp_path):
    more = [Answer(f"r{k}", "1", "b", "a", 1 - k, (), "sad") for k in range(2)]
    write_study_report(study([*three_systems("old"), *more]), tmp_path / "x.html")
    shown = tables(tmp_path / "x.html")
    assert [name for name in shown if "ystems" in name or "airs" in name] == [
        "Systems", "Pairs", "Style old: systems", "Style old: pairs",
        "Style sad: systems", "Style sad: pairs",
    ]  # fmt: skip
    assert [row[0] for row in shown["Style sad: systems"]] == ["System", "b", "a"]


def test_all_figures_are_written_and_undefined_ones_are_null(tmp_path):
    more = [Answer(f"r{k}", "1", "b", "a", 1 - k, ("x",), "sad") for k in range(2)]
    answers = [*three_systems("old"), *more, *mismatch("m", [1])]
    found = study(answers, rounds=7, excluded={"é": "failed"})
    write_json(found, tmp_path / "x.json")
    text = (tmp_path / "x.json").read_text(encoding="utf-8")
    figures = json.loads(text)
    assert "é" in text and text.endswith("}\n") and '\n "raters": 8,\n' in text
    pair = {
        "a": "b",
        "b": "a",
        "counts": [0, 1, 1, 0, 0],
        "raters": 2,
        "mean": 0.5,
        "p": pytest.approx(0.5),
        "p_holm": pytest.approx(0.5),
        "p_tukey": pytest.approx(0.42265, abs=1e-4),
        "win_rate": {"value": 1, "low": pytest.approx(0.20654, abs=1e-4), "high": 1},
    }
    sad = figures["by_style"]["sad"]
    # Scores 1 and 0 against 0 and 0: F = 0.25 / 0.25 with 1 and 2 degrees of freedom.
    assert sad["anova"] == {
        "f": pytest.approx(1),
        "p": pytest.approx(0.42265, abs=1e-5),
        "df": [1, 2],
    }
    assert sad["pairs"] == [pair] and sad["not_compared"] == []
    assert sad["systems"][0]["merit"] == {"value": 0.5, "low": 0, "high": 1}
    assert len(figures["preference"]["pairs"]) == len(figures["by_style"]["old"]["pairs"]) == 3
    (score,) = figures["alignment"]["systems"]
    assert score["score"] == {"value": 1, "low": None, "high": None} and score["p"] is None
    simple = ("format", "answers", "raters", "clips", "excluded", "reasons", "rounds", "seed")
    assert [figures[key] for key in simple] == [1, 59, 8, 6, {"é": "failed"}, {"x": 2}, 7, 0]
    assert figures["conclusions"] == conclusions(found)
    assert figures["reservations"] == reservations(found)
    assert figures["left"]["value"] == found.left.value
    write_json(study(three_systems()), tmp_path / "y.json")
    assert json.loads((tmp_path / "y.json").read_text(encoding="utf-8"))["alignment"] is None
    write_json(study(mismatch("m", [1, -1])), tmp_path / "z.json")
    assert json.loads((tmp_path / "z.json").read_text(encoding="utf-8"))["preference"] is None
