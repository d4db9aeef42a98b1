"""BayesianHilbertMap: Bayesian logistic regression on hinged kernels, scan after scan."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from gmmtorch.baselines.baseline_map import BaselineMap
from gmmtorch.baselines.hilbert_features import LatticeDesign, LatticeFeatures, check_lattice
from gmmtorch.baselines.hilbert_map import check_between
from gmmtorch.baselines.samples import beam_samples, check_length
from gmmtorch.errors import DataError, InvalidArgumentError, MemoryLimitError, check_whole
from gmmtorch.files import pack_tensors, require
from gmmtorch.scan import Scan

_FILE_KIND, _FILE_VERSION = "gmmtorch.bayesian_hilbert_map", 1
_MAX_FULL = 4096  # hinges whose full covariance is kept
_CONJUGATE_STEPS = 10  # each lowers the error, and every round goes on from the last one's mean

Covariance = Literal["diagonal", "mean_field", "full"]


@dataclass(frozen=True)
class Posterior:
    """Normal weights of F features: mean (F,), float64, and precision, (F,) if diagonal, else (F, F)."""

    mean: Tensor
    precision: Tensor

    @property
    def is_full(self) -> bool:
        return self.precision.ndim == 2

    @cached_property
    def factor(self) -> Tensor:
        """Lower Cholesky factor (F, F) of a full precision."""
        return torch.linalg.cholesky(self.precision)


def jaakkola_lambda(xi: Tensor) -> Tensor:
    """λ(ξ) = tanh(ξ/2)/4ξ, ⅛ at zero, of ξ ≥ 0: the curvature of Jaakkola & Jordan's bound at ξ."""
    return torch.where(xi > 1e-4, (0.5 * xi).tanh() / (4 * xi).clamp_min(1e-300), 0.125)


def moments(design: LatticeDesign, posterior: Posterior) -> tuple[Tensor, Tensor]:
    """Mean and variance (M,) of wᵀφ(x)."""
    mean = design.dot(posterior.mean)
    if not posterior.is_full:
        return mean, design.dot_squared(1 / posterior.precision)
    whitened = torch.linalg.solve_triangular(posterior.factor, design.dense().mT, upper=False)
    return mean, whitened.square().sum(0)


def evidence_bound(design: LatticeDesign, is_hit: Tensor, prior: Posterior, posterior: Posterior) -> float:
    """Lower bound of ln p(y), at the ξ that are best for this posterior (Jaakkola & Jordan 2000).

    Σ ln σ(ξ) − ξ/2 + (y − ½) E[wᵀφ] − KL(posterior ‖ prior), for ξ² = E[(wᵀφ)²].
    """
    mean, variance = moments(design, posterior)
    xi = (mean.square() + variance).sqrt()
    fit = torch.nn.functional.logsigmoid(xi) - 0.5 * xi + (is_hit.double() - 0.5) * mean
    return float(fit.sum() - _divergence(posterior, prior))


def _divergence(one: Posterior, other: Posterior) -> Tensor:
    """KL(one ‖ other) of normals that are both full, or both diagonal."""
    shift = one.mean - other.mean
    if not one.is_full:
        ratio = other.precision / one.precision
        return 0.5 * (ratio - 1 - ratio.log() + other.precision * shift.square()).sum()
    trace = torch.linalg.solve(one.precision, other.precision).diagonal().sum()
    determinants = 2 * (one.factor.diagonal().log().sum() - other.factor.diagonal().log().sum())
    return 0.5 * (trace - shift.shape[0] + determinants + shift @ other.precision @ shift)


def variational_step(
    design: LatticeDesign,
    is_hit: Tensor,
    prior: Posterior,
    xi: Tensor,
    covariance: Covariance,
    start: Tensor | None = None,
) -> Posterior:
    """The posterior for given ξ (M,), of the prior and the points' labels; `start` (F,): a guess of its mean.

    precision = prior's + 2 Σ λ(ξ) φφᵀ, and its mean solves precision · m = prior's · m₀ + Σ (y − ½) φ.
    "full" does that. "mean_field" is the best normal of independent weights: the same mean, and the
    diagonal of that precision. "diagonal" is the authors' fast form, which leaves the other entries
    out of the equation for the mean too, as if no two features were at one place.
    """
    curvature = 2 * jaakkola_lambda(xi)
    pulled = design.pull(is_hit.double() - 0.5)
    if prior.is_full:
        phi = design.dense()
        precision = prior.precision + phi.mT @ (phi * curvature[:, None])
        right = prior.precision @ prior.mean + pulled
        return Posterior(
            torch.cholesky_solve(right[:, None], torch.linalg.cholesky(precision))[:, 0], precision
        )
    precision = prior.precision + design.pull_squared(curvature)
    right = prior.precision * prior.mean + pulled
    if covariance == "diagonal":
        return Posterior(right / precision, precision)

    def times(x: Tensor) -> Tensor:
        return prior.precision * x + design.pull(curvature * design.dot(x))

    start = prior.mean if start is None else start
    return Posterior(_conjugate_gradients(times, right, start, precision), precision)


