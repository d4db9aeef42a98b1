"""Memory of views: their values during one plan, and lower weights for information they failed to gain."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gmmtorch.team.exploration.information.view_evaluator import BLOCK, ViewEvaluator, ViewValues
from gmmtorch.team.exploration.planning.planner_interface import PlanningTask
from gmmtorch.team.exploration.robot.mapper import LocalMap

_LEAST_ROWS = 128
"""Rows of a table; few plans evaluate more views, so that tables seldom grow."""


class ViewCache:
    """Values of lattice poses during one plan."""

    def __init__(self, task: PlanningTask, evaluator: ViewEvaluator) -> None:
        self._local_map, self._evaluator = task.local_map, evaluator
        self._row: dict[tuple[int, ...], int] = {}
        self._keys: list[Tensor] = []
        n_blocks = len(task.residual)
        # Rows beyond those of `_row` are spare.
        self._gain, self._left = torch.zeros(0, n_blocks), torch.zeros(0, n_blocks)

    def rows(self, poses: Tensor) -> Tensor:
        """Return the row (V,) of each of poses (V, 4); new ones are evaluated in one call."""
        keys = self._evaluator.keys(poses)
        names = [tuple(key) for key in keys.tolist()]
        new = []
        for i, name in enumerate(names):
            if name not in self._row:
                self._row[name] = len(self._row)
                new.append(i)
        if new:
            values = self._evaluator.evaluate(self._local_map, keys[new])
            self._store(len(self._row) - len(new), values)
            self._keys.append(keys[new])
        return torch.tensor([self._row[name] for name in names], dtype=torch.int64)

    def _store(self, begin: int, values: ViewValues) -> None:
        """Store values in the rows from `begin` on."""
        stop = begin + len(values.gain)
        if stop > len(self._gain):
            spare = self._gain.new_empty(max(stop, 2 * begin, _LEAST_ROWS) - begin, self._gain.shape[1])
            self._gain = torch.cat([self._gain[:begin], spare])
            self._left = torch.cat([self._left[:begin], spare])
        self._gain[begin:stop] = values.gain
        torch.sub(1, values.measured, out=self._left[begin:stop])

    def marginal(self, rows: Tensor, residuals: Tensor) -> tuple[Tensor, Tensor]:
        """Return the gain (V,) of views given residuals (V, G), and the residuals (V, G) after them."""
        return (self._gain[rows] * residuals).sum(1), residuals * self._left[rows]

    def measured(self, row: int) -> Tensor:
        """Return the share (G,) of each block's information that a view gains."""
        return 1 - self._left[row]

    def views(self, residual: Tensor) -> tuple[Tensor, Tensor]:
        """Return all evaluated poses (V, 4) and their values (V,) given `residual` (G,)."""
        return self._evaluator.poses(torch.cat(self._keys)), self._gain[: len(self._row)] @ residual


_DECAY = 0.25  # share of what a view promises that is discounted after its image
_EXTENT = 1 << 20  # blocks along each axis that keys can tell apart


class InformationDiscount:
    """Weights of the blocks of the world; 1 by default.

    The view from the robot's pose, evaluated right after an image was taken there, should gain nothing.
    What it still promises, the camera cannot resolve: grazing surfaces, and gaps smaller than a cell.
    Each such image changes the weight w of a block to w (1 − ¼ measured), where `measured` is the
    share of the block's remaining information that the view promises. The robot then does not keep
    looking at what it cannot see.
    """

    def __init__(self) -> None:
        self._keys = torch.zeros(0, dtype=torch.int64)  # rising
        self._weights = torch.zeros(0)
        self._when = -math.inf

    def note(self, local_map: LocalMap, measured: Tensor, now: float) -> None:
        """Apply `measured` (G,) of the view that was just taken. Only the first call at one time counts."""
        if now <= self._when:
            return
        self._when = now
        looked = measured > 0
        fresh = 1 - _DECAY * measured[looked].cpu()
        keys = torch.cat([self._keys, _keys(local_map)[looked.cpu()]])
        factors = torch.cat([self._weights, fresh])
        self._keys, row = torch.unique(keys, return_inverse=True)
        self._weights = torch.ones(len(self._keys)).scatter_reduce_(0, row, factors, "prod")

    def weights(self, local_map: LocalMap) -> Tensor:
        """Weights (G,) float32 of the local map's blocks."""
        keys = _keys(local_map)
        if len(self._keys) == 0:
            return torch.ones(len(keys))
        row = torch.searchsorted(self._keys, keys).clamp_max(len(self._keys) - 1)
        return torch.where(self._keys[row] == keys, self._weights[row], 1.0)


def _keys(local_map: LocalMap) -> Tensor:
    """Return world-fixed keys (G,) of the local map's blocks, in row-major order."""
    first = local_map.low.cpu() // BLOCK
    x, y, z = (
        (torch.arange(-(-n // BLOCK)) + low) % _EXTENT for n, low in zip(local_map.shape, first, strict=True)
    )
    return ((x[:, None, None] * _EXTENT + y[:, None]) * _EXTENT + z).reshape(-1)
