"""Ratings and votes of user studies, and how far metrics agree with them."""

import re
from dataclasses import replace
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import kendalltau, spearmanr, ttest_1samp
from statsmodels.stats.multitest import multipletests

from gesturekit.errors import EvaluationError
from gesturekit.evaluation import (
    Answer,
    BareItem,
    ClipResult,
    Evaluation,
    Interval,
    MetricResult,
    ModelResult,
    Pair,
    SpeedHistogram,
    read_ratings,
)
from gesturekit.evaluation.report.text import agreement_lines
from gesturekit.evaluation.statistics.agreement import agreement, chance_range, conclusion
from gesturekit.evaluation.statistics.answers import Ratings
from gesturekit.evaluation.statistics.scores import scores_of


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
    votes = judged(("a", "b"), ("a", "c"), ("b", "c"), users=8)  # sign test: p = 2 / 2⁸
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
    assert (question.raters, question.clips, question.ratings) == (8, 1, 24)


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


def test_scores_are_rater_centred_means(tmp_path):
    # By hand: p's mean is 40, q's 70; centred: a 10 and 20, b 0 and 0, c -10 and -20.
    lines = [("p", "a", 1, "", 50), ("p", "b", 1, "", 40), ("p", "c", 1, "", 30)]
    lines += [("q", "a", 1, "", 90), ("q", "b", 1, "", 70), ("q", "c", 1, "", 50)]
    found = scored(rated(tmp_path / "x.csv", lines), ["a", "b", "c"])
    np.testing.assert_allclose(found.values, [15, 0, -15], atol=1e-8)
    assert (found.raters, found.clips, found.ratings, found.note) == (2, 1, 6, "")
    assert str(found.ratings) == "6", "a whole number"


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


def test_pairs_differ_by_the_t_test_of_raters_with_holms_method(tmp_path):
    rng = np.random.default_rng(3)
    offset = {"a": 0.0, "b": 0.4, "c": 4.0}
    values = {s: [offset[s] + rng.normal(0, 1.5) for _ in range(9)] for s in "abc"}
    lines = [(k, s, "x", "", values[s][k]) for s in "abc" for k in range(9)]
    found = scored(rated(tmp_path / "x.csv", lines), ["a", "b", "c"])
    pairs = ((0, 1), (0, 2), (1, 2))
    p = [ttest_1samp(np.subtract(values["abc"[i]], values["abc"[j]]), 0.0).pvalue for i, j in pairs]
    expected = dict(zip(pairs, multipletests(p, method="holm")[0].tolist()))
    assert {pair: bool(found.differ[pair]) for pair in pairs} == expected
    assert any(expected.values()) and not all(expected.values())


@pytest.mark.parametrize("n", [3, 4, 5])
def test_the_chance_range_holds_95_percent_of_all_orders(n):
    taus = np.array([kendalltau(range(n), order).statistic for order in permutations(range(n))])
    bound = chance_range(n)
    assert np.mean(np.abs(taus) > bound + 1e-9) <= 0.05
    smaller = np.abs(taus)[np.abs(taus) < bound - 1e-9].max()
    assert np.mean(np.abs(taus) > smaller + 1e-9) > 0.05
    assert (bound == 1.0) == (n < 5)


def test_other_names_of_columns_are_read(tmp_path):
    head = "Participant ID;Condition;Stimulus;Rating;comment"
    (tmp_path / "x.csv").write_text(f"{head}\np;a;k;70;so, so\np;b;k;;\np;b;k;7e1;\np;b;k;7e1;\n")
    found = read_ratings([tmp_path / "x.csv"])
    assert (found.raters, found.systems, found.clips, found.questions) == (
        ("p",), ("a", "b"), ("k",), ("",),
    )  # fmt: skip
    assert found.value.tolist() == [70.0, 70.0] and not found.paired
    assert sum(bool(re.search(r"\b1\b", note)) for note in found.notes) == 2


HEAD = "rater,system,clip,value\n"


@pytest.mark.parametrize(
    ("text", "facts"),
    [
        ("", ["rater"]),
        ("rater,system,clip\np,a,x\n", ["value"]),
        ("rater,model,condition,clip,value\n", ["model", "condition"]),
        (HEAD + "p,a,x,good\n", ["line 2", "value", "good"]),
        (HEAD + "p,a,x,1\np,a,y,inf\n", ["line 3", "value", "inf"]),
        (HEAD + "p,,x,1\n", ["line 2", "empty"]),
        (HEAD + "p,a,x,1,5\n", ["line 2", "5", "4"]),
        (HEAD + 'p,a,x,"1', ["UTF-8"]),
    ],
)
def test_invalid_tables_of_ratings_are_refused_with_their_place(tmp_path, text, facts):
    (tmp_path / "x.csv").write_text(text)
    with pytest.raises(EvaluationError) as refused:
        read_ratings([tmp_path / "x.csv"])
    said = str(refused.value).replace(str(tmp_path), "")
    assert all(fact in said for fact in ("x.csv", *facts))


