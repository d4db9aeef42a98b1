"""Motions: which of them are safe from some states, and a search tree over them, in tables.

`exploration.planning.collision_checking.feasible` is the twin of the first, which handles one motion from one
state in one item. `exploration.planning.tree_search._Tree` is the twin of the kernels of the tree. They run
on the CPU, one item each, because each choice of a leaf depends on the one before.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels.compiler import FusedKernel


class Library(NamedTuple):
    """P motions: x, y, z, yaw and three velocities; metres, radians, seconds.

    paths: (P, P, S, 7) float64, states of the motions from the origin with yaw 0, after each of the motions.
    stops: (P, B, 7) float64, how a robot comes to rest after each motion, from the origin with yaw 0.
    """

    n_motions: int
    n_steps: int
    n_stops: int
    paths: Tensor
    stops: Tensor


class FreeSpace(NamedTuple):
    """Where motions are safe.

    passable: (nx, ny, nz) bool, cells in which the centre of a robot may be; low: (3,) int64, the lowest.
    resolution: side of a cell (m).
    peers: (M, T, 3) float64, metres, positions of other robots after 1, 2, …, T steps. separation: metres.
    """

    passable: Tensor
    low: Tensor
    nx: int
    ny: int
    nz: int
    resolution: float
    peers: Tensor
    n_peers: int
    n_times: int
    separation: float


# Positions and states are those of the twins.
_CLEAR = FusedKernel("rays/path_clearance.h", "motions_are_clear", rounds_each=True)
_OPEN = FusedKernel("rays/motion_tree.h", "open_nodes", rounds_each=True)
_CHOOSE = FusedKernel("rays/motion_tree.h", "choose_leaves", rounds_each=True)


def motions_are_clear(
    library: Library,
    space: FreeSpace,
    follows: Tensor,
    starts: Tensor,
    ends: Tensor,
    n_parts: int,
    first: int,
) -> Tensor:
    """Which motions (N, P) are safe: see `feasible`. A motion that does not move is.

    Args:
        follows: (N,) int64, the motion before each start. starts: (N, 7) float64.
        ends: (N, P, 7) float64, the last states of the motions.
        n_parts: checked points on each step. first: of the peers' positions, that of the first step; below T.

    A motion differs from the twin's only if it meets an edge of a cell, or the separation, within rounding.
    """
    clear = torch.empty(ends.shape[:2], dtype=torch.bool, device=starts.device)
    turns = [torch.stack([poses[..., 3].cos(), poses[..., 3].sin()], -1) for poses in (starts, ends)]
    given = follows, starts, turns[0], ends, turns[1], n_parts, first
    _CLEAR(clear.numel(), *library, *space, *given, clear)
    return clear


_N_LINKS, _PARENT, _ACTION, _FIRST_NODE = 11, 0, 1, 7
_N_VALUES, _RETURN, _METRES = 4, 2, 3


_RULE = "deepest", "exploration", "widening", "discount", "weight", "aims"


class MotionTree:
    """A tree with room for `most` nodes; its root is the node opened last.

    Args:
        state: (7,) of the root. ends: (P, 7) of the motions from it. clear: (P,) bool, which are safe.
        residual: (G,) of the root. metres: from it to the goal.
        rule: the last fields of the structure in motion_tree.h.

    Attributes:
        n_nodes, n_opened: nodes, and how many of them were opened last.
        states: (most, 7), of the nodes.
    """

    def __init__(
        self,
        most: int,
        state: Tensor,
        ends: Tensor,
        clear: Tensor,
        residual: Tensor,
        metres: float,
        **rule: Any,
    ) -> None:
        n, n_blocks = len(ends), len(residual)
        links = torch.zeros(most, _N_LINKS, dtype=torch.int64)
        values = torch.zeros(most, _N_VALUES, dtype=torch.float64)
        self.states = state.expand(most, 7).contiguous()
        self._ends = torch.empty(most, n, 7, dtype=torch.float64)
        after = torch.empty(most, n, dtype=torch.float64)
        is_clear = torch.empty(most, n, dtype=torch.bool)
        untried = torch.empty(most, n, dtype=torch.int32)
        residuals = residual.expand(most, -1).contiguous()
        self._opened = torch.zeros(most, dtype=torch.int64)
        counts = torch.ones(2, dtype=torch.int64)
        scale = torch.full((1,), 1e-12, dtype=torch.float64)
        self._links, self._values, self._counts = links.numpy(), values.numpy(), counts.numpy()
        self._links[0, [_PARENT, _ACTION]] = self._links[0, _FIRST_NODE:] = -1
        self._values[0, _METRES] = metres
        self._ends[0], is_clear[0] = ends, clear
        # `MotionTree` of motion_tree.h
        tables = links, values, self.states, self._ends, after, is_clear, untried, residuals, self._opened
        self._tables = *tables, counts, scale, n, n_blocks, *(rule[name] for name in _RULE)

    @property
    def n_nodes(self) -> int:
        return int(self._counts[0])

    @property
    def n_opened(self) -> int:
        return int(self._counts[1])

    def ends_opened(self) -> Tensor:
        """Ends (n, P, 7) of the motions from the nodes that were opened last."""
        return self._ends[self._opened[: self.n_opened]]

    def choose(self, orders: Tensor, most: int, turn: int, action: int = -1) -> int:
        """The number of new leaves in round `turn`, at most `most`. orders: (n, P), of the motions from the
        nodes that were opened last. action: the only leaf is that below the newest node."""
        before = self.n_nodes
        _CHOOSE(1, *self._tables, orders, most, turn, action)
        return self.n_nodes - before

    def open(
        self,
        library: Library,
        space: FreeSpace,
        longest: Tensor,
        spacing: float,
        n: int,
        is_last: bool,
        views: tuple[Tensor | None, ...],
    ) -> None:
        """Sets the values of the n newest nodes, and opens them unless they are the last.

        longest: (P, 2), longest step (m) and largest turn (rad) in a step of what follows each motion.
        spacing: metres between checked points. views: the row (n,) of each node's view in the tables of gains
        (V, G) and of what is left (V, G).
        """
        _OPEN(1, *self._tables, *library, *space, longest, spacing, n, is_last, *views)

    def best(self) -> tuple[list[int], list[int], float, float, float] | None:
        """Nodes and motions of the branch to the node with the largest return, the return, its information,
        and the metres of progress; None if there is only the root."""
        if self.n_nodes == 1:
            return None
        last = 1 + int(self._values[1 : self.n_nodes, _RETURN].argmax())
        nodes = [last]
        while (parent := int(self._links[nodes[0], _PARENT])) > 0:
            nodes.insert(0, parent)
        _, information, value, metres = self._values[last].tolist()
        progress = float(self._values[0, _METRES]) - metres
        return nodes, self._links[nodes, _ACTION].tolist(), value, information, progress
