"""Dataclasses as schemas of options: docstrings of their fields, construction from keywords."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import textwrap
from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, Any, TypeVar

from gesturekit.errors import GestureKitError
from gesturekit.wording import did_you_mean

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Options = TypeVar("Options", bound="DataclassInstance")


class UnknownOptionError(GestureKitError, TypeError):
    """A keyword that a function does not have."""


def build_options(schema: type[Options], keywords: Mapping[str, Any], function: str) -> Options:
    """Build the options of one call of a public function.

    Args:
        schema: a dataclass, one field for each keyword.
        keywords: by field name.
        function: its name, for errors.

    Raises:
        UnknownOptionError: a keyword that is not a field; the message gives the nearest name.
    """
    names = [field.name for field in dataclasses.fields(schema)]
    for name in keywords:
        if name not in names:
            hint = did_you_mean(name, names) or f"it has {', '.join(names)}"
            raise UnknownOptionError(f"{function} has no option {name}; {hint}")
    return schema(**keywords)


def field_docs(schema: type) -> dict[str, str]:
    """Return the docstring of each documented field, those of base classes included.

    Args:
        schema: a class whose fields are followed by a string, as in `RunConfig`. A `TypedDict` does
            not keep its base classes: its own fields.

    Returns:
        {field: text on one line}; fields without a docstring are left out.
    """
    docs: dict[str, str] = {}
    for base in reversed(schema.__mro__):
        if base.__module__ != "builtins":
            docs |= _docs_of_class(base)
    return docs


@cache
def _docs_of_class(schema: type) -> dict[str, str]:
    """Return the docstrings of the fields that a class itself declares."""
    docs = {}
    (body,) = ast.parse(textwrap.dedent(inspect.getsource(schema))).body
    assert isinstance(body, ast.ClassDef)
    for field, doc in zip(body.body, body.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(doc, ast.Expr):
            text = ast.literal_eval(doc.value)
            docs[ast.unparse(field.target)] = " ".join(text.split())
    return docs
