"""Configurations: dataclasses are the schema, YAML files hold the values.

A file may name a parent with `base: other.yaml`, or a recipe with `base: multires_speech/light`,
and then holds only what differs from it. On the command line, dotted `key=value` changes single
values. An unknown key is an error that names the nearest known one. Paths are relative to the file
that names them, or to the current folder when they come from the command line.
"""

from __future__ import annotations

import copy
import dataclasses
import difflib
import json
import math
import re
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, TypeVar

import yaml

from audio_features.archive import read_bytes
from gesturekit.errors import ConfigError
from gesturekit.field_docs import field_docs
from gesturekit.training.recipes import recipe_config

Schema = TypeVar("Schema")
Number = TypeVar("Number")


_LENGTH = ("longer", "training.updates", "training.first_stage", "training.further_stages")
_SYNONYMS = {
    **dict.fromkeys(("steps", "max_steps", "num_steps", "epoch", "epochs"), _LENGTH),
    **dict.fromkeys(("max_epochs", "num_epochs", "iters", "iterations", "n_iter"), _LENGTH),
    "lr": ("training.learning_rate",),
    "batch_size": ("training.batch",),
}
"""Names of settings in other programs, and the settings here that are meant."""
_MAX_BYTES = 2 << 20
_MAX_DIGITS = 40


class _Loader(yaml.SafeLoader):
    """Safe YAML that reads 1e-3 as a number; PyYAML follows YAML 1.1, which wants 1.0e-3.

    Numbers of many digits are refused.
    """

    def construct_yaml_int(self, node: Any) -> int:
        """Return a whole number."""
        if len(node.value) > _MAX_DIGITS:
            problem = f"a number of {len(node.value)} digits"
            raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark)
        return super().construct_yaml_int(node)


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_yaml_int)

_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\d[\d_]*)(\.\d*)?[eE][-+]?\d+$|^[-+]?\.\d+[eE][-+]?\d+$"),
    list("-+0123456789."),
)


