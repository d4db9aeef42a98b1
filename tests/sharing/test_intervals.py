"""Intervals against sets of integers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.sharing.replica.record_keys import Intervals, evict

numbers = st.sets(st.integers(0, 40))


def of(values: set[int]) -> Intervals:
    return Intervals.of(np.array(list(values), np.int64))


def members(intervals: Intervals) -> set[int]:
    return {number for begin, end in intervals.pairs() for number in range(begin, end)}


@given(one=numbers, other=numbers)
def test_operations_equal_those_of_sets(one, other):
    a, b = of(one), of(other)
    assert members(a) == one
    assert members(a | b) == one | other
    assert members(a & b) == one & other
    assert members(a - b) == one - other
    assert a.covers(b) == (other <= one)
    assert (a == b) == (one == other)
    assert bool(a) == bool(one)
    assert a.size == len(one)
    assert a.numbers().tolist() == sorted(one)


@given(one=numbers, asked=st.lists(st.integers(-3, 45)))
def test_contains(one, asked):
    found = of(one).contains(np.array(asked, np.int64))
    assert found.tolist() == [number in one for number in asked]
    assert all((number in of(one)) == (number in one) for number in asked)


@given(one=numbers, other=numbers)
def test_intervals_are_as_few_as_possible(one, other):
    joined = of(one) | of(other)
    assert (np.diff(joined.edges) > 0).all()
    starts = [number for number in one | other if number - 1 not in one | other]
    assert len(joined) == len(starts)


@given(sets=st.lists(numbers, max_size=5))
def test_union_of_many_equals_repeated_unions(sets):
    found = Intervals.union(map(of, sets))
    assert members(found) == set().union(*sets)
    assert found == of(members(found))


@given(sets=st.dictionaries(st.integers(0, 9), numbers), most=st.integers(0, 30))
def test_evict_removes_the_largest_sets_first(sets, most):
    intervals = {name: of(values) for name, values in sets.items()}
    gone = evict(intervals, most)
    sizes = {name: len(one) for name, one in intervals.items()}
    left = [sizes[name] for name in sizes.keys() - set(gone)]
    assert sum(left) <= most
    assert all(sizes[name] >= max(left, default=0) for name in gone)
    assert not gone or sum(left) + sizes[gone[-1]] > most


@given(one=numbers, most=st.integers(0, 20))
def test_up_to_empties_larger_sets(one, most):
    assert members(of(one).up_to(most)) == (one if len(of(one)) <= most else set())


def test_long_intervals_take_no_memory():
    whole = Intervals.span(0, 1 << 62)
    hole = Intervals.span(1 << 40, 1 << 50)
    assert (whole - hole).size == (1 << 62) - (1 << 50) + (1 << 40)
    assert len(whole - hole) == 2
    assert not Intervals.span(5, 5)
    assert not Intervals.span(6, 5)
    assert repr(Intervals.span(3, 6)) == "Intervals(3…5)"


@pytest.mark.parametrize("edges", [[1], [2, 1], [1, 1], [0, 2, 2, 3]])
def test_invalid_edges_are_refused(edges):
    with pytest.raises(InvalidArgumentError, match="edges"):
        Intervals(np.array(edges, np.int64))
