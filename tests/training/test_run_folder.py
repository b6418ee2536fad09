"""A run is resumed with its own settings only."""

from __future__ import annotations

import pytest

from gesturekit.errors import ConfigError
from gesturekit.training.run.folder import Run

SETTINGS = {"seed": 3, "training": {"batch": 4, "window": 8}, "features": None, "log_every": 10}


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"seed": 4}, "seed: 3"),
        ({"training": {"batch": 4, "window": 9}}, "training.window: 8"),
        ({"features": {"align": "mean"}}, "features"),
        ({"backend": "auto"}, "backend: None"),
    ],
)
def test_other_settings_than_those_of_the_run_are_refused(tmp_path, change, named):
    Run(tmp_path / "run", SETTINGS, resume=False).begin()
    Run(tmp_path / "run", SETTINGS | {"log_every": 1}, resume=True)  # changes no result
    with pytest.raises(ConfigError, match=named):
        Run(tmp_path / "run", SETTINGS | change, resume=True)
