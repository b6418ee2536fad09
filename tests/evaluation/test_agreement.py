"""Ratings and votes of user studies, and how far metrics agree with them."""

from __future__ import annotations

import importlib.util
import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from itertools import permutations
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import kendalltau, spearmanr, ttest_1samp

from gesturekit.errors import EvaluationError
from gesturekit.evaluation import read_ratings
from gesturekit.evaluation.definitions import DEFINITIONS
from gesturekit.evaluation.metrics.distributions import SpeedHistogram
from gesturekit.evaluation.pairs import ItemInterval, Pair
from gesturekit.evaluation.report.agreement_table import agreement_lines
from gesturekit.evaluation.results import (
    Agreement,
    ClipResult,
    Evaluation,
    Interval,
    MetricAgreement,
    MetricResult,
    ModelResult,
    QuestionAgreement,
)
from gesturekit.evaluation.statistics.agreement import (
    agreement,
    chance_range,
    kendall,
    metric_values,
)
from gesturekit.evaluation.statistics.answers import GENEA_COLUMNS, Answer
from gesturekit.evaluation.statistics.ratings import Ratings
from gesturekit.evaluation.statistics.scores import scores_of
from gesturekit.wording import printable


def model(label: str, **values: float) -> ModelResult:
    metrics = {
        key: MetricResult(key, Interval(value, None, None, 1, 1, "samples"), recording=1.0)
        for key, value in values.items()
    }
    return ModelResult(label, Path(label), metrics=metrics)


def judged(*wins: tuple[str, str], users: int = 4) -> list[Answer]:
    return [Answer(f"u{k}", "clip", *pair, 1) for k in range(users) for pair in wins]


def of_votes(models: list[ModelResult], answers: list[Answer]) -> dict:
    (found,) = agreement(models, Ratings.of_answers(answers)).questions
    return {one.key: one for one in found.metrics}


def rated(
    path: Path, lines: list[tuple], head: str = "rater,system,clip,question,value"
) -> Ratings:
    path.write_text("\n".join([head, *(",".join(map(str, line)) for line in lines)]))
    return read_ratings([path])


def study(path: Path, quality: dict[str, float], raters: int = 12, clips: int = 5) -> Ratings:
    """Return ratings by raters of different means, with small noise."""
    rng = np.random.default_rng(0)
    return rated(
        path,
        [
            (f"p{r}", name, f"c{c}", "human-like", level + 7 * r + 3 * c + rng.normal(0, 2))
            for r in range(raters) for c in range(clips) for name, level in quality.items()
        ],
    )  # fmt: skip


def scored(ratings: Ratings, systems: list[str]):
    return scores_of(ratings, np.ones(len(ratings.value), bool), systems)


def test_metrics_that_order_models_as_people_do_have_a_correlation_of_one():
    # People prefer a to b to c. Sync says so too; jerk is nearest to the recording's 1.0 for c.
    models = [
        model("a", sync=0.6, jerk=3.0, foot_skate=0.1),
        model("b", sync=0.4, jerk=0.2, foot_skate=0.3),
        model("c", sync=0.2, jerk=1.1, foot_skate=0.2),
    ]
    votes = judged(("a", "b"), ("a", "c"), ("b", "c"))
    found = of_votes(models, votes)
    assert found["sync"].kendall == found["sync"].spearman == 1.0
    assert (found["sync"].accuracy, found["sync"].pairs, found["sync"].n) == (1.0, 3, 3)
    assert found["sync"].low is None  # three systems: no interval
    people = [1.0, 0.5, 0.0]
    nearness = [-2.0, -0.8, -0.1]
    assert found["jerk"].kendall == pytest.approx(kendalltau(nearness, people).statistic)
    assert found["jerk"].accuracy == 0.0
    assert found["foot_skate"].spearman == pytest.approx(
        spearmanr([-0.1, -0.3, -0.2], people).statistic
    )
    (question,) = agreement(models, Ratings.of_answers(votes)).questions
    assert question.scores == {"a": 1.0, "b": 0.5, "c": 0.0}  # shares of comparisons won
    assert (question.raters, question.clips, question.ratings) == (4, 1, 12)


