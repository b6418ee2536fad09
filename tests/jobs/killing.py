"""Kill a command of gesturekit at random moments, in forks of this process; see test_killing.

    python killing.py KILLS SEED WHOLE AGAIN

WHOLE and AGAIN are arguments of gesturekit as JSON, for an undisturbed run, whose duration is
measured, and for the killed ones. The last run is not killed. The number of kills that came before
the end of the command is printed.
"""

import json
import os
import random
import signal
import sys
import time

# Everything is imported before the forks, which then start at once.
import gesturekit.corpus
import gesturekit.rendering.batch
import gesturekit.viewer  # noqa: F401
from gesturekit.cli import main


def start(arguments: list[str]) -> int:
    """Run the command in a fork, and return its process id."""
    child = os.fork()
    if child:
        return child
    code = 1
    try:
        main(arguments)
        code = 0
    except SystemExit as end:
        code = int(end.code or 0)
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def wait(child: int) -> None:
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert code == 0, f"exit code {code}"


if __name__ == "__main__":
    rng, hits = random.Random(sys.argv[2]), 0
    whole, killed = (json.loads(text) for text in sys.argv[3:])
    begin = time.monotonic()
    wait(start(whole))
    duration = time.monotonic() - begin
    for _ in range(int(sys.argv[1])):
        child = start(killed)
        moment = time.monotonic() + rng.uniform(0, duration)
        ended = 0
        while not ended and time.monotonic() < moment:
            time.sleep(0.001)
            ended, _ = os.waitpid(child, os.WNOHANG)
        if not ended:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            hits += 1
    wait(start(killed))
    print(json.dumps(hits))
