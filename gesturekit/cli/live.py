"""gesturekit live: motion for speech while it is spoken."""

from __future__ import annotations

import json
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import click

from audio_features.atomic import write_text
from gesturekit.cli.options import (
    SEED,
    Body,
    GroupedCommand,
    access_options,
    comma_separated,
    existing_option,
    framing_option,
    given,
    is_left,
    weights_option,
)

EXAMPLES = """\
gesturekit live                                            # microphone to a page, demo model
gesturekit live --model runs/mine/model --from mic:USB --to page,vmc:127.0.0.1:39539
gesturekit live --from speech.wav --to page,record:take.bvh
gesturekit live --from - --rate 48000 --to page            # samples from another program's output
gesturekit live --measure --json latency.json
gesturekit live --fit corpus.jsonl --model runs/mine/model   # a model without live predictions
"""
_CONTROLS = ("style", "speaker", "liveliness")
GROUPS = {
    "What to generate": ("model", "source", "rate", "look_ahead", "seed", *_CONTROLS, "weights"),
    "Output": ("sinks", "existing", "host", "port", "names", "token_file", "body", "framing"),
}
_RECORD = "record:"
_URGENT = 3
"""Number of Ctrl-C that end the command at once, without the recording."""


@click.command("live", cls=GroupedCommand, groups=GROUPS, epilog=EXAMPLES)
@click.argument("words", nargs=-1, metavar="")
@click.option(
    "--model", default="demo", show_default=True, help="A bundled name or a model folder."
)
@click.option(
    "--from",
    "source",
    metavar="mic[:DEVICE]|FILE|-",
    help="Microphone (a number or part of a name chooses one), sound file in real time, or samples "
    "of 16 bits, little endian, mono from standard input.  [default: mic]",
)
@click.option(
    "--to",
    "sinks",
    metavar="LIST",
    help="page (in the browser), vmc:HOST:PORT (VSeeFace, Warudo, Unity, Unreal, Blender), "
    "record:FILE (any format that is written); comma-separated.  [default: page]",
)
@click.option(
    "--look-ahead",
    type=click.FloatRange(0, 10),
    default=0.2,
    show_default=True,
    help="Seconds of sound that the model knows beyond a frame; with less, motion fits worse.",
)
@click.option("--seed", type=SEED, default=0, show_default=True, help="Random seed.")
@click.option("--style", help="Style, for models with styles; by default one is drawn.")
@click.option("--speaker", help="Recordings and body of this speaker of the corpus.")
@click.option(
    "--liveliness", type=float, help="Factor on the hand speed that is drawn.  [default: 1]"
)
@click.option("--fast", is_flag=True, help="As fast as possible, for a file or a pipe.")
@click.option(
    "--block",
    type=click.FloatRange(0.005, 1),
    default=0.04,
    show_default=True,
    help="Seconds of sound of each step.",
)
@click.option(
    "--rate",
    type=click.IntRange(4_000, 192_000),
    default=16_000,
    show_default=True,
    help="Samples per second of standard input.",
)
@click.option(
    "--host",
    default="127.0.0.1",
    show_default=True,
    help="Address of the page. Addresses other than this machine require a token.",
)
@click.option("--port", type=click.IntRange(0, 65535), default=8010, show_default=True)
@access_options
@click.option(
    "--body",
    type=Body(),
    metavar="[mannequin|human|skeleton|FILE.vrm|FILE.glb]",
    default="human",
    show_default=True,
    help="Body on the page.",
)
@framing_option
@existing_option("refuse")
@weights_option
@click.option("--device", default="cpu", show_default=True, help="cpu, cuda, cuda:1, or auto.")
@click.option(
    "--fit",
    "corpus",
    type=click.Path(path_type=Path),
    metavar="CORPUS.jsonl",
    help="Add what live speech needs to the model, from the corpus of its training, and end.",
)
@click.option("--list-devices", is_flag=True, help="List microphones and end.")
@click.option(
    "--measure",
    is_flag=True,
    help="Print latency, step times and losses at the end; by default of the bundled speech.",
)
@click.option(
    "--json",
    "figures",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Write what --measure prints, as JSON.",
)
@click.pass_context
def command(ctx: click.Context, **options: Any) -> None:
    """Generate motion while someone speaks, and show, send or record it.

    Ctrl-C ends it; a recording is then whole. Multires speech models with a state of movement can
    do it.
    """
    begun = time.perf_counter()
    from gesturekit.live.session import Report, Session
    from gesturekit.live.sinks import partial_of
    from gesturekit.live.sources import devices
    from gesturekit.systems import bundled_speech, fit_live, load

    if words := options.pop("words"):
        raise click.UsageError(
            f"{words[0]!r}: sound is given by --from, and outputs by --to: gesturekit live --from "
            "speech.wav --to page,record:take.bvh"
        )
    if (corpus := options.pop("corpus")) is not None:
        fit_live(options["model"], corpus)
        return
    if options.pop("list_devices"):
        click.echo(devices())
        return
    measure, figures = options.pop("measure"), options.pop("figures")
    options["sinks"] = tuple(comma_separated(options["sinks"] or ("" if measure else "page")))
    options["source"] = options["source"] or (str(bundled_speech()) if measure else "mic")
    files = [Path(sink[len(_RECORD) :]) for sink in options["sinks"] if sink.startswith(_RECORD)]
    if is_left([*files, *map(partial_of, files)], options.pop("existing")):
        return
    model = {name: options.pop(name) for name in ("model", "weights", "device")}
    controls = given(**{name: options.pop(name) for name in _CONTROLS})
    session = Session(**given(**options), controls=controls, say=partial(click.echo, err=True))
    report = Report(begun=begun)
    with _ended_by_signals() as stopped:
        session.run(lambda: load(**model), report, stopped)
    if figures is not None:
        write_text(figures, json.dumps(report.figures(), indent=2) + "\n")
    if measure:
        for name, value in report.figures().items():
            click.echo(f"{name.replace('_', ' '):24} {'-' if value is None else f'{value:.3f}'}")
    else:
        click.echo(report.line(), err=True)
    ctx.exit(130 if stopped.is_set() else 1 if report.failures else 0)


@contextmanager
def _ended_by_signals() -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C and SIGTERM set, so that the end is orderly."""
    stopped, n_signals = threading.Event(), 0

    def stop(*_: object) -> None:
        nonlocal n_signals
        n_signals += 1
        stopped.set()
        if n_signals >= _URGENT:
            raise KeyboardInterrupt

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stopped
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
