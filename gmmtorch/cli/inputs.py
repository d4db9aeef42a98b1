"""What a command reads and builds: data sets, their scans, and maps, from the options."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeAlias

import torch
from omegaconf import DictConfig, OmegaConf

from gmmtorch import datasets, localization  # whose parts load when they are used
from gmmtorch.cli import common, schema
from gmmtorch.datasets import Dataset, Reposed
from gmmtorch.errors import DataError, InvalidArgumentError, arg, check_choice, check_number
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
from gmmtorch.report import Event, Row
from gmmtorch.scan import Scan

_WITHOUT_POSES = ("scan_folder", "rosbag")  # data sets that `dataset.poses=standing` reads without poses


OpenedDataset: TypeAlias = "tuple[Dataset, localization.Trajectory | None, Row | None]"
"""A data set; with `dataset.odometry`, also its trajectory, and the facts of it for results.json."""


def open_dataset(config: DictConfig, group: str = "dataset") -> Dataset:
    """The data set that the options `dataset.*` describe. group: their name."""
    return open_with_trajectory(config, group)[0]


def open_with_trajectory(config: DictConfig, group: str = "dataset") -> OpenedDataset:
    """The data set of the options `dataset.*`, with the trajectory that `dataset.odometry` gives."""
    with schema.naming({name: f"{group}.{name}" for name in map(str, config)}):
        return _opened(config)


def _opened(config: DictConfig) -> OpenedDataset:
    options = {
        str(key): config[key]
        for key in config
        # If a path is missing, the reader raises an error that describes the files it needs.
        if not OmegaConf.is_missing(config, key) and config[key] is not None
    }
    method, name = options.pop("odometry", "none"), options.pop("name")
    motion = options.pop("motion", "constant")
    if (method, motion) != ("none", "constant"):
        check_choice("odometry", method, ("none", "auto", *localization.METHODS))
        check_choice("motion", motion, localization.MOTIONS)
    if method == "none" and motion != "constant":
        raise InvalidArgumentError(
            f"motion={motion} predicts the poses of odometry, but {arg('odometry')}=none estimates no poses; "
            f"use {arg('odometry')}=mixture, or {arg('motion')}=constant."
        )
    try:
        found = datasets.load(name, options.pop("path", None), **options)
        if method == "none" or (method == "auto" and found.pose(0) is not None):
            return found, None, None
        has_truth = options.get("poses") != "standing"
    except DataError:
        if method == "none" or name not in _WITHOUT_POSES:
            raise
        found = datasets.load(name, config.path, **{**options, "poses": "standing"})
        has_truth = False
    return _with_odometry(found, "mixture" if method == "auto" else method, motion, has_truth)


def _with_odometry(source: Dataset, method: str, motion: str, has_truth: bool) -> OpenedDataset:
    """The data set with estimated poses. Prints the errors against its own poses, if it has some."""
    posed, trajectory = localization.with_odometry(source, method, motion=motion)
    facts: Row = {
        "method": method,
        "n_lost": int((~trajectory.found).sum()),
        "n_closures": trajectory.n_closures,
        **_trajectory_scores(posed, trajectory, has_truth and motion != "dataset"),
    }
    text = f"odometry  {len(posed)} poses estimated, {facts['n_lost']} scans lost, "
    text += f"{trajectory.n_closures} loop closures"
    if facts["ate"] is not None:
        text += f"; ATE {facts['ate']:.3f} m, RPE {facts['rpe']:.3f} m against the poses of the data set"
    print(text)
    return posed, trajectory, facts


def _trajectory_scores(posed: Reposed, trajectory: localization.Trajectory, has_truth: bool) -> Row:
    """ATE and RPE against the data set's own poses; None where they cannot be computed."""
    scores: Row = {"align": None, **localization.UNSCORED}
    if not has_truth or len(posed) < 3:
        return scores
    true = torch.stack([posed.own_pose(index) for index in range(len(posed))])
    scores |= localization.relative_pose_error(trajectory.poses, true).scores("rpe")
    try:
        ate = localization.absolute_trajectory_error(trajectory.poses, true, "rigid").scores("ate")
        return scores | ate | {"align": "rigid"}
    except InvalidArgumentError:  # positions on a line determine no rotation
        ate = localization.absolute_trajectory_error(trajectory.poses, true, "first").scores("ate")
        return scores | ate | {"align": "first"}


def all_scans(config: DictConfig, device: str, on_event: Event) -> tuple[str, list[Scan]]:
    """The name and all scans of the data set `dataset.*`, on the device."""
    dataset = open_dataset(config.dataset)
    return dataset.name, read_scans(dataset, range(len(dataset)), device, on_event)


