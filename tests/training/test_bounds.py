"""Every setting that is a number: values out of its range are refused by name, its ends are not."""

from __future__ import annotations

import math
from typing import Any

import pytest
from small_runs import small_values

from gesturekit.diffusion.config import DiffusionConfig
from gesturekit.errors import ConfigError
from gesturekit.multires.config import MultiresConfig
from gesturekit.training.config import build

CONFIGS = {"diffusion": DiffusionConfig, "multires": MultiresConfig}

WHOLE = ([0, -1], [1])
WIDTH = ([0, -1, 10**9], [1, 4096])
ABOVE_0 = ([0.0, -1.0, math.inf, math.nan], [1e-6])
FROM_0 = ([-0.1, math.inf, math.nan], [0.0])
COUNT_FROM_0 = ([-1], [0])
SHARE = ([-0.01, 1.01], [0.0, 1.0])
BELOW_1 = ([-0.01, 1.0], [0.0, 0.99])

BOTH = {
    "fps": ABOVE_0,
    "checkpoint_every": WHOLE,
    "log_every": WHOLE,
    "eval_every": COUNT_FROM_0,
    "seed": COUNT_FROM_0,
    "smooth": ([0.0, -1.0, 2.1, math.inf, math.nan], [1e-6, 2.0]),
    "in_memory": ABOVE_0,
    "workers": WHOLE,
    "threads": WHOLE,
    "features.components": WHOLE,
}
RANGES: dict[str, dict[str, tuple[list[Any], list[Any]]]] = {
    "diffusion": BOTH
    | {
        "network.blocks": ([0, -1, 10**9], [1, 1000]),
        "network.layers": ([0, -1, 10**9], [1, 1000]),
        "network.channels": ([0, -16, 15], [2, 16]),  # of two heads
        "network.heads": ([0, -1, 3], [1, 16]),  # of 16 channels
        "network.feedforward": WIDTH,
        "network.embedding": WIDTH,
        "network.kernels": WHOLE,
        "network.nearest_view": ([0, -1], [1, 75]),  # of 75 frames for the widest
        "network.farthest_view": ([4], [5]),
        "network.dilations": ([[], [2, -1]], [[0]]),
        "network.dropout": BELOW_1,
        "noise.steps": ([0, -1, 10**9], [1, 10_000]),
        "noise.first_beta": ([0.0, 1.0, 0.51], [0.5]),  # of 0.5 for the last
        "noise.last_beta": ([0.0, 1.0, 0.007], [0.0074, 0.99]),
        "training.updates": WHOLE,
        "training.batch": WHOLE,
        "training.window": ABOVE_0,
        "training.learning_rate": ABOVE_0,
        "training.decay": ([0.0, 1.01], [0.5, 1.0]),
        "training.dropout_condition": SHARE,
        "training.dropout_style": SHARE,
        "training.clip": FROM_0,
        "training.warm_up": COUNT_FROM_0,
        "training.ema": BELOW_1,
        "training.min_snr": ABOVE_0,
        "augmentation.stretch": SHARE,
        "augmentation.stretch_range": ([-0.01, 0.51], [0.0, 0.5]),
        "unpaired.share": SHARE,
    },
    "multires": BOTH
    | {
        "contact_threshold": ABOVE_0,
        "z_star_shuffle": COUNT_FROM_0,
        "noise_levels": WHOLE,
        "network.levels": ([0, -1, 10**9], [2, 64]),
        "network.channels": ([[], [3, 0], [10**9]], [[1]]),
        "network.kernel": ([0, -1, 4, 257], [1, 7, 255]),
        "network.neighbour_distance": COUNT_FROM_0,
        "network.embedding": WIDTH,
        **{
            f"losses.{name}": FROM_0
            for name in (
                *("adversarial", "gradient_penalty", "reconstruction", "contact", "smoothness"),
                *("arm_speed", "arm_acceleration", "detail", "coarse", "contact_slope"),
                "discriminator_scale",
            )
        },
        "losses.arm_floors": ([[1.0], [1.0, 0.0], [1.0, 1.0, 1.0]], [[0.1, 0.1]]),
        "training.first_stage": WHOLE,
        "training.further_stages": WHOLE,
        "training.discriminator_steps": COUNT_FROM_0,
        "training.generator_steps": COUNT_FROM_0,
        "training.reconstruction_steps": COUNT_FROM_0,
        "training.learning_rate": ABOVE_0,
        "training.betas": ([[0.5], [0.5, 1.0], [-0.1, 0.5]], [[0.0, 0.0]]),
        "training.decay_at": FROM_0,
        "training.batch": WHOLE,
        "training.window": ABOVE_0,
        "training.window_cache": WHOLE,
        "training.renew_every": WHOLE,
        "training.silence": BELOW_1,
        "styles.mixing": SHARE,
        "recall.level": ([0, -2, 3, 6], [2, 4]),  # of four levels, which train in pairs
        "recall.piece": ([0.0, -1.0, 0.7], [0.8]),  # twice an overlap of 0.4 s
        "recall.overlap": ([0.0, -1.0, 1.1], [1.0]),  # half a piece of 2 s
        "recall.minutes": ABOVE_0,
        "recall.stretch": ([0.04, 0.51, -0.1], [0.0, 0.05, 0.5]),
        "recall.own_movement": SHARE,
    },
}
BESIDE = {"recall": {"level": 2}}
"""Settings of a section that is off by default."""


def values_with(system: str, key: str, value: Any) -> dict[str, Any]:
    """Return the settings of a small run with one of them changed."""
    section, _, name = key.rpartition(".")
    change = {section: {**BESIDE.get(section, {}), name: value}} if section else {name: value}
    return small_values(system, "corpus.jsonl", "run", change)


CASES = [(system, key) for system, ranges in RANGES.items() for key in ranges]


@pytest.mark.parametrize(("system", "key"), CASES, ids=map(" ".join, CASES))
def test_a_number_out_of_range_is_refused_by_name(system, key):
    refused, allowed = RANGES[system][key]
    message = rf"(?=.*\b{key.rpartition('.')[2]}\b).* (must be|must divide|is above) "
    for value in refused:
        with pytest.raises(ConfigError, match=message):
            build(CONFIGS[system], values_with(system, key, value))
    for value in allowed:
        build(CONFIGS[system], values_with(system, key, value))


def test_parts_are_joints_of_known_names():
    for parts, message in (
        ({"left_elbo": "Joint3"}, "parts: 'left_elbo' is none of .*left_elbow"),
        ({"left_elbow": 3}, "parts.left_elbow: 3 is not a joint name"),
        ("left_elbow", "parts: 'left_elbow' is not a mapping"),
    ):
        with pytest.raises(ConfigError, match=message):
            build(DiffusionConfig, values_with("diffusion", "parts", parts))


def test_a_window_has_two_frames_at_least():
    for seconds, frames in ((0.01, 2), (0.1, 3), (2.0, 60)):
        values = values_with("diffusion", "training.window", seconds)
        assert build(DiffusionConfig, values).window_frames == frames


def test_a_stage_without_any_step_is_refused():
    values = small_values("multires", "corpus.jsonl", "run")
    nothing = {"generator_steps": 0, "reconstruction_steps": 0}
    with pytest.raises(ConfigError, match="nothing would be trained"):
        build(MultiresConfig, {**values, "training": nothing})
