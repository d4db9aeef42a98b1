"""Parts of a log: every scan is one robot's, in order."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.datasets.dataset_shard import SPLITS, DatasetShard, shard_indices
from gmmtorch.errors import InvalidArgumentError


@given(n_scans=st.integers(0, 200), n=st.integers(1, 20), split=st.sampled_from(SPLITS))
def test_every_scan_is_one_robots_and_all_have_as_many(n_scans, n, split):
    parts = [list(shard_indices(n_scans, k, n, split)) for k in range(n)]
    assert sorted(itertools.chain(*parts)) == list(range(n_scans))
    assert max(map(len, parts)) - min(map(len, parts)) <= 1
    for part in parts:
        steps = {b - a for a, b in itertools.pairwise(part)}
        assert steps <= {n if split == "interleaved" else 1}
    if split == "consecutive":
        assert list(itertools.chain(*parts)) == list(range(n_scans))


@pytest.mark.parametrize(
    ("args", "name"),
    [
        ((-1, 0, 1), "n_scans"),
        ((5, 2, 2), "k=2"),
        ((5, -1, 2), "k"),
        ((5, 0, 0), "n="),
        ((5, 0, 1, "x"), "split"),
    ],
)
def test_bad_parts(args, name):
    with pytest.raises(InvalidArgumentError, match=name):
        shard_indices(*args)


def test_a_part_reads_what_it_is_asked_for_and_no_more():
    read: list[int] = []

    class Scans:
        def __getitem__(self, index):
            read.append(index)
            return f"scan {index}"

    part = DatasetShard(Scans(), shard_indices(10, 1, 3))
    assert (len(part), part[1], part[-1]) == (3, "scan 4", "scan 7")
    assert list(part[1:]) == ["scan 4", "scan 7"]
    assert list(part) == ["scan 1", "scan 4", "scan 7"]
    assert read == [4, 7, 4, 7, 1, 4, 7]
    with pytest.raises(IndexError):
        part[3]
