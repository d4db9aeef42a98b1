"""Growth of a tree of Gaussians, level by level; a level splits all its nodes as one batch (thesis
2.7–2.9).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from gmmtorch.mixture.em.exact import SOFTMAX_DTYPES, Parameters, log_joint
from gmmtorch.mixture.estimators.trees.nested import (
    Assignment,
    Children,
    Fitted,
    Members,
    Packed,
    assign_members,
    expectation,
    keep_children,
    maximization,
    pack,
    principal_axes_start,
    run_em,
)

if TYPE_CHECKING:
    from gmmtorch.mixture.estimators.trees.density_limit import DensityLimit
    from gmmtorch.mixture.estimators.trees.hierarchical import HierarchicalGaussianMixture as Rule

_WORST_ROUNDING = 0.02  # nats per point of float32 error above which float64 is used
_SHORTLIST = 3  # nodes that are fully fitted, per node that the limit of leaves allows to split
_TRIAL_ITERATIONS = 2


class Tree(NamedTuple):
    """Nodes of a tree of Gaussians, level by level, parents before children.

    The root, which is the whole cloud, is not a node. parents: (M,) the parent of each node, −1 on the
    first level. weights: (M,) share of the cloud; the children of a node have its weight in total. means:
    (M, D). covariances: (M, D, D).
    """

    parents: Tensor
    weights: Tensor
    means: Tensor
    covariances: Tensor

    def leaves(self) -> Tensor:
        """The nodes (K,) without children, in order."""
        is_leaf = torch.ones_like(self.parents, dtype=torch.bool)
        is_leaf[self.parents[self.parents >= 0]] = False
        return is_leaf.nonzero().squeeze(1)

    def levels(self) -> Tensor:
        """Level (M,) of each node, from 1."""
        level, ancestor = torch.ones_like(self.parents), self.parents.clone()
        while bool((ancestor >= 0).any()):
            inner = ancestor >= 0
            level[inner] += 1
            ancestor[inner] = self.parents[ancestor[inner]]
        return level

    def at_level(self, level: int) -> Tensor:
        """The nodes of a level and the leaves of earlier levels. Together they represent the whole cloud."""
        levels = self.levels()
        is_leaf = torch.zeros_like(levels, dtype=torch.bool)
        is_leaf[self.leaves()] = True
        return ((levels == level) | (is_leaf & (levels < level))).nonzero().squeeze(1)


class Nodes(NamedTuple):
    """Nodes of a level, with their place in the tree and the likelihoods of their members.

    own: (G,) Σ p log N(x) over a node's members, nats. bound: (G,) Σ p log(π N(x)/q), with q the shares of
    the points: the node's part of the lower bound of the whole cloud.
    """

    place: Tensor
    parameters: Parameters
    own: Tensor
    bound: Tensor

    @property
    def n(self) -> int:
        return self.place.shape[0]

    def select(self, nodes: Tensor) -> Nodes:
        parameters = Parameters(*(value[nodes] for value in self.parameters))
        return Nodes(self.place[nodes], parameters, self.own[nodes], self.bound[nodes])


class Growth(NamedTuple):
    """tree; lower_bounds of the mean log-likelihood, nats; converged: whether EM converged in all nodes."""

    tree: Tree
    lower_bounds: list[float]
    converged: bool


def grow(
    points: Tensor,
    weight: Tensor,
    rule: Rule,
    on_iteration: Callable[[int, float], None] | None = None,
    density: DensityLimit | None = None,
) -> Growth:
    """Grow the tree of centred points (N, D) with weights (N,) above zero, float64.

    Args:
        points, weight: the cloud.
        rule: an estimator; its parameters say when a node is split, and how children are fitted.
        on_iteration: called with the EM iteration, from 1, and the lower bound, nats per point.
        density: removes sparse children before the points are assigned to them.
    """
    nodes, members = _root(points, weight, rule.reg_covar)
    root, score, n_leaves, converged = nodes, nodes.bound.sum(), 1, True
    bounds: list[float] = []
    levels: list[Tree] = []

    def report_bound(value: Tensor) -> None:
        bounds.append(float(value / weight.sum()))
        if on_iteration is not None:
            on_iteration(len(bounds), bounds[-1])

    report_bound(score)
    for _ in range(rule.max_levels):
        free = math.inf if rule.n_components is None else rule.n_components - n_leaves
        if free < 1:
            break
        m = int(min(rule.branching, free + 1))
        chosen = _splittable(nodes, members.mass(nodes.n), rule)
        members, nodes = members.select(chosen, nodes.n), nodes.select(chosen)
        if nodes.n * (m - 1) > free:
            chosen = _shortlist(points, members, nodes, m, free, rule)
            members, nodes = members.select(chosen, nodes.n), nodes.select(chosen)
        if nodes.n == 0:
            break
        rest = score - nodes.own.sum()
        split = _split(points, members, nodes, m, rule, report_bound, rest, density)
        accepted = _accepted_splits(split, nodes, members.mass(nodes.n), free, rule)
        score = score - nodes.bound[accepted].sum()
        n_before = sum(len(level.parents) for level in levels)
        nodes, members, level = _build_children(split, nodes, accepted, weight, n_before)
        levels.append(level)
        score = score + nodes.bound.sum()
        n_leaves += nodes.n - int(accepted.sum())
        converged &= split.converged
        report_bound(score)
    if n_leaves == 1:
        return Growth(Tree(root.place, *root.parameters), bounds, converged)
    return Growth(Tree(*(torch.cat(values) for values in zip(*levels, strict=True))), bounds, converged)


def _root(points: Tensor, weight: Tensor, reg_covar: float) -> tuple[Nodes, Members]:
    """The whole cloud as one Gaussian, with every point as its member."""
    total = weight.sum()
    mean = (weight[:, None] * points).sum(0) / total
    offset = points - mean
    covariance = (weight[:, None] * offset).T @ offset / total
    covariance.diagonal().add_(reg_covar)
    root = Parameters(torch.ones_like(total)[None], mean[None], covariance[None])
    own = (weight * log_joint(points, root)[:, 0]).sum()[None]
    index = torch.arange(points.shape[0], device=points.device)
    return Nodes(index.new_tensor([-1]), root, own, own), Members(index, torch.zeros_like(index), weight)


def _splittable(nodes: Nodes, mass: Tensor, rule: Rule) -> Tensor:
    """The nodes with enough points for two children that are not flat (2.9)."""
    variance = torch.linalg.eigvalsh(nodes.parameters.covariances)
    is_flat = variance[:, 0] < rule.planarity_threshold * variance.sum(1)
    is_flat |= variance[:, 0] < rule.thickness**2
    return (~is_flat & (mass >= 2 * rule.min_support)).nonzero().squeeze(1)


def _shortlist(points: Tensor, members: Members, nodes: Nodes, m: int, free: float, rule: Rule) -> Tensor:
    """The nodes that gain most by a split in a few trial iterations."""
    n_kept = _SHORTLIST * math.ceil(free / (m - 1))
    if nodes.n <= n_kept:
        return torch.arange(nodes.n, device=nodes.place.device)
    dtype = SOFTMAX_DTYPES[rule.dtype]
    packed = pack(points, members, nodes.parameters.means, dtype)
    children = principal_axes_start(packed, nodes.n, m, rule.reg_covar)
    for _ in range(_TRIAL_ITERATIONS):
        statistics, value = expectation(packed, children)
        children, _ = maximization(statistics, rule.reg_covar, dtype, children)
    best = (value - nodes.own).argsort(descending=True, stable=True)[:n_kept]
    return best.sort().values


class _Split(NamedTuple):
    """children of nodes; the assignment of the nodes' members to them; whether EM converged; value (G,) of
    the assignment before pruning by density, which decides about the split: points that fit no surface would
    prevent it.
    """

    children: Children
    assignment: Assignment
    converged: bool
    value: Tensor


def _split(
    points: Tensor,
    members: Members,
    nodes: Nodes,
    m: int,
    rule: Rule,
    report_bound: Callable[[Tensor], None],
    rest: Tensor,
    density: DensityLimit | None,
) -> _Split:
    """At most m children in each node. `report_bound` gets `rest` + Σ p log Σ_children per iteration."""
    mass = members.mass(nodes.n)

    def learn(dtype: torch.dtype, start: Children | None, max_iter: int) -> tuple[Packed, Fitted]:
        packed = pack(points, members, nodes.parameters.means, dtype)
        return packed, run_em(
            packed,
            principal_axes_start(packed, nodes.n, m, rule.reg_covar) if start is None else start,
            mass,
            reg_covar=rule.reg_covar,
            tol=rule.tol,
            max_iter=max_iter,
            worst_error=_WORST_ROUNDING if dtype == torch.float32 else math.inf,
            on_values=lambda value: report_bound(rest + value.sum()),
        )

    packed, found = learn(SOFTMAX_DTYPES[rule.dtype], None, rule.max_iter)
    if found.is_coarse:
        packed, found = learn(torch.float64, found.children, max(1, rule.max_iter - found.n_iter))
    children = keep_children(found.children, found.children.weights * mass[:, None] >= rule.min_support)
    assignment = assign_members(packed, children, members, rule.soft_threshold)
    value = assignment.value
    if density is not None:
        children = density.drop_sparse_children(children, nodes.parameters.means, assignment.members)
        assignment = assign_members(packed, children, members, rule.soft_threshold)
    return _Split(children, assignment, found.converged, value)


def _accepted_splits(split: _Split, nodes: Nodes, mass: Tensor, free: float, rule: Rule) -> Tensor:
    """Mask (G,) of nodes whose split gains enough; if these exceed the limit of leaves, the best of them."""
    gain = split.value - nodes.own
    added = (split.children.weights > 0).sum(1) - 1
    dim = nodes.parameters.means.shape[1]
    n_parameters = added * (1 + dim + dim * (dim + 1) // 2)
    accepted = (added > 0) & (gain > rule.tol * mass) & (gain >= rule.min_gain * n_parameters)
    if int(added[accepted].sum()) > free:
        order = torch.where(accepted, gain / added.clamp_min(1), -torch.inf).argsort(
            descending=True, stable=True
        )
        accepted[order] &= torch.cumsum(added[order], 0) <= free
    return accepted


def _build_children(
    split: _Split, nodes: Nodes, accepted: Tensor, weight: Tensor, n_before: int
) -> tuple[Nodes, Members, Tree]:
    """The children of the accepted nodes, their members, and the new level of the tree.

    weight: (N,) of the points. n_before: number of nodes in earlier levels.
    """
    children, (assignment, log_density, _) = split.children, split.assignment
    m = children.weights.shape[1]
    chosen = ((children.weights > 0) & accepted[:, None]).flatten().nonzero().squeeze(1)
    parents = nodes.parameters
    parent = chosen // m
    local = children.flat()
    path_weights = (parents.weights[:, None] * children.weights).flatten()
    parameters = Parameters(
        path_weights[chosen], parents.means[parent] + local.means[chosen], local.covariances[chosen]
    )
    p, child = assignment.weight, assignment.node
    own = torch.zeros_like(path_weights).index_add_(0, child, p * log_density)
    shared = p * path_weights.log()[child] - torch.xlogy(p, p / weight[assignment.point])
    bound = own.index_add(0, child, shared)
    place = n_before + torch.arange(chosen.shape[0], device=chosen.device)
    return (
        Nodes(place, parameters, own[chosen], bound[chosen]),
        assignment.select(chosen, path_weights.shape[0]),
        Tree(nodes.place[parent], *parameters),
    )
