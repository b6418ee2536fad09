"""The tests that reach each line of the code, as coverage.py records them.

The record outlives changes: only files of tests that changed are run again, and recorded lines are
found again in the changed code by their text.
"""

from __future__ import annotations

import ast
import difflib
import gzip
import hashlib
import json
import multiprocessing
import os
import sys
from collections import Counter, defaultdict
from functools import cache
from pathlib import Path

import coverage
import pytest
from defects import Defect

PACKAGES = ("audio_features", "gesturekit")
_SECONDS_OF_BATCH = 10.0
_IMPORT = ""
"""Stands for a test where a line is reached while a file of tests is imported."""


class Reach:
    """Tests that reach each line, and the seconds that each test takes.

    Args:
        root: folder of the project.
        folder: where the record is kept.
    """

    def __init__(self, root: Path, folder: Path) -> None:
        self.root, self.folder = root, folder
        self.seconds: dict[str, float] = {}
        self._tests: dict[str, dict[int, set[str]]] = defaultdict(lambda: defaultdict(set))
        # Lines that each test, and the fixtures of each file, reach: of a file, and of all.
        self._n_lines: dict[str, Counter[str]] = defaultdict(Counter)
        self._n_all: Counter[str] = Counter()
        self._longest: Counter[str] = Counter()  # seconds of the longest test of each file
        self._kept: dict[str, dict] = {"files": {}, "texts": {}}
        if self._file.exists():
            self._kept = json.loads(gzip.decompress(self._file.read_bytes()))

    @property
    def _file(self) -> Path:
        return self.folder / "reach.json.gz"

    def update(self, processes: int) -> None:
        """Run the files of tests that are new or changed, and read the record."""
        files = {
            path.relative_to(self.root).as_posix(): _digest(path.read_text(encoding="utf-8"))
            for path in sorted((self.root / "tests").rglob("test_*.py"))
            if path.parent != Path(__file__).parent
        }
        kept = self._kept["files"]
        changed = [name for name in files if kept.get(name, {}).get("digest") != files[name]]
        self._kept["files"] = {name: kept[name] for name in kept if files.get(name)}
        if changed:
            print(f"Recording what the tests of {len(changed)} files reach ...", flush=True)
            # In a process of its own: pytest imports code that forks of this one import changed.
            arguments = (changed, processes, files)
            recording = multiprocessing.get_context("fork").Process(
                target=self._record, args=arguments
            )
            recording.start()
            recording.join()
            if recording.exitcode:
                raise SystemExit("pytest could not run the tests")
            self._kept = json.loads(gzip.decompress(self._file.read_bytes()))
        self._translate()

    def _record(self, names: list[str], processes: int, digests: dict[str, str]) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        settings, data_file = self.folder / "coveragerc", self.folder / "coverage"
        sources = "\n    ".join(PACKAGES)
        settings.write_text(f"[run]\nparallel = True\nsource =\n    {sources}\n", encoding="utf-8")
        os.environ |= {"COVERAGE_FILE": str(data_file), "PYTHONPATH": str(self.root)}
        sys.path.insert(0, str(self.root))
        durations = _Durations()
        options = ["--cov", f"--cov-config={settings}", "--cov-context=test", "--cov-report="]
        options += ["--continue-on-collection-errors"]
        parallel = ["-n", str(processes), "--dist", "loadfile"]
        code = pytest.main(
            ["-q", "-p", "no:cacheprovider", *options, *parallel, *names], plugins=[durations]
        )
        if code not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):
            raise SystemExit(code)
        for test in durations.failed:
            print(f"fails without any defect, left out: {test}", flush=True)
        reached = _reached(data_file, self.root)
        texts = {path: (self.root / path).read_text(encoding="utf-8") for path in reached}
        known = self._kept["texts"] | {_digest(text): text for text in texts.values()}
        for name in names:
            seconds = {
                test: seconds
                for test, seconds in durations.seconds.items()
                if test.partition("::")[0] == name and test not in durations.failed
            }
            lines = {
                path: {test: tests[test] for test in (*seconds, name, _IMPORT) if test in tests}
                for path, tests in reached.items()
            }
            is_whole = not any(test.partition("::")[0] == name for test in durations.failed)
            self._kept["files"][name] = {
                # A test may have failed because the machine was busy: its file runs again.
                "digest": digests[name] if is_whole else "",
                "seconds": seconds,
                "lines": {p: [_digest(texts[p]), tests] for p, tests in lines.items() if tests},
            }
        files = self._kept["files"].values()
        used = {digest for record in files for digest, _ in record["lines"].values()}
        self._kept["texts"] = {digest: known[digest] for digest in used}
        data = json.dumps(self._kept, separators=(",", ":")).encode()
        self._file.write_bytes(gzip.compress(data, 3))

    def _translate(self) -> None:
        """Index the record by the lines of today's code."""
        places: dict[tuple[str, str], dict[int, int]] = {}
        for record in self._kept["files"].values():
            self.seconds |= record["seconds"]
            for test, seconds in record["seconds"].items():
                name = test.partition("::")[0]
                self._longest[name] = max(self._longest[name], seconds)
            for path, (digest, tests) in record["lines"].items():
                if not (self.root / path).exists():
                    continue
                if (path, digest) not in places:
                    today = (self.root / path).read_text(encoding="utf-8")
                    places[path, digest] = _same_lines(self._kept["texts"][digest], today)
                for test, lines in tests.items():
                    self._n_lines[path][test] += len(lines)
                    self._n_all[test] += len(lines)
                    for line in lines:
                        if line in places[path, digest]:
                            self._tests[path][places[path, digest][line]].add(test)

    def batches_of(self, defect: Defect) -> list[list[str]]:
        """Return the tests that reach a defect, in batches of some seconds; see `tests_of`."""
        batches: list[list[str]] = []
        left = 0.0
        for test in self.tests_of(defect):
            left -= 0.05 + self.seconds.get(test, 0.0)
            if left < 0 or not batches:
                batches.append([])
                left = _SECONDS_OF_BATCH
            batches[-1].append(test)
        return batches

    def tests_of(self, defect: Defect) -> list[str]:
        """Return the tests that reach a defect; those about its file that are quick come first.

        Tests of one file stay together: they may share what takes long to set up.

        Lines of compiled functions are not recorded: all tests count that reach a module which
        imports theirs, those of files that import it themselves first.

        Defaults of arguments are computed once, by the first test that imports them: all tests
        count that reach the function. So are constants, defaults of classes and what functions
        return while a module is imported: all tests count that reach their file. A statement that
        is not in the record has the tests of its function.
        """
        if defect.compiled:
            module = defect.path.removesuffix(".py").replace("/", ".")
            callers = [path for path in self._tests if _imports(self.root / path, module)]
            found = {t for path in callers for tests in self._tests[path].values() for t in tests}
            names = {test.partition("::")[0] for test in self.seconds}
            direct = {name for name in names if _imports(self.root / name, module)}
            found |= {test for test in self.seconds if test.partition("::")[0] in direct}
        else:
            direct = set()
            tree = ast.parse((self.root / defect.path).read_text(encoding="utf-8"))
            statements = _statements_around(tree, defect.line)
            found = set()
            for lines in statements:
                found |= {t for line in lines for t in self._tests[defect.path].get(line, ())}
                if any("::" in test or test == _IMPORT for test in found):
                    break
            if _IMPORT in found or not statements[-1]:
                found = {t for tests in self._tests[defect.path].values() for t in tests}
        files = {test for test in found if "::" not in test}
        found |= {test for test in self.seconds if test.partition("::")[0] in files}
        ordered = self._in_order(found - files, defect.path)
        return sorted(ordered, key=lambda test: test.partition("::")[0] not in direct)

    def _in_order(self, tests: set[str], path: str) -> list[str]:
        by_file: dict[str, list[str]] = defaultdict(list)
        for test in tests:
            by_file[test.partition("::")[0]].append(test)

        def worth(name: str) -> float:
            """Return the chance that a file's tests notice, by the second."""
            about = max(self._share(test, path) for test in by_file[name])
            # The longest test of a file may have set up what the others use.
            own = [self.seconds.get(test, 0.0) for test in by_file[name]]
            return about / (0.1 + sum(own) + self._longest[name])

        return [
            test
            for name in sorted(by_file, key=worth, reverse=True)
            for test in sorted(by_file[name], key=lambda test: self.seconds.get(test, 0.0))
        ]

    def _share(self, test: str, path: str) -> float:
        """Return the share of lines in a file among all that a test reaches, its fixtures too."""
        names = {test, test.partition("::")[0]}
        of = sum(self._n_all[name] for name in names)
        return sum(self._n_lines[path][name] for name in names) / max(of, 1)


