"""Options and helpers that several commands share."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from gesturekit.model import Model

UNITS = ("m", "cm", "mm", "inch", "cmu")
AXES = ("x", "y", "z", "-x", "-y", "-z")

PATH = click.Path(path_type=Path)
FILE = click.Path(path_type=Path, dir_okay=False)
FOLDER = click.Path(path_type=Path, file_okay=False)
RATE = click.FloatRange(min=0, min_open=True, max=1000)
SEED = click.IntRange(0, 2**63 - 1)
"""Seeds that every random generator takes."""

Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


def together(*options: Decorator) -> Decorator:
    """Return a decorator that adds several options, in this order."""

    def add(command: Callable[..., Any]) -> Callable[..., Any]:
        for option in reversed(options):
            command = option(command)
        return command

    return add


recording_options = together(
    click.option("--in-unit", type=click.Choice(UNITS), help="Unit of the BVH or glTF input."),
    click.option("--in-up", type=click.Choice(AXES), help="Up axis of the input."),
    click.option("--in-forward", type=click.Choice(AXES), help="Forward axis of the input."),
    click.option("--in-fps", type=RATE, metavar="RATE", help="True frame rate of the input."),
    click.option(
        "--height",
        type=RATE,
        metavar="METRES",
        help="Scale the body to this height.",
    ),
    click.option(
        "--body-model",
        type=PATH,
        metavar="PATH",
        help="SMPL, SMPL-H or SMPL-X body model, or a folder of them: bones, foot points, a mesh.",
    ),
    click.option("--person", type=int, metavar="ID", help="Person to read (EasyMocap)."),
)
"""Options that override what is detected in recordings; see `read_from`."""
RECORDING_OPTIONS = ("in_unit", "in_up", "in_forward", "in_fps", "height", "body_model", "person")
"""Names of the parameters that `recording_options` adds."""
reading_options = together(
    recording_options,
    click.option("--animation", metavar="NAME", help="Animation to read: its name, or number."),
)
"""The same for motion files of any format."""

channel_option = click.option(
    "--channel", type=click.IntRange(min=1), help="Channel to use, from 1.  [default: their mean]"
)
part_option = click.option(
    *("--part", "parts"),
    multiple=True,
    metavar="PART=JOINT",
    help="Name a joint that is not recognised: left_elbow=Joint12. May be repeated.",
)
rig_options = together(
    click.option(
        "--rig", metavar="RIG", help="Skeleton to retarget to: a motion file, smpl, smplh or smplx."
    ),
    click.option(
        *("--rig-part", "rig_parts"),
        multiple=True,
        metavar="PART=JOINT",
        help="Name a joint of --rig that is not recognised. May be repeated.",
    ),
)
unit_options = together(
    click.option("--unit", type=click.Choice(UNITS), help="Unit of BVH files.  [default: cm]"),
    click.option(
        "--up", type=click.Choice(["y", "z"]), help="Up axis of SMPL npz files; AMASS has z."
    ),
)


def parse_weights(
    ctx: click.Context, _: click.Parameter, values: tuple[str, ...]
) -> Path | dict[str, Path] | None:
    """Parse --weights: one path, or KIND=PATH once for each encoder, to {kind: path}."""
    places: dict[str, Path] = {}
    for value in values:
        kind, mark, path = value.partition("=")
        if not mark or Path(value).exists():
            if len(values) > 1:
                raise click.UsageError(f"--weights {value}: of several, give each as KIND=PATH.")
            return Path(value)
        if kind in places:
            raise click.UsageError(f"--weights: {kind} is given twice.")
        places[kind] = Path(path)
    return places or None


weights_option = click.option(
    "--weights",
    multiple=True,
    callback=parse_weights,
    metavar="[KIND=]PATH",
    help="Weights of the encoder, or folder of own features; of several, wavlm=PATH files=FOLDER.",
)


def service_options(port: int) -> Decorator:
    """Add the address of a service, with its usual port, and who may use it."""
    return together(
        click.option("--host", default="127.0.0.1", help="Address; others require a token."),
        click.option("--port", type=click.IntRange(0, 65535), default=port),
        click.option(
            *("--name", "names"),
            multiple=True,
            metavar="NAME",
            help="Additional host name, such as that of a proxy. May be repeated.",
        ),
        click.option(
            "--token-file",
            type=click.Path(path_type=Path, dir_okay=False, exists=True),
            help="File with the token that requests must send.  [default: $GESTUREKIT_TOKEN]",
        ),
    )


seed_option = click.option("--seed", type=SEED, default=0, help="Random seed.")
device_option = click.option(
    "--device", default="cpu", help="Device of diffusion and encoders: cpu, cuda, cuda:1, auto."
)
workers_option = click.option(
    "--workers", type=click.IntRange(1, 1024), default=1, help="Number of processes."
)
size_option = click.option(
    "--size", type=click.Choice(["720p", "1080p"]), help="Size of mp4 videos.  [default: 720p]"
)
framing_option = click.option(
    "--framing",
    type=click.Choice(["whole", "waist", "face"]),
    help="View of videos, and the first of pages.  [default: whole]",
)


class ModelName(click.ParamType):
    """The name of a bundled model, or a model folder."""

    name = "model"

    def get_missing_message(self, param: Any = None, ctx: Any = None) -> str:
        """Return which models there are: the bundled one, and those of the newest runs."""
        files = Path("runs").glob("*/model/config.yaml")
        newest = sorted(files, key=lambda file: file.stat().st_mtime, reverse=True)
        names = ", --model ".join(["demo", *(click.format_filename(f.parent) for f in newest[:3])])
        return f"Give a bundled model or a model folder: --model {names}"


model_option = click.option(
    "--model", required=True, type=ModelName(), help="A bundled name (demo) or a model folder."
)


def _output_folder(ctx: click.Context, _: click.Parameter, out: Path) -> Path:
    """Return the output folder; a file is refused, and so is the name of a motion file."""
    from gesturekit.formats.registry import WRITABLE

    kind = out.suffix[1:].lower()
    if out.is_file() or (kind in WRITABLE and not out.exists()):
        named = kind in WRITABLE and any(param.name == "formats" for param in ctx.command.params)
        instead = f"{out.with_suffix('')}{f' --format {kind}' if named else ''}"
        raise click.UsageError(f"--out {out}: results go into a folder: --out {instead}")
    return out


output_folder_option = click.option(
    *("-o", "--out"), required=True, type=PATH, callback=_output_folder, help="Output folder."
)


class Body(click.Choice):
    """A body of the package, or the file of an avatar."""

    def __init__(self) -> None:
        super().__init__(["mannequin", "human", "skeleton"])

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return a body, or the path of an avatar."""
        if value in self.choices or str(value).lower().endswith((".vrm", ".glb")):
            return value
        self.fail(f"{value!r} is none of {', '.join(self.choices)}, FILE.vrm, FILE.glb", param)


