"""Change one thing in a copy of the code, run the tests that should notice, and list survivors.

The mutants are kept in the `*.toml` files beside this one. Each names a function, a text in it
before and after, and the tests that should fail:

    [[mutant]]
    function = "gesturekit.multires.losses:adversarial"
    before = "-scores.mean()"
    after = "scores.mean()"
    tests = ["tests/multires/test_losses.py"]
    equivalent = "..."     # only where no test can tell: why

The text must occur in the function exactly once, so that a mutant never goes stale unseen.
"""

from __future__ import annotations

import argparse
import ast
import itertools
import os
import queue
import shutil
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
COPIED = ("audio_features", "gesturekit", "blender", "tests", "recipes", "benchmarks", "docs")
COPIED_FILES = (
    "pyproject.toml",
    "Makefile",
    "README.md",
    "CONTRIBUTING.md",
    "constraints.txt",
    "mkdocs.yml",
)
SECONDS_PER_MUTANT = 300.0
_KEYS = {"function", "before", "after", "tests", "equivalent"}


class StaleMutantError(Exception):
    """A mutant whose function or text is not in the code, or not exactly once."""


@dataclass(frozen=True)
class Mutant:
    """One change: in `function` ("module:qualified.name"), `before` becomes `after`."""

    function: str
    before: str
    after: str
    tests: tuple[str, ...]
    equivalent: str = ""

    @property
    def path(self) -> str:
        """The file, relative to the root of the project."""
        return self.function.partition(":")[0].replace(".", "/") + ".py"

    def apply(self, source: str) -> str:
        """Return the file's text with the change made.

        Raises:
            StaleMutantError: there is no such function, or `before` is not in it exactly once.
        """
        lines = source.splitlines(keepends=True)
        parts = _code_of(ast.parse(source), self.function.partition(":")[2], len(lines))
        if not parts:
            raise StaleMutantError(f"{self.path} has no {self.function.partition(':')[2]}")
        texts = {part: "".join(lines[part.start : part.stop]) for part in parts}
        holding = [part for part, text in texts.items() if self.before in text]
        count = sum(text.count(self.before) for text in texts.values())
        if count != 1:
            raise StaleMutantError(f"{self.function}: {self.before!r} occurs {count} times")
        (part,) = holding
        changed = texts[part].replace(self.before, self.after)
        return "".join([*lines[: part.start], changed, *lines[part.stop :]])

    def __str__(self) -> str:
        short = " ".join(f"{self.before} -> {self.after}".split())
        return f"{self.function}: {short[:90]}"


def _code_of(tree: ast.Module, name: str, n_lines: int) -> list[range]:
    """Return the lines of a function or class by its qualified name, without its docstring.

    They are counted from 0; nothing where there is no such function, the whole file for no name.
    """
    if not name:
        return [range(n_lines)]
    node: ast.AST = tree
    for part in name.split("."):
        kinds = ast.FunctionDef | ast.ClassDef
        inside = (n for n in ast.iter_child_nodes(node) if isinstance(n, kinds) and n.name == part)
        node = next(inside, None)
        if node is None:
            return []
    first = min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)]) - 1
    if ast.get_docstring(node) is None:
        return [range(first, node.end_lineno)]
    docstring = node.body[0]
    return [range(first, docstring.lineno - 1), range(docstring.end_lineno, node.end_lineno)]


def read_mutants() -> list[Mutant]:
    """Return the kept mutants of all lists, in the order of the files."""
    mutants = []
    for path in sorted(Path(__file__).parent.glob("*.toml")):
        for entry in tomllib.loads(path.read_text(encoding="utf-8"))["mutant"]:
            if unknown := set(entry) - _KEYS:
                raise SystemExit(f"{path.name}: unknown key {', '.join(sorted(unknown))}")
            mutants.append(Mutant(**entry | {"tests": tuple(entry["tests"])}))
    return mutants


def stale(mutants: list[Mutant]) -> list[str]:
    """Return what is wrong with the mutants that do not apply, or that change nothing."""
    wrong = []
    for mutant in mutants:
        try:
            source = (ROOT / mutant.path).read_text(encoding="utf-8")
            ast.parse(mutant.apply(source))
        except (OSError, SyntaxError, StaleMutantError) as error:
            wrong.append(f"{mutant}: {error}")
        wrong += [f"{mutant}: no such test: {t}" for t in mutant.tests if not _exists(t)]
    return wrong


