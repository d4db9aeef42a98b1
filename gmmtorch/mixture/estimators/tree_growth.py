"""Growth of a tree of Gaussians, level by level; a level splits all its nodes as one batch (2.7–2.9).

Each node has a mixture of m children about its own centre. The points of a node are its members. A point
may be a member of several nodes, with a share of its weight in each. Members are packed in blocks of one
node, so that all nodes are one batch of small matrix products, for any numbers of members. Coordinates
relative to the node's centre keep enough digits in float32.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels import chunk_elements
from gmmtorch.linalg import eigen, unpack_symmetric
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em.by_type import Factors
from gmmtorch.mixture.em.exact import SOFTMAX_DTYPES, Parameters, feature_dimension, natural_parameters
from gmmtorch.mixture.em.truncated import Rows, group_rows, sums_of_blocks

if TYPE_CHECKING:
    from gmmtorch.mixture.estimators.hierarchical import DensityLimit
    from gmmtorch.mixture.estimators.hierarchical import HierarchicalGaussianMixture as Rule

_WORST_ROUNDING = 0.02  # nats per point of float32 error above which float64 is used
_SHORTLIST = 3  # nodes that are fully fitted, per node that the limit of leaves allows to split
_TRIAL_ITERATIONS = 2
_LEAST_SHARE = 1e-30  # smaller shares of the largest responsibility are treated as zero
_MOST_FEATURES = 1 << 23  # numbers; above, features are made again in each pass
_ROUNDINGS = 10.0  # variances below this number of roundings of squared distances are noise


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
    """Nodes of a level, with their place in the tree.

    own: (G,) Σ p log N(x) over a node's members, nats. bound: (G,) Σ p log(π N(x)/q), q the shares of the
    points: the node's part of the lower bound of the whole cloud.
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


def grow(
    points: Tensor,
    weight: Tensor,
    rule: Rule,
    on_iteration: Callable[[int, float], None] | None = None,
    density: DensityLimit | None = None,
) -> tuple[Tree, list[float], bool]:
    """Grow the tree of centred points (N, D) with weights (N,) above zero, float64.

    Also returns the lower bounds of the mean log-likelihood, nats, and whether EM converged in all nodes.

    Args:
        rule: an estimator; its parameters say when a node is split, and how children are fitted.
        on_iteration: called with the EM iteration, from 1, and the lower bound, nats per point.
        density: removes sparse children before the points are assigned to them.
    """
    nodes, members = _root(points, weight, rule.reg_covar)
    root, score, n_leaves, converged = nodes, nodes.bound.sum(), 1, True
    bounds: list[float] = []
    levels: list[Tree] = []

    def report(rest: Tensor, values: Tensor) -> None:
        bounds.append(float((rest + values.sum()) / weight.sum()))
        if on_iteration is not None:
            on_iteration(len(bounds), bounds[-1])

    nothing = torch.zeros_like(score)
    report(nothing, score)
    for _ in range(rule.max_levels):
        free = math.inf if rule.n_components is None else rule.n_components - n_leaves
        if free < 1:
            break
        m = int(min(rule.branching, free + 1))
        variance = torch.linalg.eigvalsh(nodes.parameters.covariances)
        flat = variance[:, 0] < rule.planarity_threshold * variance.sum(1)  # (2.9)
        flat |= variance[:, 0] < rule.thickness**2
        heavy = members.mass(nodes.n) >= 2 * rule.min_support
        chosen = (~flat & heavy).nonzero().squeeze(1)
        members, nodes = members.select(chosen, nodes.n), nodes.select(chosen)
        if nodes.n * (m - 1) > free:
            chosen = _shortlist(points, members, nodes, m, free, rule)
            members, nodes = members.select(chosen, nodes.n), nodes.select(chosen)
        if nodes.n == 0:
            break
        on_values = functools.partial(report, score - nodes.own.sum())
        children, assignment, gain, finished = _split(points, members, nodes, m, rule, on_values, density)
        accepted = _accepted_splits(children, gain, members.mass(nodes.n), free, rule)
        score = score - nodes.bound[accepted].sum()
        n_before = sum(len(level.parents) for level in levels)
        nodes, members, level = _build_children(children, assignment, nodes, accepted, weight, n_before)
        levels.append(level)
        score = score + nodes.bound.sum()
        n_leaves += nodes.n - int(accepted.sum())
        converged &= finished
        report(nothing, score)
    levels = levels if n_leaves > 1 else [Tree(root.place, *root.parameters)]
    return Tree(*(torch.cat(values) for values in zip(*levels, strict=True))), bounds, converged


