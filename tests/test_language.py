"""Docstrings begin with a verb phrase or a noun phrase, in plain English."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
AVOIDED = set("of what that how whose whether which where to in by for with".split())  # noqa: SIM905


def docstrings(path: Path) -> Iterator[tuple[int, str]]:
    """Yield (line, docstring) for the module, its classes and functions, nested ones included."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text is not None:
                yield node.body[0].lineno, text


@pytest.mark.parametrize("package", ["audio_features", "gesturekit"])
def test_docstrings_begin_with_a_verb_or_noun_phrase(package):
    wrong = []
    for path in sorted((ROOT / package).rglob("*.py")):
        if "node_modules" in path.parts:
            continue
        for line, text in docstrings(path):
            if re.match(r"\W*(\w+)", text).group(1).lower() in AVOIDED:
                wrong.append(f"{path.relative_to(ROOT)}:{line}: {text.splitlines()[0]}")
    assert not wrong, "\n".join(wrong)