def _exists(test: str) -> bool:
    return (ROOT / test.partition("::")[0]).exists()


@dataclass
class Copies:
    """Copies of the project, one for each worker, that mutants are applied to in turn."""

    folder: Path
    free: queue.Queue[Path] = field(default_factory=queue.Queue)
    # Python and numba trust a file's time: no two versions of a file may have the same.
    _stamps: itertools.count = field(default_factory=lambda: itertools.count(int(time.time())))
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def make(self, count: int) -> None:
        """Copy the project `count` times."""
        for n in range(count):
            copy = self.folder / f"copy{n}" / "project"
            for name in COPIED:
                ignored = shutil.ignore_patterns("node_modules", "*.toml.bak")
                shutil.copytree(ROOT / name, copy / name, ignore=ignored)
            for name in COPIED_FILES:
                shutil.copy2(ROOT / name, copy / name)
            # Tests find the real recordings beside the project.
            shared = ROOT.parent / "shared"
            if shared.is_dir():
                (copy.parent / "shared").symlink_to(shared)
            self.free.put(copy)

    def run(self, tests: tuple[str, ...], mutant: Mutant | None = None) -> str:
        """Return "passed", "failed" or "timeout" of these tests, with the mutant applied."""
        copy = self.free.get()
        path = copy / mutant.path if mutant else None
        original = path.read_text(encoding="utf-8") if path else ""
        try:
            if path:
                self._write(path, mutant.apply(original))
            return _tests_in(copy, tests)
        finally:
            if path:
                self._write(path, original)
            self.free.put(copy)

    def _write(self, path: Path, text: str) -> None:
        path.write_text(text, encoding="utf-8")
        with self._lock:
            stamp = next(self._stamps)
        os.utime(path, (stamp, stamp))


def _tests_in(copy: Path, tests: tuple[str, ...]) -> str:
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests]
    environment = {**os.environ, "PYTHONPATH": str(copy), "OMP_NUM_THREADS": "1"}
    try:
        done = subprocess.run(
            command,
            cwd=copy,
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            timeout=SECONDS_PER_MUTANT,
        )
    except subprocess.TimeoutExpired:
        return "timeout"
    if done.returncode not in (0, 1):  # 2 and above: pytest itself could not run them
        return "failed" if done.returncode == 2 else f"pytest exit {done.returncode}"
    return "failed" if done.returncode else "passed"


def main() -> int:
    """Run the kept mutants, print a line for each, and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--only", default="", help="text that a mutant's line must hold")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    arguments = parser.parse_args()
    mutants = [m for m in read_mutants() if arguments.only in str(m)]
    if wrong := stale(mutants):
        print("\n".join(["Mutants that no longer apply:", *wrong]))
        return 2
    tests = tuple(sorted({test for mutant in mutants for test in mutant.tests}))
    with tempfile.TemporaryDirectory() as folder:
        copies = Copies(Path(folder))
        copies.make(arguments.jobs)
        if copies.run(tests) != "passed":
            print("The tests fail without any mutant.")
            return 2
        survivors = _run_all(mutants, copies, arguments.jobs)
    argued = sum(bool(mutant.equivalent) for mutant in mutants)
    print(
        f"{len(mutants)} mutants: {len(mutants) - argued - len(survivors)} killed, "
        f"{argued} argued equivalent, {len(survivors)} survived"
    )
    return 1 if survivors else 0


def _run_all(mutants: list[Mutant], copies: Copies, jobs: int) -> list[Mutant]:
    """Return the mutants that no test noticed and that nobody argued for."""
    survivors = []
    with ThreadPoolExecutor(jobs) as pool:
        outcomes = pool.map(
            lambda m: "equivalent" if m.equivalent else copies.run(m.tests, m), mutants
        )
        for mutant, outcome in zip(mutants, outcomes, strict=True):
            words = {"passed": "SURVIVED", "failed": "killed", "timeout": "killed (time)"}
            print(f"{words.get(outcome, outcome):13} {mutant}", flush=True)
            if outcome not in ("failed", "timeout", "equivalent"):
                survivors.append(mutant)
    return survivors


if __name__ == "__main__":
    sys.exit(main())
