"""The surfaces of a map: the clearance of a robot's body from them, and its probability of touching a return.

The body is a ball, or a `Body` of balls.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.errors import InvalidArgumentError, MemoryLimitError, check_number
from gmmtorch.linalg import check_symmetric, safe_cholesky
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mixture import Parameters, checked_parameter
from gmmtorch.occupancy import check_queries, normal_mass

Surfaces = Components | GaussianMap | tuple[ArrayLike, ArrayLike, ArrayLike]
"""A map, its components, or (means (K, D), covariances (K, D, D), weights (K,))."""

MOST_PAIRS = 1 << 25
"""Largest number of touching balls that are listed at a time."""

_PORTION = 1 << 12  # balls searched at a time
_SMALLEST, _LARGEST_RATIO = 1e-12, 20  # octaves below the largest radius that are searched apart


def surface_mixture(given: Surfaces, name: str) -> Parameters:
    """Weights (supports in points), means and covariances of the surfaces of a map, float64.

    `max_range` components and components without weight are left out, so the mixture may be empty. Raises
    `InvalidArgumentError` for shapes that disagree, NaN, negative weights, or a dimension other than 2 or 3;
    `NumericalError` for a covariance that is not positive definite. `name`: of the argument, for messages.
    """
    if isinstance(given, GaussianMap):  # which has checked its components
        made = given.components() if given.dim is not None else Components.empty(3)
        kept = ~made.max_range & (made.support > 0)
        return Parameters(made.support[kept], made.means[kept], made.covariances[kept])
    if isinstance(given, Components):
        solid = ~given.max_range
        parts = given.means[solid], given.covariances[solid], given.support[solid]
    elif isinstance(given, tuple) and len(given) == 3:
        named = zip(given, ("means", "covariances", "weights"), strict=True)
        found = [as_tensor(part, f"{field} of {name}", torch.float64).detach() for part, field in named]
        parts = found[0], found[1], found[2]
    else:
        raise InvalidArgumentError(
            f"{name} is a {type(given).__name__}; give a GaussianMap, Components, or a tuple "
            "(means (K, D), covariances (K, D, D), weights (K,))."
        )
    means = parts[0]
    if means.ndim != 2 or means.shape[1] not in (2, 3):
        raise InvalidArgumentError(
            f"means of {name} have shape {tuple(means.shape)}; expected (K, 2) or (K, 3)."
        )
    k, dim = means.shape
    shapes = {"means": (k, dim), "covariances": (k, dim, dim), "weights": (k,)}
    mean, covariance, weight = (
        checked_parameter(part, shape, f"{part_name} of {name}", means.device)
        for part, (part_name, shape) in zip(parts, shapes.items(), strict=True)
    )
    if bool((weight < 0).any()):
        first = int((weight < 0).nonzero()[0])
        raise InvalidArgumentError(f"weights of {name}[{first}]={float(weight[first])} must be at least 0.")
    if k:
        safe_cholesky(check_symmetric(covariance, f"covariances of {name}"), f"covariances of {name}")
    kept = weight > 0
    return Parameters(weight[kept], mean[kept], covariance[kept])


def touching(
    centers: Tensor, radii: Tensor, points: Tensor, reach: Tensor
) -> Iterator[tuple[Tensor, Tensor]]:
    """Pairs of rows of points and of centres with |point − centre| ≤ reach + radius, in portions of points.

    Uses one k-d tree for each octave of radii, so that one large ball does not enlarge every search. Raises
    `MemoryLimitError` if a portion has more than `MOST_PAIRS` pairs.

    Args:
        centers (K, D), radii (K,); points (M, D), reach (M,).
    """
    if not len(centers) or not len(points):
        return
    size = radii.clamp_min(float(radii.max()) * 2.0**-_LARGEST_RATIO + _SMALLEST).log2().ceil()
    classes = []
    for octave in torch.unique(size):
        rows = (size == octave).nonzero().squeeze(1)
        classes.append((rows, float(radii[rows].max()), cKDTree(centers[rows].cpu().numpy())))
    for start in range(0, len(points), _PORTION):
        part = slice(start, start + _PORTION)
        asked, radius = points[part].detach().cpu().numpy(), reach[part].detach().cpu().numpy()
        found = [
            _listed(tree, asked, radius + largest, rows.to(points.device), start)
            for rows, largest, tree in classes
        ]
        point, center = (torch.cat(column) for column in zip(*found, strict=True))
        gap = (points[point].detach() - centers[center]).norm(dim=1)
        near = gap <= reach[point].detach() + radii[center]
        yield point[near], center[near]


def _listed(
    tree: cKDTree, points: np.ndarray, radius: np.ndarray, rows: Tensor, start: int
) -> tuple[Tensor, Tensor]:
    """Rows of points, counted from `start`, and of centres within each point's radius."""
    count = tree.query_ball_point(points, radius, return_length=True)
    total = int(count.sum())
    if total > MOST_PAIRS:
        raise MemoryLimitError(
            f"{len(points)} places touch {total} components, more than {MOST_PAIRS} at once: "
            "merge components first (gmmtorch.simplify), or use a smaller reach."
        )
    lists = tree.query_ball_point(points, radius, return_sorted=True)
    flat = np.fromiter(itertools.chain.from_iterable(lists), np.int64, total)
    place = np.repeat(np.arange(start, start + len(points)), count)
    return torch.from_numpy(place).to(rows.device), rows[torch.from_numpy(flat).to(rows.device)]


