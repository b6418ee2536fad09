"""Make random small defects of the code, one at a time, and print those that no test notices.

Run by `make mutants`, from the root of the project. It first runs the tests once to record which
of them reach which line; the record is kept in build/mutants until code or tests change. Many
survivors are no fault: they change nothing that a user could see. Read them, and decide.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from itertools import accumulate
from pathlib import Path
from queue import SimpleQueue
from typing import NamedTuple

import coverage

PACKAGES = ("audio_features", "gesturekit")
STATE = Path("build/mutants").absolute()
PAIRS = [(ast.Lt, ast.LtE), (ast.Gt, ast.GtE), (ast.Eq, ast.NotEq), (ast.In, ast.NotIn)]
PAIRS += [(ast.Is, ast.IsNot), (ast.Add, ast.Sub), (ast.Mult, ast.Div), (ast.And, ast.Or)]
SWAPPED = {a: b for pair in PAIRS for a, b in (pair, pair[::-1])}
SWAPPED |= {ast.FloorDiv: ast.Div, ast.Mod: ast.Mult, ast.Pow: ast.Mult, ast.MatMult: ast.Mult}
MESSAGES = {"print", "echo", "warn", "warning", "info", "debug", "error", "write"}
"""Calls whose arguments are text for people."""
NOT_RUN = {"annotation", "decorator_list", "returns"}


class Defect(NamedTuple):
    """One change: bytes `start` to `stop` of a file become `after`; `lines` are its statement's."""

    path: str
    lines: range
    start: int
    stop: int
    after: str


def defects_of(path: str, data: bytes) -> Iterator[Defect]:
    """Yield all defects inside the functions of a file."""
    starts = list(accumulate(map(len, data.splitlines(keepends=True)), initial=0))
    for node, lines in nodes_of(ast.parse(data), range(0)):
        for part, other in changes_of(node):
            start = starts[part.lineno - 1] + part.col_offset
            stop = starts[part.end_lineno - 1] + part.end_col_offset
            text = f"({ast.unparse(other)})" if isinstance(part, ast.expr) else ast.unparse(other)
            yield Defect(path, lines, start, stop, text)


def nodes_of(node: ast.AST, lines: range) -> Iterator[tuple[ast.AST, range]]:
    """Yield the nodes inside functions, with the lines of the innermost statement around each."""
    for child in parts_of(node):
        inside = lines
        is_function = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef)
        if is_function or (lines and isinstance(child, ast.stmt)):
            body = getattr(child, "body", None)
            stop = body[0].lineno if body else child.end_lineno + 1
            inside = range(child.lineno, max(stop, child.lineno + 1))
        if inside:
            yield child, inside
        yield from nodes_of(child, inside)


def parts_of(node: ast.AST) -> list[ast.AST]:
    """Return the children of a node that run: no decorators, annotations and messages."""
    if isinstance(node, ast.Raise | ast.JoinedStr):
        return []
    fields = [value for name, value in ast.iter_fields(node) if name not in NOT_RUN]
    lists = [field if isinstance(field, list) else [field] for field in fields]
    nodes = [child for children in lists for child in children if isinstance(child, ast.AST)]
    return [child for child in nodes if not is_message(child)]


def changes_of(node: ast.AST) -> Iterator[tuple[ast.AST, ast.AST]]:
    """Yield the changes of a node: the part that is replaced, and by what."""
    match node:
        case ast.Compare(ops=[op, *others]):
            yield node, changed(node, ops=[SWAPPED[type(op)](), *others])
        case ast.BinOp(op=op) | ast.AugAssign(op=op) | ast.BoolOp(op=op) if type(op) in SWAPPED:
            yield node, changed(node, op=SWAPPED[type(op)]())
        case ast.UnaryOp(op=ast.Not() | ast.USub(), operand=operand):
            yield node, operand
        case ast.If(test=test) | ast.IfExp(test=test):
            yield test, ast.UnaryOp(ast.Not(), test)
        case ast.Constant(value=bool() | int() | float() as value):
            yield node, ast.Constant(not value if isinstance(value, bool) else 2 * value + 1)
        case ast.Call(keywords=keywords):
            for n, keyword in enumerate(keywords):
                if keyword.arg:
                    yield node, changed(node, keywords=[*keywords[:n], *keywords[n + 1 :]])
        case ast.Raise() | ast.Expr(value=ast.Call()):
            yield node, ast.Pass()
        case ast.Continue():
            yield node, ast.Break()


