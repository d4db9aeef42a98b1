"""Query: the evidence and the occupancy of fixed components, by any form of evidence."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from gmmtorch.linalg import all_equal
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.query_options import QueryOptions, check_method
from gmmtorch.occupancy import (
    CUTOFF,
    Calibration,
    ConeIndex,
    Cones,
    Evidence,
    PointEvidence,
    PointForm,
    PointGroups,
    Rule,
    SparseEvidence,
    VoxelGrid,
    cell_flux,
    cone_evidence,
    flux_evidence,
    former_rows,
    probability,
    sample_rays,
    spectrum_of,
)

_RAYS_AT_ONCE = 1 << 20
_CELLS_AT_ONCE = 1 << 20
_SHARP_CUTOFF = 3.0
MANY_POINTS = 50
"""A viewpoint with this count shows where a surface ends."""


def count_many(counts: Tensor) -> tuple[int, int]:
    """How many of the counts of viewpoints are above zero, and how many are at least 50 points."""
    n_seen, n_many = torch.stack([(counts > 0).sum(), (counts >= MANY_POINTS).sum()]).tolist()
    return n_seen, n_many


def cutoff_of(n_seen: int, n_many: int) -> float:
    """The cutoff if none is given, of `n_seen` viewpoints with a count, `n_many` of them with at least 50
    points: 3 if the median is at least 50 points, otherwise `CUTOFF`."""
    return _SHARP_CUTOFF if n_seen - n_many <= (n_seen - 1) // 2 else CUTOFF


def mean_range(parts: Iterable[Components]) -> float:
    """Mean range (m) of the beams with a return, to their components' means; 1 if there are none."""
    total = count = 0.0
    for c in parts:
        weight = c.seen_count * ~c.max_range[c.seen_by]
        ranges = (c.means[c.seen_by] - c.origins[c.seen_from]).norm(dim=1)
        found = torch.stack([(weight * ranges).sum(), weight.sum()]).tolist()
        total, count = total + found[0], count + found[1]
    return total / count if total > 0 else 1.0


def rule_of(options: QueryOptions, parts: Iterable[Components]) -> Rule:
    """How probabilities follow from evidence; without a prior or a calibration, from the ranges of beams."""
    if options.prior is not None:
        return float(options.prior)
    return options.calibration or Calibration.prior(mean_range(parts))


def evidence_boxes(
    low: Tensor, high: Tensor, distance: Tensor, side: float, cutoff: float
) -> tuple[Tensor, Tensor]:
    """Lowest and highest corners (T, D), m, of boxes outside which a set of cones gives no evidence.

    Args:
        low, high: (T, D) a box around the cones of each set, see `cone_bounds`.
        distance: (T,) longest distance (m) from a mean to its sensor origin.
        side: of the cube around a point, or of the cell that contains it. A cube widens a cone as in
            `Hulls`, here by a bound for all cones of a set. The centre of the cell that contains a point is
            within one side of it.
    """
    widest = side * max(0.5 * low.shape[1] ** 0.5, cutoff / 12**0.5)
    pad = (widest * distance).sqrt().clamp_min(widest)[:, None] + side
    return low - pad, high + pad


_BLOCK = 2048  # components


