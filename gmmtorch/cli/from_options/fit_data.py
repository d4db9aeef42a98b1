"""The points that gmmtorch-fit learns from: those of the selected scans, split into training and test."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from gmmtorch.cli import common

if TYPE_CHECKING:
    from torch import Tensor

    from gmmtorch.evaluation.events import Event
    from gmmtorch.evaluation.fit_comparison import FitData
    from gmmtorch.scan import Scan


def fit_data(config: DictConfig, device: str, on_event: Event) -> FitData:
    """The points of the selected scans: at most `max_points`, split by `test_share`."""
    return fit_data_of(config, *selected_scans(config, device, on_event))


def fit_data_of(config: DictConfig, name: str, scans: Sequence[Scan]) -> FitData:
    """The same for given scans of the data set with this name."""
    import torch

    from gmmtorch.evaluation.fit_comparison import split

    points = _subset(torch.cat([scan.points for scan in scans]), config.max_points, config.seed)
    return split(name, points, config.test_share, config.seed)


def selected_scans(config: DictConfig, device: str, on_event: Event) -> tuple[str, list[Scan]]:
    """The data set's name, and its scans with the indices `scans`; all scans for null."""
    from gmmtorch.errors import InvalidArgumentError

    dataset = common.open_dataset(config.dataset)
    indices = list(range(len(dataset))) if config.scans is None else list(config.scans)
    for index in indices:
        if not -len(dataset) <= index < len(dataset):
            raise InvalidArgumentError(f"scans={indices}: {dataset.name} has scans 0 to {len(dataset) - 1}.")
    if not indices:
        raise InvalidArgumentError("scans is empty; give at least one index, or null for all.")
    return dataset.name, common.read_scans(dataset, indices, device, on_event)


def _subset(points: Tensor, max_points: int | None, seed: int) -> Tensor:
    """A random subset of `max_points` of the points (N, D), in their order; all points if there are fewer."""
    import torch

    from gmmtorch.errors import InvalidArgumentError

    if max_points is None or points.shape[0] <= max_points:
        return points
    if max_points < 1:
        raise InvalidArgumentError(f"max_points={max_points} must be at least 1, or null.")
    generator = torch.Generator().manual_seed(seed)
    chosen = torch.randperm(points.shape[0], generator=generator)[:max_points].sort().values
    return points[chosen.to(points.device)]
