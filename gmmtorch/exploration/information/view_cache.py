"""What views are worth, given each other: each is evaluated once a plan."""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.exploration.information.view_evaluator import ViewEvaluator
from gmmtorch.exploration.planning.planner_interface import PlanningTask


class Memory:
    """What lattice poses are worth, for the length of a plan."""

    def __init__(self, task: PlanningTask, evaluator: ViewEvaluator) -> None:
        self._local_map, self._evaluator = task.local_map, evaluator
        self._row: dict[tuple[int, ...], int] = {}
        self._keys: list[Tensor] = []
        n_blocks = len(task.residual)
        self._gain, self._left = torch.zeros(0, n_blocks), torch.zeros(0, n_blocks)

    def rows(self, poses: Tensor) -> Tensor:
        """Row (V,) of each of poses (V, 4); those not known yet are evaluated in one call."""
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
        """What views (V,) bring where residuals (V, G) are left, and what they leave, (V, G)."""
        return (self._gain[rows] * residuals).sum(1), residuals * self._left[rows]

    def measured(self, row: int) -> Tensor:
        """The share (G,) of what each block has to tell that a view takes."""
        return 1 - self._left[row]

    def views(self, residual: Tensor) -> tuple[Tensor, Tensor]:
        """Poses (V, 4) of all that was evaluated, and what each is worth (V,), `residual` (G,) being left."""
        if not self._keys:
            return torch.zeros(0, 4, dtype=torch.float64), torch.zeros(0)
        return self._evaluator.poses(torch.cat(self._keys)), self._gain @ residual