class Block:
    """Components that answer together, with the forms and indices of their cones for each resolution that was
    asked for, and what is known about all of them. Everything is made when it is needed."""

    def __init__(self, *parts: Components) -> None:
        self._parts = parts
        self.forms: dict[float, PointForm] = {}
        self._indices: dict[float, ConeIndex] = {}
        self._boxes: dict[float, tuple[Tensor, Tensor, Tensor]] = {}  # for each cutoff
        self._cutoff = 0.0  # of forms and indices

    @functools.cached_property
    def components(self) -> Components:
        return Components.concatenate(self._parts)

    @functools.cached_property
    def counts(self) -> tuple[int, int]:
        """`count_many` of the components."""
        return count_many(torch.cat([part.seen_count for part in self._parts]))

    def box(self, cutoff: float) -> tuple[Tensor, Tensor, Tensor]:
        """low, high (D,), distance (): the first arguments of `evidence_boxes`. There must be a viewpoint.

        The distance is that of the corners of the box, which bounds it.
        """
        if cutoff not in self._boxes:
            means, origins = (x.detach().double() for x in (self.components.means, self.components.origins))
            variances = self.components.covariances.detach().double().diagonal(dim1=1, dim2=2)
            extent = cutoff * variances.sqrt()
            low = torch.minimum((means - extent).amin(0), origins.amin(0))
            high = torch.maximum((means + extent).amax(0), origins.amax(0))
            self._boxes[cutoff] = low, high, (high - low).norm()
        return self._boxes[cutoff]

    def form(self, resolution: float, cutoff: float, share: float) -> PointForm:
        self._use(cutoff)
        if resolution not in self.forms:
            axes = spectrum_of(self.components.covariances)[1][self.components.seen_by]
            self.forms[resolution] = PointForm(self.components.cones(), resolution, cutoff, share, axes)
        return self.forms[resolution]

    def index(self, resolution: float, cutoff: float) -> ConeIndex:
        self._use(cutoff)
        if resolution not in self._indices:
            self._indices[resolution] = ConeIndex(self.components.cones(), resolution, cutoff)
        return self._indices[resolution]

    def _use(self, cutoff: float) -> None:
        if cutoff != self._cutoff:
            self._cutoff, self.forms, self._indices = cutoff, {}, {}

    def replaced(self, *parts: Components) -> Block:
        """The block of other components, which keeps the lists that it can."""
        n_known, made = len(self._parts), Block(*parts)
        is_extended = all(a is b for a, b in zip(self._parts, parts, strict=False))
        if is_extended and len(parts) == n_known:
            return self
        made._cutoff = self._cutoff
        if is_extended and len(parts) > n_known and not self._indices:
            new = Block(*parts[n_known:])
            made.forms = {
                side: form.extended(new.form(side, self._cutoff, 1.0)) for side, form in self.forms.items()
            }
            return made
        if _same(self.components, made.components):
            made.forms, made._indices, made._boxes = self.forms, self._indices, self._boxes
            return made
        former, cones = former_rows(self.components.cones(), made.components.cones()), made.components.cones()
        if 2 * int((former < 0).sum()) <= len(former):
            made.forms = {side: form.replaced(cones, former) for side, form in self.forms.items()}
            made._indices = {side: index.replaced(cones, former) for side, index in self._indices.items()}
        return made


def _same(one: Components, other: Components) -> bool:
    """Whether all cones are equal. Origins may have other numbers."""
    parts = ("means", "covariances", "max_range", "seen_by", "seen_count")
    pairs = ((getattr(one, name), getattr(other, name)) for name in parts)
    origins = ((c.origins, c.seen_from) for c in (one, other))
    return all_equal(pairs) and torch.equal(*(places[number] for places, number in origins))


def in_blocks(components: Components) -> list[Components]:
    """The components in parts of as many as a block has, and a part of the rest, each with its origins."""
    n = len(components)
    if n < _BLOCK:
        return [components]
    ends = [*range(_BLOCK, n + 1, _BLOCK), n]
    return [part.with_used_origins() for part in components.split(ends)]


def _replaced(former: Sequence[Block], parts: Iterable[Components]) -> list[Block]:
    """The blocks of parts with viewpoints; each keeps what it can from the former block in its place."""
    found = [part for part in parts if len(part.seen_by)]
    pairs = itertools.zip_longest(former[: len(found)], found)
    return [Block(part) if old is None else old.replaced(part) for old, part in pairs]


def cutoff_for(blocks: Iterable[Block]) -> float:
    """`cutoff_of` all components of some blocks."""
    return cutoff_of(*map(sum, zip((0, 0), *(block.counts for block in blocks), strict=True)))


def _with_rows(
    blocks: Sequence[Block], points: Tensor, low: Tensor, high: Tensor
) -> Iterator[tuple[Block, Tensor | None]]:
    """The blocks with boxes low, high (B, D) that contain some of the points (M, D), and the points (R,)."""
    finite = torch.where(torch.isfinite(points), points, torch.nan)
    ends = [torch.nan_to_num(finite, nan=far) for far in (torch.inf, -torch.inf)]
    met = (ends[0].amin(0) <= high).all(1) & (ends[1].amax(0) >= low).all(1)
    columns = points.T.contiguous()
    for number in met.nonzero().squeeze(1).tolist():
        inside = torch.ones_like(columns[0], dtype=torch.bool)
        for column, first, last in zip(columns, low[number], high[number], strict=True):
            inside &= (column >= first) & (column <= last)
        rows = inside.nonzero().squeeze(1)
        if len(rows):
            yield blocks[number], rows


