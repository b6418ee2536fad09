from __future__ import annotations

from collections import Counter
from math import inf

import pytest

from gesturekit.corpus.splits import cut, held_out, parse_intervals
from gesturekit.errors import CorpusError


def test_a_fraction_is_held_out_for_test_and_valid_in_turn():
    splits = held_out([f"r{i}" for i in range(40)], 0.1, seed=0)
    assert Counter(splits.values()) == {"train": 36, "test": 2, "valid": 2}


def test_the_choice_depends_on_the_seed_and_not_on_the_order():
    ids = [f"r{i}" for i in range(40)]
    assert held_out(ids, 0.2, 0) == held_out(ids[::-1], 0.2, 0)
    assert held_out(ids, 0.2, 0) != held_out(ids, 0.2, 1)


def test_at_least_one_is_held_out_where_asked_and_never_all():
    assert Counter(held_out(["a", "b"], 0.1, 0, at_least=1).values()) == {"train": 1, "test": 1}
    assert set(held_out(["a", "b"], 0.99, 0).values()) == {"train", "test"}
    assert set(held_out(["a"], 0.5, 0, at_least=1).values()) == {"train"}
    assert set(held_out(["a", "b"], 0.0, 0, at_least=1).values()) == {"train"}
    assert held_out([], 0.5, 0) == {}


def test_intervals_are_read_and_wrong_ones_refused():
    assert parse_intervals("10-20.5, 55-") == [(10.0, 20.5), (55.0, inf)]
    for text in ("", "10", "20-10", "a-b", "10-20;30-40", "-5"):
        with pytest.raises(CorpusError):
            parse_intervals(text)


def test_cutting_leaves_the_rest_for_training():
    assert cut(0.0, 10.0, [(4.0, 6.0)]) == [
        ("train", (0.0, 4.0)),
        ("test", (4.0, 6.0)),
        ("train", (6.0, 10.0)),
    ]
    assert cut(1.0, 10.0, [(8.0, inf), (0.0, 2.0)]) == [
        ("test", (1.0, 2.0)),
        ("train", (2.0, 8.0)),
        ("test", (8.0, 10.0)),
    ]
    assert cut(0.0, 5.0, [(7.0, 9.0)]) == [("train", (0.0, 5.0))]
    assert cut(0.0, 5.0, [(1.0, 3.0), (2.0, 4.0)]) == [
        ("train", (0.0, 1.0)),
        ("test", (1.0, 4.0)),
        ("train", (4.0, 5.0)),
    ]
