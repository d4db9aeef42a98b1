"""How a tree of Gaussians grows: level by level, every node that is worth it at once (thesis 2.7–2.9)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.mixture.em.exact import Parameters, log_joint
from gmmtorch.mixture.estimators.trees.mixture_tree import Tree
from gmmtorch.mixture.estimators.trees.nested import (
    Children,
    Fitted,
    Members,
    Packed,
    Partition,
    expectation,
    maximization,
    pack,
    partition,
    principal_axes_start,
    run_em,
    without_weak,
)

_WORST_ROUNDING = 0.02  # nats a point, in float32; above it, float64 is used
_SHORTLIST = 3  # nodes fitted for each that the budget allows to be split
_TRIAL_ITERATIONS = 2


@dataclass(frozen=True)
class GrowthRule:
    """When a node is split, into how many, and how its children are learned.

    The parameters of `HierarchicalGaussianMixture` of the same names; dtype is a torch dtype.
    """

    n_components: int | None = None
    branching: int = 8
    max_levels: int = 4
    tol: float = 1e-3
    max_iter: int = 100
    reg_covar: float = 1e-6
    soft_threshold: float = 0.1
    planarity_threshold: float = 0.0
    thickness: float = 0.0
    min_support: float = 4.0
    min_gain: float = 1.0
    dtype: torch.dtype = torch.float32


class Nodes(NamedTuple):
    """The nodes of a level, their place in the tree and their members' likelihoods.

    own (G,): Σ p log N(x) over a node's members, nats; bound (G,): Σ p log(π N(x)/q), what the node
    adds to the lower bound of the whole, q being the shares of the points.
    """

    place: Tensor
    parameters: Parameters
    own: Tensor
    bound: Tensor

    @property
    def n(self) -> int:
        return self.place.shape[0]

    def of(self, nodes: Tensor) -> Nodes:
        parameters = Parameters(*(value[nodes] for value in self.parameters))
        return Nodes(self.place[nodes], parameters, self.own[nodes], self.bound[nodes])


class Growth(NamedTuple):
    """tree; lower_bounds of the mean log-likelihood, nats; converged: whether EM did, in all nodes."""

    tree: Tree
    lower_bounds: list[float]
    converged: bool


def grow(
    points: Tensor,
    weight: Tensor,
    rule: GrowthRule,
    on_iteration: Callable[[int, float], None] | None = None,
    on_level: Callable[[Nodes, Members], None] | None = None,
) -> Growth:
    """The tree of centred points (N, D) of weights (N,) above zero, float64.

    Args:
        points, weight: the cloud.
        rule: when nodes are split.
        on_iteration: called with the EM iteration, from 1, and the lower bound, nats a point.
        on_level: called with the nodes of each level, the root's 0 first, and their members.
    """
    nodes, members = _root(points, weight, rule.reg_covar)
    root, score, n_leaves, converged = nodes, nodes.bound.sum(), 1, True
    bounds: list[float] = []
    levels: list[Tree] = []

    def note(value: Tensor) -> None:
        bounds.append(float(value / weight.sum()))
        if on_iteration is not None:
            on_iteration(len(bounds), bounds[-1])

    note(score)
    if on_level is not None:
        on_level(nodes, members)
    for _ in range(rule.max_levels):
        free = math.inf if rule.n_components is None else rule.n_components - n_leaves
        if free < 1:
            break
        m = int(min(rule.branching, free + 1))
        chosen = _divisible(nodes, members.mass(nodes.n), rule)
        if chosen.numel() * (m - 1) > free:
            chosen = _shortlist(points, members.of(chosen, nodes.n), nodes.of(chosen), chosen, m, free, rule)
        if chosen.numel() == 0:
            break
        members, nodes = members.of(chosen, nodes.n), nodes.of(chosen)
        split = _split(points, members, nodes, m, rule, note, rest=score - nodes.own.sum())
        accepted = _worth_it(split, nodes, members.mass(nodes.n), free, rule)
        score = score - nodes.bound[accepted].sum()
        nodes, members, level = _descend(split, nodes, accepted, weight, sum(len(t.parents) for t in levels))
        levels.append(level)
        score = score + nodes.bound.sum()
        n_leaves += nodes.n - int(accepted.sum())
        converged &= split.converged
        note(score)
        if on_level is not None:
            on_level(nodes, members)
    if n_leaves == 1:
        return Growth(Tree(root.place, *root.parameters), bounds, converged)
    return Growth(Tree(*(torch.cat(values) for values in zip(*levels, strict=True))), bounds, converged)


def _root(points: Tensor, weight: Tensor, reg_covar: float) -> tuple[Nodes, Members]:
    """The whole cloud as one Gaussian, and every point its member."""
    total = weight.sum()
    mean = (weight[:, None] * points).sum(0) / total
    offset = points - mean
    covariance = (weight[:, None] * offset).T @ offset / total
    covariance.diagonal().add_(reg_covar)
    root = Parameters(torch.ones_like(total)[None], mean[None], covariance[None])
    own = (weight * log_joint(points, root)[:, 0]).sum()[None]
    index = torch.arange(points.shape[0], device=points.device)
    return Nodes(index.new_tensor([-1]), root, own, own), Members(index, torch.zeros_like(index), weight)


def _divisible(nodes: Nodes, mass: Tensor, rule: GrowthRule) -> Tensor:
    """The nodes that have points enough for two children, and are not flat (2.9)."""
    variance = torch.linalg.eigvalsh(nodes.parameters.covariances)
    is_flat = variance[:, 0] < rule.planarity_threshold * variance.sum(1)
    is_flat |= variance[:, 0] < rule.thickness**2
    return (~is_flat & (mass >= 2 * rule.min_support)).nonzero().squeeze(1)


def _shortlist(
    points: Tensor, members: Members, nodes: Nodes, chosen: Tensor, m: int, free: float, rule: GrowthRule
) -> Tensor:
    """Of the nodes, which are the `chosen` of a level, those that a first look says to gain most."""
    n_kept = _SHORTLIST * math.ceil(free / (m - 1))
    if nodes.n <= n_kept:
        return chosen
    packed = pack(points, members, nodes.parameters.means, rule.dtype)
    children = principal_axes_start(packed, nodes.n, m, rule.reg_covar)
    for _ in range(_TRIAL_ITERATIONS):
        statistics, value = expectation(packed, children)
        children, _ = maximization(statistics, rule.reg_covar, rule.dtype, children)
    best = (value - nodes.own).argsort(descending=True, stable=True)[:n_kept]
    return chosen[best.sort().values]


class _Split(NamedTuple):
    """children of nodes, and how the nodes' members are handed down to them."""

    children: Children
    handed: Partition
    converged: bool