def is_message(node: ast.AST) -> bool:
    call = node.value if isinstance(node, ast.Expr) else node
    return isinstance(call, ast.Call) and ast.unparse(call.func).rpartition(".")[2] in MESSAGES


def changed(node: ast.AST, **parts: object) -> ast.AST:
    return type(node)(**{**vars(node), **parts})


def changed_lines(commit: str) -> dict[str, set[int]]:
    """Return the lines that were added or changed since a commit, by file."""
    command = ["git", "diff", "-U0", "--no-prefix", commit, "--", *PACKAGES]
    diff = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    lines, path = defaultdict(set), ""
    place = re.compile(r"^(?:\+\+\+ (.*)|@@ .*? \+(\d+),?(\d*) @@.*)$", re.MULTILINE)
    for file, first, count in place.findall(diff):
        path = file or path
        if first:
            lines[path] |= set(range(int(first), int(first) + int(count or 1)))
    return lines


def drawn(seed: int, count: int, only: list[str], commit: str | None) -> list[Defect]:
    """Return random defects; `only` and `commit` limit them to some paths and to changed lines."""
    files = sorted(path for package in PACKAGES for path in Path(package).rglob("*.py"))
    some = [path for path in files if path.as_posix().startswith(tuple(only or PACKAGES))]
    pool = [defect for path in some for defect in defects_of(path.as_posix(), path.read_bytes())]
    if commit:
        lines = changed_lines(commit)
        pool = [defect for defect in pool if lines[defect.path] & set(defect.lines)]
    defects = random.Random(seed).sample(pool, min(count, len(pool)))
    print(f"{len(defects)} of {len(pool)} defects, seed {seed}", flush=True)
    return defects


def run_pytest(project: Path, *arguments: object, seconds: float | None = None) -> int | None:
    """Run tests in a copy, with their output in its file `log`; return None after `seconds`."""
    environment = {"PYTHONPATH": str(project), "PYTHONDONTWRITEBYTECODE": "1"}
    environment |= {"OMP_NUM_THREADS": "1", "COVERAGE_FILE": str(STATE / "coverage")}
    environment |= {"PYTEST_ADDOPTS": "-q -ra -p no:cacheprovider"}
    command = [sys.executable, "-m", "pytest", *arguments]
    options = {"cwd": project, "env": os.environ | environment, "start_new_session": True}
    with (project / "log").open("w") as log:
        process = subprocess.Popen(command, **options, stdout=log, stderr=log)
        try:
            return process.wait(seconds)
        except subprocess.TimeoutExpired:
            return None
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()


