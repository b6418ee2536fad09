"""The command line: one file a verb. A verb parses, calls the API, and prints; nothing else.

Exit codes: 0 all done; 1 some or all items failed, each listed with its reason; 2 nothing could
start (bad usage, bad config); 130 on Ctrl-C.
"""

from __future__ import annotations

import difflib
import importlib
import sys
import warnings

import click

VERBS = (
    "demo",
    "features",
    "prepare",
    "train",
    "render",
    "convert",
    "inspect",
    "view",
    "evaluate",
    "fit-features",
    "cache",
    "doctor",
)


class VerbGroup(click.Group):
    """Imports a verb's module when it is asked for."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """The verbs, in the order in which one meets them."""
        return list(VERBS)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        """The verb of this name; None where there is none."""
        if name not in VERBS:
            return None
        return importlib.import_module(f"gesturekit.cli.{name.replace('-', '_')}").command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the verb, or name the one that was probably meant."""
        name = args[0]
        if name in VERBS or name.startswith("-"):
            return super().resolve_command(ctx, args)
        near = difflib.get_close_matches(name.lower(), VERBS, n=1)
        hint = f"did you mean {near[0]}?" if near else f"it is one of {', '.join(VERBS)}."
        raise click.UsageError(f"{name!r} is no command: {hint}", ctx)


@click.group(
    cls=VerbGroup,
    epilog="Start with: gesturekit demo",
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(package_name="gesturekit")
def cli() -> None:
    """Turn speech into body motion: train on your own wav + BVH, render wavs to BVH, npz, HTML."""


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and leave with the exit codes named at the top of this file."""
    from audio_features.errors import AudioFeaturesError
    from gesturekit.errors import GestureKitError

    try:
        with warnings.catch_warnings():
            # In the words of the warning alone: where it stands in our code helps nobody.
            warnings.showwarning = lambda message, *_, **__: click.echo(
                f"Warning: {message}", err=True
            )
            status = cli.main(arguments, prog_name="gesturekit", standalone_mode=False)
    except click.ClickException as error:
        error.show()
        status = 2
    except (click.Abort, KeyboardInterrupt):
        click.echo("Interrupted.", err=True)
        status = 130
    except (GestureKitError, AudioFeaturesError) as error:
        click.echo(f"Error: {error}", err=True)
        status = 2
    except OSError as error:
        # A folder that cannot be made, a full disk: the system's own words, without its numbers.
        where = f"{error.filename}: " if error.filename else ""
        click.echo(f"Error: {where}{error.strerror or error}", err=True)
        status = 2
    sys.exit(status or 0)