def _split(
    points: Tensor,
    members: Members,
    nodes: Nodes,
    m: int,
    rule: GrowthRule,
    note: Callable[[Tensor], None],
    rest: Tensor,
) -> _Split:
    """At most m children in each node; `note` is given `rest` and Σ p log Σ_children in each iteration."""
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
            on_values=lambda value: note(rest + value.sum()),
        )

    packed, found = learn(rule.dtype, None, rule.max_iter)
    if found.is_coarse:
        packed, found = learn(torch.float64, found.children, max(1, rule.max_iter - found.n_iter))
    children = without_weak(found.children, mass, rule.min_support)
    return _Split(children, partition(packed, children, members, rule.soft_threshold), found.converged)


def _worth_it(split: _Split, nodes: Nodes, mass: Tensor, free: float, rule: GrowthRule) -> Tensor:
    """Which nodes (G,) are split: those whose members it explains better; if they are too many, the best."""
    gain = split.handed.value - nodes.own
    added = (split.children.weights > 0).sum(1) - 1
    dim = nodes.parameters.means.shape[1]
    n_parameters = added * (1 + dim + dim * (dim + 1) // 2)
    worth = (added > 0) & (gain > rule.tol * mass) & (gain >= rule.min_gain * n_parameters)
    if int(added[worth].sum()) > free:
        order = torch.where(worth, gain / added.clamp_min(1), -torch.inf).argsort(
            descending=True, stable=True
        )
        worth[order] &= torch.cumsum(added[order], 0) <= free
    return worth


def _descend(
    split: _Split, nodes: Nodes, accepted: Tensor, weight: Tensor, n_before: int
) -> tuple[Nodes, Members, Tree]:
    """The children of the accepted nodes, with their members, and as a level of the tree.

    weight (N,): of the points; n_before: nodes in the levels above.
    """
    children, (handed, log_density, _) = split.children, split.handed
    m = children.weights.shape[1]
    chosen = ((children.weights > 0) & accepted[:, None]).flatten().nonzero().squeeze(1)
    above = nodes.parameters
    parent = chosen // m
    local = children.flat()
    path_weights = (above.weights[:, None] * children.weights).flatten()
    parameters = Parameters(
        path_weights[chosen], above.means[parent] + local.means[chosen], local.covariances[chosen]
    )
    p, child = handed.weight, handed.node
    own = torch.zeros_like(path_weights).index_add_(0, child, p * log_density)
    shared = p * path_weights.log()[child] - torch.xlogy(p, p / weight[handed.point])
    bound = own.index_add(0, child, shared)
    place = n_before + torch.arange(chosen.shape[0], device=chosen.device)
    return (
        Nodes(place, parameters, own[chosen], bound[chosen]),
        handed.of(chosen, path_weights.shape[0]),
        Tree(nodes.place[parent], *parameters),
    )