_CUTOFF = 7.0  # Mahalanobis cutoff: leaves out 3e-12 of the mass along an axis
_NODES = 32  # Gauss–Legendre nodes along each axis of a ball but the last
_ITERATIONS = 80  # of bisection, to rounding
_CHUNK = 1 << 8  # pairs of point and component integrated at a time


def clearance(
    surfaces: Surfaces, points: ArrayLike, deviations: float = 2.0, least_density: float = 0.0
) -> Tensor:
    """Distance (M,), metres, from points (M, D) to the nearest ellipsoid of the components.

    The surface of a component is {x : (x − μ)ᵀ Σ⁻¹ (x − μ) = q²}, q = `deviations`; it encloses 74 % (q = 2)
    or 97 % (q = 3) of the returns in 3D. Outside all ellipsoids the distance is exact. Inside it is negative:
    the largest depth in an ellipsoid, a lower bound of the distance to free space. It is infinite if there is
    no component.
    A body of radius r is free if clearance ≥ r; a path is free if all of its points are.

    A compact map merges stray returns into a few large ellipsoids, which can enclose free space. Components
    with fewer than `least_density` returns per m³ (m² in 2D) at their mean are left out: in a
    map of a hall, 5 leaves out 0.06 % of the returns, and the surfaces have about 2,000.

    Differentiable in the points; the gradient points away from the nearest surface and has length 1.

    Raises `InvalidArgumentError` for another shape, NaN, or deviations that are not above zero.
    """
    check_number("deviations", deviations, above=True)
    check_number("least_density", least_density)
    mixture = _dense(surface_mixture(surfaces, "surfaces"), least_density)
    query = _queries(points, mixture)
    distance = query.new_full((len(query),), math.inf)
    asked = torch.isfinite(query.detach()).all(1).nonzero().squeeze(1)
    if not len(mixture.weights) or not len(asked):
        return distance
    query = query[asked]
    variances, axes = torch.linalg.eigh(mixture.covariances)
    semi_axes = deviations * variances.clamp_min(0).sqrt()
    least, largest = semi_axes[:, 0], semi_axes[:, -1]
    # The component with the nearest mean gives an upper bound of the distance.
    places = query.detach().cpu().numpy()
    _, nearest = cKDTree(mixture.means.cpu().numpy()).query(places)
    first = torch.from_numpy(np.asarray(nearest)).to(query.device)
    bound = (query.detach() - mixture.means[first]).norm(dim=1) - least[first]
    # A small margin, so that rounding does not exclude the component of the bound.
    reach = bound + 1e-9 * (1 + query.detach().abs().amax(1) + largest[first])
    for point, component in touching(mixture.means, largest, query, reach):
        offset = query[point] - mixture.means[component]
        local = (offset[:, None] @ axes[component])[:, 0]
        gap = _ellipsoid_distance(local, semi_axes[component])
        distance = distance.scatter_reduce(0, asked[point], gap, "amin")
    return distance


def _dense(mixture: Parameters, least_density: float) -> Parameters:
    """The components whose density N/√|2πΣ| at their mean is at least `least_density`."""
    if least_density == 0:
        return mixture
    log_density = mixture.weights.log() - 0.5 * torch.logdet(2 * math.pi * mixture.covariances)
    kept = log_density >= math.log(least_density)
    return Parameters(mixture.weights[kept], mixture.means[kept], mixture.covariances[kept])


def _queries(points: ArrayLike, mixture: Parameters) -> Tensor:
    """Points (M, D), float64, on the device of the mixture; infinite points are allowed."""
    dim = mixture.means.shape[1] if len(mixture.weights) else None
    return check_queries(points, dim).to(mixture.means.device)