def _root(points: Tensor, weight: Tensor, reg_covar: float) -> tuple[Nodes, Members]:
    """The whole cloud as one Gaussian, with every point as its member."""
    total = weight.sum()
    mean = (weight[:, None] * points).sum(0) / total
    offset = points - mean
    covariance = (weight[:, None] * offset).T @ offset / total
    covariance.diagonal().add_(reg_covar)
    root = Parameters(torch.ones_like(total)[None], mean[None], covariance[None])
    own = (Factors(root, "full").direct()(points)[0] @ weight)[None]
    index = torch.arange(points.shape[0], device=points.device)
    return Nodes(index.new_tensor([-1]), root, own, own), Members(index, torch.zeros_like(index), weight)


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


def _split(
    points: Tensor,
    members: Members,
    nodes: Nodes,
    m: int,
    rule: Rule,
    on_values: Callable[[Tensor], None],
    density: DensityLimit | None,
) -> tuple[Children, Assignment, Tensor, bool]:
    """At most m children in each node; the nodes' members assigned to them; whether EM converged.

    Third, what the splits gain (G,), nats, before pruning by density: points that fit no surface would
    otherwise prevent splits.
    """
    centers, mass = nodes.parameters.means, members.mass(nodes.n)
    packed, children, converged = fit_children(points, members, centers, m, rule, on_values)
    children = keep_children(children, children.weights * mass[:, None] >= rule.min_support)
    assignment = assign_members(packed, children, members, rule.soft_threshold)
    gain = assignment[2] - nodes.own
    if density is not None:
        children = density.drop_sparse_children(children, centers, assignment[0])
        assignment = assign_members(packed, children, members, rule.soft_threshold)
    return children, assignment, gain, converged


