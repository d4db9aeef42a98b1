"""Fatigue: blocks that promise information, and keep it when they are looked at."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gmmtorch.exploration.information.view_evaluator import BLOCK
from gmmtorch.exploration.robot.local_map import LocalMap

_EXTENT = 1 << 20  # blocks along each axis that keys can tell apart


class Fatigue:
    """Weights of the blocks of the world, 1 where nothing is known to the contrary.

    The view from where a robot is, valued right after it has looked, should bring nothing. What it still
    promises then, the camera did not resolve: grazing surfaces, gaps that the cells are too coarse for.
    Each such look takes the block's weight w to w (1 − decay · measured), measured being the share of what
    the block has to tell that the view claims. So a robot does not stare at what it cannot see.
    """

    def __init__(self, decay: float = 0.25) -> None:
        self._decay = decay
        self._keys = torch.zeros(0, dtype=torch.int64)  # rising
        self._weights = torch.zeros(0)
        self._when = -math.inf

    def note(self, local_map: LocalMap, measured: Tensor, now: float) -> None:
        """What the view from here, measured (G,), claims although it was just taken; once at each time."""
        if now <= self._when:
            return
        self._when = now
        looked = measured > 0
        fresh = 1 - self._decay * measured[looked].cpu()
        keys = torch.cat([self._keys, _keys(local_map)[looked.cpu()]])
        factors = torch.cat([self._weights, fresh])
        self._keys, row = torch.unique(keys, return_inverse=True)
        self._weights = torch.ones(len(self._keys)).scatter_reduce_(0, row, factors, "prod")

    def weights(self, local_map: LocalMap) -> Tensor:
        """Weights (G,) float32 of the window's blocks."""
        keys = _keys(local_map)
        if len(self._keys) == 0:
            return torch.ones(len(keys))
        row = torch.searchsorted(self._keys, keys).clamp_max(len(self._keys) - 1)
        return torch.where(self._keys[row] == keys, self._weights[row], 1.0)


def _keys(local_map: LocalMap) -> Tensor:
    """What names each block (G,) of a window, in row-major order, wherever the window is."""
    first = local_map.low.cpu() // BLOCK
    x, y, z = (
        (torch.arange(-(-n // BLOCK)) + low) % _EXTENT for n, low in zip(local_map.shape, first, strict=True)
    )
    return ((x[:, None, None] * _EXTENT + y[:, None]) * _EXTENT + z).reshape(-1)
