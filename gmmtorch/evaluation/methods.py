"""Every method by name: forms of evidence of our map, and the baselines."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from gmmtorch.baselines.bayesian_hilbert_map import BayesianHilbertMap
from gmmtorch.baselines.bgk_map import BGKMap
from gmmtorch.baselines.bgk_points_map import BGKPointsMap
from gmmtorch.baselines.gp_map import GPMap
from gmmtorch.baselines.hilbert_map import HilbertMap
from gmmtorch.baselines.ndt_map import NDTMap
from gmmtorch.baselines.occupancy_grid import LogOdds, OccupancyGrid
from gmmtorch.baselines.octomap_map import OctoMapMap
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mapping.query_options import METHODS
from gmmtorch.occupancy.protocol import OccupancyMap

MapFactory = Callable[[float], OccupancyMap]
"""Makes an empty map for a resolution (m)."""

_BASELINES: dict[str, Callable[..., OccupancyMap]] = {
    "occupancy_grid": OccupancyGrid,
    "occupancy_log_odds": partial(OccupancyGrid, log_odds=LogOdds()),
    "hilbert": HilbertMap,
    "bayesian_hilbert": BayesianHilbertMap,
    "bgk": BGKMap,
    "bgk_points": BGKPointsMap,
    "gp": GPMap,
    "ndt": NDTMap,
    "octomap": OctoMapMap,
}


@dataclass(frozen=True)
class Form:
    """A factory of mixture maps that are asked for one form of evidence.

    Forms with the same `new_map` answer from the same map: it is built once.
    """

    new_map: Callable[[], GaussianMap]
    form: str

    def __call__(self, resolution: float) -> GaussianMap:
        return self.new_map()


def methods(
    new_map: Callable[[], GaussianMap],
    options: Mapping[str, Mapping[str, Any]] | None = None,
    **limits: Any,
) -> dict[str, MapFactory]:
    """Every method by name; `new_map` makes the mixture map that ours answer from.

    Args:
        options: of one baseline alone, by its name; else its paper's, or those that did best on
            training scans (see docs/baselines.md).
        limits: `memory_limit`, `compiled`, `random_state`: for the baselines that take them.

    Raises `InvalidArgumentError` for options of what is no baseline, or that it does not take.
    """
    options = options or {}
    for name in options:
        if name not in _BASELINES:
            raise InvalidArgumentError(
                f"method_options.{name} is not known; known are {', '.join(_BASELINES)}. Options of our own "
                "map are map.*."
            )
        if not isinstance(options[name], Mapping):
            raise InvalidArgumentError(
                f"method_options.{name}={options[name]!r} must be options, such as {{NAME: VALUE}}."
            )
    return {
        **{form: Form(new_map, form) for form in METHODS},
        **{name: baseline(name, limits, **options.get(name, {})) for name in _BASELINES},
    }


def baseline(name: str, limits: Mapping[str, Any], **options: Any) -> MapFactory:
    """A factory of a baseline's maps with these options, and those of the limits that it takes."""
    make = _BASELINES[name]
    known = set(inspect.signature(make).parameters) - {"resolution"}
    for option in options:
        if option not in known:
            raise InvalidArgumentError(
                f"method_options.{name}.{option} is not known; {name} takes {', '.join(sorted(known))}."
            )
    chosen = {**{key: value for key, value in limits.items() if key in known}, **options}
    if "resolution" in inspect.signature(make).parameters:
        return lambda resolution: make(resolution, **chosen)
    return lambda resolution: make(**chosen)


def choose(names: Sequence[str], known: Mapping[str, MapFactory]) -> dict[str, MapFactory]:
    """The factories asked for, in that order. An unknown name raises an error that lists the known."""
    if not names:
        raise InvalidArgumentError(f"method is empty; name at least one of {', '.join(sorted(known))}.")
    for name in names:
        if name not in known:
            raise InvalidArgumentError(f"method={name!r} is not known; known are {', '.join(sorted(known))}.")
    return {name: known[name] for name in names}
