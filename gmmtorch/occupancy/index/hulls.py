"""Hulls of cones, and the test whether a cone can give evidence near a point."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable

import torch
from torch import Tensor

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
        self.table = torch.cat([axes.flatten(1), means, origins, squares, distance, far], 1).T.contiguous()

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
        test = _compiled_near() if compiled else _near_cone
        return test(self.table, cone, centers, radius, self.reach, self.spread)


def _near_cone(
    table: Tensor, cone: Tensor, centers: Tensor, radius: Tensor | float, cube_reach: float, spread: float
) -> Tensor:
    """`Hulls.near` for cones that are columns of the table.

    Let y, within R of the centre x, lie on the segment from the sensor origin s to a point p of the
    ellipsoid E. Then the ray from s through x passes, beyond x, within R |p − s|/|y − s| ≤ β of p, with β =
    R·far/(|x − s| − R). So from x on this ray meets the sum of E and a ball of radius β. The ellipsoid (1 +
    ε)E + (1 + 1/ε)β²I contains that sum for every ε > 0. The test uses two values of ε, which are tight
    along the two longest axes. In the smoothed case E is widened first.
    """
    dim = centers.shape[1]
    columns = [column[cone] for column in table]
    mean, origin, squares = (columns[dim * dim + i * dim :][:dim] for i in range(3))
    whole, far = columns[-2:]
    axes = [columns[i * dim : (i + 1) * dim] for i in range(dim)]  # axes[i][j]: entry i of axis j
    x = centers.unbind(1)
    ray = [a - s for a, s in zip(x, origin, strict=True)]
    offset = [a - m for a, m in zip(x, mean, strict=True)]
    y = [sum_of(axes[i][j] * offset[i] for i in range(dim)) for j in range(dim)]
    z = [sum_of(axes[i][j] * ray[i] for i in range(dim)) for j in range(dim)]
    distance = sum_of(r * r for r in ray).sqrt()
    reach = radius if spread > 0 else radius + cube_reach
    clear = (distance - reach).clamp_min(1e-12)
    widened = (spread * (whole / clear).clamp_min(1)) ** 2  # added variance, of the rays and of the component
    far = far + widened.sqrt()
    beta = far * reach / clear
    near = distance <= far + reach
    for axis in (-1, -2):
        ratio = (beta / (squares[axis] + widened).sqrt().clamp_min(1e-12)).clamp(1e-6, 1e6)
        added = (1 + ratio) * widened + (1 + 1 / ratio) * beta**2
        weight = [1 / ((1 + ratio) * square + added) for square in squares]
        cc = sum_of(w * a * a for w, a in zip(weight, y, strict=True))
        bb = sum_of(w * a * b for w, a, b in zip(weight, y, z, strict=True))
        aa = sum_of(w * b * b for w, b in zip(weight, z, strict=True))
        # Squared Mahalanobis distance to the inflated ellipsoid, at x or at the nearest point of the ray
        # beyond x.
        near = near & (cc - bb.clamp_max(0) ** 2 / aa.clamp_min(1e-300) < 1 + 1e-6)
    # The bound does not hold where the cube contains the sensor origin: these cones count as near.
    return near | (distance <= (reach + cube_reach) * (1 + 1e-9))


@functools.cache
def _compiled_near() -> Callable[..., Tensor]:
    compiled: Callable[..., Tensor] = torch.compile(_near_cone, dynamic=True)
    return compiled


def sum_of(terms: Iterable[Tensor]) -> Tensor:
    """Sum of tensors, in order; unlike `sum` it does not start with an integer 0."""
    return functools.reduce(torch.add, terms)
