"""PeerTrajectories: the committed paths of the other robots, and which paths keep clear of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.sharing.messages.message_registry import PlanMessage

_MOST_STEPS = 1000
"""Steps of a heard plan that are used at most."""


@dataclass(frozen=True, eq=False)
class PeerTrajectories:
    """Committed paths of other robots.

    paths: (M, T, 3) float64, metres, world frame: each robot's position after 1, 2, …, T ≥ 1 planner
    steps. Each robot rests at its last position afterwards.
    separation: least distance (m) between the centres of two robots: two radii and a margin.
    """

    paths: Tensor
    separation: float = 0.7

    def __post_init__(self) -> None:
        shape = tuple(self.paths.shape)
        if len(shape) != 3 or shape[1] < 1 or shape[2] != 3 or not bool(torch.isfinite(self.paths).all()):
            raise InvalidArgumentError(
                f"paths has shape {shape}; expected finite metres (M, T, 3), T of 1 or more."
            )
        if not (math.isfinite(self.separation) and self.separation > 0):
            raise InvalidArgumentError(f"separation={self.separation} must be above zero metres.")

    @classmethod
    def of(cls, paths: Sequence[Tensor], separation: float = 0.7) -> PeerTrajectories:
        """Build from paths (T_i, 3) of any lengths, at least one position each."""
        longest = max((len(path) for path in paths), default=1)
        padded = [path[torch.arange(longest).clamp_max(len(path) - 1)] for path in paths]
        return cls(torch.stack(padded) if padded else torch.zeros(0, 1, 3, dtype=torch.float64), separation)

    def __len__(self) -> int:
        return len(self.paths)

    def later(self, steps: int) -> PeerTrajectories:
        """Return the peers as seen by a path that begins that many steps from now."""
        return PeerTrajectories(self.paths[:, min(steps, self.paths.shape[1] - 1) :], self.separation)


def clear_of(path: Tensor, peers: PeerTrajectories, start: Tensor | None = None) -> Tensor:
    """Flag (...,) the paths (..., L, 3), positions after 1, 2, …, L steps, that keep clear of the peers.

    After step L the robot stays. At step k its distance from another robot must be at least the
    separation, plus the longer step of that robot before or after step k, plus half of its own longer
    step. The robots are then also clear between steps, and if the other robot is up to half a step early
    or late. With `start` (..., 3), the position before the first step, a robot that is already too close
    may move if it is never closer than it would be by staying.
    """
    if len(peers) == 0:
        return torch.ones(path.shape[:-2], dtype=torch.bool, device=path.device)
    n_path, n_traffic = path.shape[-2], peers.paths.shape[1]
    # One robot rests after the shorter path ends.
    n = max(n_path, n_traffic)
    there = peers.paths[:, torch.arange(n).clamp_max(n_traffic - 1)]
    least = peers.separation + _longer_step(there)
    own = path if start is None else torch.cat([start[..., None, :], path], -2)
    sway = _longer_step(own)[..., own.shape[-2] - n_path :] / 2
    clear = torch.ones(path.shape[:-2], dtype=torch.bool, device=path.device)
    for other, needed in zip(there, least, strict=True):
        ahead, after = other[:n_path], other[n_path:]
        required = needed[:n_path] + sway
        if start is not None:
            required = torch.minimum(required, _distance(start[..., None, :], ahead))
        clear &= (_distance(path, ahead) >= required).all(-1)
        if len(after):
            required = needed[n_path:]
            if start is not None:
                required = torch.minimum(required, _distance(start[..., None, :], after))
            clear &= (_distance(path[..., -1:, :], after) >= required).all(-1)
    return clear


def predicted_path(plan: PlanMessage, age: float, step: float) -> Tensor:
    """Positions (S, 3), metres, of a teammate after 1, 2, …, S steps of `step` seconds from now, by a plan
    that was heard `age` seconds ago.

    Each is the plan's pose nearest in time, at most half a step of the plan off, which `clear_of` allows for.
    """
    n = len(plan.path)
    left = n * plan.step - age
    ahead = step * torch.arange(1, min(max(math.ceil(left / step - 1e-9), 1), _MOST_STEPS) + 1)
    rows = ((age + ahead.double()) / plan.step).round().clamp(1, n).long() - 1
    return plan.path[rows, :3].double()


def _longer_step(path: Tensor) -> Tensor:
    """Return metres (..., L) from each position of paths (..., L, 3) to the farther of its neighbours in
    time.
    """
    step = (path[..., 1:, :] - path[..., :-1, :]).norm(dim=-1)
    pad = torch.nn.functional.pad
    return torch.maximum(pad(step, (0, 1)), pad(step, (1, 0)))


def _distance(a: Tensor, b: Tensor) -> Tensor:
    return (a - b).norm(dim=-1)
