"""The growth of a tree of mixtures against a naive implementation in loops."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from mixture.fit_contract import blobs
from mixture.tree_cases import exact, room
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from gmmtorch.mixture.estimators import tree_growth
from gmmtorch.mixture.estimators.hierarchical import HierarchicalGaussianMixture

pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


# -- the algorithm, in loops -----------------------------------------------------------------------


class NaiveTree:
    """Hierarchical EM one node, one point and one component at a time. Node: (parent, w, μ, Σ)."""

    def __init__(self, points: np.ndarray, weight: np.ndarray, **rule: Any) -> None:
        self.points, self.rule = points, rule
        mean, covariance = self.moments(points, weight)
        self.nodes: list[tuple[int, float, np.ndarray, np.ndarray]] = []
        self.members: list[np.ndarray] = []
        level = [(-1, 1.0, mean, covariance, weight)]
        for _ in range(rule["max_levels"]):
            below: list[Any] = []
            for index, w, mean, covariance, p in level:
                below += self.split(index, w, mean, covariance, p)
            first = len(self.nodes)
            self.nodes += [child[:4] for child in below]
            self.members += [child[4] for child in below]
            level = [(first + i, *child[1:]) for i, child in enumerate(below)]

    def bound(self, weight: np.ndarray) -> float:
        """Σ q log(π N(x) / q) over the leaves, with q the share of each point in each leaf."""
        value = 0.0
        for i, (_, w, mean, covariance) in enumerate(self.nodes):
            if i not in [node[0] for node in self.nodes]:
                q = self.members[i] / weight
                log_joint = math.log(w) + multivariate_normal(mean, covariance).logpdf(self.points)
                value += weight @ np.where(q > 0, q * (log_joint - np.log(np.where(q > 0, q, 1))), 0)
        return float(value / weight.sum())

    def moments(self, points: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        mean = np.average(points, axis=0, weights=p)
        offset = points - mean
        covariance = sum(q * np.outer(x, x) for q, x in zip(p, offset, strict=True)) / p.sum()
        return mean, covariance + self.rule["reg_covar"] * np.eye(points.shape[1])

    def start(self, p: np.ndarray) -> list[tuple[float, np.ndarray, np.ndarray]]:
        """Pieces halved across their longest direction, the widest first."""
        pieces = [np.flatnonzero(p > 0)]
        while len(pieces) < self.rule["branching"]:
            widest = []
            for piece in pieces:
                variance = np.linalg.eigvalsh(self.moments(self.points[piece], p[piece])[1])
                longest = variance[-1] - self.rule["reg_covar"]
                widest.append(p[piece].sum() * longest if longest > self.rule["reg_covar"] else 0)
            order = [i for i in np.argsort(widest)[::-1] if widest[i] > 0]
            if not order:
                break
            halves = list(pieces)
            for i in order[: min(len(pieces), self.rule["branching"] - len(pieces))]:
                mean, covariance = self.moments(self.points[pieces[i]], p[pieces[i]])
                axis = np.linalg.eigh(covariance)[1][:, -1]
                side = (self.points[pieces[i]] - mean) @ axis > 0
                halves[i] = pieces[i][~side]
                halves.append(pieces[i][side])
            pieces = halves
        return [(p[i].sum() / p.sum(), *self.moments(self.points[i], p[i])) for i in pieces]

    def joint(self, mixture: list[tuple[float, np.ndarray, np.ndarray]]) -> np.ndarray:
        return np.stack(
            [math.log(w) + multivariate_normal(m, c).logpdf(self.points) for w, m, c in mixture], 1
        )

    def split(
        self, index: int, weight: float, mean: np.ndarray, covariance: np.ndarray, p: np.ndarray
    ) -> list[Any]:
        variance = np.linalg.eigvalsh(covariance)
        if variance[0] < self.rule["planarity_threshold"] * variance.sum():
            return []
        if p.sum() < 2 * self.rule["min_support"]:
            return []
        mixture, last = self.start(p), -math.inf
        for _ in range(self.rule["max_iter"]):
            joint = self.joint(mixture)
            value = p @ logsumexp(joint, axis=1) / p.sum()
            gamma = np.exp(joint - logsumexp(joint, axis=1, keepdims=True)) * p[:, None]
            mixture = [(g.sum() / p.sum(), *self.moments(self.points, g)) for g in gamma.T if g.sum() > 1e-14]
            if value - last < self.rule["tol"]:
                break
            last = value
        mixture = [child for child in mixture if child[0] * p.sum() >= self.rule["min_support"]]
        if len(mixture) < 2:
            return []
        total = sum(child[0] for child in mixture)
        mixture = [(w / total, m, c) for w, m, c in mixture]
        joint = self.joint(mixture)
        gain = p @ (logsumexp(joint, axis=1) - multivariate_normal(mean, covariance).logpdf(self.points))
        dim = len(mean)
        price = self.rule["min_gain"] * (len(mixture) - 1) * (1 + dim + dim * (dim + 1) / 2)
        if gain < max(price, self.rule["tol"] * p.sum()):
            return []
        gamma = np.exp(joint - joint.max(1, keepdims=True))
        gamma[gamma <= self.rule["soft_threshold"]] = 0  # the largest is 1
        shares = gamma / gamma.sum(1, keepdims=True) * p[:, None]
        return [(index, weight * w, m, c, q) for (w, m, c), q in zip(mixture, shares.T, strict=True)]


@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("branching", [2, 5])
def test_tree_equals_a_naive_implementation(dim, branching):
    rng = np.random.default_rng(dim)
    points = np.concatenate([room(160, noise=0.002)[:, :dim], blobs(dim, 60)])
    weight = rng.uniform(0.2, 3.0, len(points))
    rule: dict[str, Any] = {
        "branching": branching,
        "max_levels": 3,
        "max_iter": 12,
        "tol": 1e-3,
        "reg_covar": 1e-4,
        "min_support": 6.0,
        "min_gain": 0.2,
        "soft_threshold": 0.1,
        "planarity_threshold": 0.002,
    }
    tree = exact(**rule).fit(points, sample_weight=weight)
    naive = NaiveTree(points, weight, **rule)
    assert tree.n_levels_ > 1
    assert len(tree.node_parents_) == len(naive.nodes)
    assert tree.lower_bound_ == pytest.approx(naive.bound(weight), abs=1e-6)
    mine = zip(tree.node_parents_, tree.node_weights_, tree.node_means_, tree.node_covariances_, strict=True)
    for found, expected in zip(rows_of(list(mine)), rows_of(naive.nodes), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-6)


def rows_of(nodes: list[tuple[int, float, np.ndarray, np.ndarray]]) -> list[np.ndarray]:
    """The values of each node and its parent, in an order that does not depend on the order of siblings."""
    rows = []
    for parent, weight, mean, covariance in nodes:
        _, above_weight, above_mean, above = (
            nodes[parent] if parent >= 0 else (0, 1.0, 0 * mean, 0 * covariance)
        )
        values = (above_weight, above_mean, above, weight, mean, covariance)
        rows.append(np.concatenate([np.ravel(value) for value in values]))
    return sorted(rows, key=lambda row: tuple(np.round(row, 4)))


def test_features_that_are_made_again_give_the_same_tree(monkeypatch):
    x = torch.randn(700, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    options = {"dtype": "float64", "max_levels": 2, "min_gain": 0, "branching": 3}
    stored = HierarchicalGaussianMixture(**options).fit(x)
    monkeypatch.setattr(tree_growth, "_MOST_FEATURES", 0)
    made = HierarchicalGaussianMixture(**options).fit(x)
    assert stored.means.shape[0] > 3
    torch.testing.assert_close(made.means, stored.means, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(made.covariances, stored.covariances, rtol=1e-9, atol=1e-12)
