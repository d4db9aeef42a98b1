"""Query: the evidence and the occupancy of fixed components, by any form of evidence."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.mapping.query_options import QueryOptions, check_method
from gmmtorch.occupancy import (
    CUTOFF,
    Calibration,
    ConeIndex,
    Cones,
    Evidence,
    Pairs,
    PointEvidence,
    PointForm,
    Rule,
    SparseEvidence,
    VoxelGrid,
    cell_flux,
    cone_evidence,
    flux_evidence,
    former_rows,
    probability,
    sample_rays,
)

_RAYS_AT_ONCE = 1 << 20
_CELLS_AT_ONCE = 1 << 20
_SHARP_CUTOFF = 3.0
_MANY_ASKED = 1 << 18
"""Points after which a map probably does not change soon, so that all its cones get one index."""
MANY_POINTS = 50
"""A viewpoint with this count shows where a surface ends."""


def cutoff_by_support(cones: Cones) -> float:
    """The cutoff if none is given: 3 if the median count is at least 50 points, otherwise `CUTOFF`."""
    return cutoff_of(*count_many(cones))


def count_many(cones: Cones) -> tuple[int, int]:
    """Number of cones with a count, and number of cones with a count of at least 50 points."""
    return int((cones.counts > 0).sum()), int((cones.counts >= MANY_POINTS).sum())


def cutoff_of(n_seen: int, n_many: int) -> float:
    """`cutoff_by_support` of `n_seen` cones with a count, `n_many` of them with at least 50 points."""
    return _SHARP_CUTOFF if n_seen - n_many <= (n_seen - 1) // 2 else CUTOFF


def mean_range(parts: Iterable[Cones]) -> float:
    """Mean range (m) of the beams with a return, to their components' means; 1 if there are none."""
    total = count = 0.0
    for cones in parts:
        weight = cones.counts * ~cones.max_range
        ranges = (cones.means - cones.origins).norm(dim=1)
        found = torch.stack([(weight * ranges).sum(), weight.sum()]).tolist()
        total, count = total + found[0], count + found[1]
    return total / count if total > 0 else 1.0


def rule_of(options: QueryOptions, parts: Iterable[Cones]) -> Rule:
    """How probabilities follow from evidence; without a prior or a calibration, from the ranges of cones."""
    if options.prior is not None:
        return float(options.prior)
    return options.calibration or Calibration.prior(mean_range(parts))


class _Part(NamedTuple):
    """Some of the cones, and the forms and indices of them for each resolution that was asked for."""

    cones: Cones
    forms: dict[float, PointForm]
    indices: dict[float, ConeIndex]

    def replaced(self, cones: Cones, former: Tensor) -> _Part:
        """The part with other cones, which keeps what it can; `former` as for `ConeIndex.replaced`."""
        forms = {side: form.replaced(cones, former) for side, form in self.forms.items()}
        return _Part(cones, forms, {s: index.replaced(cones, former) for s, index in self.indices.items()})


