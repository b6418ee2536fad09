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
    FILE,
    PATH,
    Body,
    GroupedCommand,
    comma_separated,
    device_option,
    existing_option,
    framing_option,
    given,
    is_left,
    seed_option,
    service_options,
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
_PAGE = ("host", "port", "names", "token_file", "body", "framing")
GROUPS = {
    "What to generate": ("model", "source", "rate", "look_ahead", "seed", *_CONTROLS, "weights"),
    "Output": ("sinks", "existing", *_PAGE, "face"),
}
_RECORD = "record:"
_URGENT = 3
"""Number of Ctrl-C that end the command at once, without the recording."""


@click.command("live", cls=GroupedCommand, groups=GROUPS, epilog=EXAMPLES)
@click.argument("words", nargs=-1, metavar="")
@click.option("--model", default="demo", help="A bundled name or a model folder.")
@click.option(
    *("--from", "source"),
    metavar="mic[:DEVICE]|FILE|-",
    help="Microphone (by number or name), sound file in real time, or 16-bit mono samples from "
    "standard input.  [default: mic]",
)
@click.option(
    *("--to", "sinks"),
    metavar="LIST",
    help="page (browser), vmc:HOST:PORT (VSeeFace, Unity, Blender ...), record:FILE; "
    "comma-separated.  [default: page]",
)
@click.option(
    "--look-ahead", type=click.FloatRange(0, 10), default=0.2, help="Seconds of sound known ahead."
)
@seed_option
@click.option("--style", help="Style, for models with styles; by default one is drawn.")
@click.option("--speaker", help="Recordings and body of this speaker of the corpus.")
@click.option("--liveliness", type=float, help="Factor on the drawn hand speed.  [default: 1]")
@click.option("--fast", is_flag=True, help="As fast as possible, for a file or a pipe.")
@click.option("--block", type=click.FloatRange(0.005, 1), default=0.04, help="Seconds of a step.")
@click.option(
    "--rate", type=click.IntRange(4_000, 192_000), default=16_000, help="Hz of standard input."
)
@service_options(8010)
@click.option(
    "--body",
    type=Body(),
    metavar="[mannequin|human|skeleton|FILE.vrm|FILE.glb]",
    default="human",
    help="Body on the page.",
)
@framing_option
@click.option(
    "--face",
    type=click.Choice(["energy", "off"]),
    default="energy",
    help="Mouth, blinks and gaze by rules from the energy of the sound; no recording.",
)
@existing_option("refuse")
@weights_option
@device_option
@click.option(
    *("--fit", "corpus"),
    type=PATH,
    metavar="CORPUS.jsonl",
    help="Add to the model what live speech needs, from the corpus of its training, and end.",
)
@click.option("--list-devices", is_flag=True, help="List microphones and end.")
@click.option("--measure", is_flag=True, help="Print latency, step times and losses at the end.")
@click.option("--json", "figures", type=FILE, help="Write what --measure prints, as JSON.")
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
        how = "give sound by --from, and outputs by --to (--from speech.wav --to page)"
        raise click.UsageError(f"{words[0]!r}: {how}")
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
