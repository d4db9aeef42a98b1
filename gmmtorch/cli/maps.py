"""Maps as the options describe them: ours by `map.*`, and every method of a run."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig

from gmmtorch.cli import common

if TYPE_CHECKING:
    from gmmtorch.evaluation.contenders import MapFactory
    from gmmtorch.mapping.gaussian_map import GaussianMap, Learning

_ANSWERING = ("n_samples", "sampling", "prior", "cutoff", "hit_length", "codec")


def limits(config: DictConfig) -> dict[str, Any]:
    """What of `runtime.*`, and the seed, the maps take."""
    runtime = config.runtime
    return {
        "memory_limit": runtime.memory_limit,
        "compiled": runtime.compile,
        "random_state": config.seed,
    }


def known_methods(config: DictConfig) -> dict[str, MapFactory]:
    """Every method by name."""
    from gmmtorch.evaluation import contenders

    options = common.as_options(config.method_options)
    return contenders.methods(map_factory(config), options, **limits(config))


def map_factory(config: DictConfig, **changes: Any) -> Callable[[], GaussianMap]:
    """Makes empty maps with the options `map.*`, of which `changes` replace some."""
    from gmmtorch.mapping.gaussian_map import GaussianMap

    options = {**common.as_options(config.map), **changes}
    answering = {key: options.pop(key) for key in _ANSWERING}
    rule = _rule(options, config.runtime.dtype)

    def make() -> GaussianMap:
        return GaussianMap(rule, **answering, **limits(config))

    make()  # a bad option must not wait for the grids to be built
    return make


def _rule(options: dict[str, Any], dtype: str) -> Learning:
    """The learning rule of the options `map.*` that are left."""
    from gmmtorch.mapping.incremental import IncrementalRule
    from gmmtorch.mapping.learning import WindowedRule
    from gmmtorch.mapping.novelty import NoveltyRule

    if options.pop("name") != "incremental":
        return WindowedRule(**options, dtype=dtype)
    novelty = options.pop("novelty")
    return IncrementalRule(**options, novelty=None if novelty is None else NoveltyRule(**novelty))
