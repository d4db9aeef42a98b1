"""Counters: sums over sessions while records are added and dropped, against plain dictionaries."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.sharing.messages.count_messages import counts_of
from gmmtorch.sharing.messages.record_messages import CountersMessage
from gmmtorch.sharing.replica.component_table import Counters
from gmmtorch.sharing.replica.record_keys import first_key

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
