"""Options with which a map answers queries. Importing this file does not load torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypedDict, get_args

from gmmtorch.errors import InvalidArgumentError, check_choice, check_prior, check_whole
from gmmtorch.mapping.learning.rules import LearningRule

Method = Literal["point", "flux", "cone", "monte_carlo"]
METHODS: tuple[str, ...] = get_args(Method)
"""Forms of evidence: in closed form at a point; exact, approximate (thesis) or by rays in a cell."""

Sampling = Literal["sobol", "stratified", "plain"]
SAMPLINGS: tuple[str, ...] = get_args(Sampling)
"""Sequences from which Monte Carlo rays are drawn, see `occupancy.forms.monte_carlo`."""

HitLength = int | float | str | None
AUTO = "auto"


@dataclass(frozen=True)
class QueryOptions:
    """How a map answers queries. No option changes what the map stores.

    prior: N_p of (3.9), counts added to each outcome.
    cutoff: Mahalanobis distance at which a component ends. None: 3 if components have many points (the
        median support is at least 50), so that tails do not claim unseen space; otherwise 5, because few
        points do not show where a surface ends.
    hit_length: ℓ (m); the occupancy of a cell of side h multiplies hits by ℓ/h. A ray ends in one of the
        many cells of a thin surface that it could have crossed; the factor puts θ on the right side of ½
        and hardly changes the order of cells. "auto": half the mean range of the map's beams, which
        calibrates θ in any scene (docs/occupancy.md). None: the factor is 1.
    n_samples: number of Monte Carlo rays, drawn from the whole map.
    sampling: "sobol", "stratified" or "plain".
    random_state: seed of the rays.
    memory_limit: largest number of bytes of evidence.
    compiled: use torch.compile where a compiled form exists.
    """

    prior: float = 1.0
    cutoff: float | None = None
    hit_length: HitLength = AUTO
    n_samples: int = 1_000_000
    sampling: Sampling = "sobol"
    random_state: int = 0
    memory_limit: int = 4 << 30
    compiled: bool = False

    def __post_init__(self) -> None:
        check_prior(self.prior)
        for name in ("n_samples", "memory_limit"):
            check_whole(name, getattr(self, name), 1)
        check_whole("random_state", self.random_state, 0)
        if self.cutoff is not None and not 0 < self.cutoff < float("inf"):
            raise InvalidArgumentError(f"cutoff={self.cutoff} must be a number of deviations above zero.")
        length = self.hit_length
        if (
            length is not None
            and length != AUTO
            and (isinstance(length, str) or not 0 < length < float("inf"))
        ):
            raise InvalidArgumentError(f"hit_length={length} must be metres above zero, auto, or null.")
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
    prior: float
    cutoff: float | None
    hit_length: HitLength
    n_samples: int
    sampling: Sampling
    memory_limit: int
    compiled: bool
