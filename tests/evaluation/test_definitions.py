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
    for found, name, facts in (
        (usual, "ganimator", (r"\b30 frames", r"\b1\.20? s", r"\b2\b")),
        (paper, "paper", (r"\b30 frames", r"\b1(\.00)? s", r"\b2\.5\b")),
    ):
        assert name in found.variant
        assert all(re.search(f, text) for f in facts for text in (found.variant, found.text))
    assert "L2" in usual.text and "Frobenius" in paper.text
    assert [bas.at(25, Variants(bas=name)).fps_bound for name in ("seconds", "bailando")] == [
        False, True
    ]  # fmt: skip
    assert (usual.key, usual.unit) == ("coverage", "%") and "%" in usual.title
