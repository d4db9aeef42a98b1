"""Pruning of fits (thesis 2.1.4): of a tree before its points are partitioned, of other mixtures after EM."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mixture import MixtureEstimator, PruneOptions, SensorModel, measured_sensor, prune


class Views(NamedTuple):
    """Where points were seen from: the scan (N,) of each point, and the scans' sensor origins (S, D)."""

    scan: Tensor
    origins: Tensor

    def sensor(self, points: Tensor) -> SensorModel:
        """A sensor with the spacing of the beams of the largest scan; points (N, D)."""
        largest = int(torch.bincount(self.scan).argmax())
        return measured_sensor(points[self.scan == largest], self.origins[largest])


def tree_options(options: PruneOptions, points: Tensor, views: Views | None) -> dict[str, Any]:
    """The options of a `HierarchicalGaussianMixture` of points (N, D) that prune it while it grows."""
    if options.prune == "support":
        return {"min_support": options.min_support}
    if options.prune == "density":
        sensor = _known(views).sensor(points)
        return {"min_density_share": options.min_density_share, "sensor": sensor}
    return {}


def pruned(
    mixture: MixtureEstimator, options: PruneOptions, points: Tensor, views: Views | None
) -> MixtureEstimator:
    """The mixture of points (N, D) without the components that the options remove.

    Raises `InvalidArgumentError` if no component would remain, or if the sensor origins are not known.
    """
    if options.prune == "none":
        return mixture
    if options.prune == "support":
        return prune(mixture, len(points), min_support=options.min_support)[0]
    views = _known(views)
    n_scans = len(views.origins)
    owner = torch.as_tensor(mixture.predict(points), device=points.device)
    pair = owner * n_scans + views.scan
    counts = torch.bincount(pair, minlength=len(mixture.weights) * n_scans).view(-1, n_scans)
    return prune(
        mixture,
        len(points),
        min_density_share=options.min_density_share,
        sensor=views.sensor(points),
        origins=views.origins,
        counts=counts,
    )[0]


def _known(views: Views | None) -> Views:
    if views is None:
        raise InvalidArgumentError("prune='density' needs scans with sensor origins; use prune=support.")
    return views
