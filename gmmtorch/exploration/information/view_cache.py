"""ViewCache: values of views during one plan. Each view is evaluated once."""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.exploration.information.view_evaluator import ViewEvaluator
from gmmtorch.exploration.planning.planner_interface import PlanningTask


class ViewCache:
    """Values of lattice poses during one plan."""

    def __init__(self, task: PlanningTask, evaluator: ViewEvaluator) -> None:
        self._local_map, self._evaluator = task.local_map, evaluator
        self._row: dict[tuple[int, ...], int] = {}
        self._keys: list[Tensor] = []
        n_blocks = len(task.residual)
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
            self._gain = torch.cat([self._gain, values.gain])
            self._left = torch.cat([self._left, 1 - values.measured])
            self._keys.append(keys[new])
        return torch.tensor([self._row[name] for name in names], dtype=torch.int64)

    def marginal(self, rows: Tensor, residuals: Tensor) -> tuple[Tensor, Tensor]:
        """Return the gain (V,) of views given residuals (V, G), and the residuals (V, G) after them."""
        return (self._gain[rows] * residuals).sum(1), residuals * self._left[rows]

    def measured(self, row: int) -> Tensor:
        """Return the share (G,) of each block's information that a view gains."""
        return 1 - self._left[row]

    def views(self, residual: Tensor) -> tuple[Tensor, Tensor]:
        """Return all evaluated poses (V, 4) and their values (V,) given `residual` (G,)."""
        if not self._keys:
            return torch.zeros(0, 4, dtype=torch.float64), torch.zeros(0)
        return self._evaluator.poses(torch.cat(self._keys)), self._gain @ residual
