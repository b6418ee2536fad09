"""The model that a multires run starts from: its settings, styles and motion vectors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import audio_features as af
from gesturekit.errors import ConfigError
from gesturekit.motion.motion import Motion
from gesturekit.multires.config import MultiresConfig, NetworkConfig
from gesturekit.multires.model import MultiresModel
from gesturekit.multires.motion_vector import MultiresRepresentation
from gesturekit.multires.networks import modulated_blocks
from gesturekit.training.config import to_dict
from gesturekit.training.data.features import conditioner_values, feature_values
from gesturekit.training.data.start_model import (
    check_conditions,
    check_rig,
    check_settings,
    model_of,
)


def load_start(config: MultiresConfig, extractor: af.Extractor | None) -> MultiresModel | None:
    """Load the model of `start_from`; None for a run that starts from random weights.

    Args:
        config: settings of the run.
        extractor: its speech features; None without speech input.

    Raises:
        ConfigError: the model has other settings or features.
        ModelError: the model cannot be read.
    """
    folder = config.start_from
    if folder is None:
        return None
    weights = None if config.features is None else config.features.encoder_places
    start = MultiresModel.load(model_of(folder), weights=weights)
    known = {
        "fps": start.fps,
        "normalise": bool(start.normaliser.mean.any()),
        "contact_threshold": start.representation.contact_speed,
        **_network(start.network_config),
    }
    wanted = {
        "fps": config.fps,
        "normalise": config.normalise,
        "contact_threshold": config.contact_threshold,
        **_network(config.network),
    }
    check_settings("start_from", folder, known, wanted)
    _check_inputs(start, config, extractor, folder)
    return start


def _network(config: NetworkConfig) -> dict[str, Any]:
    return {f"network.{name}": value for name, value in to_dict(config).items()}


def _check_inputs(
    start: MultiresModel, config: MultiresConfig, extractor: af.Extractor | None, folder: Path
) -> None:
    """Raise ConfigError if a model has other inputs than a run."""
    conditions = start.conditions
    conditioner, has_state = conditions.conditioner, conditions.state is not None
    known, wanted = None, None
    if conditioner is not None:
        known = {**conditioner_values(conditioner), "residual": conditions.residual}
    if extractor is not None and config.features is not None:
        wanted = {**feature_values(extractor, config.features), "residual": config.residual}
    check_conditions(folder, {"features": known}, {"features": wanted})
    # A model without a state may get one, unless the state hides columns of vocal effort from
    # the network, or the network has no layer for a condition.
    hides = conditioner is not None and bool(conditioner.effort)
    if hides or has_state or not conditions.width:
        check_settings("start_from", folder, {"state": has_state}, {"state": config.state})


def check_styles(
    start: MultiresModel | None, config: MultiresConfig, styles: Sequence[str]
) -> None:
    """Check that a model to start from, if any, has the recordings' styles; both may have none.

    Raises:
        ConfigError: a style that the model does not know, or only one of them has styles.
    """
    if start is not None and config.start_from is not None:
        known, wanted = {"styles": list(start.styles)}, {"styles": list(styles)}
        check_conditions(config.start_from, known, wanted)


def representation_on_bones_of(
    start: MultiresModel, config: MultiresConfig, motions: Sequence[Motion]
) -> MultiresRepresentation:
    """Return the model's motion vector, on the bones of the run's recordings.

    Raises:
        ConfigError: the recordings have another rig, or other parts of the body are identified.
    """
    folder, known = config.start_from, start.representation
    assert folder is not None
    check_rig("start_from", folder, known.skeleton, motions[0].skeleton, config.corpus)
    wanted = known.on_bones_of(motions)
    for what, joints in (("feet", _feet), ("upper body", _modulated)):
        before, now = joints(known, config), joints(wanted, config)
        if before != now:
            raise ConfigError(
                f"start_from: {folder} has {what} {before}, {config.corpus} {now}; name the parts "
                "of the rig by hand (parts: {left_knee: JOINT, ...})"
            )
    return wanted


def _feet(representation: MultiresRepresentation, _: MultiresConfig) -> list[str]:
    """Return the joint of each foot point."""
    return [point.joint for point in representation.foot_points]


def _modulated(representation: MultiresRepresentation, config: MultiresConfig) -> list[str]:
    """Return the joints that the condition modulates."""
    blocks = modulated_blocks(representation, config.network)
    return [name for name, chosen in zip(representation.joints, blocks, strict=False) if chosen]
