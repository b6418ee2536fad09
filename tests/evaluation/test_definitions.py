"""The table of metrics: what it names exists, so that an entry and a function are a metric."""

from __future__ import annotations

import dataclasses
import inspect
import pkgutil
import re

import pytest

from gesturekit.evaluation.definitions import DEFINITIONS, GROUPS, definitions_of
from gesturekit.evaluation.measuring.clips import RecordedSound
from gesturekit.evaluation.measuring.inputs import ClipInputs, SetInputs

SOURCES = {
    "motion": (ClipInputs,),
    "comparison": (ClipInputs,),
    "sound": (ClipInputs, RecordedSound),
    "distance": (SetInputs,),
    "diversity": (SetInputs,),
}


@pytest.mark.parametrize("definition", definitions_of(*SOURCES), ids=lambda d: d.key)
def test_every_parameter_of_a_metric_is_an_input(definition):
    names = {
        name
        for source in SOURCES[definition.of]
        for name in [*dir(source), *(field.name for field in dataclasses.fields(source))]
    }
    parameters = inspect.signature(definition.load_function()).parameters
    needed = {name for name, p in parameters.items() if p.default is p.empty}
    assert needed <= names and set(definition.arguments) <= set(parameters)


def test_entries_are_consistent():
    for definition in DEFINITIONS.values():
        for name in re.findall(r"gesturekit\.[\w.]+", definition.source):
            assert pkgutil.resolve_name(name), definition.key
        assert definition.group in GROUPS and definition.taken_with in GROUPS, definition.key
        assert bool(definition.function) == bool(definition.of), definition.key
        assert definition.better in ("higher", "lower", "reference"), definition.key
        assert definition.enough in ("", "at least", "at most"), definition.key
        assert set(definition.shown) <= {"clips", "ratios", "ranking"}, definition.key
        assert not definition.mismatched or definition.of == "comparison", definition.key