def test_votes_of_raters_who_disagree_make_no_pair_significant_and_ties_count_half():
    models = [model("a", sync=0.6), model("b", sync=0.4), model("c", sync=0.2)]
    one_way = judged(("a", "b"), ("b", "c"), users=3)
    other_way = [
        Answer(f"v{k}", "clip", *pair, 1) for k in range(2) for pair in (("b", "a"), ("c", "b"))
    ]
    found = of_votes(models, one_way + other_way)["sync"]
    assert found.kendall == 1.0 and found.accuracy is None and found.pairs == 0
    ties = [Answer("u", "clip", "a", "b", 0), Answer("u", "clip", "b", "c", 0)]
    assert not of_votes(models, ties)  # people see no difference: there is nothing to order by


def test_recordings_may_be_one_of_the_models_of_the_study():
    models = [model("a", sync=0.6), model("b", sync=0.4)]
    found = of_votes(models, judged(("recording", "a"), ("recording", "b"), ("a", "b")))["sync"]
    assert found.n == 3 and found.kendall == 1.0  # its own sync is 1.0
    with pytest.raises(EvaluationError, match="2 in common, and a correlation needs 3"):
        agreement(models, Ratings.of_answers(judged(("a", "b"), ("b", "x"))))


def test_scores_are_rater_centred_means(tmp_path):
    # By hand: p's mean is 40, q's 70; centred: a 10 and 20, b 0 and 0, c -10 and -20.
    lines = [("p", "a", 1, "", 50), ("p", "b", 1, "", 40), ("p", "c", 1, "", 30)]
    lines += [("q", "a", 1, "", 90), ("q", "b", 1, "", 70), ("q", "c", 1, "", 50)]
    found = scored(rated(tmp_path / "x.csv", lines), ["a", "b", "c"])
    np.testing.assert_allclose(found.values, [15, 0, -15], atol=1e-8)
    assert (found.raters, found.clips, found.ratings, found.note) == (2, 1, 6, "")


def test_missing_ratings_do_not_favour_the_system_of_kind_raters_or_easy_clips(tmp_path):
    # Without noise, any design that connects the systems gives their true differences.
    rater, clip = {"p": 0.0, "q": 25.0, "r": -20.0}, {"x": 0.0, "y": 12.0}
    quality = {"a": 10.0, "b": 4.0, "c": -14.0}
    lines = [
        (r, s, c, "", quality[s] + rater[r] + clip[c])
        for r in rater for s in quality for c in clip
        if (r, s) not in (("q", "a"), ("r", "b"), ("p", "c")) and (s, c) != ("a", "y")
    ]  # fmt: skip
    found = scored(rated(tmp_path / "x.csv", lines), ["a", "b", "c"])
    np.testing.assert_allclose(found.values, [10, 4, -14], atol=1e-6)


def test_raters_of_one_system_each_are_not_centred(tmp_path):
    lines = [(f"{s}{k}", s, k % 4, "", v + k) for s, v in (("a", 9), ("b", 5), ("c", 1))
             for k in range(8)]  # fmt: skip
    found = scored(rated(tmp_path / "x.csv", lines), ["a", "b", "c"])
    np.testing.assert_allclose(found.values, [4, 0, -4], atol=1e-8)
    assert not found.differ.any() and "raters do not connect the systems" in found.note


def test_pairs_differ_by_the_t_test_of_raters_with_holms_method(tmp_path):
    rng = np.random.default_rng(3)
    offset = {"a": 0.0, "b": 0.4, "c": 4.0}
    values = {s: [offset[s] + rng.normal(0, 1.5) for _ in range(9)] for s in "abc"}
    lines = [(k, s, "x", "", values[s][k]) for s in "abc" for k in range(9)]
    found = scored(rated(tmp_path / "x.csv", lines), ["a", "b", "c"])
    pairs = ((0, 1), (0, 2), (1, 2))
    p = [ttest_1samp(np.subtract(values["abc"[i]], values["abc"[j]]), 0.0).pvalue for i, j in pairs]
    rank = np.argsort(p)
    adjusted = np.maximum.accumulate(np.array(p)[rank] * [3, 2, 1])
    expected = {pairs[k]: a < 0.05 for k, a in zip(rank, adjusted)}
    assert {pair: bool(found.differ[pair]) for pair in pairs} == expected
    assert any(expected.values()) and not all(expected.values())