def _conjugate_gradients(
    times: Callable[[Tensor], Tensor], right: Tensor, start: Tensor, diagonal: Tensor
) -> Tensor:
    """x of A x = right, A positive definite, by conjugate gradients preconditioned with its diagonal."""
    x = start
    residual = right - times(x)
    ahead = residual / diagonal
    direction, power = ahead, residual @ ahead
    goal = 1e-10 * float(right @ (right / diagonal))
    for _ in range(_CONJUGATE_STEPS):
        if float(power) <= goal:
            break
        image = times(direction)
        step = power / (direction @ image)
        x, residual = x + step * direction, residual - step * image
        ahead = residual / diagonal
        power, previous = residual @ ahead, power
        direction = ahead + power / previous * direction
    return x


def fit(
    design: LatticeDesign, is_hit: Tensor, prior: Posterior, covariance: Covariance, n_iter: int
) -> Posterior:
    """The posterior after `n_iter` rounds, from ξ = 1: of the weights for ξ, then of ξ for the weights."""
    xi = torch.ones(is_hit.shape[0], dtype=torch.float64, device=is_hit.device)
    posterior = prior
    for _ in range(n_iter):
        posterior = variational_step(design, is_hit, prior, xi, covariance, posterior.mean)
        mean, variance = moments(design, posterior)
        xi = (mean.square() + variance).sqrt()
    return posterior


def moderated(mean: Tensor, variance: Tensor) -> Tensor:
    """σ(m/√(1 + πv/8)) ≈ E[σ(a)] of a ~ N(m, v): MacKay 1992."""
    return torch.sigmoid(mean / (1 + math.pi / 8 * variance).sqrt())


