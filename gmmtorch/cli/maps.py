"""Maps as the options describe them: ours by `map.*`, and every method of a run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gmmtorch.cli import common

if TYPE_CHECKING:
    from gmmtorch.evaluation.methods import MapFactory
    from gmmtorch.mapping.gaussian_map import GaussianMap
    from gmmtorch.mapping.learning.rules import LearningRule, NoveltyRule

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
    from gmmtorch.evaluation import methods as contenders

    options = common.as_options(config.method_options)
    return contenders.methods(map_factory(config), options, **limits(config))


def check_factories(factories: Mapping[str, MapFactory], resolution: float) -> None:
    """Make an empty map of each: a bad option must not wait for the maps before it to be built."""
    from gmmtorch.errors import InvalidArgumentError

    for name, factory in factories.items():
        try:
            factory(resolution)
        except TypeError as error:  # text, say, where a baseline compares numbers
            raise InvalidArgumentError(
                f"method_options.{name} has a value of the wrong type: {error}."
            ) from error


def map_factory(config: DictConfig, **changes: Any) -> Callable[[], GaussianMap]:
    """Makes empty maps with the options `map.*`, of which `changes` replace some."""
    from gmmtorch.errors import InvalidArgumentError
    from gmmtorch.mapping.gaussian_map import GaussianMap
    from gmmtorch.mixture.em.exact import SOFTMAX_DTYPES

    dtype = config.runtime.dtype
    if dtype not in SOFTMAX_DTYPES:  # of an incremental map it is checked alone
        raise InvalidArgumentError(f"runtime.dtype={dtype!r} is not one of {', '.join(SOFTMAX_DTYPES)}.")
    options = {**common.as_options(config.map), **changes}
    names = {name: f"map.{name}" for name in options}
    answering = {key: options.pop(key) for key in _ANSWERING}
    with common.naming(names):
        rule = _rule(options, dtype)

    def make() -> GaussianMap:
        with common.naming(names):
            return GaussianMap(rule, **answering, **limits(config))

    make()  # a bad option must not wait for the grids to be built
    return make


def _rule(options: dict[str, Any], dtype: str) -> LearningRule:
    """The learning rule of the options `map.*` that are left."""
    from gmmtorch.mapping.learning.rules import IncrementalRule, WindowedRule

    if options.pop("name") != "incremental":
        return WindowedRule(**options, dtype=dtype)
    novelty = options.pop("novelty")
    return IncrementalRule(**options, novelty=None if novelty is None else _novelty(novelty))


def _novelty(options: Any) -> NoveltyRule:
    """The rule of the options `map.novelty`, whose names and types no schema has checked."""
    from gmmtorch.errors import InvalidArgumentError
    from gmmtorch.mapping.learning.rules import NoveltyRule

    chosen: DictConfig = OmegaConf.structured(NoveltyRule)
    OmegaConf.set_readonly(chosen, False)  # as the dataclass is
    try:
        if not isinstance(options, dict):
            raise TypeError("these are no options")
        chosen.merge_with(options)
        return NoveltyRule(**common.as_options(chosen))
    except (OmegaConfBaseException, TypeError) as error:
        raise InvalidArgumentError(
            f"map.novelty={options}: {str(error).splitlines()[0]}; it takes "
            f"{{{', '.join(item.name for item in fields(NoveltyRule))}}}, or null."
        ) from error
