"""Options that several verbs have, and what their commands share."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

UNITS = ("m", "cm", "mm", "inch", "cmu")
AXES = ("x", "y", "z", "-x", "-y", "-z")

RATE = click.FloatRange(min=0, min_open=True, max=1000)


_OPTIONS = (
    click.option("--in-unit", type=click.Choice(UNITS), help="Unit of a BVH that is read."),
    click.option("--in-up", type=click.Choice(AXES), help="Its axis that points up."),
    click.option("--in-forward", type=click.Choice(AXES), help="Its axis that points forward."),
    click.option(
        "--in-fps", type=RATE, metavar="RATE", help="Its true frame rate, whatever it says."
    ),
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


def read_from(reading: dict[str, Any]) -> dict[str, Any]:
    """Return the `reading_options` that were given, under the names that readers have for them."""
    return given(**{name.removeprefix("in_"): value for name, value in reading.items()})


def given(**options: Any) -> dict[str, Any]:
    """The options that were given."""
    return {name: value for name, value in options.items() if value is not None}


def comma_separated(text: str | None) -> list[str]:
    """Items between commas."""
    return [name.strip() for name in (text or "").split(",") if name.strip()]


def existing_option(default: str, *, alias: bool = False, note: str = "") -> Callable[..., Any]:
    """Add --existing, with --skip-existing as another name of `--existing skip`.

    Args:
        default: refuse, skip or replace.
        alias: whether there is --skip-existing.
        note: what else the help says of it.
    """

    skip_by_alias = "--skip-existing"

    def remember(ctx: click.Context, _: click.Parameter, given: bool) -> None:
        ctx.meta[skip_by_alias] = given

    def choose(ctx: click.Context, _: click.Parameter, value: str) -> str:
        return "skip" if ctx.meta.get(skip_by_alias) else value

    def add(command: Callable[..., Any]) -> Callable[..., Any]:
        if alias:
            command = click.option(
                *("--skip-existing", "skip_existing"),
                is_flag=True,
                is_eager=True,
                expose_value=False,
                callback=remember,
                help="The same as --existing skip.",
            )(command)
        return click.option(
            "--existing",
            type=click.Choice(["refuse", "skip", "replace"]),
            default=default,
            callback=choose,
            help=f"What to do where an output exists{note}.  [default: {default}]",
        )(command)

    return add


def is_left(files: Sequence[Path], existing: str) -> bool:
    """Tell whether outputs that exist are to be left as they are, which is then printed.

    Raises:
        ConfigError: one exists, and `existing` is "refuse".
    """
    there = [file for file in files if file.exists()]
    if not there or existing == "replace":
        return False
    if existing == "refuse":
        from gesturekit.formats.sources import refuse_existing

        refuse_existing(there)
    click.echo(f"{', '.join(map(str, there))}: left as it is", err=True)
    return True


@contextmanager
def resumable(hint: Callable[[], str]) -> Iterator[None]:
    """On Ctrl-C, say how to go on and leave with exit code 130."""
    try:
        yield
    except KeyboardInterrupt:
        click.echo(f"Interrupted. {hint()}", err=True)
        raise click.exceptions.Exit(130) from None


class GroupedCommand(click.Command):
    """A command whose help shows its examples first, and its options in groups.

    Args:
        groups: heading to the names of its parameters; all others come last.
    """

    def __init__(self, *args: Any, groups: Mapping[str, Sequence[str]], **options: Any) -> None:
        super().__init__(*args, **options)
        self.groups = groups

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the examples, then each group under its heading."""
        with formatter.section("Examples"):
            for line in (self.epilog or "").splitlines():
                formatter.write(f"{'':{formatter.current_indent}}{line}\n")
        named = {name for names in self.groups.values() for name in names}
        params = [p for p in self.get_params(ctx) if isinstance(p, click.Option)]
        rest = [param.name for param in params if param.name not in named]
        for heading, names in {**self.groups, "Other options": rest}.items():
            records = [param.get_help_record(ctx) for param in params if param.name in names]
            if rows := [record for record in records if record is not None]:
                with formatter.section(heading):
                    formatter.write_dl(rows)

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write nothing: the examples stand before the options."""
