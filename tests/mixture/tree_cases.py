"""Points and trees for the tests of hierarchical mixtures."""

from __future__ import annotations

from typing import Any

import numpy as np

from gmmtorch.mixture import HierarchicalGaussianMixture


def room(n: int, seed: int = 0, noise: float = 0.01) -> np.ndarray:
    """Two walls, a floor, and a sphere in the room."""
    rng = np.random.default_rng(seed)
    points = rng.random((n, 3)) * [4.0, 3.0, 2.0]
    side = np.arange(n) % 4
    for axis in range(3):
        points[side == axis, axis] = 0
    ball = rng.normal(size=(n, 3))
    points[side == 3] = [2.5, 2.0, 1.0] + 0.4 * (ball / np.linalg.norm(ball, axis=1, keepdims=True))[
        side == 3
    ]
    return points + noise * rng.normal(size=(n, 3))


def exact(n_components: int | None = None, **options: Any) -> HierarchicalGaussianMixture:
    return HierarchicalGaussianMixture(n_components, **{"random_state": 0, "dtype": "float64", **options})


def split_nodes(tree: HierarchicalGaussianMixture) -> np.ndarray:
    return np.unique(tree.node_parents_[tree.node_parents_ >= 0])
