"""Tests that every way to fit a mixture passes: inherit `FitContract` and implement `make`."""

from __future__ import annotations

import contextlib
import math
import warnings
from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import logsumexp
from scipy.stats import multivariate_normal
from sklearn.exceptions import ConvergenceWarning

from gmmtorch.errors import GmmTorchError, InvalidArgumentError
from gmmtorch.linalg import safe_cholesky
from gmmtorch.mixture.estimator import MixtureEstimator

dims = pytest.mark.parametrize("dim", [1, 2, 3, 5])
kinds = pytest.mark.parametrize("kind", [np.asarray, torch.from_numpy])

CENTERS = np.array([[-3.0, 0.0, 1.0, 0.0, 2.0], [3.0, 1.0, -1.0, 1.0, 0.0], [0.0, 4.0, 0.0, -2.0, 0.0]])
FAR = np.array([500_000.0, -4_000_000.0, 250.0, 1000.0, -500_000.0])


def shapes(dim: int) -> np.ndarray:
    """Square roots (3, D, D) of the covariances of `blobs`."""
    rng = np.random.default_rng(5)
    return rng.normal(size=(3, dim, dim)) * 0.1 + 0.3 * np.eye(dim)


def blobs(dim: int, n: int = 240, seed: int = 0) -> np.ndarray:
    """Three well separated clusters of different shapes and sizes, in random order.

    Coordinates are multiples of 2⁻²⁰, so that adding a large offset is exact.
    """
    rng = np.random.default_rng(seed)
    label = rng.choice(3, size=n, p=[0.5, 0.3, 0.2])
    points = CENTERS[label, :dim] + np.einsum("nij,nj->ni", shapes(dim)[label], rng.normal(size=(n, dim)))
    return np.round(points * 2**20) / 2**20


def true_score(points: np.ndarray) -> np.ndarray:
    """log p(x) of the mixture that `blobs` draws from."""
    dim = points.shape[1]
    return mixture_score(points, np.array([0.5, 0.3, 0.2]), CENTERS[:, :dim], shapes(dim))


def mixture_score(x: np.ndarray, weights: np.ndarray, means: np.ndarray, roots: np.ndarray) -> np.ndarray:
    """log Σ_k π_k N(x | μ_k, R_k R_kᵀ) by SciPy's normal density."""
    parts = [
        math.log(w) + multivariate_normal(m, r @ r.T).logpdf(x).reshape(len(x))
        for w, m, r in zip(weights, means, roots, strict=True)
        if w > 0
    ]
    return logsumexp(np.stack(parts), axis=0)