def read_scans(dataset: Dataset, indices: Sequence[int], device: str, on_event: Event) -> list[Scan]:
    """The scans with these indices, on the device."""
    scans = []
    on_event("reading scans", 0, len(indices))
    for done, index in enumerate(indices, 1):
        scans.append(dataset[index].to(device))
        on_event("reading scans", done, len(indices))
    return scans


def limits(config: DictConfig) -> dict[str, Any]:
    """Arguments of every map from `runtime.*` and the seed."""
    runtime = config.runtime
    return {"memory_limit": runtime.memory_limit, "compiled": runtime.compile, "random_state": config.seed}


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
    return tiled.open(*corners(bounds, tiled.dim), resolution)


def corners(bounds: Sequence[float], dim: int) -> tuple[list[float], list[float]]:
    """The lowest and the highest corner (m) of the option `bounds`. Raises `InvalidArgumentError`."""
    if len(bounds) != 2 * dim:
        raise InvalidArgumentError(
            f"bounds={list(bounds)} must be {2 * dim} numbers in {dim}D: the lowest corner, then the highest."
        )
    return list(bounds[:dim]), list(bounds[dim:])


def new_map(
    config: DictConfig, dataset: Dataset, folder: Path, device: str, is_continued: bool = False
) -> GaussianMap | TiledMap:
    """The empty map of the options of gmmtorch-map; with `map.memory` it grows in tiles in a folder.

    is_continued: whether a map in the folder goes on. Raises `InvalidArgumentError` for another map in it.
    """
    memory = config.map.memory
    target = _empty_map(config, config.resolution)
    if memory is None:
        return target
    options: dict[str, Any] = {"memory": int(check_number("map.memory", memory, least=1)), "device": device}
    options["memory_limit"] = config.runtime.memory_limit
    if is_continued and (folder / INDEX).exists():
        return TiledMap(folder, **options)
    with schema.naming({"side": "tile"}):
        return TiledMap.create(folder, target, _dim_of(dataset), config.tile, **options)


def _dim_of(dataset: Dataset) -> int:
    """2 or 3, of the first scan that can be read; 3 if none can."""
    for index in range(len(dataset)):
        with contextlib.suppress(DataError):  # who reads the scans counts it
            return dataset[index].dim
    return 3


def chosen_map(given: Any, group: str) -> dict[str, Any]:
    """All options of a map, from those that differ from map=incremental, or from the map that `name` says.

    group: name of the options, for errors.
    """
    options = {} if given is None else OmegaConf.to_container(given) if OmegaConf.is_config(given) else given
    if not isinstance(options, dict):
        raise InvalidArgumentError(f"{group}={options} must be options of a map, such as {{name: windowed}}.")
    name = str(options.get("name", "incremental"))
    check_choice(f"{group}.name", name, ("incremental", "per_scan", "windowed"))
    window = {"window": 1} if name == "per_scan" else {}
    return schema.checked_options(schema.map_schema(name), {"name": name, **window, **options}, group)


def map_factory(
    config: DictConfig, resolution: float = 0.1, group: str = "map", **changes: Any
) -> Callable[[], GaussianMap]:
    """A factory of empty maps with the options `map.*`; see `_empty_map`."""
    if (memory := changes.get("memory", config.map.get("memory"))) is not None:
        raise InvalidArgumentError(
            f"{group}.memory={memory} is for gmmtorch-map; here maps are in memory: leave it out."
        )
    make = functools.partial(_empty_map, config, resolution, group, **changes)
    make()  # an invalid option fails here, before any map is built
    return make


def _empty_map(config: DictConfig, resolution: float, group: str = "map", **changes: Any) -> GaussianMap:
    """An empty map with the options `map.*`; `changes` replaces some of them.

    Args:
        resolution: of queries without one (m).
        group: what errors call the options.
    """
    check_choice("runtime.dtype", config.runtime.dtype, SOFTMAX_DTYPES)  # an incremental map does not use it
    options = {**common.as_options(config.map), **changes}
    query = {item.name: options[item.name] for item in fields(QueryOptions) if item.name in options}
    cls: type[LearningRule] = IncrementalRule if options["name"] == "incremental" else WindowedRule
    others = {item.name: changes[item.name] for item in fields(cls) if item.name in changes}
    if cls is WindowedRule:
        others["dtype"] = config.runtime.dtype
    if options["name"] == "per_scan":  # each component was seen from one place
        others["max_origins"] = 1
    names = {name: f"{group}.{name}" for name in options}
    with schema.naming(names | {f"map.{name}": option for name, option in names.items()}):
        rule = schema.build(cls, config, "map", **others)
        return GaussianMap(rule, resolution=resolution, **query, **limits(config))