def _ellipsoid_distance(points: Tensor, semi_axes: Tensor) -> Tensor:
    """Signed distances (P,) of points (P, D) to axis-aligned ellipsoids about the origin, negative inside.

    The nearest point is x_d = a_d² y_d/(a_d² + t), t the largest root of Σ (a_d y_d/(a_d² + t))² = 1 (Eberly,
    *Distance from a Point to an Ellipse, an Ellipsoid, or a Hyperellipsoid*, 2013), found by bisection.
    If y lies on the plane of symmetry across the shortest axis and is deep enough, t = −a₁² is not a root;
    then x₁ is solved from the equation of the ellipsoid.
    """
    with torch.no_grad():
        y, squares = points.abs(), semi_axes.square()
        inside = (y / semi_axes).square().sum(1) < 1
        # Shifted by −a₁²: no cancellation next to the pole.
        apart = squares - squares[:, :1]
        low = semi_axes[:, 0] * y[:, 0]
        high = (semi_axes * y).norm(dim=1)
        for _ in range(_ITERATIONS):
            middle = (low + high) / 2
            ratio = semi_axes * y / (apart + middle[:, None]).clamp_min(1e-300)
            beyond = ratio.square().sum(1) > 1
            low, high = torch.where(beyond, middle, low), torch.where(beyond, high, middle)
        shifted = ((low + high) / 2)[:, None]
        nearest = squares * y / (apart + shifted).clamp_min(1e-300)
        rest = 1 - (nearest[:, 1:] / semi_axes[:, 1:]).square().sum(1)
        pole = shifted[:, 0] <= 1e-12 * squares[:, 0]
        nearest[:, 0] = torch.where(pole, semi_axes[:, 0] * rest.clamp_min(0).sqrt(), nearest[:, 0])
        signed = torch.copysign(nearest, points)
    # Envelope theorem: the gradient treats the nearest point as constant.
    gap = (points - signed).square().sum(1)
    distance = torch.where(gap > 0, gap, 1.0).sqrt() * (gap > 0)
    return torch.where(inside, -distance, distance)


def expected_returns(surfaces: Surfaces, points: ArrayLike, radius: float) -> Tensor:
    """Expected number n (M,) of returns in the ball of `radius` (m) about each point (M, D).

        n(x) = Σ_k N_k P(‖X_k − x‖ ≤ r),   X_k ~ N(μ_k, Σ_k)

    N_k are the supports (for a tuple, its weights). The probability of the ball is integrated in the
    principal axes of the component: the thinnest axis outermost, the widest in closed form, the others by
    Gauss–Legendre in an angle, in which the edge of the ball is smooth. Relative errors are below 1e-5.
    Components farther than seven deviations are ignored.

    Raises `InvalidArgumentError` for another shape, NaN, or a radius that is not above zero.
    """
    check_number("radius", radius, above=True)
    mixture = surface_mixture(surfaces, "surfaces")
    query = _queries(points, mixture).detach()
    expected = query.new_zeros(len(query))
    asked = torch.isfinite(query).all(1).nonzero().squeeze(1)
    if not len(mixture.weights) or not len(asked):
        return expected
    query = query[asked]
    variances, axes = torch.linalg.eigh(mixture.covariances)
    sigma = variances.clamp_min(1e-300).sqrt()
    reach = query.new_full((len(query),), radius)
    for point, component in touching(mixture.means, _CUTOFF * sigma[:, -1], query, reach):
        center = ((mixture.means[component] - query[point])[:, None] @ axes[component])[:, 0]
        near = (center.abs() <= radius + _CUTOFF * sigma[component]).all(1).nonzero().squeeze(1)
        for rows in near.split(_CHUNK):
            mass = _ball_mass(center[rows].T, sigma[component[rows]].T, radius)
            expected.index_add_(0, asked[point[rows]], mass * mixture.weights[component[rows]])
    return expected


def collision_probability(surfaces: Surfaces, points: ArrayLike, radius: float) -> Tensor:
    """Probability (M,) that a ball of `radius` (m) about each point (M, D) touches a return of the map.

        P(x) = 1 − exp(−n(x)),   n the `expected_returns` in the ball

    Returns are a Poisson process of intensity Σ N_k N(x | μ_k, Σ_k): a map describes where returns fall, not
    the surface between them. P is near 1 within a few deviations of a surface with many returns, and small
    near a few stray returns. Along a path the probability is at least that of its worst point, and at most
    1 − Π(1 − P).

    Arguments and errors as for `expected_returns`.
    """
    return -torch.expm1(-expected_returns(surfaces, points, radius))