def boxes_of(blocks: Sequence[Block], side: float, cutoff: float) -> tuple[Tensor, Tensor]:
    """`evidence_boxes` of at least one block."""
    low, high, distance = map(torch.stack, zip(*(block.box(cutoff) for block in blocks), strict=True))
    return evidence_boxes(low, high, distance, side, cutoff)


class Query:
    """Answers queries about fixed components. Indices and Monte Carlo rays are made at the first query.

    Each part is a block, so a query needs only the blocks near its points, and a change only the blocks that
    it touches. Parts with many components become several blocks.

    Args:
        parts: components of the map.
        options: how queries are answered.
        recent: more components, such as those of the parts of an unfinished window. They are one block.
        former: answers about other components, whose lists are kept where it is possible.
    """

    def __init__(
        self,
        parts: Sequence[Components],
        options: QueryOptions,
        recent: Sequence[Components] = (),
        former: Query | None = None,
    ) -> None:
        self.parts, self.options = parts, options
        self.dim, self._device = parts[0].dim, parts[0].means.device
        former = former if former is not None and former.dim == self.dim else None
        every = [one for part in parts for one in (in_blocks(part) if len(part) > 2 * _BLOCK else [part])]
        self._blocks: list[Block] = _replaced(former._blocks if former else [], every)
        some = [part for part in recent if len(part.seen_by)]
        known = former._recent if former and some else []
        self._recent: list[Block] = [block.replaced(*some) for block in known] or (
            [Block(*some)] if some else []
        )
        self.rule = rule_of(options, [*parts, *recent])
        self.cutoff = options.cutoff or cutoff_for([*self._blocks, *self._recent])
        self._lattices: dict[float, SparseEvidence] = {}
        self._boxes: dict[float, tuple[Tensor, Tensor]] = {}  # of the blocks but the recent, for each side
        if former and self.cutoff == former.cutoff and self._blocks == former._blocks:
            self._boxes = former._boxes

    def prepare(self, former: Query) -> None:
        """Makes what the first query at the resolutions that `former` was asked for would make."""
        sides = {side for block in [*former._blocks, *former._recent] for side in block.forms}
        for block in self._recent:
            for side in sides:
                block.form(side, self.cutoff, 1 / max(1, len(self._blocks)))

    @property
    def cones(self) -> Cones:
        """The cones of all components."""
        every = [block.components.cones() for block in [*self._blocks, *self._recent]]
        return Cones(*map(torch.cat, zip(*every, strict=True))) if every else self.parts[0].cones()

    def _near(self, points: PointGroups, side: float) -> Iterator[tuple[Block, Tensor | None]]:
        """The blocks that can give evidence at M points, and the points (R,) of each; None: all."""
        blocks = self._blocks
        if len(blocks) <= 1:
            yield from ((block, None) for block in blocks)
        elif len(points.order if points.are_few else points.points):
            if side not in self._boxes:
                self._boxes[side] = boxes_of(blocks, side, self.cutoff)
            low, high = self._boxes[side]
            if points.are_few:
                first, last = (corner[:, None] for corner in points.box)
                met = ((first <= high) & (last >= low)).all(2).any(0)
                yield from ((blocks[number], None) for number in met.nonzero().squeeze(1).tolist())
            else:
                yield from _with_rows(blocks, points.points.detach().to(low), low, high)
        yield from ((block, None) for block in self._recent)

    def occupancy(self, points: Tensor, resolution: float, method: str) -> Tensor:
        """Probability (M,) that the cube of side `resolution` (m) of each point (M, D) is occupied.

        Method "point" takes the cube centred at the point; the others take the cell of the lattice
        [i·resolution, (i+1)·resolution) that contains the point. Points at infinity are unknown (½).
        """
        found = self.evidence_at(points, resolution, method)
        return probability(found.hits, found.misses, resolution, self.dim, self.rule)

    def evidence_at(self, points: Tensor, resolution: float, method: str) -> PointEvidence:
        """Hits and misses (M,) of the cubes of `occupancy`. Those of disjoint sets of cones add up."""
        check_method(method)
        zeros = torch.zeros_like(points[:, 0])
        if not self._blocks and not self._recent:
            return PointEvidence(zeros, zeros.clone())
        if method == "point":
            return self._at_points(points, resolution)
        if method == "monte_carlo":
            return PointEvidence(*self._lattice(resolution).at_points(points))
        finite = torch.isfinite(points).all(1)
        cells, cell = torch.unique(torch.floor(points[finite] / resolution), dim=0, return_inverse=True)
        low, high = cells * resolution, (cells + 1) * resolution
        found = self._in_boxes(low, high, resolution, cells if method == "flux" else None)
        place = finite.nonzero().squeeze(1)
        return PointEvidence(*(zeros.index_copy(0, place, values[cell]) for values in found))

    def evidence(self, grid: VoxelGrid, method: str) -> Evidence:
        """Hits and misses of every cell of a grid, and the rule by which probabilities follow from them.

        Raises `MemoryLimitError` if they take more bytes than the memory limit.
        """
        check_method(method)
        grid.check_memory(self.options.memory_limit)
        evidence = replace(Evidence.empty(grid, self._device), rule=self.rule)
        if not self._blocks and not self._recent:
            return evidence
        if method == "monte_carlo":
            self._cast(evidence)
            return evidence
        if method == "flux":
            return replace(flux_evidence(self.cones, grid, self.cutoff), rule=self.rule)
        half, parts = 0.5 * grid.resolution, []
        for first in range(0, grid.n_cells, _CELLS_AT_ONCE):  # centres of all cells take more than evidence
            centers = grid.centers(self._device, range(first, first + _CELLS_AT_ONCE))
            if method == "point":
                parts.append(self._at_points(centers, grid.resolution))
            else:
                parts.append(self._in_boxes(centers - half, centers + half, grid.resolution))
        hits, misses = (torch.cat(values).view(grid.shape) for values in zip(*parts, strict=True))
        return Evidence(grid, hits, misses, self.rule)

    def _at_points(self, points: Tensor, resolution: float) -> PointEvidence:
        """Evidence of the point form. The sum over all cones has one order, in whichever blocks they are."""
        found = PointEvidence(*torch.zeros(2, len(points), dtype=points.dtype, device=points.device))
        every = PointGroups(points)
        for block, rows in self._near(every, resolution):
            form = block.form(resolution, self.cutoff, 1 / max(1, len(self._blocks)))
            if rows is None:
                found = form(every, found)
            else:
                part = form(points[rows], PointEvidence(*(values[rows] for values in found)))
                found = PointEvidence(
                    *(old.index_copy(0, rows, new) for old, new in zip(found, part, strict=True))
                )
        return found

    def _in_boxes(self, low: Tensor, high: Tensor, side: float, cells: Tensor | None = None) -> PointEvidence:
        """Evidence of boxes [low, high], (M, D) each: of the thesis's cones, or of the flux through the faces
        of `cells` (M, D)."""
        hits, misses = torch.zeros(2, len(low), dtype=low.dtype, device=low.device)
        every = torch.arange(len(low), device=low.device)
        for block, chosen in self._near(PointGroups(0.5 * (low + high)), side):
            rows, cones = every if chosen is None else chosen, block.components.cones()
            boxes = low[rows], high[rows]
            pairs = block.index(side, self.cutoff).candidates(*boxes)
            if cells is None:
                found = cone_evidence(cones, *boxes, pairs, cutoff=self.cutoff)
            else:
                found = cell_flux(cones, cells[rows], side, pairs, self.cutoff)
            hits, misses = hits.index_add(0, rows, found[0]), misses.index_add(0, rows, found[1])
        return PointEvidence(hits, misses)

    def _lattice(self, resolution: float) -> SparseEvidence:
        """Monte Carlo evidence of the whole map on the world's lattice of this resolution."""
        if resolution not in self._lattices:
            options, device = self.options, self.cones.means.device
            lattice = SparseEvidence(resolution, self.cones.dim, device, options.memory_limit)
            self._cast(lattice)
            self._lattices[resolution] = lattice
        return self._lattices[resolution]

    def _cast(self, evidence: Evidence | SparseEvidence) -> None:
        """Adds Monte Carlo rays of the whole map to `evidence`."""
        options = self.options
        generator = torch.Generator().manual_seed(options.random_state)
        rays = sample_rays(self.cones, options.n_samples, generator, options.sampling)
        parts = zip(*(field.split(_RAYS_AT_ONCE) for field in rays), strict=True)
        for origins, ends, weights, is_hit in parts:
            evidence.add_rays(origins, ends, weights, is_hit)
