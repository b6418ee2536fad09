"""Renamed settings: old names still work in files, overrides, run and model folders."""

from __future__ import annotations

import copy
import logging
from typing import Any

from gesturekit.errors import ConfigError

RENAMED_KEYS = {
    "recall": "z_star_shuffle",
    "losses.critic_scale": "losses.discriminator_scale",
    "styles.told": "styles.condition_discriminator",
    "schedule.first_pair": "training.first_stage",
    "schedule.further_pairs": "training.further_stages",
    "schedule.bank": "training.window_cache",
    "schedule.renew": "training.renew_every",
    "schedule": "training",
}
"""{old: new}, dotted. A renamed section stands after its settings: it moves what is left."""

log = logging.getLogger(__name__)


def with_new_keys(values: dict[str, Any], where: str, *, quiet: bool = False) -> dict[str, Any]:
    """Return a configuration with the new name of each renamed setting.

    Args:
        values: nested mappings, as read.
        where: the file or the command line, for messages.
        quiet: do not log the new names.

    Raises:
        ConfigError: both the old and the new name of a setting are given.
    """
    values = copy.deepcopy(values)
    moved = []
    for old, new in RENAMED_KEYS.items():
        section, _, leaf = old.rpartition(".")
        inside = values.get(section) if section else values
        if not isinstance(inside, dict) or leaf not in inside:
            continue
        if old == "recall" and (
            isinstance(inside[leaf], bool) or not isinstance(inside[leaf], int)
        ):
            continue  # the section that has this name today
        value = inside.pop(leaf)
        if section and not inside:
            del values[section]
        # A renamed section moves its settings into the section of the new name.
        is_section = isinstance(value, dict)
        names = [(f"{old}.{key}", f"{new}.{key}") for key in value] if is_section else [(old, new)]
        settings = list(value.values()) if is_section else [value]
        for (old_name, new_name), setting in zip(names, settings, strict=True):
            target, _, new_leaf = new_name.rpartition(".")
            target_values = values.setdefault(target, {}) if target else values
            if not isinstance(target_values, dict):
                raise ConfigError(f"{where}: {target} must hold keys, not {target_values!r}")
            if new_leaf in target_values:
                raise ConfigError(
                    f"{where}: {old_name} is the old name of {new_name}: give one of them"
                )
            target_values[new_leaf] = setting
        moved.append(f"{old} is now {new}")
    if moved and not quiet:
        log.info("%s: renamed settings: %s", where, ", ".join(moved))
    return values