def rigid_motion(dim: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    rotation = np.linalg.qr(rng.normal(size=(dim, dim)))[0]
    rotation[:, 0] *= np.sign(np.linalg.det(rotation))
    matrix = np.eye(dim + 1)
    matrix[:dim, :dim], matrix[:dim, dim] = rotation, rng.normal(size=dim) * 3
    return matrix


def move(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ matrix[:-1, :-1].T + matrix[:-1, -1]


def global_numpy_state() -> list[int]:
    return np.random.get_state()[1].tolist()  # noqa: NPY002 -- the state that a fit must not change


def degenerate_clouds(dim: int) -> dict[str, np.ndarray]:
    """Clouds that do not span their space."""
    rng = np.random.default_rng(3)
    line = np.outer(rng.normal(size=30), np.arange(1.0, dim + 1)) + 2.0
    flat = np.array(rng.normal(size=(40, dim)))
    flat[:, -1] = 7.0
    two = np.where(rng.random((20, 1)) < 0.5, np.zeros(dim), np.ones(dim))
    return {
        "one point": np.arange(1.0, dim + 1)[None],
        "one point, many times": np.tile(np.arange(1.0, dim + 1), (25, 1)),
        "two points, many times": two,
        "collinear": line,
        "coplanar": flat,
        "a grid": np.stack(np.meshgrid(*[np.arange(3.0)] * dim), -1).reshape(-1, dim)[:27],
        "tiny": 1e-7 * rng.normal(size=(20, dim)),
        "huge": 1e7 * rng.normal(size=(20, dim)),
    }


def check_mixture(mixture: MixtureEstimator, points: np.ndarray, at_most: int) -> None:
    """Check that the parameters are a finite mixture near the points, with a finite density there."""
    weights, means, covariances = (
        t.detach().cpu().numpy() for t in (mixture.weights, mixture.means, mixture.covariances)
    )
    k, dim = means.shape
    assert 1 <= k <= at_most
    assert dim == points.shape[1]
    assert (weights.shape, covariances.shape) == ((k,), (k, dim, dim))
    assert np.isfinite(means).all()
    assert np.isfinite(covariances).all()
    assert (weights >= 0).all()
    assert weights.sum() == pytest.approx(1, abs=1e-9)
    scale = np.abs(covariances).max((1, 2), keepdims=True)
    assert (np.abs(covariances - covariances.transpose(0, 2, 1)) <= 1e-9 * scale).all()
    assert (np.linalg.eigvalsh(covariances) > -1e-12 * scale[:, 0]).all()
    assert bool(torch.isfinite(safe_cholesky(mixture.covariances)).all())
    low, high = points.min(0), points.max(0)
    slack = 0.1 * np.linalg.norm(high - low) + 1e-6 * (1 + np.abs(points).max())
    used = means[weights > 1e-3]
    assert (used >= low - slack).all()
    assert (used <= high + slack).all()
    assert np.isfinite(mixture.score_samples(points)).all()
    assert np.isfinite(mixture.predict_proba(points)).all()
    assert all(math.isfinite(value) for value in mixture.lower_bounds_)


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
class FitContract(ABC):
    """The contract of one way to fit, such as one algorithm or precision of an estimator.

    Inherit, implement `make`, name the class `Test…`, and override the tolerances that differ.

    Tolerances are for log-densities (nats) at points of the cloud. None: the property does not hold.
    """

    exact_components = True
    """Whether a fit has exactly n_components components, rather than at most."""

    order_tolerance: float | None = 1e-6
    """For the same points in another order."""
    repetition_tolerance: float | None = 1e-6
    """For an integer weight in place of repeated points."""
    motion_tolerance: float | None = 1e-6
    """For the rotated and shifted cloud."""
    far_tolerance: float | None = 1e-5
    """For the cloud 4000 km from the origin."""
    score_tolerance = 0.3
    """Largest loss of mean log-likelihood of new points against the true density."""

    @abstractmethod
    def make(self, n_components: int = 3, **options: Any) -> MixtureEstimator:
        """An unfitted estimator; its random_state is 0 unless the options set it."""

    def scores_after(self, points: np.ndarray, **fit: Any) -> np.ndarray:
        return np.asarray(self.make().fit(points, **fit).score_samples(points))

    # -- the fitted mixture ------------------------------------------------------------------------------

    @dims
    def test_fit_gives_a_valid_mixture(self, dim):
        points = blobs(dim)
        mixture = self.make()
        assert mixture.fit(points) is mixture
        check_mixture(mixture, points, at_most=3)
        if self.exact_components:
            assert len(mixture.weights_) == 3
        assert mixture.n_features_in_ == dim
        assert mixture.lower_bounds_[-1] == mixture.lower_bound_
        assert len(mixture.lower_bounds_) == mixture.n_iter_
        assert isinstance(mixture.converged_, bool)

    @dims
    def test_fit_has_the_likelihood_of_the_true_density(self, dim):
        fresh = blobs(dim, 400, seed=1)
        score = self.make().fit(blobs(dim)).score(fresh)
        assert score > true_score(fresh).mean() - self.score_tolerance

    @dims
    def test_score_samples_is_the_density_of_the_parameters(self, dim):
        mixture = self.make().fit(blobs(dim))
        fresh = blobs(dim, 50, seed=1)
        roots = np.linalg.cholesky(mixture.covariances_)
        expected = mixture_score(fresh, mixture.weights_, mixture.means_, roots)
        np.testing.assert_allclose(mixture.score_samples(fresh), expected, atol=1e-7)
        assert mixture.score(fresh) == pytest.approx(expected.mean())

    # -- arrays and tensors ------------------------------------------------------------------------------

    def test_fit_changes_neither_its_input_nor_global_random_states(self):
        points, weight = torch.from_numpy(blobs(2)).requires_grad_(), torch.ones(240)
        before = points.detach().clone()
        torch_state, numpy_state = torch.get_rng_state(), global_numpy_state()
        mixture = self.make().fit(points, sample_weight=weight)
        assert torch.equal(points.detach(), before)
        assert torch.equal(weight, torch.ones(240))
        assert torch.equal(torch.get_rng_state(), torch_state)
        assert global_numpy_state() == numpy_state
        assert points.grad is None
        assert not mixture.means.requires_grad

    # -- invariances -------------------------------------------------------------------------------------

    def test_same_seed_gives_the_same_fit(self):
        points = blobs(3)
        for seeded in (int, np.random.RandomState, lambda seed: torch.Generator().manual_seed(seed)):
            first, again = (self.make(random_state=seeded(4)).fit(points) for _ in range(2))
            assert torch.equal(first.weights, again.weights)
            assert torch.equal(first.means, again.means)
            assert torch.equal(first.covariances, again.covariances)
            assert first.lower_bounds_ == again.lower_bounds_

    def test_on_iteration_gets_each_lower_bound(self):
        seen: list[tuple[int, float]] = []
        mixture = self.make().fit(blobs(2), on_iteration=lambda *values: seen.append(values))
        assert seen == list(enumerate(mixture.lower_bounds_, 1))

    @pytest.mark.filterwarnings("default::sklearn.exceptions.ConvergenceWarning")
    def test_reaching_max_iter_warns_unless_tol_is_zero(self):
        points = blobs(2, 100) * 0.1 + np.random.default_rng(0).normal(size=(100, 2))  # overlapping clusters
        with pytest.warns(ConvergenceWarning, match="max_iter=1"):
            assert not self.make(max_iter=1, tol=1e-12).fit(points).converged_
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            self.make(max_iter=1, tol=0).fit(points)

    def test_second_fit_is_independent_of_the_first(self):
        mixture = self.make().fit(blobs(2, seed=7)).fit(blobs(3))
        fresh = self.make().fit(blobs(3))
        assert torch.equal(mixture.means, fresh.means)
        assert mixture.n_iter_ == fresh.n_iter_
        assert mixture.fit(torch.from_numpy(blobs(2))).means.shape[1] == 2

    @dims
    def test_fit_does_not_depend_on_the_order_of_points(self, dim):
        if self.order_tolerance is None:
            pytest.skip("depends on the order of the points")
        points = blobs(dim)
        order = np.random.default_rng(0).permutation(len(points))
        shuffled = self.scores_after(points[order])
        np.testing.assert_allclose(shuffled, self.scores_after(points)[order], atol=self.order_tolerance)

    @pytest.mark.parametrize("dim", [2, 3, 5])
    def test_fit_of_a_moved_cloud_is_the_moved_fit(self, dim):
        if self.motion_tolerance is None:
            pytest.skip("depends on the frame")
        points, motion = blobs(dim), rigid_motion(dim)
        moved = self.scores_after(move(motion, points))
        np.testing.assert_allclose(moved, self.scores_after(points), atol=self.motion_tolerance)

    @dims
    def test_fit_far_from_the_origin_is_the_shifted_fit(self, dim):
        if self.far_tolerance is None:
            pytest.skip("depends on the frame")
        points, offset = blobs(dim), FAR[:dim]
        near, far = self.make().fit(points), self.make().fit(points + offset)
        expected, scores = near.score_samples(points), far.score_samples(points + offset)
        np.testing.assert_allclose(scores, expected, atol=self.far_tolerance)
        check_mixture(far, points + offset, at_most=3)

    # -- weights -----------------------------------------------------------------------------------------

    @dims
    def test_integer_weight_equals_repeated_points(self, dim):
        if self.repetition_tolerance is None:
            pytest.skip("a weight is not a repetition")
        points = blobs(dim)
        weight = np.random.default_rng(0).integers(1, 4, len(points))
        weighted = self.make().fit(points, sample_weight=weight).score_samples(points)
        repeated = self.make().fit(np.repeat(points, weight, axis=0)).score_samples(points)
        np.testing.assert_allclose(weighted, repeated, atol=self.repetition_tolerance)
        assert np.abs(weighted - self.scores_after(points)).max() > 1e-3  # the weights have an effect

    @kinds
    def test_weight_zero_equals_absence(self, kind):
        points = blobs(2)
        present = np.random.default_rng(0).random(len(points)) > 0.3
        polluted = np.where(present[:, None], points, 1e3)
        mixture = self.make().fit(kind(polluted), sample_weight=kind(present.astype(float)))
        without = self.make().fit(kind(points[present]))
        assert torch.equal(mixture.means, without.means)
        assert torch.equal(mixture.covariances, without.covariances)

    # -- invalid and degenerate clouds -------------------------------------------------------------------

    @pytest.mark.parametrize("dim", [1, 2, 3])
    @pytest.mark.parametrize("k", [1, 3])
    def test_degenerate_clouds_are_fitted(self, dim, k):
        for name, points in degenerate_clouds(dim).items():
            if len(points) < k:
                continue
            mixture = self.make(k).fit(points)
            check_mixture(mixture, points, at_most=k)
            if name.startswith("one point"):
                used = mixture.weights_ > 1e-3
                close = np.broadcast_to(points[0], mixture.means_[used].shape)
                np.testing.assert_allclose(mixture.means_[used], close, atol=1e-6)

    def test_one_component_per_point_is_allowed(self):
        points = blobs(2, 6)
        check_mixture(self.make(6).fit(points), points, at_most=6)

    @kinds
    def test_more_components_than_points_are_rejected_or_reduced(self, kind):
        points = blobs(2, 6)
        for n in (7, 60):
            if self.exact_components:
                with pytest.raises(InvalidArgumentError, match=rf"^n_components={n} .*\b6\b"):
                    self.make(n).fit(kind(points))
                continue
            with contextlib.suppress(InvalidArgumentError):
                check_mixture(self.make(n).fit(kind(points)), points, at_most=n)

    @settings(max_examples=25)
    @given(data=st.data(), dim=st.integers(1, 3), n=st.integers(1, 8), k=st.integers(1, 4))
    def test_any_small_cloud_is_fitted_or_rejected(self, data, dim, n, k):
        scale, offset = data.draw(st.sampled_from([(1.0, 0.0), (1e-6, 0.0), (1e3, 5e5), (1e-3, -1e6)]))
        numbers = st.lists(st.sampled_from([0, 1, 2, 7]), min_size=n * dim, max_size=n * dim)
        points = offset + scale * np.array(data.draw(numbers), dtype=float).reshape(n, dim)
        weight = np.array(data.draw(st.lists(st.sampled_from([0.0, 1e-3, 1.0, 3.0]), min_size=n, max_size=n)))
        present = int((weight > 0).sum())
        refusal: Any = contextlib.nullcontext()
        if present == 0 or (k > present and self.exact_components):
            refusal = pytest.raises(GmmTorchError, match=r"n_components|sample_weight")
        elif k > present:
            refusal = contextlib.suppress(InvalidArgumentError)
        with refusal:
            check_mixture(self.make(k).fit(points, sample_weight=weight), points[weight > 0], at_most=k)
