"""Small changes of the code that a good suite of tests notices.

One change is made at a time, to one expression or statement inside a function. Text, log and error
messages, annotations and `__repr__` are left alone.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass
from pathlib import Path

OPERATORS: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Div,
    ast.Mod: ast.Mult,
    ast.Pow: ast.Mult,
    ast.MatMult: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.And: ast.Or,
    ast.Or: ast.And,
    ast.Continue: ast.Break,
    ast.Break: ast.Continue,
}
FUNCTIONS = {
    one: other
    for pair in (
        ("min", "max"),
        ("minimum", "maximum"),
        ("argmin", "argmax"),
        ("any", "all"),
        ("floor", "ceil"),
        ("sin", "cos"),
        ("zeros", "ones"),
        ("mean", "median"),
        ("cumsum", "cumprod"),
    )
    for one, other in (pair, pair[::-1])
}
MESSAGES = {"print", "echo", "warn", "warning", "info", "debug", "error", "write", "tqdm"}
"""Calls whose arguments are text for people; also all classes of errors and warnings."""

LOOKS = {"alpha", "color", "daemon", "desc", "fontsize", "help", "label", "leave", "linewidth"} | {
    "metavar",
    "stacklevel",
    "strict",
    "thread_name_prefix",
    "zorder",
}
"""Keywords that only colour a picture, name a thread or guard against errors of the programmer."""


@dataclass(frozen=True)
class Defect:
    """One change: `before` at byte `start` of a file becomes `after`."""

    path: str
    line: int
    function: str
    start: int
    before: str
    after: str
    kind: str
    compiled: bool

    def apply(self, source: str) -> str:
        """Return the file's text with the change made."""
        data, stop = source.encode(), self.start + len(self.before.encode())
        return (data[: self.start] + self.after.encode() + data[stop:]).decode()

    def __str__(self) -> str:
        change = " ".join(f"{self.before} -> {self.after}".split())
        return f"{self.path}:{self.line} {self.function}: {self.kind}: {change[:160]}"


def defects_of(root: Path, path: Path) -> list[Defect]:
    """Return every defect of a file, in the order of the text; `root` is the project's folder."""
    source = path.read_text(encoding="utf-8")
    lines = source.encode().splitlines(keepends=True)
    starts = [0]
    for line in lines:
        starts.append(starts[-1] + len(line))
    found = {}
    name = path.relative_to(root).as_posix()
    for node, function, compiled in _nodes(ast.parse(source), "", False):
        for kind, part, changed in _changes(node):
            start = starts[part.lineno - 1] + part.col_offset
            stop = starts[part.end_lineno - 1] + part.end_col_offset
            before = source.encode()[start:stop].decode()
            after = ast.unparse(changed)
            if isinstance(part, ast.expr):
                after = f"({after})"
            defect = Defect(name, part.lineno, function, start, before, after, kind, compiled)
            found[start, after] = defect
    return [found[key] for key in sorted(found)]


def _nodes(node: ast.AST, function: str, compiled: bool) -> Iterator[tuple[ast.AST, str, bool]]:
    """Yield the nodes inside functions that may change, with the function that holds each."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            if child.name not in {"__repr__", "__str__"}:
                name = f"{function}.{child.name}".lstrip(".")
                jit = any("compiled" in ast.unparse(d) for d in child.decorator_list)
                yield from _nodes(_Body(child), name, compiled or jit)
            continue
        if _is_text(child) or _is_any_length(node, child):
            continue
        if function and isinstance(child, ast.expr | ast.stmt):
            yield child, function, compiled
        if isinstance(child, ast.AnnAssign):
            child = ast.Expression(child.value) if child.value else ast.Module([], [])
        yield from _nodes(child, function, compiled)


class _Body(ast.AST):
    """The parts of a function or class that run: without decorators and annotations."""

    _fields = ("parts",)

    def __init__(self, node: ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) -> None:
        defaults: list[ast.AST] = []
        if not isinstance(node, ast.ClassDef):
            defaults = [d for d in (*node.args.defaults, *node.args.kw_defaults) if d]
        super().__init__(parts=[*defaults, *node.body])


def _is_text(node: ast.AST) -> bool:
    if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
        return True
    if isinstance(node, ast.JoinedStr | ast.arguments):
        return True
    if isinstance(node, ast.keyword):
        return node.arg in LOOKS
    if isinstance(node, ast.Expr):
        node = node.value
    if isinstance(node, ast.Call):
        name = _called(node)
        return name in MESSAGES or name.endswith(("Error", "Warning", "Exception"))
    return False


def _is_any_length(parent: ast.AST, node: ast.AST) -> bool:
    """Return whether a node is -1 in an array's new shape; numpy takes any negative number."""
    is_shape = isinstance(parent, ast.Call) and _called(parent) == "reshape"
    return is_shape and isinstance(node, ast.UnaryOp)


def _called(call: ast.Call) -> str:
    return ast.unparse(call.func).rpartition(".")[2]


def _changes(node: ast.AST) -> Iterator[tuple[str, ast.AST, ast.AST]]:
    """Yield each change of a node: its kind, the part of the node that it replaces, and by what."""
    match node:
        case ast.Compare(ops=ops):
            for n, operator in enumerate(ops):
                swapped = [*ops[:n], OPERATORS[type(operator)](), *ops[n + 1 :]]
                yield "comparison", node, _with(node, ops=swapped)
        case ast.BinOp(op=op, left=left, right=right):
            text = any(isinstance(s, ast.JoinedStr) or _is_string(s) for s in (left, right))
            if type(op) in OPERATORS and not text:
                yield "arithmetic", node, _with(node, op=OPERATORS[type(op)]())
        case ast.AugAssign(op=op) if type(op) in OPERATORS:
            yield "arithmetic", node, _with(node, op=OPERATORS[type(op)]())
        case ast.BoolOp(op=op):
            yield "and, or", node, _with(node, op=OPERATORS[type(op)]())
        case ast.UnaryOp(op=ast.Not() | ast.USub()):
            yield "not, minus", node, node.operand
        case ast.If(test=test) | ast.IfExp(test=test):
            yield "condition", test, ast.UnaryOp(ast.Not(), test)
        case ast.Constant(value=bool(value)):
            yield "constant", node, ast.Constant(not value)
        case ast.Constant(value=int(value)):
            yield "constant", node, ast.Constant(value + 1)
        case ast.Constant(value=float(value)) if value == 0.0 or abs(value) > 1e-5:
            yield "constant", node, ast.Constant(value * 2 if value else 1.0)
        case ast.Call(func=func, keywords=keywords):
            if _called(node) in FUNCTIONS:
                yield "function", func, _renamed(func)
            for n, keyword in enumerate(keywords):
                if keyword.arg and keyword.arg not in LOOKS:
                    left_out = [*keywords[:n], *keywords[n + 1 :]]
                    yield "argument dropped", node, _with(node, keywords=left_out)
        case ast.Raise():
            yield "raise dropped", node, ast.Pass()
        case ast.Expr(value=ast.Call()):
            yield "call dropped", node, ast.Pass()
        case ast.Continue() | ast.Break():
            yield "loop", node, OPERATORS[type(node)]()


def _with(node: ast.AST, **parts: object) -> ast.AST:
    changed = copy(node)
    for name, value in parts.items():
        setattr(changed, name, value)
    return changed


def _is_string(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def _renamed(function: ast.expr) -> ast.expr:
    if isinstance(function, ast.Name):
        return ast.Name(FUNCTIONS[function.id])
    return _with(function, attr=FUNCTIONS[function.attr])
