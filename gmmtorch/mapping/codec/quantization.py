"""Components as whole numbers: the values that the codec writes.

Means and covariances are rounded to the `lattice`. A count is rounded to a power of 2^(1/4), or is zero. The
share of a viewpoint in its component's largest is rounded to a power of 2^(−1/2). Origins are rounded to
multiples of 2⁻⁸ m. Every number is rounded by itself, so components can be regrouped without further loss.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.linalg import all_equal, on_cpu
from gmmtorch.mapping.attributes.moments import Attributes
from gmmtorch.mapping.codec import attribute_block, lattice
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
LEAST_SIDE, LARGEST_SIDE = -20, 6
"""log2 of the side (m) of the cells of a batch."""
_FINEST = -10  # log2 of the side (m) of the cells that are ordered
_KEY_BITS = 20


@dataclass(frozen=True, eq=False)
class Quantized:
    """K components, S origins and E viewpoints as whole numbers, int64 on the CPU.

    places: means and covariances.
    count (K,): log2 of the support in steps, or `NO_COUNT`. max_range (K,) bool. ids (K, 2).
    origins (S, D): in steps; distinct, all used.
    n_viewpoints (K,): number of viewpoints of each component. For each viewpoint, sorted by component:
    seen_from (E,), its origin, by rising coordinates; share (E,), −log2 of its share of the component's
    largest, in steps.
    attributes: rounded, as `attribute_block` does.
    """

    places: Lattice
    count: Tensor
    max_range: Tensor
    ids: Tensor
    origins: Tensor
    n_viewpoints: Tensor
    seen_from: Tensor
    share: Tensor
    attributes: Attributes = field(default_factory=Attributes)

    def __len__(self) -> int:
        return len(self.count)

    def arranged(self, rows: Tensor) -> Quantized:
        """The components of distinct rows (J,), in that order, with the origins that they use, sorted."""
        chosen = self.reordered(rows)
        origins, seen_from = torch.unique(self.origins[chosen.seen_from], dim=0, return_inverse=True)
        by = torch.repeat_interleave(torch.arange(len(chosen)), chosen.n_viewpoints)
        order = torch.argsort(by * len(origins) + seen_from)
        return replace(chosen, origins=origins, seen_from=seen_from[order], share=chosen.share[order])

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
            attributes=self.attributes.selected(rows),
        )

    def restored(self) -> Components:
        """The components, float64 on the CPU."""
        means, covariances = self.places.restored()
        support = points_of(self.count)
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
            attributes=self.attributes,
        )


def quantize(components: Components) -> Quantized:
    """The components rounded to whole numbers.

    Viewpoints are sorted by component, then by the coordinates of the origin. Origins that round to the same
    place become one; origins without a viewpoint are dropped. Raises `InvalidArgumentError` for values that
    are too large to be stored, see `lattice` and `LARGEST_COUNT`.
    """
    c = components.on_cpu()
    places = lattice.nearest(c.means.double(), c.covariances.double())
    count = _support_steps(c.support.double())
    seen_by, seen_from, seen_count = c.seen_by, c.seen_from, c.seen_count.double()
    by, seen, counts = seen_by.numpy(), seen_from.numpy(), seen_count.numpy()
    largest = _largest(seen_count, seen_by, len(c)).numpy()
    kept = np.flatnonzero((counts > 0) | (largest[by] == 0))
    kept = kept[np.argsort(by[kept], kind="stable")]
    by, seen, counts = by[kept], seen[kept], counts[kept]

    steps = _origin_steps(c.origins.double()).numpy()
    distinct, place = _first_uses(steps)
    used, seen = np.unique(place[seen], return_inverse=True)
    origins = steps[distinct[used]]
    # Two origins of a component that round to the same place are one viewpoint.
    rank = ranks(origins)
    _, kept, pair = np.unique(by * len(origins) + rank[seen], return_index=True, return_inverse=True)
    seen_count = torch.from_numpy(np.bincount(pair, counts, len(kept)))
    seen_by, seen_from = torch.from_numpy(by[kept]), torch.from_numpy(seen[kept])
    attributes = c.attributes
    if attributes:
        attributes = attribute_block.rounded(attributes, c.means, *places.restored())
    return Quantized(
        places=places,
        count=count,
        max_range=c.max_range,
        ids=c.ids,
        origins=torch.from_numpy(origins),
        n_viewpoints=torch.from_numpy(np.bincount(by[kept], minlength=len(c))),
        seen_from=seen_from,
        share=_share_steps(seen_count, seen_by, count),
        attributes=attributes,
    )


def quantized(components: Components) -> Components:
    """The components after writing and reading them, on their device, without writing bits."""
    return quantize(components).restored().to(components.means.device)


def _support_steps(support: Tensor) -> Tensor:
    given = support.numpy()
    bad = ~((given >= 0) & (given <= MOST_POINTS))
    if bad.any():
        first = int(bad.argmax())
        raise InvalidArgumentError(
            f"support[{first}]={float(support[first])} cannot be stored; it must be from 0 to "
            f"{MOST_POINTS:g}."
        )
    return count_steps(support)


def count_steps(counts: Tensor) -> Tensor:
    """log2 of counts ≥ 0 in steps, or `NO_COUNT`."""
    least = 2.0 ** (LEAST_COUNT / PER_OCTAVE)
    steps = (torch.log2(counts.clamp_min(least)) * PER_OCTAVE).round().long()
    return torch.where(counts < least / 2, NO_COUNT, steps)


def points_of(steps: Tensor) -> Tensor:
    """The inverse of `count_steps`: numbers of points."""
    return torch.where(steps == NO_COUNT, 0.0, lattice.power(steps.clamp_min(LEAST_COUNT)))


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


def ranks(rows: np.ndarray) -> Ints:
    """The rank (N,) of each of rows (N, D) in lexicographic order; of equal ones, in the given order."""
    found = np.empty(len(rows), np.int64)
    found[np.lexsort(rows.T[::-1])] = np.arange(len(rows))
    return found


def quantized_after(known: Components, rounded: Components, components: Components) -> Components:
    """`quantized(components)`, which rounds only those after `known`, whose `rounded` values are given.

    If the components do not begin with the known ones, all of them are rounded.
    """
    if not len(components.origins):
        return components
    k, e, s = len(known), len(known.seen_by), len(known.origins)
    sizes = {"origins": s, "seen_by": e, "seen_from": e, "seen_count": e}
    old = {name: values[: sizes.get(name, k)] for name, values in components.tensors().items()}
    old |= components.attributes.selected(slice(k)).tensors()
    given = {**known.tensors(), **known.attributes.tensors()}
    if not k or old.keys() != given.keys() or not all_equal((old[name], x) for name, x in given.items()):
        return quantized(components)
    if len(components) == k:
        return rounded
    rows = torch.arange(k, len(components), device=components.means.device)
    return joined([rounded, quantized(components.selected(rows))])


def joined(parts: Sequence[Components]) -> Components:
    """All components of rounded parts, in order, rounded as if they were together: origins are distinct."""
    both = Components.concatenate(parts)
    if any(both is part for part in parts):
        return both
    origins = both.origins.cpu().numpy()
    distinct, place = (torch.from_numpy(v).to(both.means.device) for v in _first_uses(origins))
    seen_from = place[both.seen_from]
    rank = torch.from_numpy(ranks(origins[distinct.cpu().numpy()])).to(seen_from.device)
    order = torch.argsort(both.seen_by * len(distinct) + rank[seen_from])
    return replace(
        both,
        origins=both.origins[distinct],
        seen_by=both.seen_by[order],
        seen_from=seen_from[order],
        seen_count=both.seen_count[order],
    )


# -- order and numbers -----------------------------------------------------------------------------------


def spatial_order(components: Components) -> Tensor:
    """An order (K,) of components by place, which saves log₂ K! bits in all, about a byte a component.

    Use it before components are numbered: ids take few bits only if they are consecutive.
    """
    return _order(*on_cpu(components.means, components.covariances)).to(components.means.device)


def _order(means: Tensor, covariances: Tensor) -> Tensor:
    """`spatial_order` of means (K, D) and covariances (K, D, D) on the CPU."""
    return order_of(lattice.nearest(means.double(), covariances.double()))


def numbered(components: Components, robot: int, first: int) -> tuple[Components, int]:
    """Components with ids for those that have none: (robot, first), (robot, first + 1), …; and the number
    after all of them.

    New components come last, in their spatial order.
    """
    ids, *shapes = on_cpu(components.ids, components.means, components.covariances)
    new = (ids[:, 1] < 0).nonzero().squeeze(1)
    ids, order = _numbering(ids, _order(*(part[new] for part in shapes)), robot, first)
    device = components.ids.device
    arranged = replace(components.rearranged(order.to(device)), ids=ids.to(device))
    return arranged, number_after(ids, first)


def number_after(ids: Tensor, next_number: int) -> int:
    """The sequence number of the next new component, after components with these ids (K, 2) exist."""
    return max(next_number, int(ids[:, 1].max()) + 1 if len(ids) else 0)


def quantize_numbered(components: Components, robot: int, first: int) -> Quantized:
    """The same as `quantize(numbered(components, robot, first)[0])`, rounding every component once."""
    values = quantize(components)
    new = (values.ids[:, 1] < 0).nonzero().squeeze(1)
    ids, order = _numbering(values.ids, order_of(values.places.taken(new)), robot, first)
    return replace(values.reordered(order), ids=ids)


def _numbering(ids: Tensor, by_place: Tensor, robot: int, first: int) -> tuple[Tensor, Tensor]:
    """Ids (K, 2) after numbering, and the order (K,) of the components: numbered ones, then new ones in the
    order `by_place` (J,) of these. On the CPU.
    """
    is_new = ids[:, 1] < 0
    order = torch.cat([(~is_new).nonzero().squeeze(1), is_new.nonzero().squeeze(1)[by_place]])
    ids = ids[order].clone()
    numbers = first + torch.arange(len(by_place))
    ids[len(ids) - len(numbers) :] = torch.stack([torch.full_like(numbers, robot), numbers], 1)
    return ids, order


# -- cells ----------------------------------------------------------------------------------------------


def order_of(places: Lattice) -> Tensor:
    """The `spatial_order` (K,) of components on the lattice: that of a Morton curve."""
    cells = cells_of(places, _FINEST) + offset_of(_FINEST)
    k, dim = cells.shape
    keys = np.zeros((2, k), np.int64)  # the lower and the higher bits of the coordinates, interleaved
    for bit in range(_KEY_BITS):
        for axis in range(dim):
            place = bit * dim + dim - 1 - axis
            keys[0] |= (cells[:, axis] >> bit & 1) << place
            keys[1] |= (cells[:, axis] >> (bit + _KEY_BITS) & 1) << place
    return torch.from_numpy(np.lexsort(keys))


def cells_of(places: Lattice, exponent: int) -> Ints:
    """The cells (K, D) of side 2^exponent m that contain the means."""
    mean, step = ints(places.by_world_axis(places.mean)), ints(places.world_exponents())
    finer = exponent - step
    return np.where(finer >= 0, mean >> np.maximum(finer, 0), mean << np.maximum(-finer, 0))


def offset_of(exponent: int) -> int:
    """What is added to cells, so that they are positive, and the places around the origin of the world are in
    few blocks of the curve."""
    return sum(1 << (power - exponent) for power in range(6, 30, 2))


def cell_exponent(places: Lattice) -> int:
    """log2 of the side (m) of the cells of a batch: about the median of the largest deviations."""
    largest = ints(places.deviation[:, 0])
    middle = int(np.median(largest) // PER_OCTAVE) if len(largest) else 0
    return min(max(middle, LEAST_SIDE), LARGEST_SIDE)


def ints(values: Tensor) -> Ints:
    return values.long().numpy()
