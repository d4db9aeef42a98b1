"""Answers: what fixed components say of space, by any form of evidence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.occupancy.cones import CUTOFF, Cones
from gmmtorch.occupancy.evidence import Evidence, check_prior, occupancy_probability
from gmmtorch.occupancy.forms.cone.cone_evidence import cone_evidence
from gmmtorch.occupancy.forms.flux.box_flux import box_flux, flux_evidence
from gmmtorch.occupancy.forms.monte_carlo import SAMPLINGS, Sampling, sample_rays
from gmmtorch.occupancy.forms.point import PointEvidence, PointForm
from gmmtorch.occupancy.grid import MEMORY_LIMIT, VoxelGrid
from gmmtorch.occupancy.index.cone_index import ConeIndex
from gmmtorch.occupancy.voxels.blocks import BlockEvidence

Method = Literal["point", "flux", "cone", "monte_carlo"]
METHODS: tuple[str, ...] = get_args(Method)

_RAYS_AT_ONCE = 1 << 20
_SHARP_CUTOFF, _MANY_POINTS = 3.0, 50


@dataclass(frozen=True)
class Answering:
    """How a map answers; none of it changes what a map knows.

    prior: N_p of (3.9), counts given to either outcome before any evidence.
    cutoff: standard deviations beyond which a component is taken to end. None: 3 where components stand
        for many points, so that tails do not claim space that nothing saw; `CUTOFF` where they stand for
        few, which do not tell where a surface ends.
    hit_length: ℓ (m): the occupancy of a cell of side h weighs its hits by ℓ/h, as if cells were so deep.
        Of a thin surface a ray ends in one cell of many that it would have passed: this puts θ on the
        right side of ½ and hardly changes the order. None: h, so that hits are counts.
    n_samples: Monte Carlo rays drawn from the whole map.
    sampling: "sobol", "stratified" or "plain".
    random_state: seed of the rays.
    memory_limit: bytes that evidence may take.
    compiled: use torch.compile where there is a compiled form.
    """

    prior: float = 1.0
    cutoff: float | None = CUTOFF
    hit_length: float | None = None
    n_samples: int = 1_000_000
    sampling: Sampling = "sobol"
    random_state: int = 0
    memory_limit: int = MEMORY_LIMIT
    compiled: bool = False

    def __post_init__(self) -> None:
        check_prior(self.prior)
        for name in ("n_samples", "memory_limit"):
            check_whole(name, getattr(self, name), 1)
        check_whole("random_state", self.random_state, 0)
        if self.cutoff is not None and not 0 < self.cutoff < float("inf"):
            raise InvalidArgumentError(f"cutoff={self.cutoff} must be a number of deviations above zero.")
        if self.hit_length is not None and not 0 < self.hit_length < float("inf"):
            raise InvalidArgumentError(f"hit_length={self.hit_length} must be metres above zero, or null.")
        if self.sampling not in SAMPLINGS:
            raise InvalidArgumentError(f"sampling={self.sampling!r} is not one of {', '.join(SAMPLINGS)}.")


def check_method(method: str) -> None:
    """Raises for a form of evidence that is not known."""
    if method not in METHODS:
        raise InvalidArgumentError(f"method={method!r} is not one of {', '.join(METHODS)}.")


def fitting_cutoff(cones: Cones) -> float:
    """The cutoff for these cones where none is given: by the points that half of them stand for, or more."""
    counts = cones.counts[cones.counts > 0]
    return _SHARP_CUTOFF if counts.numel() and float(counts.median()) >= _MANY_POINTS else CUTOFF


class Answers:
    """What these cones say of space. What is costly is made once, when it is first asked for."""

    def __init__(self, cones: Cones, options: Answering) -> None:
        self.cones = cones
        self.options = options
        self.cutoff = fitting_cutoff(cones) if options.cutoff is None else options.cutoff
        self._lattices: dict[float, BlockEvidence] = {}
        self._forms: dict[float, PointForm] = {}
        self._indices: dict[float, ConeIndex] = {}

    def occupancy(self, points: Tensor, resolution: float, method: str) -> Tensor:
        """Probability (M,) that the cube of side `resolution` (m) of each point (M, D) is occupied.

        `point` asks of the cube centred at the point; the others of the cell of the lattice
        [i·resolution, (i+1)·resolution) that holds it. Points at infinity are unknown.
        """
        check_method(method)
        if len(self.cones.counts) == 0:
            return torch.full_like(points[:, 0], 0.5)
        if method == "point":
            return self._probability(self._form(resolution)(points), resolution)
        if method == "monte_carlo":
            return self._probability(self._lattice(resolution).evidence_at(points), resolution)
        finite = torch.isfinite(points).all(1)
        cells, cell = torch.unique(torch.floor(points[finite] / resolution), dim=0, return_inverse=True)
        evidence = self._in_boxes(cells * resolution, (cells + 1) * resolution, resolution, method)
        theta = torch.full_like(points[:, 0], 0.5)
        theta[finite] = self._probability(evidence, resolution)[cell]
        return theta

    def _probability(self, evidence: tuple[Tensor, Tensor], resolution: float) -> Tensor:
        """θ (M,) of hits (M,) and misses (M,)."""
        hits, misses = evidence
        length = self.options.hit_length
        return occupancy_probability(
            hits if length is None else hits * (length / resolution), misses, self.options.prior
        )

    def evidence(self, grid: VoxelGrid, method: str) -> Evidence:
        """Hits and misses of every cell of a grid: counts, whatever `hit_length` is."""
        check_method(method)
        evidence = Evidence.empty(grid, self.cones.means.device)
        if len(self.cones.counts) == 0:
            return evidence
        if method == "monte_carlo":
            self._cast(evidence)
            return evidence
        if method == "flux":
            return flux_evidence(self.cones, grid, self.cutoff)
        centers = grid.centers(self.cones.means.device)
        if method == "point":
            found = self._form(grid.resolution)(centers)
        else:
            half = 0.5 * grid.resolution
            found = self._in_boxes(centers - half, centers + half, grid.resolution, method)
        return Evidence(grid, found.hits.view(grid.shape), found.misses.view(grid.shape))

    def _form(self, resolution: float) -> PointForm:
        if resolution not in self._forms:
            options = self.options
            self._forms[resolution] = PointForm(
                self.cones, resolution, self.cutoff, compiled=options.compiled
            )
        return self._forms[resolution]

    def _in_boxes(self, low: Tensor, high: Tensor, resolution: float, method: str) -> PointEvidence:
        if resolution not in self._indices:
            self._indices[resolution] = ConeIndex(self.cones, resolution, self.cutoff)
        pairs = self._indices[resolution].candidates(low, high)
        form = box_flux if method == "flux" else cone_evidence
        return PointEvidence(*form(self.cones, low, high, pairs, cutoff=self.cutoff))

    def _lattice(self, resolution: float) -> BlockEvidence:
        """Monte Carlo evidence of the whole map on the world's lattice of this resolution."""
        if resolution not in self._lattices:
            options, device = self.options, self.cones.means.device
            lattice = BlockEvidence(
                resolution, self.cones.dim, device, options.memory_limit, options.compiled
            )
            self._cast(lattice)
            self._lattices[resolution] = lattice
        return self._lattices[resolution]

    def _cast(self, evidence: Evidence | BlockEvidence) -> None:
        """Monte Carlo rays of the whole map, added to `evidence`."""
        options = self.options
        generator = torch.Generator().manual_seed(options.random_state)
        rays = sample_rays(self.cones, options.n_samples, generator, options.sampling)
        parts = zip(*(field.split(_RAYS_AT_ONCE) for field in rays), strict=True)
        for origins, ends, weights, is_hit in parts:
            if isinstance(evidence, Evidence):
                evidence.add_rays(origins, ends, weights, is_hit, compiled=options.compiled)
            else:
                evidence.add_rays(origins, ends, weights, is_hit)
