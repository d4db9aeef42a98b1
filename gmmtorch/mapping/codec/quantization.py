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
from numpy.typing import NDArray
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.linalg import all_equal, as_tensors, on_cpu
from gmmtorch.mapping.attributes.moments import Attributes
from gmmtorch.mapping.codec import attribute_block, lattice
from gmmtorch.mapping.codec.bitstream import Ints
from gmmtorch.mapping.codec.lattice import AXIS_ORDERS, PER_OCTAVE, PRECISION, Lattice
from gmmtorch.mapping.components import Components
from gmmtorch.scan import FARTHEST

Floats = NDArray[np.float64]

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
_SPREAD = {  # the bits of numbers of ten bits, with room for those of the other axes
    dim: np.bitwise_or.reduce([(np.arange(1024) >> bit & 1) << bit * dim for bit in range(10)])
    for dim in (2, 3)
}


@dataclass(frozen=True, eq=False)
class Quantized:
    """K components, S origins and E viewpoints as whole numbers, int64 on the CPU.

    places: means and covariances.
    count (K,): log2 of the support in steps, or `NO_COUNT`. max_range (K,) bool. ids (K, 2).
    origins (S, D): in steps; distinct, all used.
    n_viewpoints (K,): number of viewpoints of each component. For each viewpoint, sorted by component:
    seen_from (E,), its origin, by rising coordinates; share (E,), −log2 of its share of the component's
    largest, in steps.
    attributes: at the rounded means, before `attribute_block` rounds them.
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
        order, n_before = rows.numpy(), self.n_viewpoints.numpy()
        n = n_before[order]
        begins = (np.cumsum(n_before) - n_before)[order]
        kept = np.repeat(begins - (np.cumsum(n) - n), n) + np.arange(n.sum())

        each = (*vars(self.places).values(), self.count, self.ids)
        arrays = *(value.numpy()[order] for value in each), n, self.seen_from.numpy()[kept]
        *places, count, ids, n_viewpoints, seen_from, share = as_tensors(*arrays, self.share.numpy()[kept])
        max_range, attributes = self.max_range[rows], self.attributes.selected(rows)
        values = count, max_range, ids, self.origins, n_viewpoints, seen_from, share, attributes
        return Quantized(Lattice(*places), *values)

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
            attributes=attribute_block.rounded(self.attributes, covariances),
        )


def quantize(components: Components, coarse: bool = False) -> Quantized:
    """The components rounded to whole numbers; those of the coarse lattice, if `coarse`.

    Viewpoints are sorted by component, then by the coordinates of the origin. Origins that round to the same
    place become one; origins without a viewpoint are dropped. Raises `InvalidArgumentError` for values that
    are too large to be stored, see `lattice` and `LARGEST_COUNT`.
    """
    c = components.on_cpu()
    return _quantized(c, lattice.nearest(c.means.double(), c.covariances.double(), coarse), coarse=coarse)


def _quantized(
    c: Components, places: Lattice, rows: Ints | None = None, ids: Ints | None = None, coarse: bool = False
) -> Quantized:
    """`quantize` of components at these places, on the CPU; in the order of `rows` (K,), with these ids."""
    count, flags = _support_steps(c.support.double()), c.max_range
    count = coarse_counts(count) if coarse else count
    by, seen, counts = c.seen_by.numpy(), c.seen_from.numpy(), c.seen_count.numpy().astype(np.float64)
    shapes, attributes = [value.numpy() for value in vars(places).values()], c.attributes
    if attributes:
        attributes = attribute_block.moved(attributes, places.restored()[0] - c.means)
    if rows is not None:
        rank = np.empty_like(rows)
        rank[rows] = np.arange(len(rows))
        by, count, shapes = rank[by], count[rows], [value[rows] for value in shapes]
        flags = torch.from_numpy(flags.numpy()[rows])
        attributes = attributes.selected(torch.from_numpy(rows)) if attributes else attributes
    order = np.argsort(by, kind="stable")
    order = order[(counts[order] > 0) | (_largest(counts[order], by[order]) == 0)]
    by, seen, counts = by[order], seen[order], counts[order]

    steps = _origin_steps(c.origins.double())
    rank, first = ranked(steps)
    used = np.flatnonzero(np.bincount(rank[seen], minlength=len(first)))
    used = used[np.argsort(first[used])]  # in the order of the origins
    number = np.empty_like(first)
    number[used] = np.arange(len(used))
    # Two origins of a component that round to the same place are one viewpoint.
    keys = by * len(first) + rank[seen]
    order = np.argsort(keys, kind="stable")
    begins = _begins(keys[order])
    kept = order[begins]
    by, counts = by[kept], np.add.reduceat(counts[order], begins) if len(kept) else counts
    share = np.where(count[by] == NO_COUNT, 0, _share_steps(counts, by))
    views = steps[first[used]], np.bincount(by, minlength=len(c)), number[rank[seen[kept]]], share
    given = c.ids.numpy() if ids is None else ids
    *made, counted, numbers, origins, n, seen_from, shares = as_tensors(*shapes, count, given, *views)
    values = counted, flags, numbers, origins, n, seen_from, shares, attributes
    return Quantized(Lattice(*made), *values)


def quantized(components: Components, coarse: bool = False) -> Components:
    """The components after writing and reading them, on their device, without writing bits; those of the
    coarse lattice, if `coarse`, which take a third fewer bytes."""
    return quantize(components, coarse).restored().to(components.means.device)


def coarse_counts(steps: Ints) -> Ints:
    """The nearest even steps of counts, or `NO_COUNT`."""
    return np.where(steps == NO_COUNT, steps, np.rint(steps / 2).astype(np.int64) * 2)


def _support_steps(support: Tensor) -> Ints:
    given = support.numpy()
    bad = ~((given >= 0) & (given <= MOST_POINTS))
    if bad.any():
        first = int(bad.argmax())
        raise InvalidArgumentError(
            f"support[{first}]={float(support[first])} cannot be stored; it must be from 0 to "
            f"{MOST_POINTS:g}."
        )
    return count_steps(support)


def count_steps(counts: Tensor) -> Ints:
    """log2 of counts ≥ 0 in steps, or `NO_COUNT`; on the CPU."""
    given, least = counts.numpy(), 2.0 ** (LEAST_COUNT / PER_OCTAVE)
    steps = np.rint(np.log2(np.maximum(given, least)) * PER_OCTAVE).astype(np.int64)
    return np.where(given < least / 2, NO_COUNT, steps)


def points_of(steps: Tensor) -> Tensor:
    """The inverse of `count_steps`: numbers of points."""
    return torch.where(steps == NO_COUNT, 0.0, lattice.power(steps.clamp_min(LEAST_COUNT)))


def _origin_steps(origins: Tensor) -> Ints:
    given = origins.numpy()
    bad = ~(np.abs(given) <= FARTHEST).all(1)
    if bad.any():
        first = int(bad.argmax())
        raise InvalidArgumentError(
            f"origins[{first}] is {origins[first].tolist()}; coordinates up to {FARTHEST:g} m can be stored."
        )
    return np.rint(given / ORIGIN_STEP).astype(np.int64)


def _share_steps(counts: Floats, owner: Ints) -> Ints:
    """−log2 (E,) of each count's share of its owner's largest, in steps; 0 if there is no count."""
    share = counts / np.maximum(_largest(counts, owner), 1e-300)
    steps = np.rint(-np.log2(np.maximum(share, 1e-300)) * SHARES_PER_OCTAVE).astype(np.int64)
    return np.where(share == 0, 0, np.clip(steps, 0, LEAST_SHARE))


def _largest(values: Floats, owner: Ints) -> Floats:
    """For each of values (E,) the largest one of its owner; owners are sorted."""
    begins = _begins(owner)
    if not len(begins):
        return values
    return np.maximum.reduceat(values, begins).repeat(np.diff(begins, append=len(owner)))


def _begins(keys: Ints) -> Ints:
    """The rows where the runs of equal sorted keys begin."""
    return np.flatnonzero(np.concatenate([np.ones(min(1, len(keys)), bool), keys[1:] != keys[:-1]]))


def ranked(rows: Ints) -> tuple[Ints, Ints]:
    """For each of rows (N, D) the rank of its value among the distinct ones, in lexicographic order; and the
    first row of each distinct value."""
    order = np.lexsort(rows.T[::-1])
    is_new = np.ones(len(rows), bool)
    is_new[1:] = (rows[order[1:]] != rows[order[:-1]]).any(1)
    rank = np.empty(len(rows), np.int64)
    rank[order] = np.cumsum(is_new) - 1
    return rank, order[is_new]


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
    rank, first = ranked(both.origins.cpu().numpy())
    in_order = np.sort(first)
    number = np.searchsorted(in_order, first[rank])
    kept, place, ranks = (torch.from_numpy(v).to(both.means.device) for v in (in_order, number, rank))
    order = torch.argsort(both.seen_by * len(first) + ranks[both.seen_from])
    return replace(
        both,
        origins=both.origins[kept],
        seen_by=both.seen_by[order],
        seen_from=place[both.seen_from][order],
        seen_count=both.seen_count[order],
    )


def spatial_order(components: Components) -> Tensor:
    """An order (K,) of components by place, which saves log₂ K! bits in all, about a byte a component.

    Use it before components are numbered: ids take few bits only if they are consecutive.
    """
    means, covariances = on_cpu(components.means, components.covariances)
    order = order_of(lattice.nearest(means.double(), covariances.double()))
    return torch.from_numpy(order).to(components.means.device)


def numbered(components: Components, robot: int, first: int) -> tuple[Components, int]:
    """Components with ids for those that have none: (robot, first), (robot, first + 1), …; and the number
    after all of them.

    New components come last, in their spatial order.
    """
    given, *shapes = on_cpu(components.ids, components.means, components.covariances)
    new = torch.from_numpy(np.flatnonzero(given.numpy()[:, 1] < 0))
    means, covariances = shapes if len(new) == len(given) else (part[new] for part in shapes)
    by_place = order_of(lattice.nearest(means.double(), covariances.double()))
    made, order = _numbering(given.numpy(), by_place, robot, first)
    ids, rows = as_tensors(made, order)
    device = components.ids.device
    arranged = replace(components.rearranged(rows.to(device)), ids=ids.to(device))
    return arranged, number_after(ids, first)


def number_after(ids: Tensor, next_number: int) -> int:
    """The sequence number of the next new component, after components with these ids (K, 2) exist."""
    numbers = on_cpu(ids)[0].numpy()[:, 1]
    return max(next_number, int(numbers.max(initial=-1)) + 1)


def quantize_numbered(components: Components, robot: int, first: int) -> Quantized:
    """The same as `quantize(numbered(components, robot, first)[0])`, rounding every component once."""
    c = components.on_cpu()
    places, given = lattice.nearest(c.means.double(), c.covariances.double()), c.ids.numpy()
    ids, order = _numbering(given, order_of(places, np.flatnonzero(given[:, 1] < 0)), robot, first)
    return _quantized(c, places, order, ids)


def _numbering(ids: Ints, by_place: Ints, robot: int, first: int) -> tuple[Ints, Ints]:
    """Ids (K, 2) after numbering, and the order (K,) of the components: numbered ones, then new ones in the
    order `by_place` (J,) of these.
    """
    is_new = ids[:, 1] < 0
    order = np.concatenate([np.flatnonzero(~is_new), np.flatnonzero(is_new)[by_place]])
    made = ids[order]
    made[len(made) - len(by_place) :, 0] = robot
    made[len(made) - len(by_place) :, 1] = first + np.arange(len(by_place))
    return made, order


def order_of(places: Lattice, rows: Ints | slice = slice(None)) -> Ints:
    """The `spatial_order` (J,) of these components on the lattice: that of a Morton curve."""
    cells = cells_of(places, _FINEST)[rows] + offset_of(_FINEST)
    dim = places.dim
    spread, shift = _SPREAD[dim], np.arange(dim)[::-1]
    # The bits of the coordinates, interleaved; those of ten levels at a time.
    digits = [(spread[cells >> 10 * n & 1023] << shift).sum(1) for n in range(4)]
    low, high = (digits[n] | digits[n + 1] << 10 * dim for n in (0, 2))
    return np.lexsort((low, high))


def cells_of(places: Lattice, exponent: int) -> Ints:
    """The cells (K, D) of side 2^exponent m that contain the means."""
    finer = exponent + PRECISION - ints(places.deviation) // PER_OCTAVE
    mean = ints(places.mean)
    cells = np.where(finer >= 0, mean >> np.maximum(finer, 0), mean << np.maximum(-finer, 0))
    found = np.empty_like(cells)
    np.put_along_axis(found, AXIS_ORDERS[places.dim].numpy()[ints(places.axis_order)], cells, 1)
    return found


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
