"""RollingWindow: evidence of the cells around a robot, in bounded memory (thesis 4.1)."""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike
from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.occupancy.voxels.cells import Box, difference, to_lattice
from gmmtorch.occupancy.voxels.sparse_evidence import SparseEvidence


class RollingWindow(SparseEvidence):
    """Evidence in a box of the world's lattice that follows the robot; evidence outside is removed.

    Counts are float32: exact up to 2²⁴ rays in a cell.

    Args:
        resolution: side (m) of the cells.
        shape: cells of the box along each axis.
        step: the box moves by multiples of this many cells, so the robot stays less than a step from its
            middle.

    Raises `InvalidArgumentError` for a resolution that is not above zero, sides that are not whole numbers
    of at least 2 cells, or a step of more than half the smallest side.
    """

    def __init__(
        self,
        resolution: float,
        shape: tuple[int, int, int] = (96, 96, 40),
        step: int = 8,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__(resolution, 3, device, dtype=torch.float32)
        if len(shape) != 3:
            raise InvalidArgumentError(f"shape={shape} must have 3 sides.")
        self.shape = tuple(check_whole("shape", n, 2) for n in shape)
        self.step = check_whole("step", step, 1)
        if 2 * step > min(shape):
            raise InvalidArgumentError(
                f"step={step} must be at most half the smallest side of shape={shape}."
            )

    def center_on(self, position: ArrayLike) -> list[Box]:
        """Move the box along each axis on which the robot at (3,), world metres, is a step or more off its
        middle.

        Returns the cells that the box did not contain before, as disjoint boxes; they have no evidence.
        These are all cells at first, and after a jump by more than the shape.
        """
        cell = self._cell(position)
        size = torch.tensor(self.shape, device=self.device)
        if self._box is None:
            low = (cell - size // 2 + self.step // 2) // self.step * self.step
            self.crop(Box(low, low + size))
            return [self.box]
        old = self.box
        off = cell - old.low - size // 2
        move = off.abs() // self.step * self.step * off.sign()
        if not bool(move.any()):
            return []
        self.crop(Box(old.low + move, old.high + move))
        return difference(self.box, old)

    def evidence(self, box: Box | None = None) -> tuple[Tensor, Tensor]:
        """Hits and misses (nx, ny, nz), float32, of the window, or of a box within it.

        Raises `InvalidArgumentError` for a box that is not within the window.
        """
        window = self.box
        box = window if box is None else box
        if bool((box.low < window.low).any() | (box.high > window.high).any()):
            raise InvalidArgumentError(
                f"box from {box.low.tolist()} to {box.high.tolist()} is not within the window, which extends "
                f"from {window.low.tolist()} to {window.high.tolist()}."
            )
        return self.dense(box)

    def around(self, position: ArrayLike, shape: tuple[int, int, int], step: int = 8) -> Box:
        """The box of `shape` cells within the window whose middle is nearest to the point (3,), world metres.

        Boxes start at multiples of `step` cells from the lowest cell of the window. Raises
        `InvalidArgumentError` if `shape` exceeds the window.
        """
        size = torch.tensor(shape, device=self.device)
        spare = torch.tensor(self.shape, device=self.device) - size
        if bool((spare < 0).any()):
            raise InvalidArgumentError(f"shape={tuple(shape)} is more than the window's {self.shape} cells.")
        low = self.box.low
        cell = self._cell(position) - low
        steps = (2 * cell - size + step) // (2 * step)  # rounded
        low = low + torch.minimum(steps.clamp_min(0), spare // step) * step
        return Box(low, low + size)

    def _cell(self, position: ArrayLike) -> Tensor:
        """The cell (3,) that contains a position, on the device of the store."""
        units = to_lattice(position, self.resolution, "position")
        if units.shape != (3,):
            raise InvalidArgumentError(f"position has shape {tuple(units.shape)}; expected (3,).")
        return units.floor().long().to(self.device)

    def _check_cells(self, cells: Tensor) -> None:
        _ = self.box  # raises before the first `center_on`