class Record:
    """The tests that reach each line, as coverage.py records them; tests that fail are left out."""

    def __init__(self, project: Path, jobs: int, tests: list[str]) -> None:
        digest, known = hashlib.sha256(repr(tests).encode()), STATE / "digest"
        for path in sorted(p for f in (*PACKAGES, "tests") for p in Path(f).rglob("*.py")):
            digest.update(path.read_bytes())
        if not known.is_file() or known.read_text() != digest.hexdigest():
            print("Recording which tests reach which lines ...", flush=True)
            shutil.rmtree(STATE, ignore_errors=True)
            STATE.mkdir(parents=True)
            settings = "[run]\nparallel = True\nrelative_files = True\nsource = "
            (STATE / "coveragerc").write_text(settings + ",".join(PACKAGES))
            options = ["--cov", f"--cov-config={STATE}/coveragerc", "--cov-context=test"]
            options += ["--cov-report=", "-n", str(jobs), "--dist", "loadfile", *tests]
            if run_pytest(project, *options) not in (0, 1):
                raise SystemExit((project / "log").read_text()[-3000:])
            shutil.copy(project / "log", STATE)
            known.write_text(digest.hexdigest())
        data = coverage.CoverageData(str(STATE / "coverage"))
        data.read()
        self.files, self.lines = sorted(data.measured_files()), cache(data.contexts_by_lineno)
        log = (STATE / "log").read_text(errors="replace")
        failed = re.findall(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", log, re.MULTILINE)
        print(*(f"fails without any defect, left out: {test}\n" for test in failed), end="", sep="")
        self.tests = {c.rpartition("|")[0] for c in data.measured_contexts()} - {"", *failed}

    def tests_of(self, defect: Defect) -> list[str]:
        """Return the tests that reach a defect, those named like its file or folder first.

        Lines of functions that numba compiles are not recorded, and lines that run during an
        import have no test: those have all tests that reach a file which imports theirs.
        """
        path, lines = Path(defect.path), self.lines(defect.path)
        reached = {context for line in defect.lines for context in lines.get(line, ())}
        if reached <= {""}:
            imported = re.compile(rf"import.*\b{path.stem}\b|\b{path.stem} import")
            files = [f for f in self.files if imported.search(Path(f).read_text())]
            files.append(defect.path)
            reached = {c for f in files for contexts in self.lines(f).values() for c in contexts}
        names = {context.rpartition("|")[0] for context in reached}
        # What a fixture reaches, all tests of its file may use.
        names |= {c.partition("::")[0] for c in reached if c.endswith("|setup")}
        tests = [t for t in self.tests if names & {t, t.partition("::")[0]}]
        return sorted(tests, key=lambda t: (path.stem not in t, path.parent.name not in t, t))


def judge(copies: SimpleQueue[Path], seconds: float, defect: Defect, tests: list[str]) -> str:
    """Return "killed", "survived", "timeout" (none failed in that time) or "unreached"."""
    if not tests:
        return "unreached"
    project = copies.get()
    file, names = project / defect.path, project / "names"
    data = file.read_bytes()
    names.write_text("\n".join(tests))
    file.write_bytes(data[: defect.start] + defect.after.encode() + data[defect.stop :])
    try:
        code = run_pytest(project, "-x", "-p", "no:cov", f"@{names}", seconds=seconds)
    finally:
        file.write_bytes(data)
        copies.put(project)
    return {0: "survived", None: "timeout"}.get(code, "killed")


def main() -> None:
    """Judge the drawn defects, print those that no test notices, and count."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--only", nargs="*", default=[], help="beginnings of paths of code")
    parser.add_argument("--changed", metavar="COMMIT", help="only lines changed since it")
    parser.add_argument("--tests", nargs="*", default=[], help="run these tests only")
    parser.add_argument("--seconds", type=float, default=150.0, help="of tests for one defect")
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    given = parser.parse_args()
    defects = drawn(given.seed, given.count, given.only, given.changed)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        copies: SimpleQueue[Path] = SimpleQueue()
        ignored = (".git", ".venv", "build", "dist", "node_modules", "runs", "__pycache__")
        for n in range(given.jobs):
            project = Path(folder, str(n), "project")
            shutil.copytree(".", project, symlinks=True, ignore=shutil.ignore_patterns(*ignored))
            # Tests find the real recordings beside the project.
            (project.parent / "shared").symlink_to(Path.cwd().parent / "shared")
            copies.put(project)
        record = Record(project, given.jobs, given.tests)
        counts: Counter[str] = Counter()
        with ThreadPoolExecutor(given.jobs) as pool:
            judged = partial(judge, copies, given.seconds)
            verdicts = pool.map(judged, defects, map(record.tests_of, defects))
            for defect, verdict in zip(defects, verdicts, strict=True):
                counts[verdict] += 1
                if verdict != "killed":
                    before = Path(defect.path).read_bytes()[defect.start : defect.stop].decode()
                    change = " ".join(f"{before} -> {defect.after}".split())
                    print(f"{verdict:9} {defect.path}:{defect.lines[0]} {change:.160}", flush=True)
    print(", ".join(f"{n} {verdict}" for verdict, n in counts.most_common()) or "no code there")


if __name__ == "__main__":
    main()
