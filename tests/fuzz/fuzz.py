"""Fuzzing of every loader: mutated files are read, or refused by an error of ours.

    python tests/fuzz/fuzz.py --seconds 60                 # all targets, one process each
    python tests/fuzz/fuzz.py bvh npz --executions 5000

Broken is: an exception that is not ours, more than a second, more than 1 GB, a message that does
not name the file or is too long. The inputs of such cases are written below --found.

Where atheris is installed, libFuzzer chooses inputs by the code that they reach, from the seeds and
our mutators (--engine atheris); without it the mutators alone choose (--engine own), and case n of
a target is the same on every run.
"""

import argparse
import faulthandler
import hashlib
import importlib.util
import json
import logging
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

CASES = Path(__file__).with_name("cases")
"""Inputs that once broke something: TARGET-NAME; every run begins with them."""
MOST_BYTES = 1 << 30
MOST_SECONDS = 1.0
HANG = 30  # seconds after which a case ends the process
LONGEST_MESSAGE = 1500
LONGEST_INPUT = 1 << 16


class Harness:
    """One target in one folder: runs cases, and keeps what was found."""

    def __init__(self, target: Any, folder: Path, found: Path | None) -> None:
        self.target, self.folder, self.found = target, folder, found
        self.path = folder / target.file
        target.setup(folder)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        work = folder / "work"
        work.mkdir()
        self.seeds = target.seeds(folder if target.name == "cache_entry" else work)
        self.counts: Counter[str] = Counter()
        self.slowest = 0.0
        self.broken: dict[str, str] = {}
        # Everything is imported before memory and time count.
        results = []
        for seed in self.seeds:
            self._write(target.wrap(seed))
            results.append(self._result())
        assert ("read", "") in results, f"{target.name}: no seed can be read: {results}"
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        most = pages * resource.getpagesize() + MOST_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (most, resource.RLIM_INFINITY))
        self._armed = 0.0

    def __call__(self, data: bytes) -> None:
        self._write(self.target.wrap(data))
        if time.monotonic() - self._armed > 1:  # a watchdog for each case would take longer than it
            self._armed = time.monotonic()
            faulthandler.dump_traceback_later(HANG, exit=True)
        begun = time.perf_counter()  # the processor's own clock is slow to read on some systems
        result, why = self._result()
        seconds = time.perf_counter() - begun
        if seconds > MOST_SECONDS / 2:  # other processes may have had the processor
            start = time.process_time()
            self._result()
            seconds = time.process_time() - start
        self.slowest = max(self.slowest, seconds)
        self.counts[result] += 1
        if seconds > MOST_SECONDS:
            self._keep(data, f"took {seconds:.1f} s", "slow")
        if result == "broken":
            self._keep(data, why, why.splitlines()[-1] if "Traceback" not in why else _place(why))

    def _write(self, content: bytes) -> None:
        if self.path.is_symlink():
            self.path.unlink()
        self.path.write_bytes(content)

    def _result(self) -> tuple[str, str]:
        """ "read", "refused" or "broken", and why."""
        from audio_features.errors import AudioFeaturesError
        from gesturekit.errors import GestureKitError

        try:
            self.target.read(self.folder, self.path)
            return "read", ""
        except (GestureKitError, AudioFeaturesError) as error:
            return self._judged(error)
        except Exception:
            return "broken", traceback.format_exc(limit=-6)

    def _judged(self, error: Exception) -> tuple[str, str]:
        message, cause = str(error), error
        while cause is not None:
            if isinstance(cause, MemoryError):
                return "broken", f"over {MOST_BYTES >> 20} MB: {message[:300]}"
            cause = cause.__cause__ or cause.__context__
        places = {"PATH": re.escape(str(self.path)), "FOLDER": re.escape(str(self.folder))}
        pattern = re.sub("PATH|FOLDER", lambda match: places[match[0]], self.target.says)
        if not re.search(pattern, message, re.DOTALL):
            return "broken", f"the message does not say where: {message[:300]}"
        if len(message) > LONGEST_MESSAGE:
            return "broken", f"a message of {len(message)} characters: {message[:300]}"
        return "refused", message

    def _keep(self, data: bytes, why: str, place: str) -> None:
        place = re.sub(r"[\d.]+|(/\S+)", "", place)[:120]
        if place in self.broken:
            return
        name = f"{self.target.name}-{hashlib.sha256(data).hexdigest()[:10]}"
        self.broken[place] = f"{name}: {why}"
        if self.found is not None:
            self.found.mkdir(parents=True, exist_ok=True)
            (self.found / name).write_bytes(data)

    def summary(self) -> dict[str, Any]:
        return {
            "target": self.target.name,
            "executions": sum(self.counts.values()),
            "results": dict(sorted(self.counts.items())),
            "slowest": round(self.slowest, 3),
            "broken": sorted(self.broken.values()),
        }


def _place(trace: str) -> str:
    """Return the place and the kind of an exception, without the values in its message."""
    frames = re.findall(r'File "([^"]+)", line (\d+)', trace)
    where = [f"{Path(file).name} l{line}" for file, line in frames]
    return f"{trace.splitlines()[-1].split(':')[0]} {' '.join(where[-2:])}"