def test_two_raters_are_enough_for_a_test_where_they_agree(tmp_path):
    """Differences of 10 and 10.1: t = 201 with one degree of freedom, p = .003."""
    lines = [("p", "a", "x", "", 50), ("p", "b", "x", "", 40), ("q", "a", "x", "", 90.1),
             ("q", "b", "x", "", 80)]  # fmt: skip
    found = scored(rated(tmp_path / "x.csv", lines), ["a", "b"])
    assert found.differ.tolist() == [[False, True], [True, False]]
    one = scored(rated(tmp_path / "y.csv", lines[:2]), ["a", "b"])
    assert not one.differ.any()


def test_kendalls_tau_of_many_rows_equals_that_of_scipy():
    rng = np.random.default_rng(0)
    one, other = rng.integers(0, 5, (2, 50, 8)).astype(float)
    np.testing.assert_allclose(
        kendall(one, other), [kendalltau(a, b).statistic for a, b in zip(one, other)], atol=1e-12
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.isnan(kendall(np.ones((1, 4)), other[:1, :4])).all()


def by_take(key: str, takes: int = 6, **values: Callable[[float], float]) -> list[ModelResult]:
    """Models whose value of each take is a function of the recording's, {label: function}."""
    own = [1.0 + 0.3 * k for k in range(takes)]
    models = []
    for label, change in values.items():
        clips = [
            ClipResult(Pair(f"t{k}", f"t{k}", None, Path("a"), Path("b")), 9.0,
                       {key: change(v)}, {key: v}, {})
            for k, v in enumerate(own)
        ]  # fmt: skip
        found = Interval(float(np.mean([change(v) for v in own])), None, None, 6, 6, "takes")
        result = MetricResult(key, found, recording=float(np.mean(own)))
        models.append(ModelResult(label, Path(label), metrics={key: result}, clips=clips))
    return models


def test_values_of_drawn_takes_move_with_those_of_the_recordings():
    models = by_take("reach", a=lambda v: v + 0.1, b=lambda v: v - 0.2, c=lambda v: 2 * v)
    found = metric_values(models, "reach", ["a", "b", "c", "recording"], 0)
    assert set(found) == {"a", "b", "c"}, "the recordings would be first by definition"
    assert found["a"] == pytest.approx(-0.1) and found["b"] == pytest.approx(-0.2)
    # Twice the recordings' is as far off as their mean, whose error is that of six takes.
    assert found["c"][0] == pytest.approx(-1.75)
    spread = 0.3 * np.std(range(6)) / np.sqrt(6)
    assert np.std(found["c"][1:]) == pytest.approx(spread, rel=0.1)
    assert np.mean(found["c"][1:]) == pytest.approx(-1.75, abs=0.02)
    higher = metric_values(by_take("sync", a=lambda v: v / 2), "sync", ["a", "recording"], 0)
    assert higher["a"] == pytest.approx(higher["recording"] / 2)
    assert higher["recording"][0] == pytest.approx(1.75) and np.ptp(higher["recording"]) > 0.3
    lower = metric_values(by_take("foot_skate", a=lambda v: v / 2), "foot_skate", ["a"], 0)
    assert set(lower) == {"a"} and lower["a"] == pytest.approx(-higher["a"])
    other = metric_values(by_take("sync", a=lambda v: v / 2), "sync", ["a"], 1)
    assert not np.array_equal(other["a"], higher["a"])


def test_few_takes_and_clips_without_a_value_are_not_drawn():
    for models in (by_take("sync", takes=4, a=abs), by_take("sync", a=abs)):
        if models[0].clips[-1].pair.stem == "t5":
            models[0].clips[0].metrics.clear()
        found = metric_values(models, "sync", ["a"], 0)["a"]
        assert np.ptp(found) == 0 and len(found) > 1
    # A recording without a value does not matter to the models.
    models = by_take("sync", a=lambda v: v / 2, b=lambda v: v / 3)
    for one in models:
        one.clips[0].recording.clear()
    found = metric_values(models, "sync", ["a", "b"], 0)
    assert np.ptp(found["a"]) > 0 and found["b"] == pytest.approx(found["a"] * 2 / 3)
    # Takes that one model lacks are not drawn for the others.
    models[1].clips = models[1].clips[1:]
    fewer = metric_values(models, "sync", ["a", "b"], 0)
    assert fewer["a"][0] == pytest.approx(found["a"][0])
    assert np.std(fewer["a"]) < np.std(found["a"])


@pytest.mark.parametrize("n", [3, 4, 5, 6, 7])
def test_the_chance_range_holds_95_percent_of_all_orders(n):
    taus = np.array([kendalltau(range(n), order).statistic for order in permutations(range(n))])
    bound = chance_range(n)
    assert np.mean(np.abs(taus) > bound + 1e-9) <= 0.05
    smaller = np.abs(taus)[np.abs(taus) < bound - 1e-9].max()
    assert np.mean(np.abs(taus) > smaller + 1e-9) > 0.05
    assert (bound == 1.0) == (n < 5)


def test_a_right_a_blind_and_an_inverted_metric_are_told_apart(tmp_path):
    quality = dict(zip("abcdefgh", (30, 25, 20, 15, 10, 5, 0, -5)))
    blind = (3, 6, 1, 5, 4, 2, 8, 7)
    models = [
        model(name, sync=level / 100, foot_skate=level, hand_q50=1 + blind[k])
        for k, (name, level) in enumerate(quality.items())
    ]
    found = agreement([*models, model("z", sync=0.1)], study(tmp_path / "x.csv", quality))
    (question,) = found.questions
    assert question.question == "human-like" and list(question.scores) == list(quality)
    metrics = {one.key: one for one in question.metrics}
    right, inverted = metrics["sync"], metrics["foot_skate"]  # less foot skate is better
    assert right.kendall == pytest.approx(1.0) and (right.accuracy, right.pairs) == (1.0, 28)
    assert inverted.kendall == pytest.approx(-1.0) and inverted.accuracy == 0.0
    assert right.low > 0 and inverted.high < 0
    assert metrics["hand_q50"].low < 0 < metrics["hand_q50"].high
    assert right.chance == pytest.approx(4 / 7)
    assert found.notes == ("left out, as they were evaluated and not in the study: z",)
    assert agreement(models, study(tmp_path / "x.csv", quality)) == agreement(
        models, study(tmp_path / "x.csv", quality)
    )


def test_several_questions_and_systems_that_one_side_lacks(tmp_path):
    lines = [
        (f"p{r}", name, "c", question, sign * level + r)
        for question, sign in (("human-like", 1), ("appropriate", -1))
        for r in range(6) for name, level in zip("abcx", (9, 5, 1, 3))
    ] + [("p0", "a", "c", "third", 1), ("p0", "b", "c", "third", 2)]  # fmt: skip
    models = [model("a", sync=0.6), model("b", sync=0.4), model("c", sync=0.2)]
    found = agreement(models, rated(tmp_path / "x.csv", lines))
    assert [(q.question, q.metrics[0].kendall) for q in found.questions] == [
        ("human-like", 1.0), ("appropriate", -1.0),
    ]  # fmt: skip
    assert found.notes == (
        "left out, as they were in the study and not evaluated: x",
        "question 'third' left out: ratings of fewer than 3 systems",
    )


def test_six_systems_have_an_interval_and_five_have_none(tmp_path):
    quality = dict(zip("abcdef", (9.0, 6.0, 4.0, 2.0, 0.0, -3.0)))
    models = [model(name, sync=level) for name, level in quality.items()]
    for count in (6, 5):
        rated_by_people = study(tmp_path / "x.csv", dict([*quality.items()][:count]))
        (metric,) = agreement(models[:count], rated_by_people).questions[0].metrics
        assert (metric.n, metric.low is None, metric.high is None) == (count, *[count < 6] * 2)


@pytest.mark.parametrize("question", ["human-like", ""])
def test_notes_on_ratings_name_their_question(tmp_path, question):
    """Raters of one system each, whose means cannot be removed."""
    lines = [(f"{s}{k}", s, k % 4, question, v + k) for s, v in (("a", 9), ("b", 5), ("c", 1))
             for k in range(4)]  # fmt: skip
    models = [model(name, sync=0.1 * k) for k, name in enumerate("abc")]
    note = "raters do not connect the systems: rater means were not removed"
    found = agreement(models, rated(tmp_path / "x.csv", lines)).notes
    assert found == ((f"{question}: {note}",) if question else (note,))


def test_the_table_of_a_question_has_its_chance_and_a_row_for_each_metric():
    sync = MetricAgreement("sync", 0.8, 0.1, 0.95, 0.9, 0.75, 8, 6, 0.733)
    reach = MetricAgreement("reach", -0.5, None, None, -0.25, None, 0, 4, 1.0)
    asked = QuestionAgreement("human\n-like", {"b": -1.5, "a\n": 12.345}, 1, 2, 30, (sync, reach))
    alone = QuestionAgreement("", {"a": 1.0}, 3, 1, 1, (replace(reach, n=3),))
    nothing = replace(alone, metrics=())

    def lines(*questions: QuestionAgreement) -> list[str]:
        found = Agreement(questions)
        return agreement_lines(
            Evaluation([], Path(), 25.0, "", {}, SpeedHistogram(), np.zeros(0), agreement=found)
        )

    names = [DEFINITIONS[key].name for key in ("sync", "reach")]
    width = max(map(len, [*names, "Metric"]))
    empty, title, people, *chance, outside, head, first, second = lines(asked)
    question, name = printable("human\n-like"), printable("a\n")
    assert empty == "" and people == f"People's scores: {name} +12.3, b -1.5."
    assert title == f"Agreement with people on {question}: 1 rater, 2 clips, 30 ratings."
    assert chance == [
        "Chance, 6 systems: 95 % of random orders have a tau between -0.73 and +0.73; pairwise "
        "accuracy 50 %.",
        "Chance, 4 systems: 95 % of random orders have a tau between -1.00 and +1.00; pairwise "
        "accuracy 50 %. These are too few systems: any order may be chance.",
    ]
    assert outside == "One metric in 20 is outside that range by chance alone."
    cells = ("Kendall's tau [95 %]", "Spearman's rho", "pairs in order", "systems")
    assert head == f"  {'Metric':<{width}}  " + "  ".join(cells)
    assert first == (
        f"  {names[0]:<{width}}  +0.80 [+0.10, +0.95]  +0.90           75% of 8        6"
    )
    assert second == f"  {names[1]:<{width}}  -0.50{'':15}  -0.25           none differ     4"
    _, title, _, chance, head, row, _, _, _, none = lines(alone, nothing)
    assert title == "Agreement with people: 3 raters, 1 clip, 1 rating."
    assert "One metric" not in chance and head.startswith("  Metric") and row.endswith("3")
    assert none == "No metric can be compared: the values, or people's scores, are all equal."
    nobody = Evaluation([], Path(), 25.0, "", {}, SpeedHistogram(), np.zeros(0))
    assert agreement_lines(nobody) == []


def test_other_names_of_columns_are_read(tmp_path):
    head = "Participant ID;Condition;Stimulus;Rating;comment"
    (tmp_path / "x.csv").write_text(f"{head}\np;a;k;70;so, so\np;b;k;;\np;b;k;7e1;\np;b;k;7e1;\n")
    found = read_ratings([tmp_path / "x.csv"])
    assert (found.raters, found.systems, found.clips, found.questions) == (
        ("p",), ("a", "b"), ("k",), ("",),
    )  # fmt: skip
    assert found.value.tolist() == [70.0, 70.0] and not found.paired
    assert found.notes == ("1 line without a value left out", "1 repeated line counted once")


def test_free_text_is_no_question(tmp_path):
    lines = [("p", "a", "x", f"because {k}", 1) for k in range(101)]
    with pytest.raises(EvaluationError, match="x.csv: 101 different questions"):
        rated(tmp_path / "x.csv", lines)


def test_votes_are_read_by_the_same_function(tmp_path):
    columns = ",".join((*GENEA_COLUMNS, "checks", "checks_failed"))
    text = f"{columns}\nu,c,a,b,model_a,True,,,2,0\nv,c,a,b,tie,,,,2,1\nw,d,b,a,tie,,,,2,0\n"
    (tmp_path / "x.csv").write_text(text)
    found = read_ratings([tmp_path])
    assert found.paired and found.value.tolist() == [1.0, 0.0, 0.5, 0.5]
    assert found.notes == ("1 rater left out: v failed 1 of 2 attention checks",)


HEAD = "rater,system,clip,value\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no column rater"),
        ("rater,system,clip\np,a,x\n", "no column value (or score, rating, mos)"),
        ("rater,model,condition,clip,value\n", "several columns may be the system"),
        (HEAD, "no rating to analyse"),
        (HEAD + "p,a,x,good\n", "line 2: value is 'good'; expected a number"),
        (HEAD + "p,a,x,1\np,a,y,inf\n", "line 3: value is 'inf'"),
        (HEAD + "p,a,x,1_0\n", "value is '1_0'"),
        (HEAD + "p,a,x,1e100\np,b,x,-1e101\n", "line 3: value is '-1e101'"),
        (HEAD + "p,,x,1\n", "line 2: rater, system or clip is empty"),
        (HEAD + "p,a,x,1,5\n", "line 2: 5 cells, but the header has 4"),
        (HEAD + 'p,a,x,"1', "not a CSV file in UTF-8"),
        ("\x00\x01" * 50, "no column rater"),
    ],
)
def test_invalid_tables_of_ratings_are_refused_with_their_place(tmp_path, text, message):
    with pytest.raises(EvaluationError, match="x.csv") as refused:
        (tmp_path / "x.csv").write_text(text)
        read_ratings([tmp_path / "x.csv"])
    assert message in str(refused.value)


