"""Bold figures: differences of models larger than chance, corrected for the number of rows."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from statsmodels.stats.multitest import multipletests

from gesturekit.evaluation.definitions import DEFINITIONS, MOVEMENT, POOLED
from gesturekit.evaluation.pairs import Pair
from gesturekit.evaluation.results import ClipResult, MetricResult, ModelResult
from gesturekit.evaluation.statistics.intervals import holm, whole_set
from gesturekit.evaluation.statistics.model_metrics import informative, metric_results
from gesturekit.evaluation.statistics.paired import contests, distance

KEYS = [
    key
    for key, d in DEFINITIONS.items()
    if d.group in (MOVEMENT, POOLED) and not key.startswith(("calm", "within", "copying_low"))
]
SEEDS = 0.06
"""Relative sd of a metric over samples of one recording: the demo model's reach and hand speed have
0.05 on 15 s of speech."""


def clip(stem: str, sample: int, metrics: dict, recording: dict) -> ClipResult:
    pair = Pair(f"{stem}_s{sample}", stem, None, Path("a"), Path("b"))
    return ClipResult(pair, 10.0, metrics, recording, {})


def model(label: str, clips: list[ClipResult]) -> ModelResult:
    return ModelResult(label, Path(label), clips=clips, metrics=metrics_of(clips))


def metrics_of(clips: list[ClipResult], pooled: dict | None = None) -> dict[str, MetricResult]:
    sets = {"pooled": {"metrics": pooled or {}}, "frechet": {"metrics": {}}}
    return metric_results(clips, sets, {}, {})


def two_models(
    seed: int, *, reach: float = 1.0, bias: float = 1.0, recordings: int = 10, samples: int = 4
) -> list[ModelResult]:
    """Two models of one kind on the same recordings; the second one's reach is `reach` times less.

    Rows are correlated within a clip, recordings differ, and both models are off by `bias`.
    """
    rng = np.random.default_rng(seed)
    own = np.exp(
        rng.normal(0.0, 0.3, (recordings, 1)) + rng.normal(0.0, 0.2, (recordings, len(KEYS)))
    )
    usual = rng.normal(0.0, 0.15, own.shape)  # of this model on each recording
    models = []
    for label, factor in (("one", 1.0), ("other", reach)):
        clips = []
        for r in range(recordings):
            for s in range(samples):
                lively = SEEDS * np.sqrt(0.5) * (rng.normal() + rng.normal(size=len(KEYS)))
                values = bias * own[r] * np.exp(usual[r] + lively)
                values[KEYS.index("reach")] *= factor
                given = dict(zip(KEYS, own[r].tolist()))
                clips.append(clip(f"r{r}", s, dict(zip(KEYS, values.tolist())), given))
        models.append(model(label, clips))
    return models


def reports_with_bold(reports: int, **options) -> tuple[float, float]:
    """Return the shares of reports with any bold figure, and with the first model's reach bold."""
    any_, found = 0, 0
    for seed in range(reports):
        best = {key: row.best for key, row in contests(two_models(seed, **options)).items()}
        any_ += any(best.values())
        found += best["reach"] == "one"
    return any_ / reports, found / reports


def test_equal_models_are_hardly_ever_bold():
    assert reports_with_bold(20)[0] <= 0.1 and reports_with_bold(20, bias=0.6)[0] <= 0.1


def test_less_reach_is_significant_with_ten_recordings():
    assert reports_with_bold(15, reach=0.8, bias=0.95)[1] >= 0.8


@pytest.mark.stress
@pytest.mark.parametrize("bias", [1.0, 0.6])
def test_rates_of_false_and_missed_bold_figures_in_200_reports(bias):
    assert reports_with_bold(200, bias=bias)[0] <= 0.05
    assert reports_with_bold(200, reach=0.8, bias=0.95)[1] >= 0.8


def test_with_four_takes_nothing_is_bold_however_many_samples():
    rows = contests(two_models(0, reach=0.1, recordings=4, samples=50))
    assert rows and all(row.best is None and row.p is None for row in rows.values())


def test_holm_agrees_with_statsmodels():
    p = [0.001, 0.04, 0.03, 0.5, 0.005]
    assert holm(p) == pytest.approx(multipletests(p, method="holm")[1])


def test_the_recordings_own_value_is_the_goal():
    """A statue's foot skate of 0 is no merit, and it takes the arrow away."""
    clips = {
        label: [clip(f"r{r}", 0, {"foot_skate": skate + 1e-3 * r}, {"foot_skate": 0.05})
                for r in range(6)]
        for label, skate in (("statue", 0.0), ("model", 0.06))
    }  # fmt: skip
    row = contests([model(label, made) for label, made in clips.items()])["foot_skate"]
    assert row.best == "model" and row.direction == "reference"
    sliding = contests([model("model", clips["model"])])["foot_skate"]
    assert sliding.direction == "lower" and sliding.best is None


def test_values_better_than_other_recordings_count_as_equal():
    assert distance("coverage", 90.0, 40.0) == 0.0 and distance("coverage", 30.0, 40.0) == 10.0
    assert distance("raw_fgd", 3.0, 5.0) == 0.0 and distance("raw_fgd", 8.0, 5.0) == 3.0
    assert distance("reach", 0.2, 0.3) == pytest.approx(0.1)


@pytest.mark.parametrize(("own", "expected"), [(0.5, True), (0.12, False)])
def test_sync_is_informative_only_where_the_recordings_are_above_chance(own, expected):
    given = {"sync": own, "sync_chance": 0.05, "sync_z": (own - 0.05) / 0.2}
    clips = [clip(f"r{r}", 0, {"sync": 0.9}, given) for r in range(4)]
    assert informative(clips, "sync") is expected
    assert metrics_of(clips)["sync"].informative is expected


@pytest.mark.parametrize(("own", "expected"), [(0.1, True), (0.0002, False)])
def test_a_held_out_recording_that_was_trained_on_says_nothing_about_copying(own, expected):
    pooled = {
        key: asdict(MetricResult(key, whole_set(value, 1), recording))
        for key, value, recording in (("copying", 0.08, own), ("novelty", 0.08 / own, None))
    }
    found = metrics_of([clip("r0", 0, {}, {})], pooled)
    assert found["novelty"].informative is expected
