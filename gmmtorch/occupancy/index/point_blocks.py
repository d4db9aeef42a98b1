"""PointBlocks: query points in blocks that share a bucket of a `ConeIndex`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.occupancy.index.cone_index import ConeIndex


class PointBlocks(NamedTuple):
    """Points sorted by position, in b blocks of B points; all points of a block lie in one bucket.

    points (D, B, b); bucket (b,); centers (b, D) and radius (b,): a ball around the points of each block.
    point (n,) and slot (n,): indices of the given points, and their places among the b·B slots. Free slots
    of a block repeat its last point.
    """

    points: Tensor
    bucket: Tensor
    centers: Tensor
    radius: Tensor
    point: Tensor
    slot: Tensor

    @classmethod
    def of(cls, points: Tensor, bucket: Tensor, index: ConeIndex) -> PointBlocks:
        """Blocks of the points (M, D) that have a bucket (M,); points with bucket −1 are left out."""
        point = (bucket >= 0).nonzero().squeeze(1)
        point = point[index.in_space_order(points[point], bucket[point])]
        touched, count = torch.unique_consecutive(bucket[point], return_counts=True)
        n_points, n_touched = point.shape[0], touched.shape[0]
        size = 16 if n_points > 24 * n_touched else 4 if n_points > 4 * n_touched else 1
        n_blocks = (count + size - 1) // size
        first, begin = torch.cumsum(count, 0) - count, (torch.cumsum(n_blocks, 0) - n_blocks) * size
        number = torch.arange(n_points, device=point.device)
        slot = number + torch.repeat_interleave(begin - first, count)
        filled = torch.zeros(int(n_blocks.sum()) * size, dtype=torch.int64, device=point.device)
        filled[slot] = number
        filled = filled.cummax(0).values
        gathered = points[point][filled].view(-1, size, index.dim)
        fixed = gathered.detach()
        centers = 0.5 * (fixed.amin(1) + fixed.amax(1))
        radius = (fixed - centers[:, None]).norm(dim=2).amax(1)
        owner = torch.repeat_interleave(touched, n_blocks)
        return cls(gathered.permute(2, 1, 0).contiguous(), owner, centers, radius, point, slot)

    def chunks(self, index: ConeIndex, chunk_pairs: int) -> Iterator[slice]:
        """Runs of blocks whose lists together have about `chunk_pairs` entries, or a single block."""
        chunk = torch.cumsum(index.list_lengths()[self.bucket], 0) // chunk_pairs
        begin = 0
        for count in torch.unique_consecutive(chunk, return_counts=True)[1].tolist():
            yield slice(begin, begin + count)
            begin += count
