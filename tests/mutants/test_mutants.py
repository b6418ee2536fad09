"""The kept mutants apply to today's code; `make mutants` shows that tests notice them."""

import pytest
from mutation import Mutant, StaleMutantError, read_mutants, stale

SOURCE = """
def loss(x):
    return x + 1


class Model:
    def loss(self, x):
        return x + 1
"""


def mutant(function, before="x + 1"):
    return Mutant(function, before, "x - 1", ())


def test_every_kept_mutant_applies_exactly_once_and_names_tests_that_exist():
    mutants = read_mutants()
    assert not stale(mutants)
    assert len({str(mutant) for mutant in mutants}) == len(mutants)


def test_a_mutant_changes_the_function_that_it_names_alone():
    changed = mutant("module:Model.loss").apply(SOURCE)
    assert changed == SOURCE[::-1].replace("1 + x", "1 - x", 1)[::-1]


@pytest.mark.parametrize("name", ["module:other", "module:Model.other", "module"])
def test_a_mutant_that_does_not_apply_exactly_once_is_refused(name):
    with pytest.raises(StaleMutantError):
        mutant(name).apply(SOURCE)
