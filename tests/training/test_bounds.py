"""Every setting that is a number: values out of its range are refused by name."""

import math
import re
from collections.abc import Iterator
from typing import Any

import pytest
from small_runs import SMALL, small_values

from gesturekit.diffusion import DiffusionConfig
from gesturekit.errors import ConfigError
from gesturekit.multires import MultiresConfig
from gesturekit.training.config import build, to_dict

CONFIGS = {"diffusion": DiffusionConfig, "multires": MultiresConfig}
BESIDE = {"unpaired": {"corpus": "more.jsonl"}}
"""Settings of sections that are off by default."""
BOTH = {"seed": [-1], "eval_every": [-1], "smooth": [2.1]}
RANGES: dict[str, dict[str, list[Any]]] = {
    "diffusion": {
        **BOTH,
        "network.blocks": [10**9],
        "network.channels": [15, 0],  # of two heads
        "network.feedforward": [10**9],
        "network.farthest_view": [4],
        "network.dilations": [[], [2, -1]],
        "network.dropout": [1.0],
        "noise.steps": [10**9],
        "noise.first_beta": [1.0, 0.51],  # of 0.5 for the last
        "training.decay": [1.01],
        "training.dropout_condition": [1.01],
        "training.ema": [1.0],
        "augmentation.stretch_range": [0.51],
    },
    "multires": {
        **BOTH,
        "network.levels": [10**9],
        "network.channels": [[], [3, 0], [10**9]],
        "network.kernel": [4, 257],
        "training.betas": [[0.5], [0.5, 1.0]],
        "training.silence": [1.0],
        "styles.mixing": [1.01],
    },
}


def values_with(system: str, key: str, value: Any) -> dict[str, Any]:
    section, _, name = key.rpartition(".")
    change = {section: {**BESIDE.get(section, {}), name: value}} if section else {name: value}
    return small_values(system, "corpus.jsonl", "run", change)


def numbers(values: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, int | float]]:
    """Yield the dotted names of all settings that are numbers, and their values."""
    for name, value in values.items():
        if isinstance(value, dict):
            yield from numbers(value, f"{prefix}{name}.")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield f"{prefix}{name}", value


def refused(system: str, key: str, value: Any) -> bool:
    name = key.rpartition(".")[2]
    try:
        build(CONFIGS[system], values_with(system, key, value))
    except ConfigError as error:
        assert name in str(error), f"{key}={value}: {error}"
        return True
    return False


@pytest.mark.parametrize("system", CONFIGS)
def test_no_number_of_a_configuration_may_be_negative_or_infinite(system):
    sections = {"styles": {}} if system == "multires" else {}
    settings = small_values(system, "corpus.jsonl", "run", sections)
    found = dict(numbers(to_dict(build(CONFIGS[system], settings))))
    assert found.keys() > dict(numbers(SMALL[system])).keys()
    for key, value in found.items():
        wrong = [-1] if isinstance(value, int) else [-0.1, math.inf, math.nan]
        assert all(refused(system, key, one) for one in wrong), key


CASES = [(system, key) for system, ranges in RANGES.items() for key in ranges]


@pytest.mark.parametrize(("system", "key"), CASES, ids=map(" ".join, CASES))
def test_a_number_out_of_range_is_refused_by_name(system, key):
    build(CONFIGS[system], small_values(system, "corpus.jsonl", "run"))
    assert all(refused(system, key, value) for value in RANGES[system][key])


def test_parts_are_joints_of_known_names():
    for parts, says in (
        ({"left_elbo": "Joint3"}, "left_elbo & left_elbow"),
        ({"left_elbow": 3}, "left_elbow"),
        ("left_elbow", "parts & left_elbow"),
    ):
        with pytest.raises(ConfigError) as caught:
            build(DiffusionConfig, values_with("diffusion", "parts", parts))
        assert all(re.search(fact, str(caught.value)) for fact in says.split(" & "))


def test_a_stage_without_any_step_is_refused():
    nothing = {"training": {"generator_steps": 0, "reconstruction_steps": 0}}
    with pytest.raises(ConfigError, match="(?=.*generator_steps)(?=.*reconstruction_steps)"):
        build(MultiresConfig, small_values("multires", "corpus.jsonl", "run", nothing))
