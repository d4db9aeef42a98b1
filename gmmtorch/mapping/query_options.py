"""Options with which a map answers queries. Importing this file does not load torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, get_args

from gmmtorch.declarations import option
from gmmtorch.errors import check_choice, check_number, check_prior, check_whole

if TYPE_CHECKING:
    from gmmtorch.occupancy import Calibration
else:
    Calibration = Any  # its module loads torch

METHODS = ("point", "flux", "cone", "monte_carlo")
"""Forms of evidence: in closed form at a point; exact, approximate (thesis) or by rays in a cell."""

Sampling = Literal["sobol", "stratified", "plain"]
"""Sequences from which Monte Carlo rays are drawn, see `occupancy.forms.monte_carlo`."""


@dataclass(frozen=True)
class QueryOptions:
    """How a map answers queries, see `GaussianMap`. No option changes what the map stores."""

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
        check_choice("sampling", self.sampling, get_args(Sampling))


def check_method(method: str) -> None:
    """Raises `InvalidArgumentError` unless `method` is one of `METHODS`."""
    check_choice("method", method, METHODS)
