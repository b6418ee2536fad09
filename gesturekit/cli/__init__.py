"""Command line: one file for each command, which only parses, calls the API and prints.

Exit codes: 0 all done; 1 some or all items failed, each listed with its reason; 2 nothing could
start (bad usage, bad config); 130 on Ctrl-C.
"""

from __future__ import annotations

import importlib
import os
import re
import signal
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from typing import Any, TextIO

import click

from gesturekit.wording import did_you_mean

VERBS = (
    "demo",
    "features",
    "prepare",
    "recipes",
    "train",
    "render",
    "jobs",
    "serve",
    "live",
    "convert",
    "inspect",
    "view",
    "evaluate",
    "study",
    "genea",
    "fit-features",
    "convert-checkpoint",
    "cache",
    "doctor",
)


class VerbGroup(click.Group):
    """A group that imports the module of a command on first use."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the commands in the order of a typical workflow."""
        return list(VERBS)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        """Return the command of this name; None if there is none."""
        if name not in VERBS:
            return None
        return importlib.import_module(f"gesturekit.cli.{name.replace('-', '_')}").command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command; the error names the closest match."""
        name = args[0]
        if name in VERBS or name.startswith("-"):
            return super().resolve_command(ctx, args)
        hint = did_you_mean(name.lower(), VERBS) or f"it is one of {', '.join(VERBS)}."
        raise click.UsageError(f"{name!r} is not a command: {hint}", ctx)


@click.group(
    cls=VerbGroup,
    epilog="Start with: gesturekit demo",
    context_settings={
        "help_option_names": ["-h", "--help"],
        "max_content_width": 100,
        "show_default": True,
    },
)
@click.version_option(package_name="gesturekit")
def cli() -> None:
    """Generate body motion from speech: train on your WAV + BVH, render WAVs to BVH, npz, HTML."""


class _Visible:
    """Text stream that writes control characters of names, such as U+202E, as escapes.

    It lets pass those of progress bars: carriage return, and cursor up.
    """

    _CONTROL = re.compile(
        r"[\0-\x08\x0b\x0c\x0e-\x1a\x1c-\x1f\x7f-\x9f\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069]"
        r"|\x1b(?!\[A)"
    )

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write a text."""
        escaped = self._CONTROL.sub(lambda sign: ascii(sign[0])[1:-1], text)
        return self._stream.write(escaped)


_CLEAN_UP = 5.0
"""Seconds after Ctrl-C in which another one does not disturb the clean-up."""


@contextmanager
def _one_interrupt() -> Iterator[None]:
    """Raise KeyboardInterrupt at the first Ctrl-C alone; one after `_CLEAN_UP` ends the process."""
    first: list[float] = []

    def interrupt(*_: Any) -> None:
        first.append(time.monotonic())
        if len(first) == 1:
            raise KeyboardInterrupt
        if first[-1] - first[0] > _CLEAN_UP:
            os._exit(130)

    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    finally:
        # The process ends; another Ctrl-C while Python does so would change its exit code.
        signal.signal(signal.SIGINT, signal.SIG_IGN if first else signal.default_int_handler)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit with the codes listed at the top of this file."""
    out, err = _Visible(sys.stdout), _Visible(sys.stderr)
    with _one_interrupt(), redirect_stdout(out), redirect_stderr(err):
        status = _status(arguments)
    sys.exit(status)


def _status(arguments: list[str] | None) -> int:
    from audio_features.errors import AudioFeaturesError
    from gesturekit.errors import GestureKitError

    try:
        with warnings.catch_warnings():
            # Only the text of a warning: its place in our code does not help a user.
            warnings.showwarning = lambda message, *_, **__: click.echo(
                f"Warning: {message}", err=True
            )
            status = cli.main(arguments, prog_name="gesturekit", standalone_mode=False)
    except click.ClickException as error:
        error.show()
        status = 2
    except (click.Abort, KeyboardInterrupt) as error:
        click.echo(f"Interrupted. {error.__cause__ or error}".rstrip(), err=True)
        status = 130
    except (GestureKitError, AudioFeaturesError) as error:
        click.echo(f"Error: {error}", err=True)
        status = 2
    except OSError as error:
        # A folder that cannot be created, a full disk: the system's message without its number.
        where = f"{error.filename}: " if error.filename else ""
        click.echo(f"Error: {where}{error.strerror or error}", err=True)
        status = 2
    return status or 0
