"""Bayesian Hilbert map: Bayesian logistic regression on hinged kernels, updated scan by scan."""

from __future__ import annotations

import math
from pathlib import Path
from typing import get_args

import torch
from torch import Tensor

from gmmtorch.errors import DataError, MemoryLimitError, check_choice, check_number, check_whole
from gmmtorch.experiments.baselines.hilbert.lattice_features import LatticeFeatures, check_lattice
from gmmtorch.experiments.baselines.hilbert.logistic_regression import (
    Covariance,
    Posterior,
    fit_posterior,
    moderated,
    moments,
)
from gmmtorch.experiments.baselines.samples import beam_samples
from gmmtorch.files import require
from gmmtorch.occupancy import TensorFileMap, check_length, optional_length
from gmmtorch.scan import Scan

_MAX_FULL = 4096  # most hinges with a full covariance


class BayesianHilbertMap(TensorFileMap):
    """A normal distribution over the weights of RBF kernels that are hinged at the nodes of a lattice.

    Senanayake & Ramos 2017, "Bayesian Hilbert maps for dynamic continuous occupancy mapping". The
    posterior of each scan, by Jaakkola and Jordan's bound, is the prior of the next scan; a large scan is
    learned in parts. No points are stored. Queries take the variance of the weights into account.
    Differences from the paper: nodes are hinged only where data is, not throughout a box; kernels are cut
    at 10⁻³; there is no constant term, so θ is exactly ½ beyond the reach of all hinges.

    Args:
        gamma: of the kernel exp(−γ d²) (1/m²). The defaults suit rooms mapped at 0.1 m.
        spacing: of the hinges (m).
        covariance: of the weights: diagonal, mean_field or full, see `variational_step`. "diagonal" needs
            kernels that hardly overlap (γ·spacing² ≥ 4, say). "full" suits few hinges: its memory is
            quadratic in their number, and its time per scan cubic.
        prior_variance: of each weight; the authors' code uses 10⁴.
        n_iter: rounds per scan.
        free_spacing: spacing of the free points of a beam (m).
        gap: distance before a hit without free points (m).
        thin: side of the cubes in which a scan's beam ends are merged (m); None: no merging.
        random_state: seed of the free points.
    """

    any_resolution = True
    file_kind = "gmmtorch.bayesian_hilbert_map"

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
        check_choice("covariance", covariance, get_args(Covariance))
        self.gamma = check_number("gamma", gamma, least=1e-12)
        self.spacing = check_length("spacing", spacing)
        self.covariance = covariance
        self.prior_variance = check_number("prior_variance", prior_variance, least=1e-12)
        self.n_iter = check_whole("n_iter", n_iter, 1)
        self.free_spacing = check_length("free_spacing", free_spacing)
        self.gap = check_number("gap", gap)
        self.thin = optional_length("thin", thin)
        self.random_state = check_whole("random_state", random_state, 0)
        self._generator = torch.Generator().manual_seed(self.random_state)
        # Values of a hinge: mean, and precision that the data adds to the prior's; float32, as in files.
        self._hinges = self._lattice(2, torch.device("cpu"))
        self._factor = torch.empty(0, 0)  # "full": lower Cholesky factor of the precision (F, F)

    def _lattice(self, dim: int, device: torch.device) -> LatticeFeatures:
        return LatticeFeatures("rbf", (2 * self.gamma) ** -0.5, self.spacing, dim, 2, device)

    @property
    def device(self) -> torch.device:
        return self._hinges.table.keys.device

    @property
    def posterior(self) -> Posterior:
        """Distribution of the weights of the hinges, in the order of `hinges`."""
        mean, added = self._hinges.table.values.double().unbind(1)
        if self.covariance != "full":
            return Posterior(mean, added + 1 / self.prior_variance)
        return Posterior.from_factor(mean, self._factor.double())

    @property
    def hinges(self) -> Tensor:
        """Centres of the kernels (F, D), world metres."""
        return self._hinges.table.centers()

    def _start(self, dim: int, device: torch.device) -> None:
        check_lattice("rbf", (2 * self.gamma) ** -0.5, self.spacing, dim)
        self._hinges = self._lattice(dim, device)
        self._factor = torch.empty(0, 0, device=device)

    # -- learning ---------------------------------------------------------------------------------

    def _learn(self, scan: Scan) -> None:
        points, is_hit = beam_samples(
            scan, self.free_spacing, gap=self.gap, thin=self.thin, generator=self._generator
        )
        if not points.shape[0]:
            return
        self._add_hinges(points)
        n_parts = math.ceil(points.shape[0] / self._max_points)
        posterior = self.posterior
        for part in range(n_parts):  # every n-th point, so that each part covers the whole scan
            design = self._hinges.design(points[part::n_parts])
            posterior = fit_posterior(design, is_hit[part::n_parts], posterior, self.covariance, self.n_iter)
        self._store(posterior)

    @property
    def _max_points(self) -> int:
        """Largest number of points per design."""
        return self._hinges.max_points if self.covariance != "full" else 1 << 12

    def _store(self, posterior: Posterior) -> None:
        table = self._hinges.table
        if self.covariance == "full":
            added = torch.zeros_like(posterior.mean)
            self._factor = posterior.factor.float().contiguous()  # rounded as in files
        else:
            added = posterior.precision - 1 / self.prior_variance
        table.values = torch.stack([posterior.mean, added], 1).float()

    def _add_hinges(self, points: Tensor) -> None:
        """Adds the missing hinges of the points' cells, with the prior."""
        table = self._hinges.table
        before = table.keys
        self._hinges.add_nodes(points)
        if self.covariance != "full":
            return
        n = self._hinges.count
        if n > _MAX_FULL:
            raise MemoryLimitError(
                f"spacing={self.spacing} m makes {n:,} hinges, above the {_MAX_FULL:,} of covariance='full'; "
                "use a wider spacing, or covariance='mean_field'."
            )
        # New weights are independent of the others. They can be inserted anywhere in the order.
        precision = torch.eye(n, dtype=torch.float64, device=table.keys.device) / self.prior_variance
        old, factor = torch.searchsorted(table.keys, before), self._factor.double()
        precision[old[:, None], old] = factor @ factor.mT
        self._factor = torch.linalg.cholesky(precision).float()

    # -- queries ----------------------------------------------------------------------------------

    def _answer(self, query: Tensor) -> Tensor:
        theta = query.new_full((query.shape[0],), 0.5)
        if not self._hinges.count:
            return theta
        posterior = self.posterior
        finite = torch.isfinite(query).all(1).nonzero().squeeze(1)
        for index in finite.split(self._max_points):
            theta[index] = moderated(*moments(self._hinges.design(query[index]), posterior))
        return theta

    # -- files ------------------------------------------------------------------------------------

    def _tensors(self) -> dict[str, Tensor]:
        """Hinges, means, and precisions or the lower triangle of their Cholesky factor, as float32."""
        mean, added = self._hinges.table.values.unbind(1)
        tensors = {**self._hinges.tensors(), "means": mean}
        if self.covariance == "full":
            rows, cols = torch.tril_indices(len(mean), len(mean))
            tensors["factor"] = self._factor[rows, cols]
        else:
            tensors["precisions"] = added
        return tensors

    def _restore(self, tensors: dict[str, Tensor], path: str | Path) -> None:
        table = self._hinges.table
        table.fill(tensors, path)
        n = table.keys.shape[0]
        table.values[:, 0] = require(tensors, "means", (n,), torch.float32, path)
        if self.covariance != "full":
            table.values[:, 1] = require(tensors, "precisions", (n,), torch.float32, path)
            if bool((table.values[:, 1] < 0).any()):
                raise DataError(f"{path}: precisions contains negative numbers; the file is damaged.")
        elif n:
            if n > _MAX_FULL:
                raise DataError(f"{path} has {n:,} hinges, above the {_MAX_FULL:,} of covariance='full'.")
            stored = require(tensors, "factor", (n * (n + 1) // 2,), torch.float32, path)
            rows, cols = torch.tril_indices(n, n)
            self._factor = torch.zeros(n, n)
            self._factor[rows, cols] = stored
            if bool((self._factor.diagonal() <= 0).any()):
                raise DataError(f"{path}: factor is not that of a precision; the file is damaged.")
