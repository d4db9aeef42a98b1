"""A layer of the world from above: the highest occupancy of each column of cells."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.occupancy.grid import check_resolution
from gmmtorch.report.style import as_array
from gmmtorch.scan import ArrayLike

UNKNOWN_BAND = 0.02
"""Of θ around ½, within which a cell is shown as unknown."""


class TopView(NamedTuple):
    """A layer of the world from above.

    image: (nx, ny) in the order of the lattice, cell (i, j) reaching from low + (i, j)·resolution on;
    low: (x, y) of its corner, world metres; resolution: metres; band: (from, to) heights shown, metres.
    """

    image: Tensor
    low: tuple[float, float]
    resolution: float
    band: tuple[float, float] = (-math.inf, math.inf)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Left, right, bottom, top, metres."""
        nx, ny = self.image.shape
        (x, y), side = self.low, self.resolution
        return x, x + nx * side, y, y + ny * side


def top_view(
    probability: ArrayLike,
    low: ArrayLike,
    resolution: float,
    band: tuple[float, float] = (-math.inf, math.inf),
) -> TopView:
    """The highest occupancy of what is known in each column (½ where nothing is), of cells within a band.

    Args:
        probability: (nx, ny, nz), the cells' occupancy; within 0.02 of ½ is unknown. Truth values do too.
        low: (3,) corner of the lowest cell, world metres.
        resolution: side (m) of the cells.
        band: heights (m) between which the centres of cells count: above the floor, below the ceiling.

    Raises:
        InvalidArgumentError: shapes that disagree, or a band without a layer of cells.
    """
    theta, corner = torch.as_tensor(probability).detach().cpu().double(), as_array(low)
    side = check_resolution(resolution)
    if theta.ndim != 3 or corner.shape != (3,):
        raise InvalidArgumentError(
            f"probability has shape {tuple(theta.shape)} and low {corner.shape}; expected (nx, ny, nz), (3,)."
        )
    heights = corner[2] + (torch.arange(theta.shape[2]) + 0.5) * side
    within = (heights >= band[0]) & (heights <= band[1])
    if not bool(within.any()):
        raise InvalidArgumentError(
            f"band={band} holds no layer of cells between {heights.min():g} and {heights.max():g} m."
            if len(heights)
            else "probability has no layer of cells."
        )
    layers = theta[:, :, within]
    highest = torch.where((layers - 0.5).abs() < UNKNOWN_BAND, -1.0, layers).amax(2)
    shown = (float(heights[within][0]) - side / 2, float(heights[within][-1]) + side / 2)
    image = torch.where(highest < 0, 0.5, highest)
    return TopView(image, (float(corner[0]), float(corner[1])), side, shown)