class Query:
    """Answers queries about fixed cones. Indices and Monte Carlo rays are made at the first query.

    Args:
        cones: of components.
        options: how queries are answered.
        settled: (C,) False for cones that the next change will probably replace, such as those of an
            unfinished window. They have an index of their own. None: all are settled.
    """

    def __init__(self, cones: Cones, options: QueryOptions, settled: Tensor | None = None) -> None:
        self.cones = cones
        self.options, self.rule = options, rule_of(options, [cones])
        self.cutoff = cutoff_by_support(cones) if options.cutoff is None else options.cutoff
        self._lattices: dict[float, SparseEvidence] = {}
        if settled is None or bool(settled.all()):
            self._parts = [_Part(cones, {}, {})]
        else:
            self._parts = [_Part(cones.taken(rows), {}, {}) for rows in (settled, ~settled)]
        self._n_asked = 0

    def replaced(self, cones: Cones, options: QueryOptions, settled: Tensor | None = None) -> Query:
        """The answers about other cones; arguments as for `Query`. Lists of settled cones stay."""
        made, old = Query(cones, options, settled), self._parts[0]
        if made.cutoff != self.cutoff or cones.dim != self.cones.dim or not len(old.cones.counts):
            return made
        first, *rest = made._parts
        former = former_rows(old.cones, first.cones)
        if 2 * int((former < 0).sum()) > len(former):
            return made
        if len(former) != len(old.cones.counts) or bool((former < 0).any()):
            old = old.replaced(first.cones, former)
        made._parts = [old._replace(cones=first.cones)]
        for part in rest:
            none = torch.full_like(part.cones.max_range, -1, dtype=torch.int64)
            made._parts.append(old.replaced(part.cones, none))
        return made

    def occupancy(self, points: Tensor, resolution: float, method: str) -> Tensor:
        """Probability (M,) that the cube of side `resolution` (m) of each point (M, D) is occupied.

        Method "point" takes the cube centred at the point; the others take the cell of the lattice
        [i·resolution, (i+1)·resolution) that contains the point. Points at infinity are unknown (½).
        """
        found = self.evidence_at(points, resolution, method)
        return probability(found.hits, found.misses, resolution, self.cones.dim, self.rule)

    def evidence_at(self, points: Tensor, resolution: float, method: str) -> PointEvidence:
        """Hits and misses (M,) of the cubes of `occupancy`. Those of disjoint sets of cones add up."""
        check_method(method)
        zeros = torch.zeros_like(points[:, 0])
        if len(self.cones.counts) == 0:
            return PointEvidence(zeros, zeros.clone())
        if method == "point":
            return self._at_points(points, resolution)
        if method == "monte_carlo":
            return PointEvidence(*self._lattice(resolution).at_points(points))
        finite = torch.isfinite(points).all(1)
        cells, cell = torch.unique(torch.floor(points[finite] / resolution), dim=0, return_inverse=True)
        low, high = cells * resolution, (cells + 1) * resolution
        if method == "flux":
            found = _sum(
                PointEvidence(*cell_flux(part.cones, cells, resolution, pairs, self.cutoff))
                for part, pairs in self._candidates(low, high, resolution)
            )
        else:
            found = self._in_boxes(low, high, resolution)
        place = finite.nonzero().squeeze(1)
        return PointEvidence(*(zeros.index_copy(0, place, values[cell]) for values in found))

    def evidence(self, grid: VoxelGrid, method: str) -> Evidence:
        """Hits and misses of every cell of a grid, and the rule by which probabilities follow from them.

        Raises `MemoryLimitError` if they take more bytes than the memory limit.
        """
        check_method(method)
        grid.check_memory(self.options.memory_limit)
        evidence = replace(Evidence.empty(grid, self.cones.means.device), rule=self.rule)
        if len(self.cones.counts) == 0:
            return evidence
        if method == "monte_carlo":
            self._cast(evidence)
            return evidence
        if method == "flux":
            return replace(flux_evidence(self.cones, grid, self.cutoff), rule=self.rule)
        half, parts = 0.5 * grid.resolution, []
        for first in range(0, grid.n_cells, _CELLS_AT_ONCE):  # centres of all cells take more than evidence
            centers = grid.centers(self.cones.means.device, range(first, first + _CELLS_AT_ONCE))
            if method == "point":
                parts.append(self._at_points(centers, grid.resolution))
            else:
                parts.append(self._in_boxes(centers - half, centers + half, grid.resolution))
        hits, misses = (torch.cat(values).view(grid.shape) for values in zip(*parts, strict=True))
        return Evidence(grid, hits, misses, self.rule)

    def _at_points(self, points: Tensor, resolution: float) -> PointEvidence:
        """Evidence of the point form. The sum over all cones has one order, however they are kept."""
        if len(self._parts) > 1 and self._n_asked > _MANY_ASKED:  # one index is faster for more points
            self._parts = [_Part(self.cones, {}, {})]
        self._n_asked += len(points)
        found = None
        for part in self._parts:
            if resolution not in part.forms:
                part.forms[resolution] = PointForm(part.cones, resolution, self.cutoff)
            found = part.forms[resolution](points, found)
        assert found is not None
        return found

    def _candidates(
        self, low: Tensor, high: Tensor, resolution: float
    ) -> Iterator[tuple[_Part, Iterator[Pairs]]]:
        for part in self._parts:
            if resolution not in part.indices:
                part.indices[resolution] = ConeIndex(part.cones, resolution, self.cutoff)
            yield part, part.indices[resolution].candidates(low, high)

    def _in_boxes(self, low: Tensor, high: Tensor, resolution: float) -> PointEvidence:
        """Evidence of the thesis's cones."""
        return _sum(
            PointEvidence(*cone_evidence(part.cones, low, high, pairs, cutoff=self.cutoff))
            for part, pairs in self._candidates(low, high, resolution)
        )

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


def _sum(parts: Iterable[PointEvidence]) -> PointEvidence:
    """The evidence of disjoint sets of cones, which adds up."""
    hits, misses = (functools.reduce(torch.add, values) for values in zip(*parts, strict=True))
    return PointEvidence(hits, misses)
