"""Calibration of draws: by hand, and of models whose calibration is known."""

import numpy as np
import pytest

from gesturekit.errors import EvaluationError
from gesturekit.evaluation import calibration, evaluate


def test_ranks_spread_and_width_by_hand():
    seeds = [[k + 10 * clip for k in range(9)] for clip in range(3)]
    found = calibration(seeds, [0.0, 18.5, 20.0], speaker=[0.0, 10.0])
    # The lowest and the highest of nine: 0 to 8, 10 to 18, 20 to 28.
    assert found.coverage == pytest.approx(200 / 3)
    # sd of 0 ... 8 is sqrt(7.5); that of 0, 18.5, 20 is 11.14.
    assert found.spread == pytest.approx(np.sqrt(7.5) / 11.1393, rel=1e-4)
    # Nine draws from two clips, 0 and 10, all agree once in 256 times.
    assert found.sharpness == pytest.approx(8 / (10 * (1 - 2 / 2**9)), abs=0.01)
    assert (found.clips, found.seeds) == (3, 9)


@pytest.mark.parametrize(("given", "used"), [(9, 9), (18, 9), (19, 19), (28, 19), (40, 39)])
def test_seeds_are_used_as_far_as_ranks_cover_80_percent(given, used):
    rng = np.random.default_rng(given)
    found = calibration(rng.standard_normal((4000, given)), rng.standard_normal(4000))
    assert found.seeds == used and found.coverage == pytest.approx(80, abs=2.5)


def test_only_sharpness_tells_a_model_that_listens_from_a_draw_that_does_not():
    rng = np.random.default_rng(0)
    told, rest = rng.standard_normal(2000), 0.5 * rng.standard_normal((2000, 20))
    recorded = told + rest[:, 0]
    listens = calibration(told[:, None] + rest[:, 1:], recorded)
    blind = calibration(np.sqrt(1.25) * rng.standard_normal((2000, 19)), recorded)
    sure = calibration(told[:, None] + 0.1 * rest[:, 1:], recorded)
    assert listens.coverage == pytest.approx(80, abs=3) == blind.coverage
    assert (listens.sharpness, blind.sharpness) == pytest.approx((0.45, 1.0), abs=0.04)
    assert (listens.spread, blind.spread) == pytest.approx((0.45, 1.0), abs=0.05)
    assert sure.coverage < 20 and sure.spread < 0.1


@pytest.mark.parametrize("levels", [[range(8)] * 3, [range(19)], [range(19), range(3)]])
def test_few_seeds_or_a_single_clip_are_refused_with_what_to_do(levels):
    with pytest.raises(EvaluationError, match="render --samples 19"):
        calibration(levels, [1.0] * len(levels))


def test_a_report_has_it_for_models_with_nine_samples(gesture, tmp_path):
    for clip in range(2):
        gesture(1.0, 15.0, seed=clip).save(tmp_path / "recorded" / f"c{clip}.npz")
        for k in range(1, 10):
            gesture(1.0, 15.0, seed=10 * clip + k).save(tmp_path / "made" / f"c{clip}_s{k}.npz")
    (model,) = evaluate(tmp_path / "made", tmp_path / "recorded", cheap=True).models
    assert {"2", "9"} <= {*model.metrics["calibration"].note.split()}
    assert model.metrics["sharpness"].recording == 1.0
    (tmp_path / "made" / "c1_s9.npz").unlink()
    (model,) = evaluate(tmp_path / "made", tmp_path / "recorded", cheap=True).models
    assert "calibration" not in model.metrics
    assert not any("calibration" in f"{e.what} {e.reason}".lower() for e in model.excluded)