@dataclass(frozen=True)
class Body:
    """B balls that cover a robot, in its own frame.

    centres (B, D): metres. D is 2 or 3.
    radii (B,): metres, above zero.

    Raises `InvalidArgumentError` for other shapes or values, or no ball.
    """

    centres: Tensor
    radii: Tensor

    def __init__(self, centres: ArrayLike, radii: ArrayLike) -> None:
        places = as_tensor(centres, "centres", torch.float64)
        sizes = as_tensor(radii, "radii", torch.float64)
        if places.ndim != 2 or places.shape[1] not in (2, 3) or not len(places):
            raise InvalidArgumentError(f"centres has shape {tuple(places.shape)}; expected (B, 2) or (B, 3).")
        if sizes.shape != places.shape[:1]:
            raise InvalidArgumentError(f"radii has shape {tuple(sizes.shape)}; expected ({len(places)},).")
        if not bool(torch.isfinite(places).all() & torch.isfinite(sizes).all() & (sizes > 0).all()):
            raise InvalidArgumentError("centres and radii must be finite, and radii above zero.")
        object.__setattr__(self, "centres", places)
        object.__setattr__(self, "radii", sizes)

    def clearance(
        self, surfaces: Surfaces, poses: ArrayLike, deviations: float = 2.0, least_density: float = 0.0
    ) -> Tensor:
        """Distance (S,), metres, from the body at each pose to the nearest surface; negative in collision.

        Args:
            surfaces: a map, its components, or (means, covariances, weights).
            poses: (S, D+1, D+1), map ← body.
            deviations, least_density: which ellipsoids are obstacles, as in `clearance`.

        Differentiable in the poses: the gradient moves a path away from surfaces.
        """
        balls = self._placed(poses)
        gaps = clearance(surfaces, balls.flatten(0, 1), deviations, least_density)
        return (gaps.unflatten(0, balls.shape[:2]) - self.radii.to(gaps)).amin(1)

    def collision_probability(self, surfaces: Surfaces, poses: ArrayLike) -> Tensor:
        """Probability (S,) that the body at each pose touches a return of the map.

            P = 1 − exp(−Σ_b n_b),   n_b the expected number of returns in ball b

        A return in several balls counts several times, so P is an upper bound if balls overlap.
        `poses`: (S, D+1, D+1), map ← body.
        """
        balls = self._placed(poses).detach()
        expected = torch.zeros(len(balls), dtype=torch.float64, device=balls.device)
        for radius in self.radii.unique().tolist():  # balls of one size are queried together
            places = balls[:, (self.radii == radius).to(balls.device)]
            returns = expected_returns(surfaces, places.flatten(0, 1), radius)
            expected = expected + returns.unflatten(0, places.shape[:2]).sum(1)
        return -torch.expm1(-expected)

    def _placed(self, poses: ArrayLike) -> Tensor:
        """Centres (S, B, D) of the balls at the poses."""
        dim = self.centres.shape[1]
        matrices = as_tensor(poses, "poses", torch.float64)
        if matrices.ndim != 3 or matrices.shape[1:] != (dim + 1, dim + 1):
            raise InvalidArgumentError(
                f"poses has shape {tuple(matrices.shape)}; expected (S, {dim + 1}, {dim + 1})."
            )
        centres = self.centres.to(matrices.device)
        return centres @ matrices[:, :dim, :dim].mT + matrices[:, None, :dim, dim]


def _ball_mass(center: Tensor, sigma: Tensor, radius: float) -> Tensor:
    """Mass (P,) in the ball about the origin of normals of means (D, P) and deviations (D, P), rising."""
    nodes, weights = _gauss_legendre()
    nodes, weights = nodes.to(center), weights.to(center)

    def sweep(axis: int, room: Tensor) -> Tensor:
        """Mass within radius `room` (…, P) in the axes from `axis` on."""
        if axis == len(center) - 1:
            return normal_mass((-room - center[axis]) / sigma[axis], 2 * room / sigma[axis])
        low = torch.maximum(-room, center[axis] - _CUTOFF * sigma[axis])
        high = torch.minimum(room, center[axis] + _CUTOFF * sigma[axis])
        # x = room sin θ: the remaining radius, room cos θ, is smooth up to the edge of the ball.
        safe = room.clamp_min(1e-300)
        first, last = torch.asin((low / safe).clamp(-1, 1)), torch.asin((high / safe).clamp(-1, 1))
        half = ((last - first) / 2).clamp_min(0)
        shape = (-1, *[1] * room.ndim)
        angle = (first + last) / 2 + half * nodes.view(shape)
        left = room * torch.cos(angle)
        z = (room * torch.sin(angle) - center[axis]) / sigma[axis]
        density = torch.exp(-0.5 * z * z) / (sigma[axis] * math.sqrt(2 * math.pi))
        return (weights.view(shape) * half * density * left * sweep(axis + 1, left)).sum(0)

    return sweep(0, torch.full_like(center[0], radius))


@functools.cache
def _gauss_legendre() -> tuple[Tensor, Tensor]:
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    return torch.from_numpy(nodes), torch.from_numpy(weights)
