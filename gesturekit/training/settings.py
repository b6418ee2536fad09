"""List of the settings of a configuration, with values, defaults and docstrings."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from dataclasses import MISSING, dataclass
from typing import Any

import yaml

from gesturekit.field_docs import field_docs


@dataclass(frozen=True)
class Setting:
    """One setting of a configuration, or the heading of a section.

    Attributes:
        name: dotted name, as on the command line.
        value: YAML on one line; None for the heading of a section.
        default: YAML on one line, or "required"; None where it is the value.
        doc: docstring on one line; empty where there is none.
    """

    name: str
    value: str | None
    default: str | None
    doc: str


def list_settings(config: Any, prefix: str = "") -> Iterator[Setting]:
    """Yield the settings of a configuration in the order of its schema, sections last.

    Args:
        config: an instance of a configuration dataclass.
        prefix: dotted name of its section, with a dot at the end.
    """
    docs = field_docs(type(config))
    sections = []
    for field in dataclasses.fields(config):
        name, value = f"{prefix}{field.name}", getattr(config, field.name)
        doc, default = docs.get(field.name, ""), _default(field)
        if dataclasses.is_dataclass(value):
            doc = doc or (type(value).__doc__ or "").partition("\n")[0]
            heading = Setting(name, None, "null" if default == "null" else None, doc)
            sections.append((heading, value))
        else:
            written = _yaml(value)
            yield Setting(name, written, None if written == default else default, doc)
    for heading, section in sections:
        yield heading
        yield from list_settings(section, f"{heading.name}.")


def _default(field: dataclasses.Field[Any]) -> str:
    if field.default is not MISSING:
        return _yaml(field.default)
    return "required" if field.default_factory is MISSING else _yaml(field.default_factory())


def _yaml(value: Any) -> str:
    """Return a value as YAML on one line."""

    def plain(value: Any) -> Any:
        is_one = dataclasses.is_dataclass(value) and not isinstance(value, type)
        return dataclasses.asdict(value) if is_one else str(value)

    text = yaml.safe_dump(
        json.loads(json.dumps(value, default=plain)),
        default_flow_style=True,
        sort_keys=False,
        allow_unicode=True,
        width=10_000,
    )
    return text.split("\n...")[0].strip()