class BayesianHilbertMap(BaselineMap):
    """A normal distribution over the weights of RBF kernels hinged at the nodes of a lattice.

    Senanayake & Ramos 2017, "Bayesian Hilbert maps for dynamic continuous occupancy mapping": each
    scan's posterior, by Jaakkola and Jordan's bound, is the next one's prior (a large scan is learned in
    parts), so that no points are
    kept, and answers are moderated by the weights' variance. Nodes are hinged where data is, rather
    than throughout a box; kernels are cut at 10⁻³, and there is no constant term, so that θ is
    exactly ½ out of all hinges' reach.

    Args:
        gamma: of the kernel exp(−γ d²) (1/m²). The defaults suit rooms seen to 0.1 m.
        spacing: of the hinges (m).
        covariance: of the weights: diagonal, mean_field or full, see `variational_step`. "diagonal"
            needs kernels that hardly overlap (γ·spacing² ≥ 4, say); "full" is for few hinges: it takes
            the square of their number, and its cube in time for each scan.
        prior_variance: of every weight; the authors' code has 10⁴.
        n_iter: rounds for each scan.
        free_spacing: of the free points along a beam (m).
        gap: before a hit, without free points (m).
        thin: side of the cubes in which a scan's ends count once (m); None: all count.
        random_state: seed of the free points.
    """

    any_resolution = True

    def __init__(
        self,
        gamma: float = 30.0,
        *,
        spacing: float = 0.2,
        covariance: Covariance = "mean_field",
        prior_variance: float = 10.0,
        n_iter: int = 3,
        free_spacing: float = 1.0,
        gap: float = 0.0,
        thin: float | None = None,
        random_state: int = 0,
    ) -> None:
        if covariance not in get_args(Covariance):
            raise InvalidArgumentError(
                f"covariance={covariance!r} is not one of {', '.join(get_args(Covariance))}."
            )
        self.gamma = check_between("gamma", gamma, 1e-12)
        self.spacing = check_length("spacing", spacing)
        self.covariance = covariance
        self.prior_variance = check_between("prior_variance", prior_variance, 1e-12)
        self.n_iter = check_whole("n_iter", n_iter, 1)
        self.free_spacing = check_length("free_spacing", free_spacing)
        self.gap = check_between("gap", gap, 0)
        self.thin = None if thin is None else check_length("thin", thin)
        self.random_state = check_whole("random_state", random_state, 0)
        self._drawing = torch.Generator().manual_seed(self.random_state)
        # Of each hinge the mean and what the data adds to the precision, in single precision, as stored.
        self._hinges = self._lattice(2, torch.device("cpu"))
        self._factor: Tensor | None = None  # "full": lower Cholesky factor of the precision (F, F)

    def _lattice(self, dim: int, device: torch.device) -> LatticeFeatures:
        return LatticeFeatures("rbf", (2 * self.gamma) ** -0.5, self.spacing, dim, 2, device)

    @property
    def device(self) -> torch.device:
        return self._hinges.table.keys.device

    @property
    def posterior(self) -> Posterior:
        """Of the weights of the hinges, in the order of `hinges`."""
        mean, added = self._hinges.table.values.double().unbind(1)
        if self.covariance != "full":
            return Posterior(mean, added + 1 / self.prior_variance)
        factor = self._full_factor().double()
        made = Posterior(mean, factor @ factor.mT)
        made.__dict__["factor"] = factor  # known already
        return made

    @property
    def hinges(self) -> Tensor:
        """Where the kernels are (F, D), world metres."""
        return self._hinges.table.centers()

    def _start(self, dim: int, device: torch.device) -> None:
        check_lattice("rbf", (2 * self.gamma) ** -0.5, self.spacing, dim)
        self._hinges = self._lattice(dim, device)

    def _learn(self, scan: Scan) -> None:
        points, is_hit = beam_samples(
            scan, self.free_spacing, gap=self.gap, thin=self.thin, generator=self._drawing
        )
        if not points.shape[0]:
            return
        self._open(points)
        n_parts = math.ceil(points.shape[0] / self._at_once)
        posterior = self.posterior
        for part in range(n_parts):  # every n-th point, so that each part is of the whole scan
            design = self._hinges.design(points[part::n_parts])
            posterior = fit(design, is_hit[part::n_parts], posterior, self.covariance, self.n_iter)
        self._keep(posterior)

    @property
    def _at_once(self) -> int:
        """Points that are worked on together."""
        return self._hinges.points_at_once if self.covariance != "full" else 1 << 12

    def _keep(self, posterior: Posterior) -> None:
        table = self._hinges.table
        if self.covariance == "full":
            added = torch.zeros_like(posterior.mean)
            self._factor = posterior.factor.float().contiguous()  # as it is stored, and as it is read
        else:
            added = posterior.precision - 1 / self.prior_variance
        table.values = torch.stack([posterior.mean, added], 1).float()

    def _open(self, points: Tensor) -> None:
        """Hinges for the points' cells; those that are new have the prior."""
        table = self._hinges.table
        before = table.keys
        self._hinges.open(points)
        if self.covariance != "full":
            return
        n = self._hinges.count
        if n > _MAX_FULL:
            raise MemoryLimitError(
                f"spacing={self.spacing} m makes {n:,} hinges, above the {_MAX_FULL:,} of covariance='full'; "
                "take a wider one, or covariance='mean_field'."
            )
        # A new weight is independent of the others, wherever in the order it comes: rows of the precision.
        precision = torch.eye(n, dtype=torch.float64, device=table.keys.device) / self.prior_variance
        if self._factor is not None:
            old = torch.searchsorted(table.keys, before)
            earlier = self._factor.double()
            precision[old[:, None], old] = earlier @ earlier.mT
        self._factor = torch.linalg.cholesky(precision).float()

    def _full_factor(self) -> Tensor:
        if self._factor is None:
            return torch.empty(0, 0, device=self.device)
        return self._factor

    def _answer(self, query: Tensor) -> Tensor:
        theta = query.new_full((query.shape[0],), 0.5)
        if not self._hinges.count:
            return theta
        posterior = self.posterior
        finite = torch.isfinite(query).all(1).nonzero().squeeze(1)
        for index in finite.split(self._at_once):
            theta[index] = moderated(*moments(self._hinges.design(query[index]), posterior))
        return theta

    # -- keeping ----------------------------------------------------------------------------------

    _OPTIONS = (
        "gamma",
        "spacing",
        "covariance",
        "prior_variance",
        "n_iter",
        "free_spacing",
        "gap",
        "thin",
        "random_state",
    )

    def _serialized(self) -> bytes:
        """Hinges, means, and precisions (or the lower triangle of their Cholesky factor), as float32."""
        facts: dict[str, Any] = {name: getattr(self, name) for name in self._OPTIONS}
        mean, added = self._hinges.table.values.unbind(1)
        tensors = {**self._hinges.tensors(), "means": mean}
        if self.covariance == "full":
            rows, cols = torch.tril_indices(len(mean), len(mean))
            tensors["factor"] = self._full_factor()[rows, cols]
        else:
            tensors["precisions"] = added
        return pack_tensors(tensors, _FILE_KIND, _FILE_VERSION, dim=self.dim, **facts)

    @classmethod
    def load(cls, path: str | Path) -> BayesianHilbertMap:
        """Read a map that `save` wrote. Raises `DataError` if it is not one."""
        made, tensors = cls._opened(path, _FILE_KIND, _FILE_VERSION)
        table = made._hinges.table
        table.fill(tensors, path)
        n = table.keys.shape[0]
        table.values[:, 0] = require(tensors, "means", (n,), torch.float32, path)
        if made.covariance != "full":
            table.values[:, 1] = require(tensors, "precisions", (n,), torch.float32, path)
            if bool((table.values[:, 1] < 0).any()):
                raise DataError(f"{path}: precisions holds negative numbers; the file is damaged.")
        elif n:
            if n > _MAX_FULL:
                raise DataError(f"{path} has {n:,} hinges, above the {_MAX_FULL:,} of covariance='full'.")
            stored = require(tensors, "factor", (n * (n + 1) // 2,), torch.float32, path)
            rows, cols = torch.tril_indices(n, n)
            made._factor = torch.zeros(n, n)
            made._factor[rows, cols] = stored
            if bool((made._factor.diagonal() <= 0).any()):
                raise DataError(f"{path}: factor is not of a precision; the file is damaged.")
        return made
