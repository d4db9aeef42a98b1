"""Pose graph: the poses that agree best with measured motions between them.

With poses T_i, world ← sensor, and edges (i, j) with a measured motion Z_ij (i ← j) and covariance Σ_ij,

    minimise Σ_edges ρ(e_ijᵀ Σ_ij⁻¹ e_ij),   e_ij = Log(Z_ij⁻¹ T_i⁻¹ T_j),   T_0 fixed,

by Gauss–Newton steps on SE(3) or SE(2) with a sparse factorisation (Grisetti et al. 2010). ρ is the square
for edges of odometry and Geman–McClure's function, ρ(s) = s / (1 + s/c²), for loop closures, so that a wrong
closure loses its weight. The closures start with a wide c, which narrows (graduated non-convexity, Yang et
al. 2020).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.pose import Pose, skew

_SETTLED = 1e-7  # metres and radians: a smaller step ends the optimisation
_MOST_STEPS = 100
_FIRST_SCALE = 1e3  # deviations c² of closures that are far off are forgiven at first
_NARROWING = 0.5  # of c at each step
_COLUMNS = 256  # of the inverse at a time


class Edges(NamedTuple):
    """E measured motions: source, target (E,); motions (E), source ← target; information (E, F, F), the
    inverse covariance of a shift (m) and a turn (rad) in the frame of the target; and whether an edge is a
    closure (E,), which may be wrong."""

    source: Tensor
    target: Tensor
    motions: Pose
    information: Tensor
    is_closure: Tensor

    def joined(self, others: Edges) -> Edges:
        return Edges(
            torch.cat([self.source, others.source]),
            torch.cat([self.target, others.target]),
            Pose.cat([self.motions, others.motions]),
            torch.cat([self.information, others.information]),
            torch.cat([self.is_closure, others.is_closure]),
        )

    def at(self, rows: Tensor) -> Edges:
        source, target, motions, information, is_closure = self
        return Edges(source[rows], target[rows], motions[rows], information[rows], is_closure[rows])


class OptimisedPoses(NamedTuple):
    """Poses (N), world ← sensor; covariances (N, F, F) of a shift (m) and a turn (rad) in the frame of the
    sensor, zero for the first pose, NaN if they were not asked for; weight (E,) of each edge, near 0 for a
    rejected closure; and whether the last step was small."""

    poses: Pose
    covariances: Tensor
    weights: Tensor
    converged: bool


def optimised(poses: Pose, edges: Edges, scale: float = 3.0, with_covariances: bool = True) -> OptimisedPoses:
    """The poses (N) that agree best with the edges, from a first guess; the first one stays.

    scale: deviations c at which a closure loses most of its weight. with_covariances: their time is
    proportional to N².

    Raises `InvalidArgumentError` if an edge names a pose that does not exist, or if the edges do not connect
    all poses.
    """
    n, free = len(poses), edges.information.shape[1]
    _check(n, edges)
    if n == 1:
        return OptimisedPoses(poses, torch.zeros(1, free, free).double(), torch.ones(0).double(), True)
    wide, step = scale * _FIRST_SCALE**0.5, torch.full((1,), torch.inf)
    for _ in range(_MOST_STEPS):
        weights = _weights(poses, edges, max(wide, scale))
        hessian, gradient = _normal_equations(poses, edges, weights)
        step = torch.from_numpy(splu(hessian).solve(-gradient)).view(n - 1, free)
        poses = Pose.cat([poses[:1], _moved(poses[1:], step)])
        if float(step.abs().max()) < _SETTLED and wide <= scale:
            break
        wide *= _NARROWING
    weights = _weights(poses, edges, scale)
    converged = float(step.abs().max()) < _SETTLED
    if not with_covariances:
        return OptimisedPoses(poses, torch.full((n, free, free), torch.nan).double(), weights, converged)
    hessian, _ = _normal_equations(poses, edges, weights)
    return OptimisedPoses(poses, _marginals(hessian, n, free), weights, converged)


def residuals(poses: Pose, edges: Edges) -> Tensor:
    """e_ij (E, F) of the edges: a shift (m) and a turn (rad)."""
    between = poses[edges.source].inverse() @ poses[edges.target]
    return (edges.motions.inverse() @ between).log()


def _check(n: int, edges: Edges) -> None:
    ends = torch.cat([edges.source, edges.target])
    if len(ends) and not (int(ends.min()) >= 0 and int(ends.max()) < n):
        raise InvalidArgumentError(f"edges name pose {int(ends.max())}, but there are {n} poses.")
    links = coo_matrix(
        (np.ones(len(edges.source)), (edges.source.numpy(), edges.target.numpy())), shape=(n, n)
    )
    _, part = connected_components(links, directed=False)
    apart = np.flatnonzero(part != part[0])
    if len(apart):
        raise InvalidArgumentError(f"edges do not connect pose {apart[0]} with the first one; add an edge.")


def _weights(poses: Pose, edges: Edges, scale: float) -> Tensor:
    """Of each edge (E,): ρ′ of its square error."""
    error = residuals(poses, edges)
    square = torch.einsum("ei,eij,ej->e", error, edges.information, error)
    return torch.where(edges.is_closure, (1 + square / scale**2).reciprocal().square(), 1.0)


def _normal_equations(poses: Pose, edges: Edges, weights: Tensor) -> tuple[csc_matrix, np.ndarray]:
    """The Gauss–Newton Hessian and the gradient for steps of all poses but the first one, in their frames.

    With T_i ← T_i Exp(x_i) and the error's rotation R and turn φ: ∂e/∂x_j = diag(R, J_r(φ)⁻¹) and
    ∂e/∂x_i = −∂e/∂x_j Ad(T_j⁻¹ T_i).
    """
    n, free = len(poses), edges.information.shape[1]
    between = poses[edges.source].inverse() @ poses[edges.target]
    off = edges.motions.inverse() @ between
    error = off.log()
    after = torch.zeros(len(error), free, free).to(error)
    after[:, : poses.dim, : poses.dim] = off.rotation
    after[:, poses.dim :, poses.dim :] = _turn_jacobian(error[:, poses.dim :])
    before = -after @ between.inverse().adjoint()
    information = weights[:, None, None] * edges.information
    rows, columns, values = [], [], []
    gradient = torch.zeros(n, free, dtype=torch.float64)
    ends = ((edges.source, before), (edges.target, after))
    place = torch.arange(free)
    for at, jacobian in ends:
        weighted = jacobian.mT @ information
        gradient.index_add_(0, at, (weighted @ error[:, :, None])[:, :, 0])
        for other, other_jacobian in ends:
            block = weighted @ other_jacobian
            rows.append((at[:, None, None] * free + place[:, None]).expand_as(block).flatten())
            columns.append((other[:, None, None] * free + place).expand_as(block).flatten())
            values.append(block.flatten())
    index = torch.cat(rows).numpy(), torch.cat(columns).numpy()
    hessian = coo_matrix((torch.cat(values).numpy(), index), shape=(n * free, n * free)).tocsc()
    return hessian[free:, free:], gradient.flatten()[free:].numpy()


def _turn_jacobian(turn: Tensor) -> Tensor:
    """J_r(φ)⁻¹ of turns φ (E, 1 or 3), rad: I + φ^/2 + (1 − α/2 · cot(α/2)) φ^²/α², with α = |φ| (Sola et al.
    2018, equation 144)."""
    eye = torch.eye(turn.shape[1]).to(turn)
    if len(eye) == 1:
        return eye.expand(len(turn), 1, 1)
    half = turn.norm(dim=1).clamp_min(1e-4)[:, None, None] / 2
    cross = skew(turn)
    return eye + cross / 2 + (1 - half / half.tan()) / (4 * half.square()) * cross @ cross


def _marginals(hessian: csc_matrix, n: int, free: int) -> Tensor:
    """Covariances (N, F, F): the diagonal blocks of the inverse; zero for the first pose."""
    factor, size = splu(hessian), (n - 1) * free
    found = np.zeros((n, free, free))
    width = _COLUMNS // free * free
    for begin in range(0, size, width):
        end = min(begin + width, size)
        columns = np.zeros((size, end - begin))
        columns[np.arange(begin, end), np.arange(end - begin)] = 1
        part = factor.solve(columns)[begin:end]
        for block in range((end - begin) // free):
            at = slice(block * free, (block + 1) * free)
            found[1 + begin // free + block] = part[at, at]
    covariances = torch.from_numpy(found)
    return (covariances + covariances.mT) / 2


def _moved(poses: Pose, steps: Tensor) -> Pose:
    """Poses (N) moved by steps (N, F), a shift and a turn in their own frames."""
    return poses @ Pose.from_turn(steps[:, poses.dim :], steps[:, : poses.dim])