def said_by(speaker: str | None) -> ItemInterval:
    return ItemInterval(SimpleNamespace(speaker=speaker, style=None))


def clips_of(label: str, values: list[float], speakers: tuple[str | None, ...]) -> ModelResult:
    """Return a model with a sync for each of some takes, which each speaker numbers from 0."""
    found = model(label, sync=float(np.mean(values)))
    each = len(values) // len(speakers)
    found.clips = [
        ClipResult(
            Pair(f"c{k}", f"c{k}", None, Path(), said_by(speakers[k // each]), take=f"{k % each}"),
            1.0,
            {"sync": value},
            {"sync": 1.0},
            {},
        )
        for k, value in enumerate(values)
    ]
    return found


def test_the_takes_of_the_evaluation_are_drawn_as_well(tmp_path):
    # Two neighbours swap their order with the take: their tau is not certain.
    quality = dict(zip("abcdefgh", (30, 25, 20, 15, 10, 5, 0, -5)))
    ratings = study(tmp_path / "x.csv", quality)
    rng = np.random.default_rng(0)
    noise = rng.normal(0, 0.3, (8, 6))
    shared = rng.normal(0, 0.3, 6)  # takes that are easy or hard for all systems alike
    intervals = {}
    for name, away, speakers in (
        ("steady", np.zeros((8, 6)), (None,)),
        ("alike", np.tile(shared, (8, 1)), (None,)),
        ("noisy", noise, (None,)),
        ("two speakers", noise, ("anna", "bert")),
    ):
        models = [
            clips_of(label, list(v / 50 + row), speakers)
            for (label, v), row in zip(quality.items(), away)
        ]
        (question,) = agreement(models, ratings).questions
        intervals[name] = (question.metrics[0].low, question.metrics[0].high)
    assert intervals["steady"] == pytest.approx(intervals["alike"])
    assert intervals["noisy"][0] < intervals["steady"][0] - 0.2
    # Takes of two speakers are different takes, whatever their names.
    assert intervals["two speakers"] == intervals["noisy"]


@pytest.fixture(scope="module")
def simulation():
    """The module of `benchmarks/agreement_power.py`."""
    path = Path(__file__).parents[2] / "benchmarks" / "agreement_power.py"
    spec = importlib.util.spec_from_file_location("agreement_power", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


def test_simulated_studies_rank_metrics_as_they_are(simulation):
    design = simulation.Design(9, 40, 20, 0.2)
    found = list(simulation.studies(design, 30, seed=0))
    rates = {
        name: simulation.rates(name, [one[name] for one in found], 9)
        for name in simulation.CORRELATIONS
    }
    assert rates["right"]["above chance"] >= 0.9 and rates["right"]["accuracy"] > 0.97
    assert rates["inverted"]["below chance"] >= 0.9 and rates["inverted"]["accuracy"] < 0.03
    assert rates["blind"]["above chance"] + rates["blind"]["below chance"] <= 0.2
    assert all(one["covered"] >= 0.85 for one in rates.values())


def test_equal_systems_hardly_ever_differ_significantly(simulation):
    # Many raters of the same clips agree on what is true of these clips only.
    assert simulation.false_alarms(simulation.Design(9, 40, 200), 20, seed=0) <= 0.2
