"""Data sets and their scans from the options `dataset.*`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from omegaconf import DictConfig, OmegaConf

from gmmtorch import datasets
from gmmtorch.cli import common
from gmmtorch.datasets import Dataset, Reposed
from gmmtorch.errors import DataError, InvalidArgumentError, check_choice
from gmmtorch.events import Event, Row
from gmmtorch.localization import (
    METHODS,
    MOTIONS,
    UNSCORED,
    Trajectory,
    absolute_trajectory_error,
    relative_pose_error,
    with_odometry,
)
from gmmtorch.scan import Scan

_WITHOUT_POSES = ("scan_folder", "rosbag")  # data sets that `dataset.poses=standing` reads without poses


class OpenedDataset(NamedTuple):
    """A data set; with `dataset.odometry`, also its trajectory, and the facts of it for results.json."""

    dataset: Dataset
    trajectory: Trajectory | None
    odometry: Row | None


def open_dataset(config: DictConfig) -> Dataset:
    """The data set that the options `dataset.*` describe."""
    return open_with_trajectory(config).dataset


def open_with_trajectory(config: DictConfig) -> OpenedDataset:
    """The data set of the options `dataset.*`, with the trajectory that `dataset.odometry` gives."""
    options = {
        str(key): config[key]
        for key in config
        # If a path is missing, the reader raises an error that describes the files it needs.
        if not OmegaConf.is_missing(config, key) and config[key] is not None
    }
    method, name = options.pop("odometry", "none"), options.pop("name")
    motion = options.pop("motion", "constant")
    check_choice("dataset.odometry", method, ("none", "auto", *METHODS))
    check_choice("dataset.motion", motion, MOTIONS)
    if method == "none" and motion != "constant":
        raise InvalidArgumentError(
            f"dataset.motion={motion} predicts the poses of odometry, but dataset.odometry=none estimates no "
            "poses; use dataset.odometry=mixture, or dataset.motion=constant."
        )
    try:
        found = datasets.load(name, options.pop("path", None), **options)
        if method == "none" or (method == "auto" and found.pose(0) is not None):
            return OpenedDataset(found, None, None)
        has_truth = options.get("poses") != "standing"
    except DataError:
        if method == "none" or name not in _WITHOUT_POSES:
            raise
        found = datasets.load(name, config.path, **{**options, "poses": "standing"})
        has_truth = False
    return _with_odometry(found, "mixture" if method == "auto" else method, motion, has_truth)


def _with_odometry(source: Dataset, method: str, motion: str, has_truth: bool) -> OpenedDataset:
    """The data set with estimated poses. Prints the errors against its own poses, if it has some."""
    with common.naming({"odometry": "dataset.odometry", "motion": "dataset.motion"}):
        posed, trajectory = with_odometry(source, method, motion=motion)
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
    return OpenedDataset(posed, trajectory, facts)


def _trajectory_scores(posed: Reposed, trajectory: Trajectory, has_truth: bool) -> Row:
    """ATE and RPE against the data set's own poses; None where they cannot be computed."""
    scores: Row = {"align": None, **UNSCORED}
    if not has_truth or len(posed) < 3:
        return scores
    true = torch.stack([posed.own_pose(index) for index in range(len(posed))])
    scores |= relative_pose_error(trajectory.poses, true).scores("rpe")
    try:
        ate = absolute_trajectory_error(trajectory.poses, true, "rigid").scores("ate")
        return scores | ate | {"align": "rigid"}
    except InvalidArgumentError:  # positions on a line determine no rotation
        ate = absolute_trajectory_error(trajectory.poses, true, "first").scores("ate")
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
