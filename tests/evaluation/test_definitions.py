"""The table of metrics: what it names exists, so that an entry and a function are a metric."""

import pkgutil
import re

from gesturekit.evaluation import DEFINITIONS, GROUPS, Variants


def test_entries_are_consistent():
    for definition in DEFINITIONS.values():
        for name in re.findall(r"gesturekit\.[\w.]+", definition.source):
            assert pkgutil.resolve_name(name), definition.key
        assert definition.group in GROUPS and definition.taken_with in GROUPS, definition.key
        assert bool(definition.function) == bool(definition.of), definition.key
        assert not definition.mismatched or definition.of == "comparison", definition.key


def test_definitions_are_filled_with_frames_seconds_and_the_variant():
    coverage, bas = DEFINITIONS["coverage"], DEFINITIONS["bas"]
    usual, paper = coverage.at(25, Variants()), coverage.at(30, Variants("paper", 2.5))
    assert re.search(r"ganimator.*30 frames.*1\.20 s.*\b2$", usual.variant)
    assert all(fact in usual.text for fact in ("30 frames", "1.20 s", " 2 ", "L2 norm"))
    assert re.search(r"paper.*30 frames.*1\.00 s.*\b2\.5", paper.variant)
    assert all(fact in paper.text for fact in ("30 frames", "1.00 s", " 2.5 ", "Frobenius"))
    assert [bas.at(25, Variants(bas=name)).fps_bound for name in ("seconds", "bailando")] == [
        False, True
    ]  # fmt: skip
    assert (usual.key, usual.unit, usual.title) == ("coverage", "%", "Coverage, %")
    assert DEFINITIONS["sync"].at(25, Variants("paper")).title == "Sync"
