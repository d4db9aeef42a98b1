"""Tests that every mixture estimator passes: inherit `MixtureContract` and implement `make`."""

from __future__ import annotations

import contextlib
import copy
import inspect
import math
import pickle
import warnings
from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import logsumexp
from scipy.stats import multivariate_normal
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning
from torch import Tensor

from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError, MissingDataError
from gmmtorch.files import pack_tensors
from gmmtorch.linalg import safe_cholesky
from gmmtorch.mixture.density import NotFittedError
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
class MixtureContract(ABC):
    """Inherit, implement `make`, name the class `Test…`, and override the tolerances that differ.

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
    bad_parameters: ClassVar[list[dict[str, Any]]] = []
    """Further invalid constructor options; the error must name the first option."""

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

    def test_predict_is_the_largest_responsibility(self):
        points = blobs(2)
        mixture = self.make().fit(points)
        share = mixture.predict_proba(points)
        assert share.shape == (len(points), len(mixture.weights_))
        np.testing.assert_allclose(share.sum(1), 1, rtol=1e-12)
        assert (mixture.predict(points) == share.argmax(1)).all()

    def test_samples_have_the_moments_of_the_mixture(self):
        mixture = self.make().fit(blobs(2))
        points, labels = mixture.sample(4000, random_state=0)
        assert points.shape == (4000, 2)
        share = np.bincount(labels, minlength=len(mixture.weights_)) / 4000
        np.testing.assert_allclose(share, mixture.weights_, atol=0.05)
        np.testing.assert_allclose(points.mean(0), mixture.weights_ @ mixture.means_, atol=0.2)

    def test_queries_before_fit_raise_not_fitted(self):
        mixture = self.make()
        for ask in (lambda: mixture.score_samples(blobs(2)), mixture.sample, mixture.n_parameters):
            with pytest.raises(NotFittedError, match="fit"):
                ask()

    # -- arrays and tensors ------------------------------------------------------------------------------

    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    def test_arrays_give_arrays(self, dtype):
        points = blobs(2).astype(dtype)
        mixture = self.make().fit(points)
        for value in (mixture.weights_, mixture.means_, mixture.covariances_, mixture.precisions_):
            assert isinstance(value, np.ndarray)
            assert value.dtype == np.float64
        assert mixture.score_samples(points).dtype == dtype
        assert mixture.predict_proba(points).dtype == dtype
        assert isinstance(mixture.sample(2)[0], np.ndarray)

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    def test_tensors_give_tensors(self, dtype):
        points = torch.from_numpy(blobs(2)).to(dtype)
        mixture = self.make().fit(points)
        for value in (mixture.weights_, mixture.means_, mixture.covariances_, mixture.precisions_):
            assert isinstance(value, Tensor)
            assert value.dtype == torch.float64
        assert mixture.score_samples(points).dtype == dtype
        assert mixture.predict_proba(points).dtype == dtype
        assert mixture.predict(points).dtype == torch.int64
        assert isinstance(mixture.sample(2)[0], Tensor)

    def test_tensors_and_arrays_give_equal_fits(self):
        points = blobs(3)
        array, tensor = self.make().fit(points), self.make().fit(torch.from_numpy(points))
        assert torch.equal(array.means, tensor.means)
        assert torch.equal(array.covariances, tensor.covariances)

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

    @kinds
    def test_invalid_weights_are_named(self, kind):
        for weight in (
            [1.0, -1.0, 1.0, 1.0],
            [1.0, math.nan, 1.0, 1.0],
            [1.0, math.inf, 1.0, 1.0],
            [0.0] * 4,
            [1.0] * 3,
            [[1.0] * 4],
        ):
            with pytest.raises(InvalidArgumentError, match="sample_weight"):
                self.make(1).fit(kind(blobs(2, 4)), sample_weight=kind(np.array(weight)))

    # -- invalid and degenerate clouds -------------------------------------------------------------------

    @pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
    def test_non_finite_points_are_named(self, value):
        points = blobs(2)
        points[7, 1] = value
        with pytest.raises(ValueError, match=r"NaN|infinity"):
            self.make().fit(points)
        with pytest.raises(InvalidArgumentError, match=r"X\[7\]"):
            self.make().fit(torch.from_numpy(points))
        mixture = self.make().fit(blobs(2))
        with pytest.raises(InvalidArgumentError, match=r"X\[7\]"):
            mixture.score_samples(torch.from_numpy(points))

    @kinds
    def test_input_of_another_shape_is_rejected(self, kind):
        for x in (
            np.empty((0, 2)),
            np.empty((4, 0)),
            np.zeros(4),
            np.zeros((4, 2, 2)),
            np.zeros((4, 2), complex),
        ):
            with pytest.raises(ValueError, match=r"X |array|[Cc]omplex"):
                self.make(1).fit(kind(x))
        mixture = self.make().fit(kind(blobs(2)))
        with pytest.raises(ValueError, match="3 features"):
            mixture.score_samples(kind(blobs(3)))

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

    # -- parameters --------------------------------------------------------------------------------------

    def test_invalid_parameters_are_named(self):
        usual: list[dict[str, Any]] = [{"n_components": value} for value in (0, -1, 1.5, "many")]
        usual += [{"random_state": value} for value in (-1, 1.5, "seed", 2**64)]
        for options in [*usual, *self.bad_parameters]:
            name = next(iter(options))
            with pytest.raises(InvalidArgumentError, match=name):
                self.make(**options).fit(blobs(2))

    def test_every_parameter_is_stored_and_documented(self):
        mixture = self.make()
        signature = inspect.signature(type(mixture).__init__).parameters
        assert set(mixture.get_params()) == set(signature) - {"self"}
        assert all(name in (type(mixture).__doc__ or "") for name in mixture.get_params())

    def test_clone_is_unfitted_and_gives_the_same_fit(self):
        mixture = self.make().fit(blobs(2))
        other = clone(mixture)
        assert not hasattr(other, "means")
        assert other.get_params() == mixture.get_params()
        assert torch.equal(other.fit(blobs(2)).means, mixture.means)

    # -- motions, copies and files -----------------------------------------------------------------------

    @pytest.mark.parametrize("dim", [2, 3])
    @kinds
    def test_moved_mixture_has_equal_scores_at_moved_points(self, dim, kind):
        points, motion = blobs(dim), rigid_motion(dim)
        mixture = self.make().fit(kind(points))
        before = mixture.means.clone()
        moved = mixture.moved(motion)
        assert type(moved) is type(mixture)
        assert type(moved.means_) is type(mixture.means_)
        expected = mixture.score_samples(kind(points))
        np.testing.assert_allclose(moved.score_samples(kind(move(motion, points))), expected, atol=1e-8)
        assert torch.equal(mixture.means, before)
        assert moved.get_params() == mixture.get_params()
        assert moved.lower_bounds_ == mixture.lower_bounds_
        assert moved.state_dict().keys() == mixture.state_dict().keys()
        self.same(mixture.moved(np.eye(dim + 1)), mixture)
        with pytest.raises(InvalidArgumentError, match="transform"):
            mixture.moved(2 * motion)

    def test_unfitted_mixture_has_no_fitted_attributes(self, tmp_path):
        for name in ("means_", "weights_", "covariances_", "precisions_", "lower_bound_"):
            assert not hasattr(self.make(), name)
        with pytest.raises(NotFittedError):
            self.make().save(tmp_path / "m.safetensors")
        assert list(tmp_path.iterdir()) == []

    def same(self, other: MixtureEstimator, mixture: MixtureEstimator) -> None:
        """Check that both mixtures are equal to the bit."""
        assert type(other) is type(mixture)
        mine, state = other.state_dict(), mixture.state_dict()
        assert mine.keys() == state.keys()
        assert all(torch.equal(mine[name], state[name]) for name in state)
        assert type(other.means_) is type(mixture.means_)
        for name in ("lower_bounds_", "lower_bound_", "n_iter_", "converged_", "n_features_in_"):
            assert getattr(other, name) == getattr(mixture, name)
        assert other.get_params() == mixture.get_params()
        points = blobs(mixture.n_features_in_, 20, seed=2)
        assert (other.score_samples(points) == mixture.score_samples(points)).all()

    @kinds
    def test_copies_are_equal(self, kind):
        mixture = self.make().fit(kind(blobs(2)))
        for other in (copy.deepcopy(mixture), pickle.loads(pickle.dumps(mixture))):
            assert other is not mixture
            self.same(other, mixture)
        assert not hasattr(copy.deepcopy(self.make()), "means")

    @kinds
    def test_load_restores_what_save_wrote(self, tmp_path, kind):
        path = tmp_path / "m.safetensors"
        mixture = self.make().fit(kind(blobs(3)))
        mixture.save(path)
        loaded = type(mixture).load(path)
        self.same(loaded, mixture)
        loaded.save(tmp_path / "again.safetensors")
        assert (tmp_path / "again.safetensors").read_bytes() == path.read_bytes()
        self.same(loaded.moved(np.eye(4)).fit(kind(blobs(3))), mixture)

    def test_moved_mixture_can_be_saved(self, tmp_path):
        mixture = self.make().fit(blobs(2)).moved(rigid_motion(2))
        mixture.save(tmp_path / "m.safetensors")
        self.same(type(mixture).load(tmp_path / "m.safetensors"), mixture)

    def test_missing_foreign_and_truncated_files_are_named(self, tmp_path):
        mixture = self.make().fit(blobs(2))
        path = tmp_path / "m.safetensors"
        with pytest.raises(MissingDataError, match=r"m\.safetensors"):
            type(mixture).load(path)
        mixture.save(path)
        data = path.read_bytes()
        for wrong in (
            pack_tensors({}, "gmmtorch.other", 1),
            b"",
            *(data[:n] for n in range(0, len(data), 37)),
        ):
            path.write_bytes(wrong)
            with pytest.raises(DataError, match=r"m\.safetensors"):
                type(mixture).load(path)

    @settings(max_examples=60)
    @given(place=st.floats(0, 1, exclude_max=True), value=st.integers(0, 255), in_header=st.booleans())
    def test_damaged_file_is_rejected_or_valid(self, tmp_path, place, value, in_header):
        path = tmp_path / "sound.safetensors"
        if not path.exists():
            self.make().fit(blobs(2)).save(path)
        data = bytearray(path.read_bytes())
        end = 8 + int.from_bytes(data[:8], "little") if in_header else len(data)
        data[int(place * end)] = value
        (tmp_path / "damaged.safetensors").write_bytes(data)
        try:
            loaded = type(self.make()).load(tmp_path / "damaged.safetensors")
        except GmmTorchError:
            return
        assert np.isfinite(loaded.score_samples(np.zeros((2, 2)))).all()

    def test_state_dict_restores_an_unfitted_mixture(self):
        mixture, other = self.make().fit(torch.from_numpy(blobs(3))), self.make()
        other.load_state_dict(mixture.state_dict())
        points = torch.from_numpy(blobs(3, 20, seed=2))
        assert torch.equal(other(points), mixture(points))
        assert list(mixture.parameters()) == []

    def test_cast_of_the_module_keeps_float64_parameters(self):
        mixture = self.make().fit(blobs(2)).to(torch.float16)
        assert all(value.dtype != torch.float16 for value in mixture.state_dict().values())