@lru_cache(maxsize=32)
def _parsed(text: str | bytes) -> Any:
    """Return the values of YAML; a command reads the same chain of recipes several times."""
    try:
        return yaml.load(text, Loader=_Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        # ValueError: what looks like a date and is none. RecursionError: nested without end.
        raise ConfigError(f"not valid YAML: {' '.join(str(error).split())}") from None


def read_yaml(path: str | Path) -> dict[str, Any]:
    """Read one YAML mapping by the safe loader.

    Raises:
        ConfigError: the file is missing, is not YAML, or holds no mapping.
    """
    content = read_bytes(Path(path), _MAX_BYTES, ConfigError)
    try:
        values = copy.deepcopy(_parsed(content))
        if not isinstance(values, dict):
            raise ConfigError(f"holds {type(values).__name__}, expected key: value lines")
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    return values


def load_config(
    path: str | Path,
    schema: type[Schema],
    overrides: Sequence[str] = (),
    settings: Mapping[str, Any] | None = None,
) -> Schema:
    """Read a configuration file, its parents, and command-line overrides into `schema`.

    Args:
        path: YAML file; its `base:` names a parent, relative to itself, or a recipe.
        schema: the dataclass that holds names, types and defaults.
        overrides: `key.subkey=value` strings; values are read as YAML.
        settings: the same as Python values, by (dotted) name; they take precedence.

    Raises:
        ConfigError: unknown key, wrong type, a chain of parents that does not end.
    """
    merged, given = read_chain(path, schema), dict[str, Any]()
    for override in overrides:
        key, separator, text = override.partition("=")
        try:
            if not separator or not key:
                raise ConfigError("overrides look like key=value or section.key=value")
            given = _merge(given, _nested(key, _parsed(text)))
        except ConfigError as error:
            raise ConfigError(f"{override!r}: {error}") from None
    for key, value in (settings or {}).items():
        given = _merge(given, _nested(key, value))
    merged = _merge(merged, _resolve_paths(given, schema, Path.cwd()))
    try:
        return build(schema, merged, where=str(path))
    except ConfigError as error:
        problem = str(error).removeprefix(f"{path}: ")
        key = re.findall(r"(?:unknown key )?([\w.]*)", problem)[0]
        if any(f"{name}.".startswith(f"{key}.") for name in dotted(given)):
            raise ConfigError(problem) from None  # an override is wrong, not the file
        raise


def read_chain(path: str | Path, schema: type | None = None, depth: int = 8) -> dict[str, Any]:
    """Return a file's values over those of its `base:` files, unchecked.

    Paths are as written; with the schema that names them, absolute.
    """
    path = Path(path)
    values: dict[str, Any] = {}
    for key, value in read_yaml(path).items():
        values = _merge(values, _nested(key, value))
    base = values.pop("base", None)
    values = _resolve_paths(values, schema, path.resolve().parent)
    if base is None:
        return values
    if depth == 0 or not isinstance(base, str):
        problem = "does a file include itself?" if depth == 0 else "not a file name"
        raise ConfigError(f"{path}: base: {base!r}: {problem}")
    parent = path.parent / base
    if not parent.exists():
        parent = recipe_config(base) or parent
    return _merge(read_chain(parent, schema, depth - 1), values)


def _nested(key: Any, value: Any) -> dict[Any, Any]:
    """Return nested mappings for a dotted key: {"a": {"b": value}} for "a.b"."""
    for name in reversed(key.split(".") if isinstance(key, str) else [key]):
        value = {name: value}
    return value


def _merge(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    merged = dict(below)
    for key, value in above.items():
        if isinstance(value, dict) and isinstance(merged.get(key), dict):
            merged[key] = _merge(merged[key], value)
        else:
            merged[key] = value
    return merged


def _resolve_paths(values: Any, schema: Any, folder: Path) -> Any:
    """Make the values of Path fields absolute, relative to the folder they were written in."""
    if not dataclasses.is_dataclass(schema) or not isinstance(values, dict):
        return values
    hints = typing.get_type_hints(schema)
    resolved = {}
    for key, value in values.items():
        options = _options(hints.get(key, Any))
        if Path in options and isinstance(value, (str, Path)):
            value = str(path_from(folder, key, value))
        for option in options:
            value = _resolve_paths(value, option, folder)
        resolved[key] = value
    return resolved


def path_from(folder: Path, key: str, value: str | Path) -> Path:
    """Return the absolute path of a value that may begin with ~ or be relative to a folder.

    Raises:
        ConfigError: there is no such user, or the text cannot be a path.
    """
    try:
        return (folder / Path(value).expanduser()).resolve()
    except (OSError, RuntimeError, ValueError) as error:
        raise ConfigError(f"{folder}: {key}: {value!a} is no path: {error}") from None


@dataclass(frozen=True)
class Limits:
    """Limits of a setting that is a number; without any, it is finite and at least 0.

    Attributes:
        most: inclusive upper limit, which may bound memory and time.
        is_above: whether 0 is excluded.
        is_below: whether `most` is excluded.
    """

    most: float = math.inf
    is_above: bool = False
    is_below: bool = False


Positive = Annotated[Number, Limits(is_above=True)]
Share = Annotated[float, Limits(most=1)]
ShareBelowOne = Annotated[float, Limits(most=1, is_below=True)]


class Settings:
    """Base of configuration dataclasses: checks numbers against the `Limits` of their fields."""

    def __post_init__(self) -> None:
        for name, hint in typing.get_type_hints(type(self), include_extras=True).items():
            value = getattr(self, name)
            if isinstance(value, int | float) and not isinstance(value, bool):
                limits = hint.__metadata__[0] if typing.get_origin(hint) is Annotated else Limits()
                low = value > 0 if limits.is_above else value >= 0
                high = value < limits.most if limits.is_below else value <= limits.most
                if low and high and math.isfinite(value):
                    continue
                wanted = "above 0" if limits.is_above else "at least 0"
                if limits.most < math.inf:
                    wanted += f" and {'below' if limits.is_below else 'at most'} {limits.most:g}"
                raise ConfigError(f"{name}: {value!r} must be {wanted}")
        if problem := next(self.problems(), None):
            raise ConfigError(problem)

    def problems(self) -> Iterator[str]:
        """Yield what is wrong with the settings, beside numbers out of their limits."""
        yield from ()


def build(schema: type[Schema], values: dict[str, Any], *, where: str = "config") -> Schema:
    """Build a dataclass from a mapping, and check its values.

    Raises:
        ConfigError: with `where`, the dotted key, the value and what was expected.
    """
    try:
        return _section(values, schema, "")
    except KeyError as unknown:
        key, known = unknown.args[0], _settings(schema)
        section, _, leaf = key.rpartition(".")
        beside = {n.rpartition(".")[2]: n for n in known if n.rpartition(".")[0] == section}
        meant = [name for name in _SYNONYMS.get(leaf, ()) if name in known]
        meant = meant or [name for name in known if name.rpartition(".")[2] == leaf]
        meant = meant or [beside[name] for name in difflib.get_close_matches(leaf, beside, 1, 0.5)]
        if not beside:  # no such section
            meant = meant or difflib.get_close_matches(key, known, n=1, cutoff=0.5)
        hint = f"did you mean {' or '.join(meant)}?" if meant else f"known: {', '.join(beside)}"
        problem = f"unknown key {key}; {hint}"
    except ConfigError as error:
        problem = str(error)
    raise ConfigError(f"{where}: {problem}")


def _settings(schema: Any, prefix: str = "") -> list[str]:
    """Return the dotted names of all settings and sections of a dataclass."""
    names = []
    for name, hint in typing.get_type_hints(schema).items():
        names += [f"{prefix}{name}"]
        for option in _options(hint):
            if dataclasses.is_dataclass(option):
                names += _settings(option, f"{prefix}{name}.")
    return names


def _section(values: Any, schema: Any, key: str) -> Any:
    """Build a dataclass; `key` is its dotted name, empty for the whole configuration.

    Raises:
        KeyError: a dotted key that it does not have: of an unknown section, its first setting.
        ConfigError: a wrong value.
    """
    if not isinstance(values, dict):
        raise ConfigError(f"{key or 'the file'} must hold keys, not {values!r}")
    hints, prefix = typing.get_type_hints(schema), f"{key}." if key else ""
    for name in (name for name in values if name not in hints):
        raise KeyError(f"{prefix}{next(iter(dotted({name: values[name]})))}")
    made = {name: _convert(value, hints[name], f"{prefix}{name}") for name, value in values.items()}
    for field in dataclasses.fields(schema):
        is_required = field.default is MISSING and field.default_factory is MISSING
        if is_required and field.name not in made:
            name = f"{prefix}{field.name}"
            raise ConfigError(f"{name} is missing; add it there, or {name}=... here")
    try:
        return schema(**made)
    except ConfigError as error:  # of __post_init__, which does not know the section
        raise ConfigError(f"{prefix}{error}") from None


def dotted(values: Mapping[Any, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested values by their dotted names, such as training.updates."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        name = f"{prefix}{key}"
        flat |= dotted(value, f"{name}.") if isinstance(value, dict) and value else {name: value}
    return flat


def _options(hint: Any) -> tuple[Any, ...]:
    origin = typing.get_origin(hint)
    return typing.get_args(hint) if origin in (typing.Union, types.UnionType) else (hint,)


def _convert(value: Any, hint: Any, key: str) -> Any:
    """Return a value of YAML as its type hint asks; the first problem of a union counts."""
    options, problems = _options(hint), []
    if value is None and type(None) in options:
        return None
    for option in options:
        try:
            return _converted(value, option, key)
        except ConfigError as error:
            problems.append(error)
    raise problems[0]


def _converted(value: Any, hint: Any, key: str) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if dataclasses.is_dataclass(hint):
        return _section(value, hint, key)
    expected = f"of type {getattr(hint, '__name__', hint)}"
    if origin is typing.Literal:
        if value in arguments:
            return value
        expected = f"one of {', '.join(map(repr, arguments))}"
    elif origin in (list, tuple):
        if isinstance(value, (list, tuple)):
            return tuple(_convert(item, arguments[0], f"{key}[]") for item in value)
        expected = "a list"
    elif dict in (hint, origin):
        if isinstance(value, dict):
            return value
        expected = "a mapping"
    elif hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    elif hint is Path and isinstance(value, str):
        return Path(value)
    elif hint in (int, bool, str) and type(value) is hint:
        return value
    raise ConfigError(f"{key}: {'null' if value is None else repr(value)} is not {expected}")


def to_dict(config: Any) -> Any:
    """Return a configuration, or one of its values, as plain values, ready for YAML or JSON."""

    def plain(value: Any) -> Any:
        is_section = dataclasses.is_dataclass(value) and not isinstance(value, type)
        return dataclasses.asdict(value) if is_section else str(value)

    return json.loads(json.dumps(config, default=plain))


def dump_yaml(values: Mapping[str, Any]) -> str:
    """Return YAML text of plain values, in their own order."""
    # As JSON is a tree, no value refers to another one.
    return yaml.safe_dump(to_dict(values), sort_keys=False, allow_unicode=True)


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
        doc, default = docs.get(field.name, ""), "required"
        if field.default_factory is not MISSING:
            default = _on_one_line(field.default_factory())
        elif field.default is not MISSING:
            default = _on_one_line(field.default)
        if dataclasses.is_dataclass(value):
            doc = doc or (type(value).__doc__ or "").partition("\n")[0]
            heading = Setting(name, None, "null" if default == "null" else None, doc)
            sections.append((heading, value))
        else:
            written = _on_one_line(value)
            yield Setting(name, written, None if written == default else default, doc)
    for heading, section in sections:
        yield heading
        yield from list_settings(section, f"{heading.name}.")


def _on_one_line(value: Any) -> str:
    """Return a value as YAML on one line."""
    text = yaml.safe_dump(
        to_dict(value),
        default_flow_style=True,
        sort_keys=False,
        allow_unicode=True,
        width=10_000,
    )
    return text.split("\n...")[0].strip()