def _accepted_splits(children: Children, gain: Tensor, mass: Tensor, free: float, rule: Rule) -> Tensor:
    """Mask (G,) of nodes whose split gains enough; if these exceed the limit of leaves, the best of them."""
    added = (children.weights > 0).sum(1) - 1
    dim = children.means.shape[2]
    n_parameters = added * (1 + dim + dim * (dim + 1) // 2)
    accepted = (added > 0) & (gain > rule.tol * mass) & (gain >= rule.min_gain * n_parameters)
    if int(added[accepted].sum()) > free:
        priority = torch.where(accepted, gain / added.clamp_min(1), -torch.inf)
        order = priority.argsort(descending=True, stable=True)
        accepted[order] &= torch.cumsum(added[order], 0) <= free
    return accepted


def _build_children(
    children: Children, assignment: Assignment, nodes: Nodes, accepted: Tensor, weight: Tensor, n_before: int
) -> tuple[Nodes, Members, Tree]:
    """The children of the accepted nodes, their members, and the new level of the tree.

    weight: (N,) of the points. n_before: number of nodes in earlier levels.
    """
    (members, log_density, _), m = assignment, children.weights.shape[1]
    chosen = ((children.weights > 0) & accepted[:, None]).flatten().nonzero().squeeze(1)
    parents = nodes.parameters
    parent = chosen // m
    local = children.flat()
    path_weights = (parents.weights[:, None] * children.weights).flatten()
    parameters = Parameters(
        path_weights[chosen], parents.means[parent] + local.means[chosen], local.covariances[chosen]
    )
    p, child = members.weight, members.node
    own = torch.zeros_like(path_weights).index_add_(0, child, p * log_density)
    shared = p * path_weights.log()[child] - torch.xlogy(p, p / weight[members.point])
    bound = own.index_add(0, child, shared)
    place = n_before + torch.arange(chosen.shape[0], device=chosen.device)
    return (
        Nodes(place, parameters, own[chosen], bound[chosen]),
        members.select(chosen, path_weights.shape[0]),
        Tree(nodes.place[parent], *parameters),
    )


class Members(NamedTuple):
    """Assignment of points to nodes, in no order: point (R,), node (R,), weight (R,) float64."""

    point: Tensor
    node: Tensor
    weight: Tensor

    def select(self, nodes: Tensor, n_nodes: int) -> Members:
        """The members of some `nodes` (G,) of `n_nodes`, which are renumbered from 0."""
        number = torch.full((n_nodes,), -1, dtype=torch.int64, device=nodes.device)
        number[nodes] = torch.arange(nodes.shape[0], device=nodes.device)
        new = number.index_select(0, self.node)
        kept = (new >= 0).nonzero().squeeze(1)
        return Members(*(value.index_select(0, kept) for value in (self.point, new, self.weight)))

    def mass(self, n_nodes: int) -> Tensor:
        """Weight of each node, (n_nodes,)."""
        return self.weight.new_zeros(n_nodes).index_add_(0, self.node, self.weight)


class Packed(NamedTuple):
    """Members in blocks of B of one node. Members of weight 0 fill incomplete blocks.

    values: (b, F, B) features relative to the node's centre; the points (b, D, B) if their features
    would need much memory. weight: (b, B). node: (b,) of each block. member: (b, B) index of the
    member in each place, −1 if the place is empty. dim: D.
    """

    values: Tensor
    weight: Tensor
    node: Tensor
    member: Tensor
    dim: int

    def select(self, kept: Tensor) -> Packed:
        """The blocks of the nodes in the mask `kept` (G,), which are renumbered from 0."""
        blocks = kept[self.node].nonzero().squeeze(1)
        values, weight, node, member = (value.index_select(0, blocks) for value in self[:4])
        return Packed(values, weight, (torch.cumsum(kept.long(), 0) - 1)[node], member, self.dim)

    def chunks(self, n_children: int) -> Iterator[tuple[slice, Tensor, Tensor, Tensor]]:
        """Slices of blocks, and their features, weight and node, small enough for the cache."""
        are_points = self.values.shape[1] == self.dim
        width = max(n_children, self.dim**2 // 8 if are_points else 0)
        step = max(1, chunk_elements(self.weight.device) // (self.weight.shape[1] * width))
        for begin in range(0, self.node.shape[0], step):
            part = slice(begin, begin + step)
            x = self.values[part]
            if are_points:  # `exact.quadratic_features` in another layout
                squares = [x[:, i : i + 1] * x[:, i:] for i in range(self.dim)]
                x = torch.cat([torch.ones_like(x[:, :1]), x, *squares], 1)
            yield part, x, self.weight[part], self.node[part]


def pack(points: Tensor, members: Members, centers: Tensor, dtype: torch.dtype) -> Packed:
    """Pack members of points (N, D) relative to the centres (G, D) of their nodes, in `dtype`."""
    rows = Rows(points.index_select(0, members.point), members.weight, are_points=True)
    dim = points.shape[1]
    many = dim > 3 and members.weight.shape[0] * dim * (dim + 1) // 2 > _MOST_FEATURES
    groups = group_rows(rows, members.node, centers, dtype, as_points=many)
    member = torch.full((groups.weight.numel(),), -1, dtype=torch.int64, device=points.device)
    member[groups.slot] = groups.row
    # With members along the rows, the products run twice as fast.
    values = groups.features.transpose(1, 2).contiguous()
    return Packed(values, groups.weight, groups.owner, member.view_as(groups.weight), dim)


class Children(NamedTuple):
    """Mixtures of m children in each of G nodes; weights add up to one in each node.

    weights: (G, m), 0 for an absent child. means: (G, m, D) relative to the node's centre. covariances:
    (G, m, D, D).
    """

    weights: Tensor
    means: Tensor
    covariances: Tensor

    def flat(self) -> Parameters:
        """All children as one list, (G·m, …)."""
        return Parameters(self.weights.flatten(), self.means.flatten(0, 1), self.covariances.flatten(0, 1))

    def natural(self, dtype: torch.dtype) -> Tensor:
        """Natural parameters (G, m, F)."""
        return natural_parameters(self.flat()).view(*self.weights.shape, -1).to(dtype)


def expectation(packed: Packed, children: Children) -> tuple[Tensor, Tensor]:
    """The E-step in all nodes: statistics (G, m, F) and Σ p log Σ_children (G,), float64."""
    n_nodes, m = children.weights.shape
    natural = children.natural(packed.values.dtype)
    sums = natural.new_zeros(n_nodes, m * natural.shape[2], dtype=torch.float64)
    value = natural.new_zeros(n_nodes, dtype=torch.float64)
    for _, features, weight, node in packed.chunks(m):
        of_blocks, values = sums_of_blocks(natural.index_select(0, node), features, weight)
        # Summed in float64, so that rounding errors average out over the blocks of a large node.
        sums.index_add_(0, node, of_blocks.double())
        value.index_add_(0, node, values)
    return sums.view_as(natural), value


def maximization(
    statistics: Tensor, reg_covar: float, dtype: torch.dtype, previous: Children | None = None
) -> tuple[Children, float]:
    """The M-step in all nodes, from statistics (G, m, F) of features in `dtype`.

    Also returns the error of the next E-step, nats per point: ε/2 E[‖x‖²]/λ_min. Variances below the
    rounding error are raised to it.
    """
    n_nodes, m, n_features = statistics.shape
    dim = feature_dimension(n_features)
    sums = statistics.flatten(0, 1)
    new = em.maximization(sums, reg_covar, None if previous is None else previous.flat())
    count = torch.where(new.weights > 0, sums[:, 0], 0.0)
    square = unpack_symmetric(sums[:, 1 + dim :], dim).diagonal(dim1=1, dim2=2).sum(1)
    square = square / sums[:, 0].clamp_min(1e-300)
    eps = torch.finfo(dtype).eps
    thinnest = torch.linalg.eigvalsh(new.covariances)[:, 0]
    least = torch.where(count > 0, (_ROUNDINGS * eps * square).clamp_min(reg_covar), 1.0)
    new.covariances.diagonal(dim1=1, dim2=2).add_((least - thinnest).clamp_min(0)[:, None])
    error = eps / 2 * (count * square / torch.maximum(thinnest, least).clamp_min(1e-300)).sum() / count.sum()
    weights = count.view(n_nodes, m)
    children = Children(
        weights / weights.sum(1, keepdim=True),
        new.means.view(n_nodes, m, dim),
        new.covariances.view(n_nodes, m, dim, dim),
    )
    return children, float(error)


def principal_axes_start(packed: Packed, n_nodes: int, n_children: int, reg_covar: float) -> Children:
    """Start of EM: each node's members are cut into at most m pieces, with one component per piece.

    Pieces are halved at their mean across their longest direction, those with the largest scatter first,
    while they are longer than `reg_covar` (m²) resolves. The result is deterministic and does not depend
    on the frame. A node with fewer distinct places than m gets children of weight 0.
    """
    label = torch.zeros_like(packed.member)
    n_pieces = 1
    dtype, dim = packed.values.dtype, packed.dim
    while n_pieces < n_children:
        statistics = _pool(packed, label, n_nodes, n_pieces)
        count = statistics[..., 0]
        means = statistics[..., 1 : 1 + dim] / count[..., None].clamp_min(1e-300)
        second = unpack_symmetric(statistics[..., 1 + dim :] / count[..., None].clamp_min(1e-300), dim)
        variances, axes = eigen(second - means[..., :, None] * means[..., None, :])
        longest, across = variances[..., -1], axes[..., -1]
        scatter = torch.where(longest > reg_covar, count * longest, 0.0)
        n_new = min(n_pieces, n_children - n_pieces)
        rank = scatter.argsort(dim=1, descending=True, stable=True).argsort(dim=1)
        own = torch.arange(n_pieces, device=rank.device).expand_as(rank)
        other_half = torch.where((rank < n_new) & (scatter > 0), n_pieces + rank, own)
        plane = torch.cat([-(across * means).sum(-1, keepdim=True), across], -1).to(dtype)
        for part, features, _, node in packed.chunks(n_pieces):
            place = label[part, None]
            along = torch.bmm(plane.index_select(0, node), features[:, : 1 + dim]).gather(1, place)
            cut = other_half.index_select(0, node).gather(1, label[part])
            label[part] = torch.where(along[:, 0] > 0, cut, label[part])
        n_pieces += n_new
    return maximization(_pool(packed, label, n_nodes, n_children), reg_covar, dtype)[0]


def _pool(packed: Packed, label: Tensor, n_nodes: int, n_pieces: int) -> Tensor:
    """Statistics (G, n, F) of the pieces that the labels (b, B) of members define in each node."""
    n_features = 1 + packed.dim + packed.dim * (packed.dim + 1) // 2
    sums = packed.weight.new_zeros(n_nodes, n_pieces * n_features, dtype=torch.float64)
    piece = torch.arange(n_pieces, device=label.device)[:, None]
    for part, features, weight, node in packed.chunks(n_pieces):
        share = torch.where(label[part, None] == piece, weight[:, None], 0.0)
        sums.index_add_(0, node, torch.bmm(share, features.transpose(1, 2)).flatten(1).double())
    return sums.view(n_nodes, n_pieces, n_features)


def fit_children(
    points: Tensor, members: Members, centers: Tensor, m: int, rule: Rule, on_values: Callable[[Tensor], None]
) -> tuple[Packed, Children, bool]:
    """EM of m children in each node until its mean log-likelihood increases by less than `rule.tol` nats.

    Returns the packed members, the children, and whether EM converged in all nodes. If the error of float32
    becomes too large, EM goes on in float64. `on_values` gets Σ p log Σ_children (G,) before each M-step.
    """
    mass, dtype, left = members.mass(len(centers)), SOFTMAX_DTYPES[rule.dtype], rule.max_iter
    children: Children | None = None
    while True:
        packed = whole = pack(points, members, centers, dtype)
        if children is None:
            children = principal_axes_start(packed, len(centers), m, rule.reg_covar)
        value = torch.full_like(mass, -torch.inf)
        active = torch.arange(mass.shape[0], device=mass.device)
        for _ in range(max(1, left)):
            left -= 1
            part = Children(*(values[active] for values in children))
            statistics, found = expectation(packed, part)
            part, error = maximization(statistics, rule.reg_covar, dtype, part)
            for values, new in zip(children, part, strict=True):
                values[active] = new
            going_on = found - value[active] >= rule.tol * mass[active]
            value[active] = found
            on_values(value)
            if not bool(going_on.any()):
                return whole, children, True
            if dtype == torch.float32 and error > _WORST_ROUNDING:
                break
            if not bool(going_on.all()):
                packed, active = packed.select(going_on), active[going_on]
        else:
            return whole, children, False
        dtype = torch.float64


def keep_children(children: Children, kept: Tensor) -> Children:
    """Set children outside of the mask (G, m) to weight 0, in favour of their siblings.

    A node without a child in the mask keeps its largest one.
    """
    kept = kept & (children.weights > 0)
    largest = children.weights == children.weights.amax(1, keepdim=True)
    weights = torch.where(torch.where(kept.any(1, keepdim=True), kept, largest), children.weights, 0.0)
    return children._replace(weights=weights / weights.sum(1, keepdim=True))


Assignment = tuple[Members, Tensor, Tensor]
"""The members of children, which are numbered node · m + child; their log-densities (R,) there, nats; and
Σ p log Σ_children (G,) of the nodes."""


def assign_members(packed: Packed, children: Children, members: Members, soft_threshold: float) -> Assignment:
    """Assign the members of each node to its children (2.7): to each child j with γ_j > λ max γ.

    The most likely child is always included. The children share the member's whole weight in proportion
    to γ (2.8).
    """
    m = children.weights.shape[1]
    natural = children.natural(packed.values.dtype)
    log_weight = children.weights.log().flatten()
    floor = em.exponent_floor(natural.dtype)
    value = torch.zeros_like(children.weights[:, 0])
    least = max(soft_threshold, _LEAST_SHARE)
    found: list[tuple[Tensor, ...]] = []
    for part, features, weight, node in packed.chunks(m):
        joint = torch.bmm(natural.index_select(0, node), features)
        peak = joint.amax(1, keepdim=True)
        gamma = (joint - peak).clamp_(min=floor).exp_()
        value.index_add_(0, node, (weight * (peak[:, 0] + gamma.sum(1).log())).sum(1).double())
        kept = ((gamma > least) | (gamma == 1)) & (packed.member[part] >= 0)[:, None]
        gamma = (gamma * kept).double()
        gamma /= gamma.sum(1, keepdim=True)
        block, child, place = kept.nonzero(as_tuple=True)
        where = (block, child, place)
        found.append((packed.member[part][block, place], node[block] * m + child, gamma[where], joint[where]))
    member, child, share, log_joint = (torch.cat(values) for values in zip(*found, strict=True))
    assigned = Members(members.point[member], child, members.weight[member] * share)
    return assigned, log_joint.double() - log_weight[child], value
