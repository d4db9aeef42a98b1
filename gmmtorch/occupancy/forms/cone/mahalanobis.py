"""Geometry of cells and faces in a component's whitened frame, where the component is a unit ball.

Coordinates come first, (D, P) for P pairs of a cell or face and a cone, edges (E, D, P).
"""

from __future__ import annotations

import torch
from torch import Tensor


def dot(a: Tensor, b: Tensor) -> Tensor:
    """a·b over coordinates: (…, D, P) → (…, P)."""
    return (a * b).sum(-2)


def cross(a: Tensor, b: Tensor) -> Tensor:
    """a × b: (…, 3, P) in 3D, (…, 1, P) in 2D; its length is that of the part of a across b, times |b|."""
    if a.shape[-2] == 2:
        return (a[..., 0, :] * b[..., 1, :] - a[..., 1, :] * b[..., 0, :])[..., None, :]
    a, b = torch.broadcast_tensors(a, b)
    return torch.linalg.cross(a, b, dim=-2)


def length(a: Tensor) -> Tensor:
    """|a| over coordinates: (…, D, P) → (…, P)."""
    return dot(a, a).sqrt()  # far quicker than norm over a leading dimension


def outside_cone(ray: Tensor, offset: Tensor, edges: Tensor, cutoff: float) -> Tensor:
    """Cells or faces (P,) that certainly lie outside a cone cut off at `cutoff` deviations.

    A place q is outside where its ray from the sensor s passes the mean μ at more than `cutoff`, or
    where q lies farther than that behind the ray's nearest point. Both are bounded from below over
    centre + Σ f_i edge_i, |f_i| ≤ ½. Never true of one that is reached; not always of one that is not.

    Args:
        ray, offset: W(q − s) and W(q − μ) of the centres, (D, P).
        edges: whitened, (E, D, P).
    """
    reach = 0.5 * length(edges).sum(0)
    mean = ray - offset
    across = length(cross(offset, ray)) - 0.5 * length(cross(edges, mean[None])).sum(0)
    behind = dot(offset, ray) - 0.5 * dot(edges, (offset + ray)[None]).abs().sum(0)
    far = cutoff * (length(ray) + reach)
    return (across > far) | (behind > far)


def outside_ball(offset: Tensor, edges: Tensor, cutoff: float) -> Tensor:
    """Cells (P,) that certainly lie farther than `cutoff` deviations from the mean; arguments as above."""
    distance = length(offset)
    along = dot(edges, offset[None] / distance.clamp_min(1e-30)).abs().sum(0)
    return distance - 0.5 * along > cutoff


def square_on(monomials: Tensor, start: Tensor, edges: Tensor) -> Tensor:
    """|start + Σ f_i edge_i|² at the nodes f of a rule, given their monomials: (n, P)."""
    terms = [dot(start, start), *(2 * dot(start, edge) for edge in edges)]
    for i, edge in enumerate(edges):
        terms += [dot(edge, edge), *(2 * dot(edge, other) for other in edges[i + 1 :])]
    return monomials @ torch.stack(terms)


def product_on(monomials: Tensor, a: Tensor, b: Tensor, edges: Tensor) -> Tensor:
    """(a + Σ f_i edge_i)·(b + Σ f_i edge_i) at the nodes: (n, P)."""
    both = a + b
    terms = [dot(a, b), *(dot(both, edge) for edge in edges)]
    for i, edge in enumerate(edges):
        terms += [dot(edge, edge), *(2 * dot(edge, other) for other in edges[i + 1 :])]
    return monomials @ torch.stack(terms)


def linear_on(monomials: Tensor, start: Tensor, edges: Tensor, vector: Tensor) -> Tensor:
    """(start + Σ f_i edge_i)·vector at the nodes: (n, P)."""
    terms = [dot(start, vector), *(dot(edge, vector) for edge in edges)]
    return monomials[:, : len(terms)] @ torch.stack(terms)
