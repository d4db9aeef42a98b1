"""Sets of keys and sums of counters against plain Python; keys in datagrams against the decoder."""

from __future__ import annotations

import random

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from mapping.random_components import random_components
from sharing.message_examples import examples
from sharing.schedules import act

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.occupancy.calibrator import Calibrator
from gmmtorch.team.sharing.messages.count_messages import counts_of
from gmmtorch.team.sharing.messages.message_registry import ComponentsMessage, decode, encode_components
from gmmtorch.team.sharing.messages.record_messages import CountersMessage
from gmmtorch.team.sharing.replica.component_table import Counters
from gmmtorch.team.sharing.replica.record_keys import (
    RECORD_KINDS,
    Intervals,
    evict,
    first_key,
    keys_in,
    keys_of,
)
from gmmtorch.team.sharing.replica.replica import Replica

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


# -- counters -------------------------------------------------------------------------------------------

entries = st.dictionaries(st.integers(0, 12), st.integers(-41, 160), max_size=8)
acts = st.lists(st.tuples(st.integers(0, 2), entries, st.booleans()), max_size=25)


@given(acts=acts, choice=st.randoms(use_true_random=False))
def test_sums_equal_those_of_the_records(acts, choice):
    totals, here = Counters(), {}
    for number, (robot, row, drops) in enumerate(acts):
        names = np.array(list(row), np.int64)
        record = CountersMessage(
            first_key(robot, 3) + number, names, np.array([row[name] for name in names.tolist()], np.int64)
        )
        totals.add(record)
        here[record.key] = record
        if drops:
            gone = choice.sample(sorted(here), choice.randint(1, len(here)))
            totals.drop([here.pop(key) for key in gone])
        largest: dict[tuple[int, int], int] = {}
        for key, one in here.items():
            for name, step in zip(one.components.tolist(), one.steps.tolist(), strict=True):
                largest[name, key >> 28] = max(largest.get((name, key >> 28), step), step)
        expected = [0.0] * 14  # not by sum(), which compensates rounding since Python 3.12
        for (name, _), step in sorted(largest.items()):
            expected[name] += float(counts_of(np.array([step]))[0])
        assert totals.sums(np.arange(14)).tolist() == expected
        assert totals.keys().tolist() == sorted({name for name, _ in largest})
        assert {key for robot in range(3) for key in totals.of(first_key(robot, 3) >> 28)} == here.keys()


# -- keys in datagrams ----------------------------------------------------------------------------------


def decoded_keys(datagram: bytes) -> Intervals:
    message = decode(datagram)
    if isinstance(message, ComponentsMessage):
        return Intervals.of(keys_of(message.components.ids))
    return Intervals.span(message.key, message.key + 1)


def test_keys_in_datagrams_equal_the_decoded_keys():
    rng, replica = random.Random(3), Replica(5)
    datagrams: list[bytes] = []
    for _ in range(25):
        act(rng, replica)
        datagrams += replica.datagrams()
    replica.calibrate(Calibrator.of(12.0, 3).calibration._replace(n_predicted=90))
    datagrams += replica.datagrams()
    for dim in (2, 3):
        for k in (1, 2, 150):
            made = random_components(dim, k=k, robot=1023)
            made.ids[:, 1] = torch.randperm(1 << 20)[:k] << 32
            datagrams += encode_components(made)
    datagrams += Replica(6, own_frame=True).datagrams()
    assert {datagram[0] & 15 for datagram in datagrams} == RECORD_KINDS
    for datagram in datagrams:
        assert keys_in(datagram) == decoded_keys(datagram)


def test_datagrams_without_records_are_refused():
    components = encode_components(random_components(3, k=20))[0]
    others = [datagram for datagram in examples() if datagram[0] & 15 not in RECORD_KINDS]
    assert len(others) >= 8
    for datagram in [b"", b"\x11", components[:9], b"\x1b" + components[1:], *others]:
        with pytest.raises(DataError):
            keys_in(datagram)
