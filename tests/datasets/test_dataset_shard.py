"""Dataset shards: each scan belongs to exactly one robot, in order."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.datasets.base import SPLITS, DatasetShard, shard_indices
from gmmtorch.errors import InvalidArgumentError


@given(n_scans=st.integers(0, 200), n=st.integers(1, 20), split=st.sampled_from(SPLITS))
def test_shards_partition_the_scans_evenly(n_scans, n, split):
    shards = [list(shard_indices(n_scans, k, n, split)) for k in range(n)]
    assert sorted(itertools.chain(*shards)) == list(range(n_scans))
    assert max(map(len, shards)) - min(map(len, shards)) <= 1
    for shard in shards:
        steps = {b - a for a, b in itertools.pairwise(shard)}
        assert steps <= {n if split == "interleaved" else 1}
    if split == "consecutive":
        assert list(itertools.chain(*shards)) == list(range(n_scans))


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
def test_shard_indices_rejects_invalid_arguments(args, name):
    with pytest.raises(InvalidArgumentError, match=name):
        shard_indices(*args)


def test_dataset_shard_reads_only_the_accessed_scans():
    read: list[int] = []

    class Scans:
        def __getitem__(self, index):
            read.append(index)
            return f"scan {index}"

    shard = DatasetShard(Scans(), shard_indices(10, 1, 3))
    assert (len(shard), shard[1], shard[-1]) == (3, "scan 4", "scan 7")
    assert list(shard[1:]) == ["scan 4", "scan 7"]
    assert list(shard) == ["scan 1", "scan 4", "scan 7"]
    assert read == [4, 7, 4, 7, 1, 4, 7]
    with pytest.raises(IndexError):
        shard[3]
