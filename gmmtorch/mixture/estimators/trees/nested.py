"""Nested mixtures: EM in every node of a level as one batch, and the assignment of points to children (2.7).

Each node has a mixture of m children about its own centre. The points of a node are its members. A point
may be a member of several nodes, with a share of its weight in each. Members are packed in blocks of one
node, so that all nodes are one batch of small matrix products, for any numbers of members. Coordinates
relative to the node's centre keep enough digits in float32.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels import chunk_elements
from gmmtorch.linalg import unpack_symmetric
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em.exact import Parameters, feature_dimension, natural_parameters
from gmmtorch.mixture.em.grouping import Rows, group_rows

_LEAST_SHARE = 1e-30  # smaller shares of the largest responsibility are treated as zero
_ROUNDINGS = 10.0  # variances below this number of roundings of squared distances are noise


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

    features: (b, F, B) relative to the node's centre. weight: (b, B). node: (b,) of each block. member:
    (b, B) index of the member in each place, −1 if the place is empty.
    """

    features: Tensor
    weight: Tensor
    node: Tensor
    member: Tensor

    def select(self, kept: Tensor) -> Packed:
        """The blocks of the nodes in the mask `kept` (G,), which are renumbered from 0."""
        blocks = kept[self.node].nonzero().squeeze(1)
        features, weight, node, member = (value.index_select(0, blocks) for value in self)
        return Packed(features, weight, (torch.cumsum(kept.long(), 0) - 1)[node], member)

    def chunks(self, n_children: int) -> Iterator[tuple[slice, Tensor, Tensor, Tensor]]:
        """Slices of blocks, and their features, weight and node, small enough for the cache."""
        step = max(1, chunk_elements(self.weight.device) // (self.weight.shape[1] * n_children))
        for begin in range(0, self.node.shape[0], step):
            part = slice(begin, begin + step)
            yield part, self.features[part], self.weight[part], self.node[part]


def pack(points: Tensor, members: Members, centers: Tensor, dtype: torch.dtype) -> Packed:
    """Pack members of points (N, D) relative to the centres (G, D) of their nodes, in `dtype`."""
    rows = Rows(points.index_select(0, members.point), members.weight, are_points=True)
    groups = group_rows(rows, members.node, centers, dtype)
    member = torch.full((groups.weight.numel(),), -1, dtype=torch.int64, device=points.device)
    member[groups.slot] = groups.row
    # With members along the rows, the products run twice as fast.
    features = groups.features.transpose(1, 2).contiguous()
    return Packed(features, groups.weight, groups.owner, member.view_as(groups.weight))


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

    def select(self, nodes: Tensor) -> Children:
        return Children(*(value[nodes] for value in self))

    def natural(self, dtype: torch.dtype) -> Tensor:
        """Natural parameters (G, m, F)."""
        return natural_parameters(self.flat()).view(*self.weights.shape, -1).to(dtype)


def expectation(packed: Packed, children: Children) -> tuple[Tensor, Tensor]:
    """The E-step in all nodes: statistics (G, m, F) and Σ p log Σ_children (G,), float64."""
    n_nodes, m = children.weights.shape
    dtype, n_features = packed.features.dtype, packed.features.shape[1]
    natural, floor = children.natural(dtype), em.exponent_floor(dtype)
    sums = natural.new_zeros(n_nodes, m * n_features, dtype=torch.float64)
    value = natural.new_zeros(n_nodes, dtype=torch.float64)
    for _, features, weight, node in packed.chunks(m):
        gamma = torch.bmm(natural.index_select(0, node), features)  # (b, m, B)
        peak = gamma.amax(1, keepdim=True)
        norm = gamma.sub_(peak).clamp_(min=floor).exp_().sum(1)
        value.index_add_(0, node, (weight * (peak[:, 0] + norm.log())).sum(1).double())
        gamma.mul_((weight / norm)[:, None])
        # Summed in float64, so that rounding errors average out over the blocks of a large node.
        sums.index_add_(0, node, torch.bmm(gamma, features.transpose(1, 2)).flatten(1).double())
    return sums.view(n_nodes, m, n_features), value


def maximization(
    statistics: Tensor, reg_covar: float, dtype: torch.dtype, previous: Children | None = None
) -> tuple[Children, float]:
    """The M-step in all nodes, from statistics (G, m, F) of features in `dtype`.

    Also returns the mean error of that dtype in the next E-step, nats per point: ε/2 E[‖x‖²]/λ_min.
    Variances below the rounding error are raised to it.
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


# -- start of EM ----------------------------------------------------------------------------------


def principal_axes_start(packed: Packed, n_nodes: int, n_children: int, reg_covar: float) -> Children:
    """Start of EM: each node's members are cut into at most m pieces, with one component per piece.

    Pieces are halved at their mean across their longest direction, those with the largest scatter first,
    while they are longer than `reg_covar` (m²) resolves. The result is deterministic and does not depend
    on the frame. A node with fewer distinct places than m gets children of weight 0.
    """
    label = torch.zeros_like(packed.member)
    n_pieces = 1
    dtype = packed.features.dtype
    dim = feature_dimension(packed.features.shape[1])
    while n_pieces < n_children:
        statistics = _pool(packed, label, n_nodes, n_pieces)
        count = statistics[..., 0]
        means = statistics[..., 1 : 1 + dim] / count[..., None].clamp_min(1e-300)
        second = unpack_symmetric(statistics[..., 1 + dim :] / count[..., None].clamp_min(1e-300), dim)
        variances, axes = torch.linalg.eigh(second - means[..., :, None] * means[..., None, :])
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
    n_features = packed.features.shape[1]
    sums = packed.weight.new_zeros(n_nodes, n_pieces * n_features, dtype=torch.float64)
    piece = torch.arange(n_pieces, device=label.device)[:, None]
    for part, features, weight, node in packed.chunks(n_pieces):
        share = torch.where(label[part, None] == piece, weight[:, None], 0.0)
        sums.index_add_(0, node, torch.bmm(share, features.transpose(1, 2)).flatten(1).double())
    return sums.view(n_nodes, n_pieces, n_features)


# -- the loop -------------------------------------------------------------------------------------


class Fitted(NamedTuple):
    """Result of EM in nodes.

    children: of each node. converged: whether EM converged in all nodes. n_iter: EM iterations.
    is_coarse: whether EM stopped because its dtype is too coarse.
    """

    children: Children
    converged: bool
    n_iter: int
    is_coarse: bool


def run_em(
    packed: Packed,
    start: Children,
    mass: Tensor,
    *,
    reg_covar: float,
    tol: float,
    max_iter: int,
    worst_error: float,
    on_values: Callable[[Tensor], None],
) -> Fitted:
    """EM in each node until its own mean log-likelihood increases by less than `tol` nats.

    Args:
        packed: the members of G nodes.
        start: where EM starts.
        mass: (G,) weight of each node.
        reg_covar: added to each variance (m²).
        tol, max_iter: when EM stops.
        worst_error: EM stops if the error of its dtype is larger (nats per point).
        on_values: called with Σ p log Σ_children (G,) before each M-step.
    """
    children = Children(*(value.clone() for value in start))
    value = torch.full_like(mass, -torch.inf)
    active = torch.arange(mass.shape[0], device=mass.device)
    dtype = packed.features.dtype
    for iteration in range(1, max_iter + 1):
        part = children.select(active)
        statistics, found = expectation(packed, part)
        part, error = maximization(statistics, reg_covar, dtype, part)
        for whole, new in zip(children, part, strict=True):
            whole[active] = new
        going_on = found - value[active] >= tol * mass[active]
        value[active] = found
        on_values(value)
        converged = not bool(going_on.any())
        if converged or error > worst_error:
            return Fitted(children, converged, iteration, not converged)
        if not bool(going_on.all()):
            packed, active = packed.select(going_on), active[going_on]
    return Fitted(children, False, max_iter, False)


def keep_children(children: Children, kept: Tensor) -> Children:
    """Set children outside of the mask (G, m) to weight 0, in favour of their siblings.

    A node without a child in the mask keeps its largest one.
    """
    kept = kept & (children.weights > 0)
    largest = children.weights == children.weights.amax(1, keepdim=True)
    weights = torch.where(torch.where(kept.any(1, keepdim=True), kept, largest), children.weights, 0.0)
    return children._replace(weights=weights / weights.sum(1, keepdim=True))


# -- assignment of members to children ------------------------------------------------------------


class Assignment(NamedTuple):
    """Members of the children, which are numbered node · m + child.

    log_density: (R,) of each member at its child, nats. value: (G,) Σ p log Σ_children of the nodes.
    """

    members: Members
    log_density: Tensor
    value: Tensor


def assign_members(packed: Packed, children: Children, members: Members, soft_threshold: float) -> Assignment:
    """Assign the members of each node to its children (2.7): to each child j with γ_j > λ max γ.

    The most likely child is always included. The children share the member's whole weight in proportion
    to γ (2.8).
    """
    m = children.weights.shape[1]
    natural = children.natural(packed.features.dtype)
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
    return Assignment(
        Members(members.point[member], child, members.weight[member] * share),
        log_joint.double() - log_weight[child],
        value,
    )
