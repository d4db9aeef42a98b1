"""The points that gmmtorch-fit learns from, and the options of a fit."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from omegaconf import DictConfig
from torch import Tensor

from gmmtorch.cli import build, open_dataset, read_scans
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.evaluation import FitData, FitOptions, Views, split
from gmmtorch.report import Event
from gmmtorch.scan import Scan


def fit_options(config: DictConfig) -> FitOptions:
    """The options of a fit from `mixture.*` and `runtime.*`."""
    runtime = config.runtime
    return build(FitOptions, config, "mixture", dtype=runtime.dtype, compiled=runtime.compile)


def fit_data(config: DictConfig, device: str, on_event: Event) -> FitData:
    """The points of the selected scans: at most `max_points`, split by `test_share`."""
    return fit_data_of(config, *selected_scans(config, device, on_event))


def fit_data_of(config: DictConfig, name: str, scans: Sequence[Scan]) -> FitData:
    """The same for given scans of the data set with this name."""
    points = torch.cat([scan.points for scan in scans])
    sizes = torch.tensor([len(scan.points) for scan in scans], device=points.device)
    views = Views(torch.repeat_interleave(sizes), torch.stack([scan.origin.double() for scan in scans]))
    chosen = _subset(points, config.max_points, config.seed)
    views = views._replace(scan=views.scan[chosen])
    return split(name, points[chosen], config.test_share, config.seed, views)


def selected_scans(config: DictConfig, device: str, on_event: Event) -> tuple[str, list[Scan]]:
    """The data set's name, and its scans with the indices `scans`; all scans for null."""
    dataset = open_dataset(config.dataset)
    indices = list(range(len(dataset))) if config.scans is None else list(config.scans)
    for index in indices:
        if not -len(dataset) <= index < len(dataset):
            raise InvalidArgumentError(f"scans={indices}: {dataset.name} has scans 0 to {len(dataset) - 1}.")
    if not indices:
        raise InvalidArgumentError("scans is empty; give at least one index, or null for all.")
    return dataset.name, read_scans(dataset, indices, device, on_event)


def _subset(points: Tensor, max_points: int | None, seed: int) -> Tensor | slice:
    """Indices of a random subset of `max_points` of the points (N, D), in their order; all if there are
    fewer."""
    if max_points is None or points.shape[0] <= max_points:
        return slice(None)
    if max_points < 1:
        raise InvalidArgumentError(f"max_points={max_points} must be at least 1, or null.")
    generator = torch.Generator().manual_seed(seed)
    return torch.randperm(points.shape[0], generator=generator)[:max_points].sort().values.to(points.device)