body_option = click.option(
    "--body",
    type=Body(),
    metavar="[mannequin|human|skeleton|FILE.vrm|FILE.glb]",
    help="Body that is drawn: one of ours, or an avatar (VRM, or glb with Mixamo's names).  "
    "[default: mannequin; human for the demo model]",
)


def read_from(reading: dict[str, Any]) -> dict[str, Any]:
    """Return the `reading_options` that were given, by the readers' names for them."""
    return given(**{name.removeprefix("in_"): value for name, value in reading.items()})


def given(**options: Any) -> dict[str, Any]:
    """Return the options that are not None."""
    return {name: value for name, value in options.items() if value is not None}


def comma_separated(text: str | None) -> list[str]:
    """Return the items of a comma-separated list."""
    return [name.strip() for name in (text or "").split(",") if name.strip()]


def parse_expert(
    text: str, open_model: Callable[[str], Model]
) -> tuple[Model, float | str | None, str | None]:
    """Parse MODEL[:WEIGHT[:STYLE]]; a weight with times stays a string."""
    model, _, rest = text.partition(":")
    weight, _, style = rest.partition(":")
    try:
        share = weight if "@" in weight else float(weight) if weight else None
    except ValueError:
        how = "expected MODEL[:WEIGHT[:STYLE]]"
        raise click.UsageError(f"--expert {text}: {weight!r} is not a weight; {how}.") from None
    return open_model(model), share, style or None


def parse_placed_files(text: str) -> dict[float, Path]:
    """Parse a.bvh@0,b.bvh@6 to files by the second at which they begin; without @ at 0."""
    from gesturekit.model import split_seconds

    placed: dict[float, Path] = {}
    for item in comma_separated(text):
        name, seconds = split_seconds(item)
        begin = seconds or 0.0
        if begin in placed:
            both = f"{placed[begin]} and {name} both begin at {begin:g} s"
            raise click.UsageError(f"--keep: {both}; give a time, such as b.bvh@6.")
        placed[begin] = Path(name)
    return placed


