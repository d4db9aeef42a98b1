"""A search tree over motions, in tables: its values, what can follow its nodes, and the choice of leaves.

`exploration.planning.tree_search._Tree` is the twin of the fused kernels. They run on the CPU, one item each,
because each choice of a leaf depends on the one before.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels.compiler import FusedKernel
from gmmtorch.kernels.rays.path_clearance import FreeSpace, Library

_N_LINKS, _PARENT, _ACTION, _FIRST_NODE = 11, 0, 1, 7
_N_VALUES, _RETURN, _METRES = 4, 2, 3
_OPEN = FusedKernel("rays/motion_tree.h", "open_nodes", rounds_each=True)  # states are those of the twin
_CHOOSE = FusedKernel("rays/motion_tree.h", "choose_leaves", rounds_each=True)


class _Tables(NamedTuple):
    """`MotionTree` of motion_tree.h."""

    links: Tensor
    values: Tensor
    states: Tensor
    ends: Tensor
    after: Tensor
    clear: Tensor
    untried: Tensor
    residuals: Tensor
    opened: Tensor
    counts: Tensor
    scale: Tensor
    n_actions: int
    n_blocks: int
    deepest: int
    exploration: float
    widening: float
    discount: float
    weight: float
    aims: float


class MotionTree:
    """A tree with room for `most` nodes; its root is the node opened last.

    Args:
        state: (7,) of the root. ends: (P, 7) of the motions from it. clear: (P,) bool, which are safe.
        residual: (G,) of the root. metres: from it to the goal.
        rule: the other fields of the structure in motion_tree.h, from `deepest` on.

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
        self._tables = tables = _Tables(
            links=torch.zeros(most, _N_LINKS, dtype=torch.int64),
            values=torch.zeros(most, _N_VALUES, dtype=torch.float64),
            states=state.expand(most, 7).contiguous(),
            ends=torch.empty(most, n, 7, dtype=torch.float64),
            after=torch.empty(most, n, dtype=torch.float64),
            clear=torch.empty(most, n, dtype=torch.bool),
            untried=torch.empty(most, n, dtype=torch.int32),
            residuals=residual.expand(most, -1).contiguous(),
            opened=torch.zeros(most, dtype=torch.int64),
            counts=torch.ones(2, dtype=torch.int64),
            scale=torch.full((1,), 1e-12, dtype=torch.float64),
            n_actions=n,
            n_blocks=n_blocks,
            **rule,
        )
        self.states = tables.states
        self._links, self._values = tables.links.numpy(), tables.values.numpy()
        self._counts = tables.counts.numpy()
        self._links[0, [_PARENT, _ACTION]] = self._links[0, _FIRST_NODE:] = -1
        self._values[0, _METRES] = metres
        tables.ends[0], tables.clear[0] = ends, clear

    @property
    def n_nodes(self) -> int:
        return int(self._counts[0])

    @property
    def n_opened(self) -> int:
        return int(self._counts[1])

    def ends_opened(self) -> Tensor:
        """Ends (n, P, 7) of the motions from the nodes that were opened last."""
        return self._tables.ends[self._tables.opened[: self.n_opened]]

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
        state = *self._tables, *library, *space
        _OPEN(1, *state, longest, spacing, n, is_last, *views)

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