def clips_of(label: str, values: list[float], speakers: tuple[str | None, ...]) -> ModelResult:
    """Return a model with a sync for each of some takes, which each speaker numbers from 0."""
    found = model(label, sync=float(np.mean(values)))
    each = len(values) // len(speakers)
    found.clips = [
        ClipResult(
            Pair(
                f"c{k}",
                f"c{k}",
                None,
                BareItem(id="made"),
                BareItem(id="recorded", speaker=speakers[k // each]),
                take=f"{k % each}",
            ),
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
    intervals = {}
    for name, away, speakers in (
        ("steady", np.zeros((8, 6)), (None,)),
        ("noisy", noise, (None,)),
        ("one clip without sync", noise, (None,)),
        ("two speakers", noise, ("anna", "bert")),
    ):
        models = [
            clips_of(label, list(v / 50 + row), speakers)
            for (label, v), row in zip(quality.items(), away)
        ]
        if name == "one clip without sync":
            del models[0].clips[0].metrics["sync"]
        (question,) = agreement(models, ratings).questions
        intervals[name] = (question.metrics[0].low, question.metrics[0].high)
    assert intervals["noisy"][0] < intervals["steady"][0] - 0.2
    assert intervals["one clip without sync"][0] < intervals["steady"][0] - 0.2
    # Takes of two speakers are different takes, whatever their names.
    assert intervals["two speakers"] == intervals["noisy"]


def test_one_sentence_says_which_metric_is_established():
    """Nine models in people's order: a tau of 1 has p = 2 / 9! alone; one of six is chance."""

    def found(values: dict[str, list[float]], **unsure: bool):
        names = "abcdefghi"
        models = [
            model(name, **{key: column[k] for key, column in values.items()})
            for k, name in enumerate(names)
        ]
        for one in models:
            for key, informative in unsure.items():
                one.metrics[key] = replace(one.metrics[key], informative=informative)
        votes = judged(*[(a, b) for i, a in enumerate(names) for b in names[i + 1 :]])
        (question,) = agreement(models, Ratings.of_answers(votes)).questions
        return question, {metric.key: metric for metric in question.metrics}

    order, mixed = [9.0, 8, 7, 6, 5, 4, 3, 2, 1], [5.0, 2, 8, 1, 9, 4, 7, 3, 6]
    question, metrics = found({"sync": order, "bas": mixed, "foot_skate": order})
    p = 2 / 362880
    assert metrics["sync"].p_holm == pytest.approx(3 * p)
    assert metrics["bas"].p_holm == pytest.approx(kendalltau(mixed, order).pvalue)
    sentence = conclusion(question)
    assert re.search(r"Sync.* as people.*Foot skate.*other way", sentence) and "3" in sentence
    assert all(metric.informative for metric in metrics.values())
    question, metrics = found({"sync": order, "bas": mixed}, sync=False)
    assert [metrics[key].informative for key in ("sync", "bas")] == [False, True]
    assert metrics["sync"].p_holm is None and "1 metric" in conclusion(question)
    assert "Sync" not in conclusion(question)


def test_the_recordings_are_left_out_of_one_tau():
    """The recordings are first by people and by sync; the three models are in reverse order."""
    models = [model("a", sync=0.2), model("b", sync=0.3), model("c", sync=0.4)]
    order = ("recording", "a", "b", "c")
    votes = judged(*[(x, y) for i, x in enumerate(order) for y in order[i + 1 :]])
    found = of_votes(models, votes)["sync"]
    assert (found.kendall, found.of_models, found.n) == (pytest.approx(0), pytest.approx(-1), 4)


def test_questions_with_few_systems_and_raters_of_one_system_are_said(tmp_path):
    """`good` has three systems; each of its raters sees one, so that raters are no common scale."""
    rows = ["rater,system,clip,question,value"]
    rows += [f"{s}{k},{s},c{k},good,{10 * i + k}" for i, s in enumerate("abc") for k in range(4)]
    rows += [f"a{k},{s},c{k},fast,{k}" for s in "ab" for k in range(4)]
    (tmp_path / "r.csv").write_text("\n".join(rows))
    models = [model(s, sync=0.1 * i) for i, s in enumerate("abc")]
    found = agreement(models, read_ratings([tmp_path / "r.csv"]))
    assert [question.question for question in found.questions] == ["good"]
    assert any("'fast'" in note and "3 systems" in note for note in found.notes)
    assert any("good" in note and "raters do not connect" in note for note in found.notes)


def test_systems_of_one_side_alone_are_named():
    models = [model(s, sync=0.1 * i) for i, s in enumerate("abcx")]
    votes = judged(("a", "b"), ("b", "c"), ("a", "c"), ("a", "y"))
    notes = agreement(models, Ratings.of_answers(votes)).notes
    assert [note.rpartition(": ")[2] for note in notes] == ["y", "x"]
    assert "not evaluated" in notes[0] and "not in the study" in notes[1]


def test_the_terminal_has_names_as_they_are(tmp_path):
    quality = {"a": 3.0, "b": 2.0, "c": 1.0}
    lines = [
        (f"p{k}", s, "c", "body & <speech>", v + k) for k in range(4) for s, v in quality.items()
    ]
    models = [model(s, sync=v) for s, v in quality.items()]
    found = Evaluation(
        models, Path("r"), 25.0, "", {}, SpeedHistogram(), np.zeros(0),
        agreement(models, rated(tmp_path / "x.csv", lines)),
    )  # fmt: skip
    text = "\n".join(agreement_lines(found))
    assert "body & <speech>" in text and re.search(r"Sync +\+1\.00", text)


def test_a_column_of_free_text_is_no_question(tmp_path):
    lines = [("p", s, "c", f"I think {k}", k) for k in range(101) for s in "ab"]
    with pytest.raises(EvaluationError, match=r"x\.csv: 101 different questions.*100"):
        rated(tmp_path / "x.csv", lines)
    assert len(rated(tmp_path / "y.csv", lines[2:]).questions) == 100
