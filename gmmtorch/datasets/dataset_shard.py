"""Part: the scans of a log that one robot of a team has."""

from __future__ import annotations

from collections.abc import Sequence
from typing import overload

from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.scan import Scan

SPLITS = ("interleaved", "consecutive")


def part_of(n_scans: int, k: int, n: int, split: str = "interleaved") -> range:
    """Which of so many scans are those of robot k of n: each n-th one, or the k-th of n stretches."""
    check_whole("n_scans", n_scans, 0)
    if check_whole("k", k, 0) >= check_whole("n", n, 1):
        raise InvalidArgumentError(f"k={k} must be below n={n}: robots are counted from 0.")
    if split not in SPLITS:
        raise InvalidArgumentError(f"split={split!r} is not one of {', '.join(SPLITS)}.")
    if split == "interleaved":
        return range(k, n_scans, n)
    return range(n_scans * k // n, n_scans * (k + 1) // n)


class Part(Sequence[Scan]):
    """Some scans of a data set, read when asked for.

    Args:
        indices: of the scans, in order, such as `part_of(len(scans), k, n)`.
    """

    def __init__(self, scans: Sequence[Scan], indices: Sequence[int]) -> None:
        self._scans, self._indices = scans, indices

    def __len__(self) -> int:
        return len(self._indices)

    @overload
    def __getitem__(self, index: int) -> Scan: ...
    @overload
    def __getitem__(self, index: slice) -> Part: ...
    def __getitem__(self, index: int | slice) -> Scan | Part:
        if isinstance(index, slice):
            return Part(self._scans, self._indices[index])
        return self._scans[self._indices[index]]
