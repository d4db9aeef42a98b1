"""Components as whole numbers: the values that the codec writes.

Means and covariances are rounded to the `lattice`. A count is rounded to a power of 2^(1/4), or is zero. The
share of a viewpoint in its component's largest is rounded to a power of 2^(−1/2). Origins are rounded to
multiples of 2⁻⁸ m. Every number is rounded by itself, so components can be regrouped without further loss.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mapping.codec import lattice
from gmmtorch.mapping.codec.bitstream import Ints
from gmmtorch.mapping.codec.lattice import PER_OCTAVE, Lattice
from gmmtorch.mapping.components import Components
from gmmtorch.scan import FARTHEST

ORIGIN_STEP = 2.0**-8
"""Metres. Rounding moves an origin by at most half a step on each axis."""
SHARES_PER_OCTAVE = 2
LEAST_SHARE = 15
"""Steps: shares below 2^(−15/2) = 1/181 of the component's largest are raised to it."""
LEAST_COUNT, LARGEST_COUNT = -10 * PER_OCTAVE, 40 * PER_OCTAVE
"""Steps: 2⁻¹⁰ and 2⁴⁰ points. Counts below half the least become zero; larger ones are refused."""
MOST_POINTS = 2.0 ** (LARGEST_COUNT / PER_OCTAVE)
NO_COUNT = LEAST_COUNT - 1
"""The number that encodes a count of zero."""
COUNT_ERROR = lattice.DEVIATION_ERROR
"""Largest relative error of a count."""