class _Durations:
    """Plugin of pytest: the seconds of each test, its setup included, and the tests that fail."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.failed: set[str] = set()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.seconds[report.nodeid] += round(report.duration, 3)
        if report.failed:
            self.failed.add(report.nodeid)


def _reached(data_file: Path, root: Path) -> dict[str, dict[str, list[int]]]:
    """Return the lines that each test, and the fixtures of a file, reach, by file of the code."""
    data = coverage.CoverageData(str(data_file))
    data.read()
    reached: dict[str, dict[str, list[int]]] = {}
    for name in data.measured_files():
        path = os.path.relpath(name, root)
        tests: dict[str, set[int]] = defaultdict(set)
        for line, contexts in data.contexts_by_lineno(name).items():
            for context in contexts:
                test, _, phase = context.rpartition("|")
                # What a fixture reaches, all tests of its file may use.
                tests[test.partition("::")[0] if phase == "setup" else test].add(line)
        if path.startswith(PACKAGES):
            reached[path] = {test: sorted(lines) for test, lines in tests.items()}
    return reached


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _same_lines(before: str, today: str) -> dict[int, int]:
    """Return today's number of each line, counted from 1, that stayed as it was."""
    matcher = difflib.SequenceMatcher(None, before.splitlines(), today.splitlines(), autojunk=False)
    return {
        block.a + n + 1: block.b + n + 1
        for block in matcher.get_matching_blocks()
        for n in range(block.size)
    }


def _statements_around(tree: ast.Module, line: int) -> list[range]:
    """Return the lines of the statements that hold a line, the innermost first.

    A statement with a body counts up to its body; of a function's defaults, its whole body counts.
    The function that holds the line comes last; it is empty if there is none.
    """
    spans: list[range] = []
    function = range(0)
    for node in ast.walk(tree):
        if isinstance(node, ast.stmt) and node.lineno <= line <= node.end_lineno:
            body = getattr(node, "body", None)
            last = max(node.lineno, body[0].lineno - 1) if body else node.end_lineno
            is_function = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
            if is_function:
                function = range(body[0].lineno, node.end_lineno + 1)
            if line <= last:
                spans.append(function if is_function else range(node.lineno, last + 1))
    return [*sorted(spans, key=len), function]


@cache
def _imports(path: Path, module: str) -> bool:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    package, _, name = module.rpartition(".")
    return any(
        n.module == module or (n.module == package and name in {alias.name for alias in n.names})
        for n in ast.walk(tree)
        if isinstance(n, ast.ImportFrom)
    )
