"""The tool behind `make mutants`: which defects it makes, and what it says about them."""

import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import mutation
import pytest
from defects import defects_of

ROOT = Path(__file__).parents[2]

CODE = '''"""A module."""

LIMIT = 5


def share(part: int, whole: int = 100, *, name: str = "x") -> float:
    """Return a share."""
    if part < 0 and not whole:
        raise ValueError(f"{part + 1} is negative")
    for _ in zip(range(whole), strict=True):
        break
    return round(max(part, 0.5) / whole, ndigits=3)


class Kept:
    def __repr__(self) -> str:
        return f"{1 + 1}"

    @property
    def changed(self) -> bool:
        print(1 + 1)
        self.keep(-1)
        return True
'''


@pytest.fixture
def project(tmp_path):
    """A project of one module and one test."""
    (tmp_path / "gesturekit").mkdir()
    (tmp_path / "audio_features").mkdir()
    (tmp_path / "tests").mkdir()
    (tmp_path / "gesturekit" / "__init__.py").write_text("")
    (tmp_path / "gesturekit" / "shares.py").write_text(
        "def double(n):\n    return n * 2\n\n\ndef opposite(n):\n    return -n\n\n\n"
        "def unused(n):\n    return -n\n\n\n"
        "def at_import(n):\n    return -n\n\n\nSIZE = at_import(-4)\n"
    )
    (tmp_path / "tests" / "test_shares.py").write_text(
        "from gesturekit.shares import SIZE, double, opposite\n\n\n"
        "def test_double():\n    assert double(SIZE) == 8\n\n\n"
        "def test_opposite():\n    assert opposite(0) == 0\n"
    )
    return tmp_path


def run(project: Path, *arguments: str) -> list[str]:
    command = [
        sys.executable,
        str(ROOT / "tests/mutants/mutation.py"),
        "--jobs",
        "1",
        "--libraries",
        *arguments,
    ]
    done = subprocess.run(command, cwd=project, capture_output=True, text=True, check=True)
    return [line for line in done.stdout.splitlines() if "shares" in line or "killed" in line]


def test_each_expression_is_changed_in_one_way_and_text_never(tmp_path):
    file = tmp_path / "module.py"
    file.write_text(CODE)
    assert [(d.line, d.before, d.after) for d in defects_of(tmp_path, file)] == [
        (6, "100", "(101)"),
        (8, "part < 0 and not whole", "(not (part < 0 and (not whole)))"),
        (8, "part < 0 and not whole", "(part < 0 or not whole)"),
        (8, "part < 0", "(part <= 0)"),
        (8, "0", "(1)"),
        (8, "not whole", "(whole)"),
        (9, 'raise ValueError(f"{part + 1} is negative")', "pass"),
        (11, "break", "continue"),
        (12, "round(max(part, 0.5) / whole, ndigits=3)", "(round(max(part, 0.5) / whole))"),
        (12, "max(part, 0.5) / whole", "(max(part, 0.5) * whole)"),
        (12, "max", "(min)"),
        (12, "0.5", "(1.0)"),
        (12, "3", "(4)"),
        (22, "self.keep(-1)", "pass"),
        (22, "-1", "(1)"),
        (22, "1", "(2)"),
        (23, "True", "(False)"),
    ]
    for defect in defects_of(tmp_path, file):
        compile(defect.apply(CODE), "module.py", "exec")
        assert len(defect.apply(CODE)) - len(CODE) == len(defect.after) - len(defect.before)


def test_it_says_which_defects_no_test_notices_also_after_lines_moved(project):
    lines = run(project, "--count", "10")
    # Those of `double` die, and that of `at_import`, which runs while the module is imported; that
    # of `opposite` survives with 0; no test reaches `unused`.
    survivors = sorted(line.split(": ")[0].split()[::2] for line in lines[:-2])
    assert survivors == [["survived", "opposite"], ["uncovered", "unused"]]
    assert lines[-1].split(maxsplit=1)[1] == "3 of 5 killed: 60% (23% to 88%)"
    code = project / "gesturekit/shares.py"
    code.write_text("import math\n\n\n" + code.read_text())
    again = run(project)
    assert again[-1] == lines[-1] and len(again) == len(lines)


def test_formulas_and_arguments_are_of_todays_code(monkeypatch):
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(mutation, "ROOT", ROOT)
    assert len(mutation.formulas()) > 100
    known = defaultdict(set)
    for entry in mutation.table("equivalent.toml").get("defect", []):
        path = ROOT / (entry["function"].partition(":")[0].replace(".", "/") + ".py")
        if path not in known:
            known[path] = {mutation.key_of(defect) for defect in defects_of(ROOT, path)}
        assert (entry["function"], entry["change"]) in known[path]
        assert entry["because"].endswith(".")
