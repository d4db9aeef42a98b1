"""The mapping methods by name: the forms of evidence of `GaussianMap`, and the baselines."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.baselines import (
    BayesianHilbertMap,
    BGKMap,
    BGKPointsMap,
    GPMap,
    HilbertMap,
    NDTMap,
    OctoMapMap,
)
from gmmtorch.mapping import METHODS, GaussianMap
from gmmtorch.occupancy import LogOdds, OccupancyGrid, OccupancyMap

MapFactory = Callable[[float], OccupancyMap]
"""resolution (m) → an empty map."""

BASELINES: dict[str, Callable[..., OccupancyMap]] = {
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
    """A factory of `GaussianMap`s that are queried by one form of evidence.

    Forms with the same `new_map` share one map, which is built once.
    """

    new_map: Callable[[], GaussianMap]
    form: str

    def __call__(self, resolution: float) -> GaussianMap:
        return self.new_map()


def methods(
    new_map: Callable[[], GaussianMap], options: Mapping[str, Mapping[str, Any]] | None = None, **limits: Any
) -> dict[str, MapFactory]:
    """Every method by name.

    Args:
        new_map: makes the empty `GaussianMap` that the forms of evidence query.
        options: options of each baseline, by its name. The defaults are those of the baseline's paper, or the
            best on training scans (see docs/baselines.md).
        limits: `memory_limit`, `compiled`, `random_state`: given to the baselines that take them.

    Raises `InvalidArgumentError` for an unknown baseline, or an option that it does not take.
    """
    options = options or {}
    for name in options:
        if name not in BASELINES:
            raise InvalidArgumentError(
                f"method_options.{name} is not known; known are {', '.join(BASELINES)}. The options of "
                "GaussianMap are map.*."
            )
        if not isinstance(options[name], Mapping):
            raise InvalidArgumentError(
                f"method_options.{name}={options[name]!r} must be options, such as {{NAME: VALUE}}."
            )
    return {
        **{form: Form(new_map, form) for form in METHODS},
        **{name: baseline(name, limits, **options.get(name, {})) for name in BASELINES},
    }


def baseline(name: str, limits: Mapping[str, Any], **options: Any) -> MapFactory:
    """A factory of a baseline's maps with these options, and with the limits that it takes."""
    make = BASELINES[name]
    parameters = set(inspect.signature(make).parameters)
    known = parameters - {"resolution"}
    for option in options:
        if option not in known:
            raise InvalidArgumentError(
                f"method_options.{name}.{option} is not known; {name} takes {', '.join(sorted(known))}."
            )
    chosen = {**{key: value for key, value in limits.items() if key in known}, **options}
    if "resolution" in parameters:
        return lambda resolution: make(resolution, **chosen)
    return lambda resolution: make(**chosen)


def choose(names: Sequence[str], known: Mapping[str, MapFactory]) -> dict[str, MapFactory]:
    """The factories with these names, in their order. Raises for an unknown name and lists the known ones."""
    if not names:
        raise InvalidArgumentError(f"method is empty; name at least one of {', '.join(sorted(known))}.")
    for name in names:
        if name not in known:
            raise InvalidArgumentError(f"method={name!r} is not known; known are {', '.join(sorted(known))}.")
    return {name: known[name] for name in names}
