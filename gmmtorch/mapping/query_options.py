"""Options with which a map answers queries. Importing this file does not load torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypedDict, get_args

from gmmtorch.declarations import option
from gmmtorch.errors import check_choice, check_number, check_prior, check_whole
from gmmtorch.mapping.learning.rules import LearningRule

if TYPE_CHECKING:
    from gmmtorch.occupancy import Calibration
else:
    Calibration = Any  # its module loads torch

Method = Literal["point", "flux", "cone", "monte_carlo"]
METHODS: tuple[str, ...] = get_args(Method)
"""Forms of evidence: in closed form at a point; exact, approximate (thesis) or by rays in a cell."""

Sampling = Literal["sobol", "stratified", "plain"]
SAMPLINGS: tuple[str, ...] = get_args(Sampling)
"""Sequences from which Monte Carlo rays are drawn, see `occupancy.forms.monte_carlo`."""


@dataclass(frozen=True)
class QueryOptions:
    """How a map answers queries. No option changes what the map stores.

    cutoff: Mahalanobis distance at which a component ends. None: 3 if components have many points (the median
        support is at least 50), so that tails do not claim unseen space; otherwise 5, because few points do
        not show where a surface ends.
    sampling: "sobol", "stratified" or "plain".
    random_state: seed of the rays.
    memory_limit: largest number of bytes of evidence.
    compiled: has no effect; fused kernels answer queries.
    calibration: of the probabilities. None: that of the sensor model, for the ranges of the map's beams.
    """

    prior: float | None = option(
        None,
        "null: calibrated probabilities; a number N_p: those of counts, θ = (H + N_p)/(H + M + 2N_p), as in "
        "the thesis (3.9)",
    )
    cutoff: float | None = None
    n_samples: int = option(1_000_000, "Monte Carlo rays, drawn from the whole map")
    sampling: Sampling = "sobol"
    random_state: int = 0
    memory_limit: int = 4 << 30
    compiled: bool = False
    calibration: Calibration | None = None

    def __post_init__(self) -> None:
        if self.prior is not None:
            check_prior(self.prior)
        for name in ("n_samples", "memory_limit"):
            check_whole(name, getattr(self, name), 1)
        check_whole("random_state", self.random_state, 0)
        if self.cutoff is not None:
            object.__setattr__(self, "cutoff", check_number("cutoff", self.cutoff, above=True))
        check_choice("sampling", self.sampling, SAMPLINGS)


def check_method(method: str) -> None:
    """Raises `InvalidArgumentError` unless `method` is one of `METHODS`."""
    check_choice("method", method, METHODS)


class MapOptions(TypedDict, total=False):
    """The arguments of `GaussianMap`; see there."""

    learning: LearningRule | None
    window: int | None
    resolution: float
    method: str
    random_state: int
    robot: int
    codec: str
    prior: float | None
    cutoff: float | None
    n_samples: int
    sampling: Sampling
    memory_limit: int
    compiled: bool
    calibration: Calibration | None
