"""Draw small defects of the code at random, run the tests that reach each, and list survivors.

A defect that no test reaches survives; one that makes a test hang is killed. Survivors that no
input can tell from the code are kept in `equivalent.toml`, with the reason, and do not count.
Formulas that chance seldom hits have defects of their own in `formulas.toml`. Run it from the root
of the project; the record of which test reaches which line is kept in `build/mutants`.
"""

from __future__ import annotations

import argparse
import ast
import multiprocessing
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

from defects import Defect, defects_of
from reach import PACKAGES, Reach
from scipy.stats import binomtest

ROOT = Path.cwd()
_HANGS = 100.0
"""Seconds after which tests hang that should take about ten."""
LIBRARIES = ["hypothesis", "librosa", "matplotlib.pyplot", "numba", "scipy.stats", "torch"]


def drawn(seed: int, count: int, only: list[str], changed: str | None) -> Iterator[Defect]:
    """Yield defects in random order, those that are argued equivalent left out.

    Args:
        seed: seed of the draw.
        count: number of defects.
        only: beginnings of paths; empty: the whole code.
        changed: commit; only lines that were added or changed since it are taken.
    """
    lines = _changed_lines(changed) if changed else None
    pool = [
        defect
        for package in PACKAGES
        for path in sorted((ROOT / package).rglob("*.py"))
        if not only or path.relative_to(ROOT).as_posix().startswith(tuple(only))
        for defect in defects_of(ROOT, path)
        if lines is None or defect.line in lines[defect.path]
    ]
    equivalent = {(e["function"], e["change"]) for e in table("equivalent.toml").get("defect", [])}
    random.Random(seed).shuffle(pool)
    print(f"{min(count, len(pool))} of {len(pool)} defects, seed {seed}", flush=True)
    left = count
    for defect in pool:
        if left and key_of(defect) not in equivalent and _compiles(defect):
            left -= 1
            yield defect


def key_of(defect: Defect) -> tuple[str, str]:
    """Return what names a defect in `equivalent.toml`: its function and its change."""
    change = " ".join(f"{defect.before} -> {defect.after}".split())
    module = defect.path.removesuffix(".py").replace("/", ".")
    return f"{module}:{defect.function}", change


def table(name: str) -> dict[str, Any]:
    return tomllib.loads((Path(__file__).parent / name).read_text(encoding="utf-8"))


def _compiles(defect: Defect) -> bool:
    try:
        compile(defect.apply((ROOT / defect.path).read_text(encoding="utf-8")), "", "exec")
    except SyntaxError:
        return False
    return True


def _changed_lines(base: str) -> dict[str, set[int]]:
    command = ["git", "diff", "-U0", "--no-prefix", base, "--", *PACKAGES]
    diff = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    lines: dict[str, set[int]] = defaultdict(set)
    path = ""
    for line in diff.splitlines():
        if line.startswith("+++ "):
            path = line[4:]
        elif line.startswith("@@"):
            first, _, count = line.split("+")[1].split()[0].partition(",")
            lines[path] |= set(range(int(first), int(first) + int(count or 1)))
    return lines


def formulas() -> list[Defect]:
    """Return the defects of `formulas.toml`.

    Raises:
        SystemExit: a text is not in its function, or not exactly once.
    """
    found = []
    for function, changes in table("formulas.toml").items():
        module, _, name = function.partition(":")
        path = module.replace(".", "/") + ".py"
        source = (ROOT / path).read_text(encoding="utf-8")
        start, stop = _span(source, name)
        for before, after in changes.items():
            if source.count(before, start, stop) != 1:
                raise SystemExit(f"formulas.toml: {function} does not have once: {before}")
            at = len(source[: source.index(before, start)].encode())
            line = source.encode()[:at].count(b"\n") + 1
            found.append(Defect(path, line, name, at, before, after, "formula", compiled=False))
    return found


def _span(source: str, name: str) -> tuple[int, int]:
    """Return where the text of a function starts and stops, (0, 0) if there is none."""
    node: ast.AST = ast.parse(source)
    for part in name.split("."):
        kinds = ast.FunctionDef | ast.ClassDef
        inside = (n for n in ast.iter_child_nodes(node) if isinstance(n, kinds) and n.name == part)
        node = next(inside, None)
        if node is None:
            return 0, 0
    lines = source.splitlines(keepends=True)
    return len("".join(lines[: node.lineno - 1])), len("".join(lines[: node.end_lineno]))


