"""RiemannianGaussianMixture against EM and scikit-learn."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mixture.estimator_contract import MixtureContract
from mixture.fit_contract import blobs
from scipy.linalg import expm, sqrtm
from scipy.optimize import rosen, rosen_der
from torch import Tensor

from gmmtorch.errors import NumericalError
from gmmtorch.kernels import kernels
from gmmtorch.mixture import GaussianMixture, Parameters, RiemannianGaussianMixture, Rows
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em import loop
from gmmtorch.mixture.em.by_type import Factors
from gmmtorch.mixture.estimators.riemannian import (
    Iterate,
    Likelihood,
    ascend,
    pack_tangent,
    quasi_newton,
    search,
    unpack_tangent,
)


class TestRiemannianGaussianMixture(MixtureContract):
    def make(self, n_components: int = 3, **options: Any) -> RiemannianGaussianMixture:
        return RiemannianGaussianMixture(n_components, **{"random_state": 0, **options})


# -- the estimator ---------------------------------------------------------------------------------


def overlapping(seed: int = 0, n: int = 1500) -> np.ndarray:
    """Four components of equal place and size that differ only in shape."""
    rng = np.random.default_rng(seed)
    roots = rng.normal(size=(4, 2, 2)) * 0.3 + np.eye(2)
    label = rng.integers(4, size=n)
    return rng.normal(size=(4, 2))[label] * 0.5 + np.einsum(
        "nij,nj->ni", roots[label], rng.normal(size=(n, 2))
    )


def blurred_em_step(points: np.ndarray, reg_covar: float) -> loop.Step:
    """EM on the objective of the ascent: points as cells of covariance ε I."""
    x = torch.from_numpy(points)
    features = em.quadratic_features(x)
    dim = x.shape[1]
    rows, cols = torch.triu_indices(dim, dim)
    features[:, 1 + dim :] += reg_covar * (rows == cols)
    return loop.em_step(Rows(features, torch.ones(len(x)).double(), False), 0.0, torch.float64)


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_one_component_has_the_mean_and_covariance_plus_epsilon(dim):
    points = overlapping()[:, [0]] if dim == 1 else blobs(dim)
    fit = RiemannianGaussianMixture(
        1, reg_covar=0.25, init_params="bounding_box", random_state=0, tol=1e-12
    ).fit(points)
    expected = np.cov(points.T, ddof=0).reshape(dim, dim) + 0.25 * np.eye(dim)
    np.testing.assert_allclose(fit.means_[0], points.mean(0), atol=1e-5)
    np.testing.assert_allclose(fit.covariances_[0], expected, atol=1e-5)


@pytest.mark.parametrize("init_params", ["kmeans", "random_points"])
@pytest.mark.parametrize("reg_covar", [1e-6, 0.1])
def test_em_does_not_improve_the_result(init_params, reg_covar):
    points = overlapping(n=500)
    fit = RiemannianGaussianMixture(
        4,
        reg_covar=reg_covar,
        tol=1e-9,
        max_iter=2000,
        init_params=init_params,
        random_state=0,
    ).fit(points)
    assert fit.converged_
    parameters = Parameters(fit.weights, fit.means, fit.covariances)
    again = loop.run_em(blurred_em_step(points, reg_covar), parameters, tol=0, max_iter=30)
    assert again.lower_bounds[0] == pytest.approx(fit.lower_bound_, abs=1e-8)
    assert 0 <= again.lower_bounds[-1] - again.lower_bounds[0] < 1e-7
    place = Likelihood(torch.from_numpy(points), torch.ones(len(points)).double(), reg_covar).at(parameters)
    assert float(place.gradient.norm()) < 1e-4
    torch.testing.assert_close(place.frames.offset.norm(dim=1), torch.ones(4).double(), rtol=0, atol=1e-3)


@settings(max_examples=10)
@given(seed=st.integers(0, 10**6), dim=st.integers(1, 3), k=st.integers(1, 6))
def test_likelihood_never_decreases(seed, dim, k):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(80, dim)) * rng.choice([1e-3, 1, 30], size=dim)
    fit = RiemannianGaussianMixture(k, init_params="random_points", random_state=seed, tol=0, max_iter=20)
    fit.fit(points, sample_weight=rng.random(80) + 0.1)
    assert (np.diff(fit.lower_bounds_) >= 0).all()


def test_overlapping_clusters_need_a_fifth_of_the_iterations_of_em():
    points = overlapping(n=1000)
    found = RiemannianGaussianMixture(4, tol=1e-8, max_iter=3000, random_state=0).fit(points)
    em_fit = GaussianMixture(4, dtype="float64", tol=0, max_iter=5 * found.n_iter_, random_state=0).fit(
        points
    )
    assert found.lower_bound_ > em_fit.lower_bound_ - 1e-4


def test_collapse_without_regularisation_is_an_error():
    points = np.concatenate([blobs(2, 60), np.array([[40.0, 40.0], [40.0, 41.0]])])
    with pytest.raises(NumericalError, match="reg_covar"):
        RiemannianGaussianMixture(
            5, reg_covar=0, tol=0, max_iter=400, init_params="random_points", random_state=1
        ).fit(points)


def random_iterate(
    k: int, dim: int, generator: torch.Generator, n: int = 40, blur: float = 0.3, dtype=torch.float64
) -> Iterate:
    """A point of the manifold that is not a mixture: s ≠ 1."""

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    weight = torch.rand(n, generator=generator, dtype=torch.float64) + 0.1
    likelihood = Likelihood(2 * normal(n, dim), weight, blur, dtype)
    first = Parameters(
        torch.full((k,), 1 / k).double(), normal(k, dim), torch.eye(dim).double().expand(k, dim, dim)
    )
    there = likelihood.at(first)
    return there.move(0.4 * normal(*there.gradient.shape))


def augmented(place: Iterate) -> Tensor:
    """H (K, D+1, D+1) as one matrix: H [x; 1] = A (x − μ) + b."""
    linear, means, offset = place.frames
    return torch.cat([linear, offset[:, :, None] - linear @ means[:, :, None]], 2)


def covariance(place: Iterate) -> Tensor:
    """S = (HᵀH)⁻¹."""
    frame = augmented(place)
    return torch.linalg.inv(frame.mT @ frame)


def reference(likelihood: Likelihood, S: Tensor, log_weights: Tensor) -> Tensor:
    """f of S and η as in the docstring of the module."""
    dim = S.shape[1] - 1
    y = torch.cat([likelihood.points, likelihood.points.new_ones(len(likelihood.points), 1)], 1)
    inverse = torch.linalg.inv(S)
    squared = torch.einsum("ni,kij,nj->nk", y, inverse, y)
    blur = likelihood.blur * torch.stack([p[:dim, :dim].trace() for p in inverse])
    log_q = 0.5 - dim / 2 * math.log(2 * math.pi) - 0.5 * (torch.logdet(S) + squared + blur)
    value = torch.logsumexp(torch.log_softmax(log_weights, 0) + log_q, 1)
    return (likelihood.weight * value).sum() / likelihood.weight.sum()


# -- the objective and its gradient ----------------------------------------------------------------


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_value_and_gradient_equal_autograd(dim, generator):
    place = random_iterate(3, dim, generator)
    S = covariance(place).requires_grad_()
    log_weights = place.log_weights.clone().requires_grad_()
    value = reference(place.likelihood, S, log_weights)
    assert place.value == pytest.approx(float(value.detach()), rel=1e-12)
    by_S, by_weights = torch.autograd.grad(value, [S, log_weights])
    root = torch.linalg.inv(augmented(place))  # S = G Gᵀ, so that df = tr(∂f/∂S G dΞ Gᵀ)
    expected = pack_tangent(root.mT @ by_S @ root, by_weights)
    torch.testing.assert_close(place.gradient, expected, rtol=1e-9, atol=1e-12)


def test_float32_value_and_gradient_are_close(generator):
    state = generator.get_state()
    exact = random_iterate(3, 3, generator)
    generator.set_state(state)
    with kernels("torch"):  # the fused E-step has float64 exponentials
        coarse = random_iterate(3, 3, generator, dtype=torch.float32)
    assert coarse.value != exact.value
    assert coarse.value == pytest.approx(exact.value, abs=1e-5)
    torch.testing.assert_close(coarse.gradient, exact.gradient, rtol=0, atol=1e-5)


def test_distant_thin_component_gives_the_value_near_the_centre(generator):
    """A component 1 mm thick at 10 km, where natural parameters would keep two digits."""
    flat = torch.randn(60, 3, generator=generator, dtype=torch.float64) * torch.tensor([2.0, 1.0, 1e-3])
    flat = torch.round(flat * 2**30) / 2**30
    offset = torch.tensor([8192.0, -4096.0, 2048.0]).double()
    weight, share = torch.ones(60).double(), torch.ones(1).double()
    cov = torch.diag(torch.tensor([3.0, 2.0, 2e-6]).double())[None]
    tangent = 0.3 * torch.randn(1, 11, generator=generator, dtype=torch.float64)
    places = []
    for shift in (0 * offset, offset):
        mean = shift[None] + 1e-3
        first = Likelihood(flat + shift, weight, 1e-9).at(Parameters(share, mean, cov))
        places.append((first, first.move(tangent)))
    assert bool(Factors(places[1][0].parameters(), "full").lost_digits())
    for near, far in zip(*places, strict=True):
        assert far.value == pytest.approx(near.value, rel=1e-6)
        torch.testing.assert_close(far.gradient, near.gradient, rtol=1e-5, atol=1e-6)


# -- the manifold ----------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [1, 3])
def test_move_is_the_exponential_map_with_parallel_transport(dim, generator):
    """S½ exp(S^−½ V S^−½) S½, and transport E Z Eᵀ with E = (S' S⁻¹)½, by scipy's expm and sqrtm."""
    place = random_iterate(2, dim, generator)
    step, other = (
        0.5 * torch.randn(place.gradient.shape, generator=generator, dtype=torch.float64) for _ in range(2)
    )
    moved = place.move(step)
    torch.testing.assert_close(
        moved.log_weights, torch.log_softmax(place.log_weights + step[:, -1], 0), rtol=1e-12, atol=0
    )
    for k in range(2):
        S, S_new = (covariance(p)[k].numpy() for p in (place, moved))
        root, root_new = (np.linalg.inv(augmented(p)[k].numpy()) for p in (place, moved))
        V, Z, Z_new = (
            g @ unpack_tangent(t, dim + 1)[0][k].numpy() @ g.T
            for g, t in ((root, step), (root, other), (root_new, other))
        )
        half = np.real(sqrtm(S))
        inverse = np.linalg.inv(half)
        np.testing.assert_allclose(S_new, half @ expm(inverse @ V @ inverse) @ half, rtol=1e-8, atol=1e-10)
        E = np.real(sqrtm(S_new @ np.linalg.inv(S)))
        np.testing.assert_allclose(Z_new, E @ Z @ E.T, rtol=1e-8, atol=1e-10)


# -- the ascent on other functions -----------------------------------------------------------------


@dataclass
class Flat:
    """A point of Rⁿ with the interface of the ascent."""

    at: np.ndarray
    function: Any
    slope: Any
    tried: list[np.ndarray]

    @property
    def value(self) -> float:
        return float(self.function(self.at))

    @property
    def gradient(self) -> Tensor:
        return torch.from_numpy(self.slope(self.at))

    @property
    def inverse_hessian(self) -> Tensor:
        return torch.full((len(self.at),), 0.5).double()

    def bounded(self, direction: Tensor) -> Tensor:
        return direction

    def move(self, tangent: Tensor) -> Flat:
        self.tried.append(self.at + tangent.numpy())
        return Flat(self.tried[-1], self.function, self.slope, self.tried)


def hill(start: list[float]) -> Flat:
    return Flat(np.array(start), lambda x: -rosen(x), lambda x: -rosen_der(x), [])


def test_ascend_finds_the_optimum_of_rosenbrock():
    top, values, converged = ascend(hill([-1.2, 1.0, 0.5]), tol=1e-14, max_iter=500)
    assert converged
    np.testing.assert_allclose(top.at, 1, atol=1e-5)
    assert (np.diff(values) >= 0).all()


def test_two_loop_recursion_equals_dense_bfgs():
    rng = np.random.default_rng(0)
    memory, dense = deque(), 0.5 * np.eye(4)
    for _ in range(4):
        step, root = rng.normal(size=4), rng.normal(size=(4, 4))
        fall = (root @ root.T + np.eye(4)) @ step
        memory.append((torch.from_numpy(step), torch.from_numpy(fall), step @ fall))
        rho = 1 / (fall @ step)
        left = np.eye(4) - rho * np.outer(step, fall)
        dense = left @ dense @ left.T + rho * np.outer(step, step)  # Nocedal & Wright, 6.17
    gradient = rng.normal(size=4)
    found = quasi_newton(Flat(np.zeros(4), None, lambda x: gradient, []), memory)
    np.testing.assert_allclose(found.numpy(), dense @ gradient, rtol=1e-10)


@pytest.mark.parametrize("size", [1e-4, 1.0, 1e3])
def test_search_satisfies_the_wolfe_conditions(size):
    place = hill([-1.2, 1.0])
    direction = size * place.gradient / place.gradient.norm()
    length, found = search(place, direction)
    slope = float((place.gradient * direction).sum())
    assert found.value >= place.value + 1e-4 * length * slope
    assert float((found.gradient * direction).sum()) <= 0.9 * slope


def test_ascend_stays_if_no_direction_ascends():
    place = Flat(np.zeros(2), lambda x: -np.abs(x).sum(), lambda x: np.ones(2), [])  # with a wrong gradient
    top, values, converged = ascend(place, tol=0, max_iter=50)
    assert (top.at.tolist(), values, converged) == ([0, 0], [0], True)
    assert len(place.tried) < 100


def test_search_rejects_points_that_cannot_be_computed():
    def function(x: np.ndarray) -> float:
        if x[0] > 1:
            raise NumericalError("out of bounds")
        return math.nan if x[0] > 0.5 else x[0]

    place = Flat(np.zeros(1), function, lambda x: np.ones(1), [])
    place.move = lambda t: (function(t.numpy()), Flat(t.numpy(), function, place.slope, []))[1]
    length, found = search(place, torch.tensor([8.0]).double())
    assert 0.4 < found.value <= 0.5
    assert length == pytest.approx(found.value / 8)
