"""MixtureTiles: a spatial index over batches of components, by the box around their rays."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable
from typing import NamedTuple

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mapping.components import Components
from gmmtorch.occupancy import Box, CellEvidence, RollingWindow, cone_bounds

_REACH = 3.0  # deviations around the means that belong to the box
_MOST_TILES = 4096  # a batch in more tiles is tested in every search


class _Batch(NamedTuple):
    components: Components
    low: list[float]  # corners of the box around its rays, metres
    high: list[float]


class MixtureTiles:
    """Batches of components, each of one message or frame, hashed into cubes by the box around their rays.

    The time of a search grows with the number of near batches, not of all. Batches never change.

    Args:
        tile: side (m) of the cubes.
    """

    def __init__(self, tile: float = 8.0) -> None:
        if not 0 < tile < math.inf:
            raise InvalidArgumentError(f"tile={tile} must be finite metres above zero.")
        self.tile = tile
        self._batches: list[_Batch] = []
        self._tiles: dict[tuple[int, ...], list[int]] = {}  # rows of the batches in each cube
        self._everywhere: list[int] = []

    def add(self, components: Components) -> None:
        """Adds a batch. Raises `InvalidArgumentError` for components that are not in 3D, and means,
        covariances or origins that are not finite."""
        if components.dim != 3:
            raise InvalidArgumentError(f"components have {components.dim} dimensions; tiles need 3.")
        if not len(components.seen_by):
            return  # it has no rays
        lows, highs = cone_bounds(components.cones(), _REACH)
        low, high = lows.amin(0).tolist(), highs.amax(0).tolist()
        if not all(map(math.isfinite, (*low, *high))):
            raise InvalidArgumentError("The components of a batch hold NaN or infinite values.")
        spans = self._spans(low, high)
        if math.prod(map(len, spans)) > _MOST_TILES:
            self._everywhere.append(len(self._batches))
        else:
            for place in itertools.product(*spans):
                self._tiles.setdefault(place, []).append(len(self._batches))
        self._batches.append(_Batch(components, low, high))

    def near(self, box: Box, resolution: float) -> list[Components]:
        """Batches whose rays may reach a box of cells of side `resolution` (m), in the order of `add`.

        Rays must end within three deviations of their means, as those of `component_rays` do.
        """
        low = [x * resolution for x in box.low.tolist()]
        high = [x * resolution for x in box.high.tolist()]
        spans = self._spans(low, high)
        found = set(self._everywhere)
        if math.prod(map(len, spans)) < len(self._tiles):
            for place in itertools.product(*spans):
                found.update(self._tiles.get(place, ()))
        else:  # the box has more tiles than are in use
            for place, numbers in self._tiles.items():
                if all(x in span for x, span in zip(place, spans, strict=True)):
                    found.update(numbers)
        batches = [self._batches[number] for number in sorted(found)]
        return [
            batch.components
            for batch in batches
            if all(a <= d and c <= b for a, b, c, d in zip(batch.low, batch.high, low, high, strict=True))
        ]

    def _spans(self, low: list[float], high: list[float]) -> list[range]:
        """The tiles along each axis from one corner to the other, metres."""
        return [
            range(math.floor(a / self.tile), math.floor(b / self.tile) + 1)
            for a, b in zip(low, high, strict=True)
        ]


def regenerate(
    sliding: RollingWindow,
    boxes: Iterable[Box],
    tiles: MixtureTiles,
    evidence: Callable[[Components, float, Box], CellEvidence],
) -> None:
    """Fills empty boxes that the window has uncovered with the evidence of the mixture (thesis Fig 4.2).

    Rays are clipped to the boxes, so nothing is counted twice. `evidence(components, resolution, box)`.
    """
    for box in boxes:
        if near := tiles.near(box, sliding.resolution):
            sliding.add(evidence(Components.concatenate(near), sliding.resolution, box))
