"""The share of a data set that one robot of a team reads."""

from __future__ import annotations

from collections.abc import Sequence
from typing import overload

from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.scan import Scan

SPLITS = ("interleaved", "consecutive")


def shard_indices(n_scans: int, k: int, n: int, split: str = "interleaved") -> range:
    """Indices of the scans of robot k of n.

    "interleaved" takes every n-th scan from scan k on; "consecutive" takes the k-th of n equal intervals.
    """
    check_whole("n_scans", n_scans, 0)
    if check_whole("k", k, 0) >= check_whole("n", n, 1):
        raise InvalidArgumentError(f"k={k} must be below n={n}: robots are counted from 0.")
    if split not in SPLITS:
        raise InvalidArgumentError(f"split={split!r} is not one of {', '.join(SPLITS)}.")
    if split == "interleaved":
        return range(k, n_scans, n)
    return range(n_scans * k // n, n_scans * (k + 1) // n)


class DatasetShard(Sequence[Scan]):
    """A selection of the scans of a data set, each read when it is accessed.

    Args:
        scans: the data set.
        indices: of the selected scans, in order, for example `shard_indices(len(scans), k, n)`.
    """

    def __init__(self, scans: Sequence[Scan], indices: Sequence[int]) -> None:
        self._scans, self._indices = scans, indices

    def __len__(self) -> int:
        return len(self._indices)

    @overload
    def __getitem__(self, index: int) -> Scan: ...
    @overload
    def __getitem__(self, index: slice) -> DatasetShard: ...
    def __getitem__(self, index: int | slice) -> Scan | DatasetShard:
        if isinstance(index, slice):
            return DatasetShard(self._scans, self._indices[index])
        return self._scans[self._indices[index]]
