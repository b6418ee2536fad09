"""Kill a command of gesturekit at random moments, in forks of this process; see test_killing.

    python killing.py KILLS SEED ARGUMENTS

ARGUMENTS are those of gesturekit as JSON, with {out} in place of the output. It is first "whole",
for a run that is left alone and whose duration is measured. Then it is "0": the command is killed
and started again, up to `MOST` times before it is left alone; then "1", and so on, until there were
KILLS kills before the end of a command. The number of outputs is printed.
"""

import importlib
import json
import os
import random
import signal
import sys
import time

from gesturekit.cli import main

TRAINERS = ("gesturekit.multires.training.trainer", "gesturekit.diffusion.training.trainer")
NEEDS = {
    "features": ("gesturekit.rendering.features",),
    "convert": ("gesturekit.conversion", "gesturekit.viewer"),
    "prepare": ("gesturekit.corpus",),
    "render": ("gesturekit.rendering.renderer", "gesturekit.viewer", *TRAINERS),
    "live": TRAINERS,
    "train": TRAINERS,
}
"""Modules that are imported before the forks, so that these start at once."""
MOST = 6
"""Kills of a command before it is left alone, so that many outputs are killed at many moments."""


def start(arguments: list[str], out: str) -> int:
    """Run the command in a fork, and return its process id."""
    child = os.fork()
    if child:
        return child
    code = 1
    try:
        main([argument.replace("{out}", out) for argument in arguments])
        code = 0
    except SystemExit as end:
        code = int(end.code or 0)
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def check(status: int) -> None:
    code = os.waitstatus_to_exitcode(status)
    assert code == 0, f"exit code {code}"


if __name__ == "__main__":
    rng, kills, number, here = random.Random(sys.argv[2]), 0, 0, 0
    command = json.loads(sys.argv[3])
    for module in NEEDS[command[0]]:
        importlib.import_module(module)
    begin = time.monotonic()
    check(os.waitpid(start(command, "whole"), 0)[1])
    duration = time.monotonic() - begin
    while kills < int(sys.argv[1]):
        child = start(command, str(number))
        moment = time.monotonic() + (rng.uniform(0, duration) if here < MOST else float("inf"))
        ended = 0
        while not ended and time.monotonic() < moment:
            time.sleep(0.001)
            ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            check(status)
            number, here = number + 1, 0
        else:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            kills, here = kills + 1, here + 1
    check(os.waitpid(start(command, str(number)), 0)[1])
    print(number + 1)
