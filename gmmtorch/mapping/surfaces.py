"""The surfaces of a map as a plain mixture, and the search for pairs of touching balls."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.errors import InvalidArgumentError, MemoryLimitError
from gmmtorch.linalg import check_symmetric, safe_cholesky
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mixture import Parameters, checked_parameter

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
    if isinstance(given, GaussianMap):
        given = given.components() if given.dim is not None else Components.empty(3)
    if isinstance(given, Components):
        solid = ~given.max_range
        parts = given.means[solid], given.covariances[solid], given.support[solid]
    elif isinstance(given, tuple) and len(given) == 3:
        names = ("means", "covariances", "weights")
        means, covariances, weights = (
            as_tensor(part, f"{part_name} of {name}", torch.float64).detach()
            for part, part_name in zip(given, names, strict=True)
        )
        parts = means, covariances, weights
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
