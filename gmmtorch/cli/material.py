"""What gmmtorch-fit works on: the scans that were chosen, and their points, split."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from gmmtorch.cli import common

if TYPE_CHECKING:
    from torch import Tensor

    from gmmtorch.evaluation.events import Event
    from gmmtorch.evaluation.studies.fitting import Material
    from gmmtorch.scan import Scan


def material(config: DictConfig, device: str, on_event: Event) -> Material:
    """The points of the chosen scans, thinned to `max_points`, less those held out."""
    return material_of(config, *chosen_scans(config, device, on_event))


def material_of(config: DictConfig, name: str, scans: Sequence[Scan]) -> Material:
    """The same of given scans."""
    import torch

    from gmmtorch.evaluation.studies.fitting import split

    points = _thinned(torch.cat([scan.points for scan in scans]), config.max_points, config.seed)
    return split(name, points, config.test_share, config.seed)


def chosen_scans(config: DictConfig, device: str, on_event: Event) -> tuple[str, list[Scan]]:
    """The data set's name, and its scans whose numbers are in `scans`; all of them for null."""
    from gmmtorch.errors import InvalidArgumentError

    dataset = common.open_dataset(config.dataset)
    indices = list(range(len(dataset))) if config.scans is None else list(config.scans)
    for index in indices:
        if not -len(dataset) <= index < len(dataset):
            raise InvalidArgumentError(f"scans={indices}: {dataset.name} has scans 0 to {len(dataset) - 1}.")
    if not indices:
        raise InvalidArgumentError("scans is empty; name at least one, or null for all.")
    return dataset.name, common.read_scans(dataset, indices, device, on_event)


def _thinned(points: Tensor, max_points: int | None, seed: int) -> Tensor:
    """At most so many of the points (N, D), drawn at random, in their order."""
    import torch

    from gmmtorch.errors import InvalidArgumentError

    if max_points is None or points.shape[0] <= max_points:
        return points
    if max_points < 1:
        raise InvalidArgumentError(f"max_points={max_points} must be at least 1, or null.")
    generator = torch.Generator().manual_seed(seed)
    chosen = torch.randperm(points.shape[0], generator=generator)[:max_points].sort().values
    return points[chosen.to(points.device)]
