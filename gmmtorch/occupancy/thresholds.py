"""Which probabilities are called free, and which occupied, by those who take three classes."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.occupancy.evidence import CellClass


@dataclass(frozen=True)
class Thresholds:
    """θ below `free` is free, above `occupied` occupied, else unknown. The defaults are map_server's."""

    free: float = 0.196
    occupied: float = 0.65

    def __post_init__(self) -> None:
        if not 0 <= self.free <= self.occupied <= 1:  # NaN compares false
            raise InvalidArgumentError(
                f"free_thresh={self.free}, occupied_thresh={self.occupied} must be probabilities, the first "
                "no larger than the second."
            )

    def classify(self, probability: Tensor) -> Tensor:
        """`CellClass` values (int8) of probabilities, any shape."""
        label = torch.full_like(probability, CellClass.UNKNOWN, dtype=torch.int8)
        label[probability > self.occupied] = int(CellClass.OCCUPIED)
        label[probability < self.free] = int(CellClass.FREE)
        return label
