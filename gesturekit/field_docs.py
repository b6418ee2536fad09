"""Docstrings of dataclass fields: the string below a field says what it is."""

from __future__ import annotations

import ast
import inspect
import textwrap
from functools import cache


@cache
def field_docs(schema: type) -> dict[str, str]:
    """Return the docstring of each documented field, those of base classes included.

    Args:
        schema: a class whose fields are followed by a string, as in `RunConfig`.

    Returns:
        {field: text on one line}; fields without a docstring are left out.
    """
    docs: dict[str, str] = {}
    for base in reversed(schema.__mro__[:-1]):
        (body,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        assert isinstance(body, ast.ClassDef)
        for field, doc in zip(body.body, body.body[1:], strict=False):
            if isinstance(field, ast.AnnAssign) and isinstance(doc, ast.Expr):
                text = ast.literal_eval(doc.value)
                docs[ast.unparse(field.target)] = " ".join(text.split())
    return docs
