"""Numbers of distinct integers by a hash table; the twins in `gmmtorch.linalg` sort. On a CPU only."""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.kernels.compiler import FusedKernel

_KERNEL = FusedKernel(
    "distinct_keys",
    "const int64* keys, int64 n_keys, int64* place, int64 n_places, int64* distinct, int64* number,"
    " int64* n_distinct",
    """
    // One item for all keys: their first occurrences are numbered in order. A free place holds -1.
    int64_t found = 0;
    for (int64_t i = 0; i < n_keys; ++i) {
        const int64_t key = keys[i];
        uint64_t hash = (uint64_t)key * 0x9E3779B97F4A7C15ull;
        int64_t at = (int64_t)((hash ^ (hash >> 32)) & (uint64_t)(n_places - 1));
        while (place[at] >= 0 && distinct[place[at]] != key) at = (at + 1) & (n_places - 1);
        if (place[at] < 0) {
            place[at] = found;
            distinct[found++] = key;
        }
        number[i] = place[at];
    }
    *n_distinct = found;
    """,
    shares=True,
)


def distinct_keys(keys: Tensor) -> tuple[Tensor, Tensor]:
    """The distinct keys (C,) of `keys` (N,), int64, in the order of their first occurrence; and the index
    (N,) of each key among them.
    """
    keys, n = keys.contiguous(), keys.shape[0]
    n_places = 1 << (2 * n).bit_length()
    place = torch.full((n_places,), -1, dtype=torch.int64)
    distinct = torch.empty_like(keys)
    number = torch.empty_like(keys)
    n_distinct = torch.zeros(1, dtype=torch.int64)
    _KERNEL(1, keys, n, place, n_places, distinct, number, n_distinct, device=keys.device)
    return distinct[: int(n_distinct)], number
