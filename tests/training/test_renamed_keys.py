"""Runs of earlier versions, whose settings had other names, can be resumed."""

from __future__ import annotations

import pytest

from gesturekit.errors import ConfigError
from gesturekit.training.config import dump_yaml
from gesturekit.training.run.folder import Run

NEW = {"z_star_shuffle": 3, "training": {"batch": 4, "window_cache": 8}, "features": None}
OLD = {"recall": 3, "schedule": {"batch": 4, "bank": 8}, "features": None}


@pytest.fixture
def run(tmp_path):
    Run(tmp_path / "run", NEW, resume=False).begin()
    return tmp_path / "run"


def test_a_run_with_old_names_is_resumed(run):
    (run / "config.yaml").write_text(dump_yaml(OLD))
    Run(run, NEW, resume=True)
    Run(run, {**NEW, "backend": "auto"}, resume=True)  # a setting that was added since


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"z_star_shuffle": 4}, "z_star_shuffle: 3"),
        ({"training": {"batch": 4, "window_cache": 9}}, "training.window_cache: 8"),
        ({"features": {"align": "mean"}}, "features"),
    ],
)
def test_another_value_is_refused_under_the_new_name(run, change, named):
    (run / "config.yaml").write_text(dump_yaml(OLD))
    with pytest.raises(ConfigError, match=named):
        Run(run, NEW | change, resume=True)
