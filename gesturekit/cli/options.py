"""Options that several verbs have: how a motion or sound file is to be read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

UNITS = ("m", "cm", "mm", "inch", "cmu")
AXES = ("x", "y", "z", "-x", "-y", "-z")

RATE = click.FloatRange(min=0, min_open=True, max=1000)


_RECORDING = (
    click.option("--in-unit", type=click.Choice(UNITS), help="Unit of a BVH that is read."),
    click.option("--in-up", type=click.Choice(AXES), help="Its axis that points up."),
    click.option("--in-forward", type=click.Choice(AXES), help="Its axis that points forward."),
    click.option(
        "--in-fps", type=RATE, metavar="RATE", help="Its true frame rate, whatever it says."
    ),
    click.option(
        "--height",
        type=click.FloatRange(min=0, min_open=True, max=1000),
        metavar="METRES",
        help="Scale the body to this height, sole to crown, whatever its file says: 1.75.",
    ),
)
RECORDING_OPTIONS = ("in_unit", "in_up", "in_forward", "in_fps", "height")
"""Names of the parameters that `recording_options` adds."""
_OPTIONS = (
    *_RECORDING,
    click.option("--person", type=int, metavar="ID", help="Whom to read, of several (EasyMocap)."),
    click.option(
        "--body-model",
        type=click.Path(path_type=Path),
        metavar="NPZ",
        help="SMPL or SMPL-X model: true bones for SMPL files, a skin for html and obj.",
    ),
)

channel_option = click.option(
    "--channel",
    type=click.IntRange(min=1),
    help="Channel to take, from 1 (left), where two speakers share a file.  [default: the mean]",
)

part_option = click.option(
    "--part",
    "parts",
    multiple=True,
    metavar="PART=JOINT",
    help="Name a joint that is not recognised, as left_elbow=Joint12. May be repeated.",
)

rig_part_option = click.option(
    "--rig-part",
    "rig_parts",
    multiple=True,
    metavar="PART=JOINT",
    help="Name a joint of --rig that is not recognised, as left_elbow=Joint12. May be repeated.",
)


def reading_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options that overrule what is detected in a motion file; see `read_from`."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command


def recording_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add those of `reading_options` that recordings of a corpus (BVH and npz) can need."""
    for option in reversed(_RECORDING):
        command = option(command)
    return command


def read_from(reading: dict[str, Any]) -> dict[str, Any]:
    """What `reading_options` were given, under the names that readers have for them."""
    return given(**{name.removeprefix("in_"): value for name, value in reading.items()})


def given(**options: Any) -> dict[str, Any]:
    """The options that were given."""
    return {name: value for name, value in options.items() if value is not None}


def comma_separated(text: str | None) -> list[str]:
    """Items between commas."""
    return [name.strip() for name in (text or "").split(",") if name.strip()]
