"""Maps from the options: `GaussianMap` from `map.*`, every method of a run, and the test of their maps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from gmmtorch.cli import common
from gmmtorch.cli.options.structured import build
from gmmtorch.errors import InvalidArgumentError, check_choice
from gmmtorch.mapping import (
    INDEX,
    SOFTMAX_DTYPES,
    GaussianMap,
    IncrementalRule,
    LearningRule,
    QueryOptions,
    TiledMap,
    WindowedRule,
)


def limits(config: DictConfig) -> dict[str, Any]:
    """Arguments of every map from `runtime.*` and the seed."""
    runtime = config.runtime
    return {
        "memory_limit": runtime.memory_limit,
        "compiled": runtime.compile,
        "random_state": config.seed,
    }


def open_map(
    path: Path, runtime: DictConfig, bounds: Sequence[float] | None = None, resolution: float | None = None
) -> GaussianMap:
    """The map in a file, or in a folder: a run directory of gmmtorch-map, or a tiled map.

    Args:
        bounds: the lowest corner of a box and then the highest (m). Of a tiled map only the tiles are opened
            that give evidence in the box. None: all.
        resolution: side (m) of the largest cells that will be asked; None: that of the map.
    """
    folders = [folder for folder in (path / "tiles", path) if (folder / INDEX).exists()]
    if (path / "map.safetensors").exists() or not folders:
        file = path / "map.safetensors" if path.is_dir() else path
        return GaussianMap.load(file).to(runtime.device)
    tiled = TiledMap(folders[0], runtime.device, memory_limit=runtime.memory_limit)
    if bounds is None:
        return tiled.open(resolution=resolution)
    if len(bounds) != 2 * tiled.dim:
        raise InvalidArgumentError(
            f"bounds={list(bounds)} must be {2 * tiled.dim} numbers in {tiled.dim}D: the lowest corner, then "
            "the highest."
        )
    return tiled.open(list(bounds[: tiled.dim]), list(bounds[tiled.dim :]), resolution)


def map_factory(config: DictConfig, resolution: float = 0.1, **changes: Any) -> Callable[[], GaussianMap]:
    """A factory of empty maps with the options `map.*`; `changes` replaces some of them. `resolution`: of
    queries without one (m)."""
    dtype = config.runtime.dtype
    check_choice("runtime.dtype", dtype, SOFTMAX_DTYPES)  # an incremental map does not use it
    options = {**common.as_options(config.map), **changes}
    rule = _rule(options, dtype)
    query = {item.name: options[item.name] for item in fields(QueryOptions) if item.name in options}

    def make() -> GaussianMap:
        with common.naming({name: f"map.{name}" for name in options}):
            return GaussianMap(rule, resolution=resolution, codec=options["codec"], **query, **limits(config))

    make()  # an invalid option fails here, before any map is built
    return make


def _rule(options: dict[str, Any], dtype: str) -> LearningRule:
    """The learning rule of the options `map.*`."""
    if options["name"] == "incremental":
        return build(IncrementalRule, options, "map")
    return build(WindowedRule, options, "map", dtype=dtype)
