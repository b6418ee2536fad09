"""Examples in docstrings run, and show what they say.

They know `af` (audio_features), `gk` (gesturekit), `np`, and `folder`, an empty folder.
"""

import doctest
import importlib
import pkgutil
from collections.abc import Iterator
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

import audio_features as af
import gesturekit as gk
from gesturekit.evaluation import DEFINITIONS, metrics

# Packages of which every public name has an example.
COMPLETE = ("audio_features", "gesturekit", "gesturekit.evaluation")


def public(package: str) -> dict[str, object]:
    module = importlib.import_module(package)
    return {name: getattr(module, name) for name in module.__all__}


def examples() -> Iterator[doctest.DocTest]:
    """Yield the docstrings with examples of the modules that define public names and metrics."""
    modules = {getattr(value, "__module__", None) for p in COMPLETE for value in public(p).values()}
    below = pkgutil.walk_packages(metrics.__path__, f"{metrics.__name__}.")
    modules |= {*(found.name for found in below), *COMPLETE}
    for name in sorted(modules - {None, "builtins", "typing"}):
        found = doctest.DocTestFinder().find(importlib.import_module(name))
        yield from (test for test in found if test.examples)


# A model is loaded once for all examples.
OURS = SimpleNamespace(**public("gesturekit") | {"load": cache(gk.load)})


@pytest.mark.parametrize("example", list(examples()), ids=lambda example: example.name)
def test_the_example_shows_what_it_says(example, tmp_path):
    example.globs |= {"af": af, "gk": OURS, "np": np, "folder": tmp_path}
    lines: list[str] = []
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE)
    assert not runner.run(example, out=lines.append).failed, "".join(lines)


def without_example(named: dict[str, object]) -> list[str]:
    found = doctest.DocTestFinder(recurse=False)
    return [
        name
        for name, value in named.items()
        if not any(test.examples for test in found.find(value, name))
    ]


@pytest.mark.parametrize("package", COMPLETE)
def test_every_public_name_has_an_example(package):
    without = without_example(public(package))
    assert not without, f"without an example: {', '.join(without)}"


def test_every_metric_of_the_registry_has_an_example():
    functions = {d.function: d.load_function() for d in DEFINITIONS.values() if d.function}
    without = without_example(functions)
    assert functions and not without, f"metrics without an example: {', '.join(without)}"
