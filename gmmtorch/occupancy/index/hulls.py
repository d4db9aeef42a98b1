"""Hulls of cones, and the test whether a cone can give evidence near a point."""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.kernels.hull_test import near_hulls
from gmmtorch.occupancy.cones import Cones


class Hulls:
    """Hulls of C cones: all segments from the sensor origin to the component's ellipsoid at `cutoff`.

    A cone can give evidence to a cube of side `extent` (m) if its hull meets the cube. With `smoothed`, as
    in the point form, the cone is widened instead by a Gaussian with the variance of the cube.
    """

    def __init__(self, cones: Cones, extent: float, cutoff: float, smoothed: bool) -> None:
        dim = self.dim = cones.dim
        means, origins = cones.means.detach().double(), cones.origins.detach().double()
        variances, axes = torch.linalg.eigh(cones.covariances.detach().double())
        squares = cutoff**2 * variances.clamp_min(0)  # (C, D) squared half axes, ascending
        distance = (means - origins).norm(dim=1, keepdim=True)
        far = distance + squares[:, -1:].sqrt()
        self.means, self.origins, self.distance = means, origins, distance[:, 0]
        self.half = (axes**2 @ squares[:, :, None]).squeeze(2).sqrt()
        self.reach = 0.5 * extent * dim**0.5  # from the centre of the cube to its corners
        self.spread = cutoff * extent / 12**0.5 if smoothed else 0.0  # cutoff radius of the cube's Gaussian
        self.table = torch.cat([axes.flatten(1), means, origins, squares, distance, far], 1)

    def bounds(self) -> tuple[Tensor, Tensor]:
        """Boxes, lowest and highest corner (C, D), outside which a cone gives no evidence."""
        # The spread as seen from the sensor origin at range r is spread · distance / r, and at most r.
        widest = max(self.reach, self.spread)
        pad = torch.maximum((widest * self.distance).sqrt(), torch.full_like(self.distance, widest))
        low = torch.minimum(self.means - self.half, self.origins) - pad[:, None]
        high = torch.maximum(self.means + self.half, self.origins) + pad[:, None]
        return low, high

    def near(self, cone: Tensor, centers: Tensor, radius: Tensor | float, compiled: bool = False) -> Tensor:
        """Whether (T,) cone (T,) can give evidence to a cube centred in the ball around `centers` (T, D)."""
        return near_hulls(self.table, cone, centers, radius, self.reach, self.spread, compiled)
