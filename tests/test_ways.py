"""The ways through the code that docs/architecture.md lists lead through functions that exist."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TITLES = [
    "From a wav to motion",
    "From files to files",
    "From a corpus to a model",
    "From outputs to a report",
]


def functions(tree: ast.AST, above: str = "") -> Iterator[str]:
    """Yield the qualified names of the functions of a module."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield f"{above}{node.name}"
            yield from functions(node, f"{above}{node.name}.")


@pytest.mark.parametrize("title", TITLES)
def test_each_list_names_functions_that_exist(title):
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    section = text.partition(f"## {title}\n")[2].partition("\n## ")[0]
    lines = re.findall(r"^\d+\. .*$", section, re.MULTILINE)
    assert lines, title
    for line in lines:
        name, file = re.match(r"\d+\. `([\w.]+)` in `([\w/.]+\.py)`: ", line).groups()
        assert name in set(functions(ast.parse((ROOT / file).read_text("utf-8")))), line