def run_own(harness: Harness, options: argparse.Namespace) -> None:
    from mutators import mutate

    end = time.monotonic() + options.seconds
    executions = options.executions // 10 if harness.target.is_slow else options.executions
    for number in range(options.first, options.first + executions):
        if time.monotonic() > end:
            break
        seed = harness.seeds[number % len(harness.seeds)]
        harness(mutate(seed, harness.target.mutators, number))


def run_atheris(harness: Harness, options: argparse.Namespace, out: Any) -> None:
    """Fuzz until the time is over; never returns, as libFuzzer does not."""
    import atheris
    from mutators import mutate

    corpus = harness.folder.parent / "corpus"
    corpus.mkdir()
    for number, seed in enumerate(harness.seeds):
        (corpus / str(number)).write_bytes(seed)
    end = time.monotonic() + options.seconds

    def one(data: bytes) -> None:
        harness(data)
        executions = sum(harness.counts.values())
        if time.monotonic() > end or executions >= options.executions:
            print(json.dumps(harness.summary() | {"engine": "atheris"}), file=out, flush=True)
            os._exit(0)

    def change(data: bytes, most: int, seed: int) -> bytes:
        if seed % 3 == 0:
            return atheris.Mutate(data, most)
        return mutate(data, harness.target.mutators, seed)[:most]

    longest = max(LONGEST_INPUT, *(len(seed) for seed in harness.seeds))
    arguments = ["fuzz", f"-max_len={longest}", f"-timeout={HANG}", "-rss_limit_mb=0"]
    arguments += ["-len_control=0", f"-seed={options.first + 1}", "-verbosity=0", str(corpus)]
    atheris.Setup(arguments, one, custom_mutator=change)
    atheris.Fuzz()


def fuzz_one(name: str, options: argparse.Namespace) -> dict[str, Any]:
    """Fuzz one target in this process; with atheris, end the process."""
    from targets import TARGETS

    out = os.fdopen(os.dup(1), "w")
    shm = Path("/dev/shm")  # memory, where there is such a folder
    where = shm if os.access(shm, os.W_OK) else None
    with tempfile.TemporaryDirectory(
        prefix="fuzz-", dir=where, ignore_cleanup_errors=True
    ) as temporary:
        folder = Path(temporary) / "case"
        folder.mkdir()
        harness = Harness(TARGETS[name], folder, options.found)
        for case in sorted(CASES.glob(f"{name}-*")):
            harness(case.read_bytes())
        if options.engine == "atheris":
            run_atheris(harness, options, out)
        run_own(harness, options)
        faulthandler.cancel_dump_traceback_later()
        resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        return harness.summary() | {"engine": "own"}


def fuzz_apart(name: str, options: argparse.Namespace) -> dict[str, Any]:
    """Fuzz one target in a process of its own, which may die."""
    command = [sys.executable, __file__, name, "--inside", "--engine", options.engine]
    command += ["--seconds", str(options.seconds), "--executions", str(options.executions)]
    command += ["--first", str(options.first)]
    if options.found is not None:
        command += ["--found", str(options.found)]
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as log:
        done = subprocess.run(command, stdin=subprocess.DEVNULL, stdout=out, stderr=log)
        out.seek(0), log.seek(0)
        said, why = out.read(), log.read()
    try:
        return json.loads(said.splitlines()[-1])
    except (IndexError, ValueError):
        why = f"the process ended with {done.returncode}: {why[-3000:]}"
        return {"target": name, "executions": 0, "results": {}, "slowest": 0.0, "broken": [why]}


def instrument() -> None:
    """Import everything of ours so that libFuzzer sees which code is reached."""
    import atheris

    # numba compiles these modules itself, and cannot compile what atheris made of them.
    import gesturekit.evaluation.metrics.diagonals
    import gesturekit.multires.cpu.kernels  # noqa: F401

    with atheris.instrument_imports(include=["gesturekit", "audio_features", "yaml"]):
        import targets  # noqa: F401


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("targets", nargs="*", help="names of targets; all by default")
    parser.add_argument("--seconds", type=float, default=1e9, help="time of each target")
    parser.add_argument("--executions", type=int, default=10**9, help="of each target")
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--engine", choices=["auto", "atheris", "own"], default="auto")
    parser.add_argument("--found", type=Path, help="folder for inputs that break something")
    parser.add_argument("--inside", action="store_true", help="all targets in this process")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    logging.disable(logging.CRITICAL)
    if options.engine == "auto":
        options.engine = "atheris" if importlib.util.find_spec("atheris") else "own"
    if options.inside and options.engine == "atheris":
        instrument()
    from targets import TARGETS

    summaries = []
    for name in options.targets or TARGETS:
        summaries.append((fuzz_one if options.inside else fuzz_apart)(name, options))
        print(json.dumps(summaries[-1]), flush=True)
    if not options.inside:
        total = sum(summary["executions"] for summary in summaries)
        broken = sum(len(summary["broken"]) for summary in summaries)
        print(f"{total} executions of {len(summaries)} targets, {broken} broken")
        sys.exit(1 if broken else 0)


if __name__ == "__main__":
    main()
