"""Pruning of a tree by density: sparse children lose their points to their siblings (thesis 2.1.4)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.mixture.estimators.sensor_model import SensorModel
from gmmtorch.mixture.estimators.trees.nested import Children, Members, keep_children
from gmmtorch.mixture.reduction.pruning import density_share


class DensityLimit(NamedTuple):
    """When a child is too sparse for a surface.

    least: smallest share of the density of a surface. sensor: gives this density. origins: (S, D), relative
    to the centre of the cloud. seen: (N, S) points of each row of the cloud seen from each origin; None: the
    nearest origin has seen all of them.
    """

    least: float
    sensor: SensorModel
    origins: Tensor
    seen: Tensor | None = None

    def drop_sparse_children(self, children: Children, centers: Tensor, members: Members) -> Children:
        """Set sparse children to weight 0, in favour of their siblings.

        Args:
            children: of G nodes with these centers (G, D).
            members: of the children, which are numbered node · m + child.
        """
        found = children._replace(means=children.means + centers[:, None]).flat()
        support, counts = members.mass(len(found.weights)), None
        if self.seen is not None:
            seen = self.seen.index_select(0, members.point)
            seen = seen * (members.weight / seen.sum(1).clamp_min(torch.finfo(seen.dtype).tiny))[:, None]
            counts = seen.new_zeros(len(support), seen.shape[1]).index_add_(0, members.node, seen)
        share = density_share(support, found, self.sensor, self.origins, counts)
        return keep_children(children, (share >= self.least).view_as(children.weights))
