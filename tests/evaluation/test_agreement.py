"""Agreement of metrics with the answers of a user study."""

from __future__ import annotations

from pathlib import Path

import pytest
from scipy.stats import kendalltau, spearmanr

from gesturekit.errors import EvaluationError
from gesturekit.evaluation.results import Interval, MetricResult, ModelResult
from gesturekit.evaluation.statistics.agreement import agreement
from gesturekit.evaluation.statistics.answers import Answer


def model(label: str, **values: float) -> ModelResult:
    metrics = {
        key: MetricResult(key, Interval(value, None, None, 1, 1, "samples"), recording=1.0)
        for key, value in values.items()
    }
    return ModelResult(label, Path(label), metrics=metrics)


def judged(*wins: tuple[str, str], users: int = 4) -> list[Answer]:
    return [Answer(f"u{k}", "clip", *pair, 1) for k in range(users) for pair in wins]


def test_metrics_that_order_models_as_people_do_have_a_correlation_of_one():
    # People prefer a to b to c. Sync says so too; jerk is nearest to the recording's 1.0 for c.
    models = [
        model("a", sync=0.6, jerk=3.0, foot_skate=0.1),
        model("b", sync=0.4, jerk=0.2, foot_skate=0.3),
        model("c", sync=0.2, jerk=1.1, foot_skate=0.2),
    ]
    found = {one.key: one for one in agreement(models, judged(("a", "b"), ("a", "c"), ("b", "c")))}
    assert found["sync"].kendall == found["sync"].spearman == 1.0
    assert (found["sync"].low, found["sync"].high) == (1.0, 1.0)
    assert (found["sync"].n, found["sync"].users, found["sync"].answers) == (3, 4, 12)
    people = [1.0, 0.5, 0.0]
    nearness = [-2.0, -0.8, -0.1]
    assert found["jerk"].kendall == pytest.approx(kendalltau(nearness, people).statistic)
    assert found["foot_skate"].spearman == pytest.approx(
        spearmanr([-0.1, -0.3, -0.2], people).statistic
    )


def test_users_who_disagree_widen_the_interval_and_ties_count_half():
    models = [model("a", sync=0.6), model("b", sync=0.4), model("c", sync=0.2)]
    one_way = judged(("a", "b"), ("b", "c"), users=3)
    other_way = [
        Answer(f"v{k}", "clip", *pair, 1) for k in range(2) for pair in (("b", "a"), ("c", "b"))
    ]
    (found,) = agreement(models, one_way + other_way)
    assert found.kendall == 1.0 and found.low < 0 < found.high
    ties = [Answer("u", "clip", "a", "b", 0), Answer("u", "clip", "b", "c", 0)]
    assert not agreement(models, ties)  # people see no difference: there is nothing to order by


def test_recordings_may_be_one_of_the_models_of_the_study():
    models = [model("a", sync=0.6), model("b", sync=0.4)]
    (found,) = agreement(models, judged(("recording", "a"), ("recording", "b"), ("a", "b")))
    assert found.n == 3 and found.kendall == 1.0  # its own sync is 1.0
    with pytest.raises(EvaluationError, match="2 in common, and a correlation needs 3"):
        agreement(models, judged(("a", "b"), ("b", "x")))
