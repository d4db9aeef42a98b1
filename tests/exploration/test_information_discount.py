"""InformationDiscount, against a dictionary of blocks."""

from __future__ import annotations

import itertools

import torch
from exploration.voxel_worlds import surroundings_from
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.team.exploration.information.view_cache import InformationDiscount

SHAPE = (12, 9, 8)
COUNTS = (3, 3, 2)


def window(low: tuple[int, int, int]):
    return surroundings_from(torch.ones(SHAPE, dtype=torch.bool), low)


corners = st.tuples(*[st.integers(-3, 3).map(lambda n: 4 * n)] * 3)


@given(lows=st.lists(corners, min_size=1, max_size=5), seed=st.integers(0, 99))
def test_weights_equal_a_dictionary_for_any_window(lows, seed):
    generator = torch.Generator().manual_seed(seed)
    discount, kept = InformationDiscount(), {}
    for now, low in enumerate(lows):
        measured = torch.rand(18, generator=generator) * (torch.rand(18, generator=generator) < 0.5)
        discount.note(window(low), measured, float(now))
        for share, block in zip(measured.tolist(), itertools.product(*map(range, COUNTS)), strict=True):
            name = tuple(a // 4 + b for a, b in zip(low, block, strict=True))
            kept[name] = kept.get(name, 1.0) * (1 - 0.25 * share)
    for low in lows:
        expected = [
            kept.get(tuple(a // 4 + b for a, b in zip(low, block, strict=True)), 1.0)
            for block in itertools.product(*map(range, COUNTS))
        ]
        torch.testing.assert_close(discount.weights(window(low)), torch.tensor(expected))


def test_note_counts_once_for_each_time():
    discount = InformationDiscount()
    assert discount.weights(window((0, 0, 0))).tolist() == [1.0] * 18
    for _ in range(3):
        discount.note(window((0, 0, 0)), torch.ones(18), 2.0)
    assert discount.weights(window((0, 0, 0))).tolist() == [0.75] * 18
    discount.note(window((0, 0, 0)), torch.ones(18), 4.0)
    assert discount.weights(window((0, 0, 0))).tolist() == [0.5625] * 18