class Copy:
    """A copy of the project in which defects are made in turn."""

    def __init__(self, folder: Path) -> None:
        self.root = folder / "project"
        ignored = shutil.ignore_patterns(".git", ".venv", "build", "dist", "node_modules", "runs")
        shutil.copytree(ROOT, self.root, symlinks=True, ignore=ignored)
        # Tests find the real recordings beside the project.
        shared = ROOT.parent / "shared"
        if shared.is_dir():
            (folder / "shared").symlink_to(shared.resolve())
        self._log = folder / "log"
        # Python and numba trust a file's time: no two versions of a file may have the same.
        self._stamp = int(time.time())

    def judge(self, defect: Defect, batches: list[list[str]], seconds: float) -> tuple[str, str]:
        """Return "killed", "hangs", "survived" or "uncovered", and the test that fails.

        After so many seconds no further batch of tests begins, and the defect has survived.
        """
        if not batches:
            return "uncovered", ""
        path = self.root / defect.path
        source = path.read_text(encoding="utf-8")
        self._write(path, defect.apply(source))
        try:
            verdict, note = self._tests(batches, seconds)
        finally:
            self._write(path, source)
        if verdict == "hangs" and self._tests(batches[:1], seconds)[0] == "hangs":
            return "survived", "the first tests take as long without the defect"
        return verdict, note

    def _write(self, path: Path, text: str) -> None:
        path.write_text(text, encoding="utf-8")
        self._stamp += 1
        os.utime(path, (self._stamp, self._stamp))

    def _tests(self, batches: list[list[str]], seconds: float) -> tuple[str, str]:
        end = time.monotonic() + seconds
        for n, batch in enumerate(batches):
            process = multiprocessing.get_context("fork").Process(
                target=_run_pytest, args=(self.root, batch, self._log)
            )
            process.start()
            process.join(max(_HANGS, end - time.monotonic()))
            if process.is_alive():
                os.killpg(process.pid, signal.SIGKILL)
                process.join()
                return ("hangs", batch[0]) if n == 0 else ("survived", f"{n} of {len(batches)}")
            if process.exitcode != 0:
                return "killed", _failed(self._log.read_text(errors="replace"))
            if time.monotonic() > end and n + 1 < len(batches):
                return "survived", f"{n + 1} of {len(batches)} batches of tests ran"
        return "survived", ""


def _run_pytest(root: Path, tests: list[str], log: Path) -> None:
    """Run tests in this process, which was forked for it."""
    os.setpgid(0, 0)
    os.chdir(root)
    sys.path.insert(0, str(root))
    os.environ |= {"PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}
    with log.open("w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    import pytest

    options = ["-x", "-q", "-p", "no:cacheprovider", "-p", "no:cov", "-p", "no:xdist", "--tb=line"]
    code = pytest.main([*options, *tests])
    os._exit(0 if code in (0, 5) else 1)


def _failed(log: str) -> str:
    failed = [line for line in log.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return failed[0][:120] if failed else log[-120:]


_copy: list[Copy] = []


def _start_worker(folder: str) -> None:
    _copy.append(Copy(Path(tempfile.mkdtemp(dir=folder))))


def _judge(seconds: float, defect: Defect, batches: list[list[str]]) -> tuple[str, str]:
    return _copy[0].judge(defect, batches, seconds)


def _share(killed: int, of: int) -> str:
    interval = binomtest(killed, of).proportion_ci(method="wilson")
    return f"{killed} of {of} killed: {killed / of:.0%} ({interval.low:.0%} to {interval.high:.0%})"


def main() -> int:
    """Judge the drawn defects, print survivors and shares, and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seed", type=int, default=0, help="seed of the draw")
    parser.add_argument("--count", type=int, default=100, help="number of defects")
    parser.add_argument("--only", nargs="*", default=[], help="beginnings of paths")
    parser.add_argument("--changed", metavar="BASE", help="only lines changed since this commit")
    parser.add_argument("--formulas", action="store_true", help="those of formulas.toml instead")
    text = "of tests for one defect; a first look needs fewer"
    parser.add_argument("--seconds", type=float, default=150.0, help=text)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    text = "libraries that all tests import once, before their processes are forked"
    parser.add_argument("--libraries", nargs="*", default=LIBRARIES, help=text)
    arguments = parser.parse_args()
    os.environ.pop("PYTEST_ADDOPTS", None)  # options of the user's own runs
    reach = Reach(ROOT, ROOT / "build" / "mutants")
    reach.update(arguments.jobs)
    defects = (
        formulas()
        if arguments.formulas
        else drawn(arguments.seed, arguments.count, arguments.only, arguments.changed)
    )
    defects = list(defects)
    if not defects:
        raise SystemExit("no code to change there")
    for library in arguments.libraries:
        __import__(library)
    totals: dict[str, Counter[str]] = defaultdict(Counter)
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder,
        ProcessPoolExecutor(
            arguments.jobs,
            multiprocessing.get_context("fork"),
            initializer=_start_worker,
            initargs=(folder,),
        ) as pool,
    ):
        judge = partial(_judge, arguments.seconds)
        outcomes = pool.map(judge, defects, map(reach.batches_of, defects))
        for defect, (verdict, note) in zip(defects, outcomes, strict=True):
            folders = defect.path.split("/")[:-1]
            package = "/".join(folders[:2]) if folders[0] == "gesturekit" else folders[0]
            totals[package][verdict] += 1
            if verdict in {"survived", "uncovered"}:
                print(f"{verdict:9} {defect} {note}", flush=True)
    dead = {name: counts["killed"] + counts["hangs"] for name, counts in totals.items()}
    for name in sorted(totals):
        print(f"{name:28} {_share(dead[name], totals[name].total())}")
    print(f"{'all':28} {_share(sum(dead.values()), len(defects))}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