def parse_level_files(text: str) -> dict[str, Path]:
    """Parse 1-4=a.wav,7-10=b.wav to files by levels."""
    pairs = [item.partition("=") for item in comma_separated(text)]
    for levels, _, name in pairs:
        if not name:
            raise click.UsageError(f"--level-speech: {levels!r} names no file: 7-10=b.wav does.")
    return {levels: Path(name) for levels, _, name in pairs}


def take_option(effect: str) -> Decorator:
    """Add --take-pattern and --take-table; `effect` says what goes by takes."""
    pattern = click.option(
        "--take-pattern",
        metavar="REGEX",
        help=f"Session of a recording cut into files, by its name: '(.*)_part[0-9]+'. {effect}",
    )
    table = click.option(
        "--take-table",
        type=PATH,
        metavar="FILE.csv",
        help="Take the sessions from a table with the columns id,take instead.",
    )
    return lambda command: pattern(table(command))


def existing_option(default: str, *, note: str = "") -> Decorator:
    """Add --existing; `note` is added to the help text."""
    return click.option(
        "--existing",
        type=click.Choice(["refuse", "skip", "replace"]),
        default=default,
        help=f"What to do if an output exists{note}.",
    )


def is_left(files: Sequence[Path], existing: str) -> bool:
    """Return whether outputs exist and are kept; if so, print them.

    Raises:
        ConfigError: one exists, and `existing` is "refuse".
    """
    there = [file for file in files if file.exists()]
    if not there or existing == "replace":
        return False
    if existing == "refuse":
        from gesturekit.jobs.batch import refuse_existing

        refuse_existing(there)
    click.echo(f"{', '.join(map(str, there))}: skipped, exists already", err=True)
    return True


@contextmanager
def resumable(hint: Callable[[], str]) -> Iterator[None]:
    """On Ctrl-C, print how to continue and exit with code 130."""
    try:
        yield
    except KeyboardInterrupt:
        click.echo(f"Interrupted. {hint()}", err=True)
        raise click.exceptions.Exit(130) from None


ARGUMENTS = "gesturekit: arguments"
"""Key of a context's `meta`: the arguments of the command as they were given."""


ALL_OPTIONS = "gesturekit: all options"
"""Key of a context's `meta`: whether the help shows all options."""
_MOST_OPTIONS = 20
"""Options that the help shows at most, unless all are asked for."""


def _show_all(ctx: click.Context, _: click.Parameter, is_given: bool) -> None:
    if is_given:
        ctx.meta[ALL_OPTIONS] = True
        click.echo(ctx.get_help())
        ctx.exit()


class GroupedCommand(click.Command):
    """A command whose help shows its examples first, and its options in groups.

    If there are more than 20, --help-all shows all of them.

    Args:
        groups: names of its parameters by heading; all others come last.
        usual: names of the parameters that --help shows; by default the first ones.
    """

    def __init__(
        self, *args: Any, groups: Mapping[str, Sequence[str]], usual: Sequence[str] = (), **kw: Any
    ) -> None:
        super().__init__(*args, **kw)
        self.groups, self._usual = groups, usual
        if (count := sum(isinstance(p, click.Option) for p in self.params)) >= _MOST_OPTIONS:
            about = {"is_flag": True, "is_eager": True, "expose_value": False}
            note = f"Show all {count + 2} options."
            self.params.append(click.Option(["--help-all"], callback=_show_all, help=note, **about))

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments, and keep them for launchers, which repeat the command elsewhere."""
        ctx.meta[ARGUMENTS] = tuple(args)
        return super().parse_args(ctx, args)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the examples, then each group under its heading."""
        with formatter.section("Examples"):
            for line in (self.epilog or "").splitlines():
                formatter.write(f"{'':{formatter.current_indent}}{line}\n")
        named = [name for names in self.groups.values() for name in names]
        params = [p for p in self.get_params(ctx) if isinstance(p, click.Option)]
        rest = [param.name for param in params if param.name not in named]
        if len(params) > _MOST_OPTIONS and not ctx.meta.get(ALL_OPTIONS):
            usual = self._usual or [*named, *rest]
            shown = {*usual[: _MOST_OPTIONS - 2], params[-1].name, "help_all"}  # the last is --help
            params = [param for param in params if param.name in shown]
        last = "Other options" if named else "Options"
        for heading, names in {**self.groups, last: rest}.items():
            records = [param.get_help_record(ctx) for param in params if param.name in names]
            if rows := [record for record in records if record is not None]:
                with formatter.section(heading):
                    formatter.write_dl(rows)

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write nothing: the examples stand before the options."""
