"""Monte Carlo tree search over motion primitives, with leaves evaluated in batches (thesis 4.3)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from gmmtorch.kernels import MotionTree, is_fused
from gmmtorch.team.exploration.planning.collision_checking import check_steps, free_space
from gmmtorch.team.exploration.planning.journeys import Goal
from gmmtorch.team.exploration.planning.planner_interface import PlanningTask, options
from gmmtorch.team.exploration.planning.primitives import Primitives
from gmmtorch.team.exploration.planning.view_evaluator import ViewCache

_FAR = 1e4  # metres, where there is no way to the goal
_WIDENING = 1.5  # a node tries about `_WIDENING` √visits primitives; the root tries all


@dataclass(frozen=True)
class SearchRule:
    """Parameters of the search.

    depth: primitives on a branch. n_rounds, n_leaves: batches, and new nodes in each. exploration: c of
    UCT, as a share of the largest return found so far. discount: factor on the gain of each further
    primitive.
    """

    depth: int = 4
    n_rounds: int = 4
    n_leaves: int = 32
    exploration: float = 0.5
    discount: float = 0.9


@dataclass(frozen=True, eq=False)
class Found:
    """The best branch.

    actions: its L primitives. path: (S, 7) and braking: (B, 7) of the first. views: (L, 4), the end of each.
    value: return of the branch. information: undiscounted information of its views.
    progress: metres that the branch comes closer to the goal.
    """

    actions: list[int]
    path: Tensor
    braking: Tensor
    views: Tensor
    value: float
    information: float
    progress: float


@dataclass(slots=True, eq=False)
class _Node:
    """A state at the end of a primitive, with the statistics of its branch."""

    number: int
    parent: _Node | None
    action: int
    depth: int
    untried: list[int] = field(default_factory=list)
    children: list[_Node] = field(default_factory=list)
    visits: int = 0
    total: float = 0.0
    information: float = 0.0  # of the views up to here
    value: float = 0.0  # return of the branch up to here
    closed: bool = False  # no node below remains to be tried
    shut: int = -1  # the round in which no node below can be chosen

    def path(self) -> list[_Node]:
        """The nodes from the root to this node."""
        path = [self]
        while (parent := path[-1].parent) is not None:
            path.append(parent)
        return path[::-1]


def search_tree(
    primitives: Primitives,
    rule: SearchRule,
    task: PlanningTask,
    memory: ViewCache | None = None,
    goal: Goal | None = None,
    first: Sequence[int] = (),
) -> Found | None:
    """Search for the branch with the largest return (thesis 4.3); None if no primitive is feasible.

    The return of a branch is the information of its views, given each other and the teammates' plans,
    plus the goal's weight for every metre of progress, both discounted by depth. The view from the start
    counts as taken. UCT chooses the primitives (see `_Tree._promising`). A leaf counts as visited with zero
    return until its round ends.

    memory: values of views; None: only the goal counts. goal: the goal; None: only views count. first:
    primitives of a branch that is tried first, such as the rest of the last plan.
    """
    kind = _FusedTree if is_fused(task.local_map.passable, task.state) else _Tree
    tree = kind(primitives, rule, task, memory, goal)
    tree.grow(first)
    return tree.best()


class _Tree:
    """The tree of one search. Node n has row n in each table."""

    def __init__(
        self,
        primitives: Primitives,
        rule: SearchRule,
        task: PlanningTask,
        memory: ViewCache | None,
        goal: Goal | None,
    ) -> None:
        self._primitives, self._rule, self._task = primitives, rule, task
        self._memory, self._goal = memory, goal
        start, residual = task.state.double(), task.residual
        if memory is not None:  # the robot has just looked from here, so another look gains nothing
            residual = memory.marginal(memory.rows(start[None, :4]), residual[None])[1][0]
        self._paths, self._braking, feasible = options(primitives, start[None], task, may_escape=True)
        metres = 0.0 if goal is None else float(goal.cost(start).clamp_max(_FAR))
        self._begin(1 + rule.depth + rule.n_rounds * rule.n_leaves, residual, feasible, metres)

    def _begin(self, most: int, residual: Tensor, feasible: Tensor, metres: float) -> None:
        """Make the tables of at most `most` nodes, and the root: what is left of each block (G,), which
        primitives are feasible (1, P), and the metres to the goal."""
        start, n_primitives = self._task.state.double(), len(self._primitives)
        self._states = start.expand(most, 7).clone()
        self._ends = start.expand(most, n_primitives, 7).clone()  # end states of the primitives
        self._metres = torch.full((most,), metres, dtype=torch.float64)  # remaining to the goal
        self._metres_after = torch.zeros(most, n_primitives, dtype=torch.float64)
        self._residuals = residual.expand(most, -1).clone()
        self._scale = 1e-12  # the largest return found
        root = _Node(0, None, -1, 0)
        self._nodes = [root]
        self._open([root], self._paths[:, :, -1], feasible)

    def grow(self, first: Sequence[int]) -> None:
        """Try the branch `first`, then the most promising leaves, round by round."""
        node = self._nodes[0]
        for action in first[: self._rule.depth]:
            if action not in node.untried:
                break
            node.untried.remove(action)
            node = self._child(node, action, 0)
            self._extend([node])
        for turn in range(1, self._rule.n_rounds + 1):
            chosen: list[_Node] = []
            while len(chosen) < self._rule.n_leaves and (leaf := self._select(turn)) is not None:
                chosen.append(leaf)
            if not chosen:
                break
            self._extend(chosen, is_last=turn == self._rule.n_rounds)

    def best(self) -> Found | None:
        """Return the branch to the node with the largest return; the first of equals."""
        if len(self._nodes) == 1:
            return None
        last = max(self._nodes[1:], key=lambda node: node.value)
        branch = last.path()[1:]
        return Found(
            actions=[node.action for node in branch],
            path=self._paths[0, branch[0].action],
            braking=self._braking[0, branch[0].action],
            views=self._states[[node.number for node in branch], :4],
            value=last.value,
            information=last.information,
            progress=float(self._metres[0] - self._metres[last.number]),
        )

    def _select(self, turn: int) -> _Node | None:
        """Return a new node below the most promising one; None if none remains in this round."""
        root = self._nodes[0]
        node = root
        while not root.closed and root.shut != turn:
            may_widen = node is root or len(node.children) < _WIDENING * math.sqrt(node.visits)
            child = None if node.untried and may_widen else self._promising(node, turn)
            if child is not None:
                node = child
            elif node.untried:
                return self._child(node, node.untried.pop(0), turn)
            else:
                node.shut, node.closed = turn, all(child.closed for child in node.children)
                node = root
        return None

    def _promising(self, node: _Node, turn: int) -> _Node | None:
        """Return the child that UCT prefers among those that are neither exhausted nor waiting.

        It maximises Q̄(a) + c √(ln N / N_a), where Q̄(a) is the mean return of the branches through child a,
        N_a its visits, N those of `node`, and c is `exploration` times the largest return found so far
        (Kocsis & Szepesvári 2006, Bandit based Monte-Carlo planning; thesis 4.3).
        """
        c, log_visits = self._rule.exploration * self._scale, math.log(max(node.visits, 1))
        best, best_score = None, -math.inf
        for child in node.children:
            if not child.closed and child.shut != turn:
                score = child.total / child.visits + c * math.sqrt(log_visits / child.visits)
                if score > best_score:
                    best, best_score = child, score
        return best

    def _child(self, parent: _Node, action: int, turn: int) -> _Node:
        child = _Node(len(self._nodes), parent, action, parent.depth + 1, shut=turn)
        parent.children.append(child)
        self._nodes.append(child)
        for node in child.path():
            node.visits += 1
        return child

    def _extend(self, nodes: list[_Node], is_last: bool = False) -> None:
        """Set the states and values of the newest nodes, and find the primitives that can follow them."""
        rows = slice(nodes[0].number, nodes[-1].number + 1)  # new nodes have consecutive numbers
        paths = [node.path() for node in nodes]
        parents = torch.tensor([path[-2].number for path in paths])
        actions = torch.tensor([node.action for node in nodes])
        self._states[rows] = self._ends[parents, actions]
        self._metres[rows] = self._metres_after[parents, actions]
        gains = [0.0] * len(nodes)
        if self._memory is not None:
            views = self._memory.rows(self._states[rows, :4])
            marginal, self._residuals[rows] = self._memory.marginal(views, self._residuals[parents])
            gains = marginal.tolist()
        weight = 0.0 if self._goal is None else self._goal.weight
        progress = (self._metres[parents] - self._metres[rows]).tolist()
        for path, gain, metres in zip(paths, gains, progress, strict=True):
            *_, above, node = path
            later = self._rule.discount ** (node.depth - 1)
            node.information = above.information + gain
            node.value = above.value + later * (gain + weight * metres)
            self._scale = max(self._scale, node.value)
            for each in path:
                each.total += node.value
            node.closed = is_last or node.depth == self._rule.depth
        for depth in sorted({node.depth for node in nodes if not node.closed}):
            some = [node for node in nodes if node.depth == depth]
            states = self._states[torch.tensor([node.number for node in some])]
            flown, _, feasible = options(self._primitives, states, self._task, after=depth)
            self._open(some, flown[:, :, -1], feasible)

    def _open(self, nodes: list[_Node], ends: Tensor, feasible: Tensor) -> None:
        """Store the primitives that can follow N nodes: ends (N, P, 7), and which are feasible (N, P)."""
        rows = torch.tensor([node.number for node in nodes])
        self._ends[rows] = ends
        order = torch.rand(ends.shape[:2], generator=self._task.generator, dtype=torch.float64)
        if self._goal is not None:  # primitives that lead towards it come first
            self._metres_after[rows] = order = self._goal.cost(ends).clamp_max(_FAR)
        order = order.masked_fill(~feasible, math.inf).argsort(dim=1, stable=True)
        count = feasible.sum(1).tolist()
        for node, actions, n in zip(nodes, order.tolist(), count, strict=True):
            node.untried, node.closed = actions[:n], n == 0


class _FusedTree(_Tree):
    """The tree of one search in the tables of fused kernels; `_Tree` is its twin."""

    def _begin(self, most: int, residual: Tensor, feasible: Tensor, metres: float) -> None:
        task, rule, goal = self._task, self._rule, self._goal
        check_steps(self._primitives, task.local_map)
        self._space = free_space(task.local_map, task.peers)
        self._tree = MotionTree(
            most,
            task.state.double(),
            self._paths[0, :, -1],
            feasible[0],
            residual,
            metres,
            deepest=rule.depth,
            exploration=rule.exploration,
            widening=_WIDENING,
            discount=rule.discount,
            weight=0.0 if goal is None else goal.weight,
            aims=0.0 if goal is None else 1.0,
        )

    def grow(self, first: Sequence[int]) -> None:
        """Try the branch `first`, then the most promising leaves, round by round."""
        orders = self._orders()
        for action in first[: self._rule.depth]:
            if not self._tree.choose(orders, 1, 0, action):
                break
            orders = self._extended(1)
        for turn in range(1, self._rule.n_rounds + 1):
            n = self._tree.choose(orders, self._rule.n_leaves, turn)
            if not n:
                break
            orders = self._extended(n, is_last=turn == self._rule.n_rounds)

    def best(self) -> Found | None:
        """Return the branch to the node with the largest return; the first of equals."""
        best = self._tree.best()
        if best is None:
            return None
        nodes, actions, value, information, progress = best
        path, braking = self._paths[0, actions[0]], self._braking[0, actions[0]]
        views = self._tree.states[nodes, :4]
        return Found(actions, path, braking, views, value, information, progress)

    def _extended(self, n: int, is_last: bool = False) -> Tensor:
        """Set the values of the n newest nodes; returns the orders of what can follow them."""
        tree = self._tree
        views: tuple[Tensor | None, ...] = (None, None, None)
        if self._memory is not None:
            rows = self._memory.rows(tree.states[tree.n_nodes - n : tree.n_nodes, :4])
            views = rows, *self._memory.tables
        primitives = self._primitives
        tree.open(
            primitives.library, self._space, primitives.longest, self._space.resolution, n, is_last, views
        )
        return self._orders()

    def _orders(self) -> Tensor:
        """Orders (n, P) in which the motions from the nodes opened last are tried: towards the goal first."""
        n = self._tree.n_opened, len(self._primitives)
        orders = torch.rand(n, generator=self._task.generator, dtype=torch.float64)
        if self._goal is None or not len(orders):
            return orders
        return self._goal.cost(self._tree.ends_opened()).clamp_max(_FAR)