@dataclass(frozen=True, eq=False)
class Quantized:
    """K components, S origins and E viewpoints as whole numbers, int64 on the CPU.

    places: means and covariances.
    count (K,): log2 of the support in steps, or `NO_COUNT`. max_range (K,) bool. ids (K, 2).
    origins (S, D): in steps; distinct, all used.
    n_viewpoints (K,): number of viewpoints of each component. For each viewpoint, sorted by component:
    seen_from (E,), its origin; share (E,), −log2 of its share of the component's largest, in steps.
    """

    places: Lattice
    count: Tensor
    max_range: Tensor
    ids: Tensor
    origins: Tensor
    n_viewpoints: Tensor
    seen_from: Tensor
    share: Tensor

    def __len__(self) -> int:
        return len(self.count)

    def arranged(self, rows: Tensor) -> Quantized:
        """The components of distinct rows (J,), in that order, with the origins that they use, sorted."""
        chosen = self.reordered(rows)
        origins, seen_from = torch.unique(self.origins[chosen.seen_from], dim=0, return_inverse=True)
        return replace(chosen, origins=origins, seen_from=seen_from)

    def reordered(self, rows: Tensor) -> Quantized:
        """The components of distinct rows (J,), in that order; all origins stay as they are."""
        n = self.n_viewpoints[rows]
        begins = (self.n_viewpoints.cumsum(0) - self.n_viewpoints)[rows]
        kept = torch.repeat_interleave(begins - (n.cumsum(0) - n), n) + torch.arange(int(n.sum()))
        return replace(
            self,
            places=self.places.taken(rows),
            count=self.count[rows],
            max_range=self.max_range[rows],
            ids=self.ids[rows],
            n_viewpoints=n,
            seen_from=self.seen_from[kept],
            share=self.share[kept],
        )

    def restored(self) -> Components:
        """The components, float64 on the CPU."""
        means, covariances = self.places.restored()
        support = torch.where(self.count == NO_COUNT, 0.0, lattice.power(self.count.clamp_min(LEAST_COUNT)))
        seen_by = torch.from_numpy(np.arange(len(self)).repeat(self.n_viewpoints.numpy()))
        weight = lattice.power(-self.share * (PER_OCTAVE // SHARES_PER_OCTAVE))
        total = support.new_zeros(len(support)).index_add_(0, seen_by, weight)
        return Components(
            means=means,
            covariances=covariances,
            support=support,
            max_range=self.max_range,
            ids=self.ids,
            origins=self.origins.double() * ORIGIN_STEP,
            seen_by=seen_by,
            seen_from=self.seen_from,
            seen_count=weight * (support / total)[seen_by],
        )


def quantize(components: Components) -> Quantized:
    """The components rounded to whole numbers.

    Viewpoints are sorted by component. Origins that round to the same place become one; origins without a
    viewpoint are dropped. Raises `InvalidArgumentError` for values that are too large to be stored, see
    `lattice` and `LARGEST_COUNT`.
    """
    c = components
    places = lattice.nearest(c.means.double().cpu(), c.covariances.double().cpu())
    count = _count_steps(c.support.double().cpu())
    seen_by, seen_from, seen_count = c.seen_by.cpu(), c.seen_from.cpu(), c.seen_count.double().cpu()
    by, seen, counts = seen_by.numpy(), seen_from.numpy(), seen_count.numpy()
    largest = _largest(seen_count, seen_by, len(c)).numpy()
    kept = np.flatnonzero((counts > 0) | (largest[by] == 0))
    kept = kept[np.argsort(by[kept], kind="stable")]
    by, seen, counts = by[kept], seen[kept], counts[kept]

    steps = _origin_steps(c.origins.double().cpu()).numpy()
    distinct, place = _first_uses(steps)
    used, seen = np.unique(place[seen], return_inverse=True)
    origins = steps[distinct[used]]
    # Two origins of a component that round to the same place are one viewpoint.
    kept, pair = _first_uses(by * len(origins) + seen)
    seen_count = torch.from_numpy(np.bincount(pair, counts, len(kept)))
    seen_by, seen_from = torch.from_numpy(by[kept]), torch.from_numpy(seen[kept])
    return Quantized(
        places=places,
        count=count,
        max_range=c.max_range.cpu(),
        ids=c.ids.cpu(),
        origins=torch.from_numpy(origins),
        n_viewpoints=torch.from_numpy(np.bincount(by[kept], minlength=len(c))),
        seen_from=seen_from,
        share=_share_steps(seen_count, seen_by, count),
    )


def _count_steps(support: Tensor) -> Tensor:
    given = support.numpy()
    bad = ~((given >= 0) & (given <= MOST_POINTS))
    if bad.any():
        first = int(bad.argmax())
        raise InvalidArgumentError(
            f"support[{first}]={float(support[first])} cannot be stored; it must be from 0 to "
            f"{MOST_POINTS:g}."
        )
    least = 2.0 ** (LEAST_COUNT / PER_OCTAVE)
    steps = (torch.log2(support.clamp_min(least)) * PER_OCTAVE).round().long()
    return torch.where(support < least / 2, NO_COUNT, steps)


def _origin_steps(origins: Tensor) -> Tensor:
    bad = ~(np.abs(origins.numpy()) <= FARTHEST).all(1)
    if bad.any():
        first = int(bad.argmax())
        raise InvalidArgumentError(
            f"origins[{first}] is {origins[first].tolist()}; coordinates up to {FARTHEST:g} m can be stored."
        )
    return (origins / ORIGIN_STEP).round().long()


def _share_steps(count: Tensor, seen_by: Tensor, component_count: Tensor) -> Tensor:
    """−log2 (E,) of each count's share of its component's largest, in steps; 0 if there is no count."""
    share = count / _largest(count, seen_by, len(component_count))[seen_by].clamp_min(1e-300)
    steps = (-torch.log2(share.clamp_min(1e-300)) * SHARES_PER_OCTAVE).round().long().clamp(0, LEAST_SHARE)
    nothing = (component_count == NO_COUNT)[seen_by] | (share == 0)
    return torch.where(nothing, 0, steps)


def _largest(values: Tensor, owner: Tensor, n: int) -> Tensor:
    """The largest value (n,) of each owner."""
    return values.new_zeros(n).scatter_reduce_(0, owner, values, "amax")


def _first_uses(rows: Ints) -> tuple[Ints, Ints]:
    """The first row of each distinct value of (N, …), in order; and for each row, the number of its value."""
    _, first, which = np.unique(rows, return_index=True, return_inverse=True, axis=0)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return first[order], rank[which.reshape(-1)]
