"""Bold figures: differences of models larger than chance, corrected for the number of rows."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from statsmodels.stats.multitest import multipletests

from gesturekit.evaluation import (
    DEFINITIONS,
    MOVEMENT,
    POOLED,
    BareItem,
    ClipResult,
    MetricResult,
    ModelResult,
    Pair,
    above_chance,
    contests,
    distance,
    holm,
    metric_results,
    verdict,
    whole_set,
)
from gesturekit.evaluation.results import GroupLikeness
from gesturekit.evaluation.statistics.likeness import likeness_result

KEYS = [
    key
    for key, d in DEFINITIONS.items()
    if d.group in (MOVEMENT, POOLED)
    and not key.startswith(("calm", "within", "copying_low", "worst"))
]
SEEDS = 0.06
"""Relative sd of a metric over samples of one recording: the demo model's reach and hand speed have
0.05 on 15 s of speech."""


def clip(stem: str, sample: int, metrics: dict, recording: dict) -> ClipResult:
    pair = Pair(f"{stem}_s{sample}", stem, None, BareItem(id="a"), BareItem(id="b"))
    return ClipResult(pair, 10.0, metrics, recording, {})


def model(label: str, clips: list[ClipResult]) -> ModelResult:
    return ModelResult(label, Path(label), clips=clips, metrics=metrics_of(clips))


def metrics_of(clips: list[ClipResult], pooled: dict | None = None) -> dict[str, MetricResult]:
    return metric_results(clips, pooled or {}, {})


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
    any_, found = 0, 0
    for seed in range(reports):
        best = {key: row.best for key, row in contests(two_models(seed, **options)).items()}
        any_ += any(best.values())
        found += best["reach"] == "one"
    return any_ / reports, found / reports


def test_equal_models_are_hardly_ever_bold():
    assert reports_with_bold(8)[0] <= 1 / 8


def test_less_reach_is_significant_with_ten_recordings():
    assert reports_with_bold(6, reach=0.8, bias=0.95)[1] >= 0.8


@pytest.mark.stress
@pytest.mark.parametrize("bias", [1.0, 0.6])
def test_rates_of_false_and_missed_bold_figures_in_200_reports(bias):
    assert reports_with_bold(200, bias=bias)[0] <= 0.05
    assert reports_with_bold(200, reach=0.8, bias=0.95)[1] >= 0.8


def test_with_four_takes_nothing_is_bold_however_many_samples():
    rows = contests(two_models(0, reach=0.1, recordings=4, samples=50))
    assert rows and all(row.best is None and row.p is None for row in rows.values())


def test_holm_agrees_with_statsmodels():
    for p in ([0.001, 0.04, 0.03, 0.5, 0.005], [0.9, 0.7, 0.8]):
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


def judged(values: dict[str, list[float]], key: str = "reach", own: float = 0.5, **more):
    """The row of a key: a clip of each model, {label: values}, for every recording; None: none."""
    models = []
    for label, given in values.items():
        clips = [
            clip(f"r{r}", 0, {key: value, **{k: v[r] for k, v in more.items()}}, {key: own})
            for r, value in enumerate(given)
            if value is not None
        ]
        models.append(model(label, clips))
    return contests(models).get(key)


NEAR, FAR = ([base + 0.01 * (k % 3) for k in range(6)] for base in (0.4, 0.3))


def test_the_p_value_is_that_of_the_paired_differences():
    row = judged({"far": FAR, "near": [0.4, 0.43, 0.41, 0.4, 0.42, 0.41]})
    p = stats.ttest_rel(FAR, [0.4, 0.43, 0.41, 0.4, 0.42, 0.41]).pvalue
    assert row.best == "near" and row.p == pytest.approx(p) and row.own == 0.5
    assert row.distances == pytest.approx({"far": 0.19, "near": 0.5 - 2.47 / 6})
    assert judged({"alone": NEAR}).p is None


def test_the_best_model_differs_from_every_other_one_on_the_recordings_of_both():
    third = [value - 0.001 for value in NEAR]
    third[0] += 0.002
    row = judged({"far": FAR, "near": NEAR, "third": third})
    assert row.best is None
    assert row.p == pytest.approx(min(1, stats.ttest_rel(NEAR, third).pvalue))
    assert judged({"far": FAR, "near": NEAR, "third": [0.2, *FAR[1:]]}).best == "near"
    # Four takes in common are too few, whatever each has beside them.
    row = judged({"far": [*FAR[:4], None, None, *FAR], "near": [*NEAR[:4], *NEAR, None]})
    assert row.best == "near", "the takes of one name are compared"
    row = judged({"far": [*FAR[:4], None, None], "near": NEAR})
    assert row.best is None and row.p is None


def test_likenesses_differ_by_the_pseudo_values_of_their_takes():
    """Five takes: each counts as likeness less 4 times the change of the likeness without it."""
    noise = np.array([0.01, -0.02, 0.015, 0.0, 0.005])

    def like(label: str, value: float, without: np.ndarray) -> ModelResult:
        takes = dict(zip("uvwxy", (value + without).tolist()))
        group = GroupLikeness("", tuple(takes), value, 0.9, {}, takes)
        made = likeness_result([group], {}, 5)
        return ModelResult(label, Path(label), metrics={"likeness": made})

    for other, best in ((0.5, "near"), (0.79, None)):
        row = contests([like("far", other, noise[::-1]), like("near", 0.8, noise)])["likeness"]
        found = stats.ttest_rel(0.8 - 4 * noise, other - 4 * noise[::-1])
        assert row.best == best and row.distances == pytest.approx({"far": 1 - other, "near": 0.2})
        assert row.p == pytest.approx(found.pvalue if best else 1.0)


def test_models_as_far_off_on_either_side_are_equal():
    """They differ surely, and are 0.1 below and 0.104 above; 0.1 and 0.13 is surely nearer."""
    noise = [0.01, -0.01, 0.02, -0.02, 0.015, -0.015]
    below = [0.4 + n for n in noise]
    for above, best in ((0.604, None), (0.63, "below")):
        row = judged({"above": [above - n for n in noise[::-1]], "below": below})
        assert row.best == best and (row.p == 1.0) == (best is None), above


def test_a_value_must_be_surely_above_the_higher_of_its_chance_levels():
    good, bad = [0.4, 0.42, 0.41, 0.43, 0.4, 0.42], [0.1, 0.12, 0.1, 0.13, 0.11, 0.1]
    shaky = [0.39, 0.2, 0.6, 0.3, 0.55, 0.4]

    def row(chance: list[float], mismatched: float):
        models = []
        for label, values in (("good", good), ("bad", bad)):
            given = [{"sync": v, "sync_chance": c} for v, c in zip(values, chance)]
            own = {"sync": 0.6, "sync_chance": 0.1, "sync_z": 5.0}
            clips = [clip(f"r{r}", 0, found, own) for r, found in enumerate(given)]
            for one in clips:
                one.mismatched["sync"] = mismatched
            models.append(model(label, clips))
        return contests(models)["sync"]

    found = row([0.1] * 6, 0.2)
    above = stats.ttest_1samp(np.array(good) - 0.2, 0, alternative="greater").pvalue
    assert found.best == "good" and above > stats.ttest_rel(good, bad).pvalue
    assert found.p == pytest.approx(above)
    assert row([0.1] * 6, 0.43).best is None, "no higher than with other recordings"
    found = row(shaky, 0.0)
    above = np.array(good) - shaky
    assert found.p == pytest.approx(stats.ttest_1samp(above, 0, alternative="greater").pvalue)
    assert found.best is None


@pytest.mark.parametrize(
    ("key", "values", "direction"),
    [
        ("srgr", (0.3, 0.2), "higher"),
        ("srgr", (0.3, 0.51), "reference"),
        ("foot_skate", (0.6, 0.7), "lower"),
        ("foot_skate", (0.6, 0.49), "reference"),
        ("reach", (0.6, 0.7), "reference"),
    ],
)
def test_an_arrow_holds_as_long_as_no_model_is_beyond_the_recordings(key, values, direction):
    given = {f"m{k}": [value] * 3 for k, value in enumerate(values)}
    assert judged(given, key).direction == direction


def test_results_are_means_over_takes_beside_chance_and_other_recordings():
    clips = [clip(f"r{r}", 0, {"bc": v, "bc_chance": c}, {"bc": 0.5 + r, "bc_chance": 0.1,
             "bc_z": 3.0}) for r, (v, c) in enumerate(((0.4, 0.1), (0.6, 0.2)))]  # fmt: skip
    clips[0].mismatched["bc"] = 0.3
    clips.append(clip("r2", 0, {"reach": 1.0}, {}))
    found = metrics_of(clips)
    bc = found["bc"]
    assert (bc.interval.value, bc.recording, bc.chance, bc.mismatched) == pytest.approx(
        (0.5, 1.0, 0.15, 0.3)
    )
    assert "2 of 3" in bc.note and bc.recording_interval.n == 2
    reach = found["reach"]
    assert (reach.recording, reach.chance, reach.mismatched) == (None, None, None)
    assert reach.recording_interval is None


def test_the_standard_deviations_of_recordings_are_pooled():
    """Each of four recordings of 10 s has 0.2 or more: the sum has 0.4, and three times is 1.2."""

    def given(gap: float, z: float | None = 9.0, **more) -> list[ClipResult]:
        own = {"sync": 0.1 + gap, "sync_chance": 0.1} | ({} if z is None else {"sync_z": z})
        return [clip(f"r{r}", s, {}, own) for r in range(4) for s in range(2)]

    assert above_chance(given(0.35), "sync") and not above_chance(given(0.25), "sync")
    assert not above_chance(given(0.35, z=0.3), "sync"), "wider where the shifts say so"

    # Others have that of the shifts alone: four of z are a sum of 2 z.
    def beats(z: float) -> list[ClipResult]:
        own = {"bc": 0.6, "bc_chance": 0.5, "bc_z": z}
        return [clip(f"r{r}", 0, {}, own) for r in range(4)]

    assert above_chance(beats(1.8), "bc") and not above_chance(beats(1.2), "bc")
    # 2.5 s have twice the deviation.
    assert not above_chance([replace(c, seconds=2.5) for c in given(0.4)], "sync")


@pytest.mark.parametrize(("own", "expected"), [(0.5, True), (0.12, False)])
def test_sync_is_informative_only_where_the_recordings_are_above_chance(own, expected):
    given = {"sync": own, "sync_chance": 0.05, "sync_z": (own - 0.05) / 0.2}
    clips = [clip(f"r{r}", 0, {"sync": 0.9}, given) for r in range(4)]
    assert above_chance(clips, "sync") is expected
    assert metrics_of(clips)["sync"].informative is expected


def test_the_range_of_short_recordings_says_nothing():
    for seconds, expected in ((6.0, False), (6.5, True)):
        clips = [clip(f"r{r}", 0, {"joint_limits": 60.0}, {"joint_limits": 0.0}) for r in range(4)]
        found = metrics_of([replace(one, seconds=seconds) for one in clips])
        assert found["joint_limits"].informative is expected
        assert ("broken" in verdict(found, [])) is expected


def test_correlations_that_any_two_recordings_have_say_nothing():
    clips = [clip(f"r{r}", 0, {"cca": 0.999, "sync": 0.5}, {"cca": 1.0}) for r in range(4)]
    for own, expected in ((0.995, False), (0.985, True)):
        found = metric_results(clips, {}, {"cca": (whole_set(own, 4), "against another take")})
        assert found["cca"].informative is expected


@pytest.mark.parametrize(("own", "expected"), [(0.1, True), (0.0002, False)])
def test_a_held_out_recording_that_was_trained_on_says_nothing_about_copying(own, expected):
    pooled = {
        key: MetricResult(key, whole_set(value, 1), recording)
        for key, value, recording in (("copying", 0.08, own), ("novelty", 0.08 / own, None))
    }
    found = metrics_of([clip("r0", 0, {}, {})], pooled)
    assert found["novelty"].informative is expected
