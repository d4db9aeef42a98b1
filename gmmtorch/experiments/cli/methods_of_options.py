"""The methods of a run, and the test of their maps, from the options."""

from __future__ import annotations

from collections.abc import Mapping

from omegaconf import DictConfig

from gmmtorch.cli import as_options, build, limits, map_factory
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.evaluation import MapFactory, Protocol, methods


def known_methods(config: DictConfig) -> dict[str, MapFactory]:
    """Every method by name."""
    options = as_options(config.method_options)
    return methods(map_factory(config), options, **limits(config))


def protocol_of(config: DictConfig) -> Protocol:
    """The held-out test from `evaluation.*`."""
    return build(Protocol, config, "evaluation")


def check_factories(factories: Mapping[str, MapFactory], resolution: float) -> None:
    """Make an empty map with each factory, so that an invalid option fails before any map is built."""
    for name, factory in factories.items():
        try:
            factory(resolution)
        except TypeError as error:  # for example text, where a baseline compares numbers
            raise InvalidArgumentError(
                f"method_options.{name} has a value of the wrong type: {error}."
            ) from error
