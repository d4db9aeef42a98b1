"""Starting parameters of EM, and k-means: beside scikit-learn's, and by its definition."""

from __future__ import annotations

import itertools
import math
import warnings

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kernels.twins import by_both
from mixture.fit_contract import check_mixture, degenerate_clouds, move, rigid_motion
from mixture.mixture_cases import cloud, thin_wall
from sklearn.base import clone
from sklearn.cluster import KMeans
from sklearn.datasets import load_digits, load_iris
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mixture import (
    INITIALIZATIONS,
    GaussianMixture,
    Parameters,
    initialize,
    least_support,
    pool_into_cells,
    surface_pieces,
)
from gmmtorch.mixture.em import initialization
from gmmtorch.mixture.em import kmeans as module
from gmmtorch.mixture.em.exact import quadratic_features
from gmmtorch.mixture.em.initialization import distinct, flat_pieces, moments_of, replicated
from gmmtorch.mixture.em.kmeans import kmeans, spread_out

METHODS = sorted(INITIALIZATIONS)
SEEDED = [method for method in METHODS if method != "flat_pieces"]


def begin(method: str, points: Tensor, k: int, weight: Tensor | None = None, seed: int = 0):
    weight = points.new_ones(len(points)) if weight is None else weight
    return initialize(method, points, weight, k, 1e-6, torch.Generator().manual_seed(seed))


def test_distinct_points_have_summed_weights_in_any_order_and_at_minus_zero():
    points = torch.tensor([[1.0, 2.0], [-0.0, 5.0], [1.0, 2.0], [1.0, -3.0], [0.0, 5.0]]).double()
    weight = torch.tensor([1.0, 2.0, 3.0, 0.5, 4.0]).double()
    rows, mass = distinct(points, weight)
    assert dict(zip(map(tuple, points[rows].tolist()), mass.tolist(), strict=True)) == {
        (0.0, 5.0): 6.0,
        (1.0, -3.0): 0.5,
        (1.0, 2.0): 4.0,
    }
    other, _ = distinct(points.flip(0), weight.flip(0))
    assert torch.equal(points.flip(0)[other], points[rows])


@given(st.integers(0, 999), st.integers(1, 60), st.integers(1, 6), st.integers(1, 3))
def test_distinct_points_are_those_of_numpy(seed, n, dim, places):
    points = np.random.default_rng(seed).integers(0, places, (n, dim)) * 2.0**40
    rows, mass = distinct(torch.from_numpy(points), torch.ones(n).double())
    expected, count = np.unique(points, axis=0, return_counts=True)
    order = np.lexsort(points[rows.numpy()].T[::-1])
    np.testing.assert_array_equal(points[rows.numpy()][order], expected)
    np.testing.assert_array_equal(mass.numpy()[order], count)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("dim", [2, 3])
def test_start_is_a_mixture_within_the_cloud(method, dim):
    points = cloud(300, dim)
    weights, means, covariances = begin(method, points, 7)
    assert (weights.shape, means.shape, covariances.shape) == ((7,), (7, dim), (7, dim, dim))
    assert float(weights.min()) > 0
    assert float(weights.sum()) == pytest.approx(1)
    assert float(torch.linalg.eigvalsh(covariances).min()) > 0
    assert bool(((means >= points.amin(0)) & (means <= points.amax(0))).all())


@pytest.mark.parametrize("method", SEEDED)
def test_start_depends_on_the_seed(method):
    points = cloud(200, 2)
    first, again, other = begin(method, points, 5), begin(method, points, 5), begin(method, points, 5, seed=1)
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert not torch.equal(first.means, other.means)


@pytest.mark.parametrize("method", METHODS)
def test_integer_weights_equal_repeated_points_in_any_order(method):
    points = cloud(100, 3)
    weight = torch.randint(1, 4, (100,), generator=torch.Generator().manual_seed(2)).double()
    repeated = points.repeat_interleave(weight.long(), 0)
    shuffled = repeated[torch.randperm(len(repeated), generator=torch.Generator().manual_seed(3))]
    found, same = begin(method, points, 6, weight), begin(method, shuffled, 6)
    torch.testing.assert_close(tuple(found), tuple(same), rtol=1e-10, atol=1e-12)


def test_random_points_are_drawn_by_weight():
    points = torch.arange(4.0, dtype=torch.float64)[:, None].expand(4, 2)
    weight = torch.tensor([1.0, 2.0, 3.0, 4.0], dtype=torch.float64)
    drawn = [float(begin("random_points", points, 1, weight, seed).means[0, 0]) for seed in range(800)]
    shares = np.bincount(np.array(drawn, dtype=int), minlength=4) / 800
    np.testing.assert_allclose(shares, [0.1, 0.2, 0.3, 0.4], atol=0.07)  # four standard errors


@pytest.mark.parametrize("method", ["random_points", "bounding_box"])
@pytest.mark.parametrize("dim", [2, 3])
def test_isotropic_starts_have_the_reduced_variance_of_the_cloud(method, dim):
    points = cloud(500, dim)
    covariances = begin(method, points, 4).covariances
    variance = points.numpy().var(axis=0).mean() * 4 ** (-2 / dim) + 1e-6
    expected = np.broadcast_to(variance * np.eye(dim), (4, dim, dim))
    np.testing.assert_allclose(covariances.numpy(), expected, rtol=1e-10)


def test_kmeans_start_has_the_moments_of_the_clusters():
    centers = torch.tensor([[-9.0, 0.0], [0.0, 9.0], [9.0, 0.0]], dtype=torch.float64)
    points = torch.cat(
        [center + 0.3 * cloud(n, 2, n) for center, n in zip(centers, (30, 50, 20), strict=True)]
    )
    weights, means, covariances = begin("kmeans", points, 3)
    order = means[:, 0].argsort()
    np.testing.assert_allclose(weights[order].numpy(), [0.3, 0.5, 0.2], rtol=1e-10)
    for i, own in zip(order, points.split([30, 50, 20]), strict=True):
        np.testing.assert_allclose(means[i].numpy(), own.numpy().mean(0), atol=1e-10)
        expected = np.cov(own.numpy().T, ddof=0) + 1e-6 * np.eye(2)
        np.testing.assert_allclose(covariances[i].numpy(), expected, rtol=1e-8, atol=1e-11)


@pytest.mark.parametrize("method", METHODS)
def test_several_starts_differ_from_each_other_and_are_those_of_any_batches(method, monkeypatch):
    points, weight = cloud(200, 3), torch.ones(200).double()
    found = []
    for at_once in (1 << 20, 1):
        monkeypatch.setattr(initialization, "_DISTANCES", at_once)
        settings = 5, 1e-6, torch.Generator().manual_seed(3), "full", 4
        found.append([*initialization.initializations(method, points, weight, *settings)])
    together, apart = found
    assert len(together) == len(apart) == 4
    means = {tuple(one.means.flatten().tolist()) for one in together}
    assert len(means) > 1 or method in ("flat_pieces", "kmeans_restarts")
    assert all(float(one.weights.sum()) == pytest.approx(1) for one in together)
    for one, other in zip(together, apart, strict=True):
        torch.testing.assert_close(one.means, other.means)


def test_kmeans_restarts_keep_the_clustering_of_least_scatter():
    points = cloud(400, 2)

    def scatter(method: str, seed: int) -> float:
        weights, _, covariances = begin(method, points, 25, seed=seed)
        return float((weights * covariances.diagonal(dim1=-2, dim2=-1).sum(1)).sum())

    once, restarted = (
        [scatter(method, seed) for seed in range(6)] for method in ("kmeans", "kmeans_restarts")
    )
    assert max(restarted) < np.mean(once)
    assert min(restarted) <= min(once)


# -- flat pieces -------------------------------------------------------------------------------------


def check_moments(found: Parameters, labels: Tensor, points: np.ndarray, weight: np.ndarray) -> None:
    """Check that each component has the weight, mean and covariance of the points of its label."""
    dim = points.shape[1]
    for k, (share, mean, covariance) in enumerate(zip(*found, strict=True)):
        own, p = points[labels.numpy() == k], weight[labels.numpy() == k]
        assert float(share) == pytest.approx(p.sum() / weight.sum(), rel=1e-9)
        center = np.average(own, axis=0, weights=p)
        np.testing.assert_allclose(mean, center, rtol=1e-12, atol=1e-9)
        offset = own - center
        expected = np.einsum("n,ni,nj->ij", p / p.sum(), offset, offset) + 1e-6 * np.eye(dim)
        np.testing.assert_allclose(covariance, expected, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("dim", [1, 2, 3, 5])
@pytest.mark.parametrize("pooled", [False, True])
def test_flat_pieces_have_the_moments_of_their_points(dim, pooled, monkeypatch):
    if pooled:
        monkeypatch.setattr(initialization, "_FEWEST_CELLS", 100)
    points = cloud(600, dim)
    weight = torch.rand(600, generator=torch.Generator().manual_seed(1), dtype=torch.float64) + 0.1
    found, labels = flat_pieces(points, weight, 12, 1e-6)
    assert found.weights.shape == (12,)
    assert labels.shape == (600,)
    assert sorted(set(labels.tolist())) == list(range(12))
    check_moments(found, labels, points.numpy(), weight.numpy())


def test_flat_pieces_of_cells_have_the_moments_of_their_points():
    points, weight = cloud(600, 3), torch.ones(600, dtype=torch.float64)
    cells = pool_into_cells(points, 150, 1e-3)
    means = cells.features[:, 1:4].contiguous()
    found, labels = flat_pieces(means, cells.weight, 10, 1e-6, cells.features)
    assert labels.shape == (len(means),)
    check_moments(found, labels[cells.member], points.numpy(), weight.numpy())


def test_moments_of_distant_thin_pieces_keep_their_digits():
    wall = thin_wall(500, 3.0, noise=1e-3).numpy()
    points = torch.from_numpy(np.concatenate([wall - 250_000.0, wall + 250_000.0]))
    labels = torch.arange(2).repeat_interleave(500)
    weight = torch.ones(1000, dtype=torch.float64)
    found = moments_of(quadratic_features(points), weight, labels, 2, 0.0, points)
    for covariance in found.covariances:
        np.testing.assert_allclose(covariance, np.cov(wall.T, ddof=0), atol=1e-10)


@pytest.mark.parametrize("k", [3, 4, 7])
def test_replicated_components_share_the_weight(k):
    weights = torch.tensor([0.5, 0.3, 0.2], dtype=torch.float64)
    found = Parameters(weights, cloud(3, 2), torch.eye(2, dtype=torch.float64).repeat(3, 1, 1))
    many, copy = replicated(found, k), torch.arange(k) % 3
    assert many.weights.shape == (k,)
    assert torch.equal(many.means, found.means[copy])
    sums = torch.zeros(3, dtype=torch.float64).index_add_(0, copy, many.weights)
    torch.testing.assert_close(sums, weights)


NOISE = 0.01


def wall(n: int, center: tuple[float, ...], axis: int, seed: int, noise: float = NOISE) -> Tensor:
    """A square of 4 m that is thin along one axis."""
    generator = torch.Generator().manual_seed(seed)
    points = 4 * torch.rand(n, 3, generator=generator, dtype=torch.float64) - 2
    points[:, axis] = noise * torch.randn(n, generator=generator, dtype=torch.float64)
    return points + torch.tensor(center, dtype=torch.float64)


def room(n_wall: int = 500, seed: int = 0) -> Tensor:
    """Six walls of a cube around the origin."""
    sides = [
        wall(
            n_wall, tuple(2.0 * sign * (axis == a) for a in range(3)), axis, 10 * seed + 2 * axis + (sign > 0)
        )
        for axis in range(3)
        for sign in (-1, 1)
    ]
    return torch.cat(sides)


def sphere(n: int, seed: int = 0) -> Tensor:
    """The surface of a sphere of radius 1 m, with 2 mm of noise."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(n, 3, generator=generator, dtype=torch.float64)
    points /= points.norm(dim=1, keepdim=True)
    return points * (1 + 0.002 * torch.randn(n, 1, generator=generator, dtype=torch.float64))


def count(points: Tensor, noise: float = NOISE, weight: Tensor | None = None) -> int:
    weight = points.new_ones(len(points)) if weight is None else weight
    found, labels = surface_pieces(points - points.mean(0), weight, noise, 1e-6)
    assert labels.unique().tolist() == list(range(len(found.weights)))
    return len(found.weights)


def fitted(points: Tensor | np.ndarray, **options) -> GaussianMixture:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return GaussianMixture(None, random_state=0, **options).fit(points)


# -- the count ------------------------------------------------------------------------------------


def test_flat_wall_is_one_component_and_clutter_many():
    assert [count(wall(n, (0, 0, 0), 1, 0)) for n in (10, 1000, 30_000)] == [1, 1, 1]
    assert count(cloud(1000, 3)) > 15


def test_room_has_large_pieces_on_walls_and_small_ones_at_edges():
    points = room(2000)
    found, labels = surface_pieces(points, torch.ones(len(points)).double(), NOISE, 0.0)
    size = torch.bincount(labels)
    flat = torch.linalg.eigvalsh(found.covariances)[:, 0].sqrt() <= 2 * NOISE
    # Pieces across two walls have too few points to be halved, and are along an edge.
    assert bool((flat | (size < 4 * least_support(3))).all())
    from_edge = (2 - points.abs()).sort(1).values[:, 1]
    assert float(from_edge[~flat[labels]].max()) < 1
    inside = from_edge > 0.6
    assert float(size[labels][inside].double().mean()) > 6 * least_support(3)
    assert len(size) < 0.6 * count(cloud(12_000, 3))


def test_less_noise_gives_more_pieces_of_a_curved_surface():
    counts = [count(sphere(20_000), noise) for noise in (0.16, 0.08, 0.04, 0.02, 0.01)]
    assert counts == sorted(counts)
    # A cap of radius a on a unit ball is about a²/4 thick in standard deviations over √3: pieces grow
    # with the noise, so their number is inversely proportional to it.
    for fewer, more in itertools.pairwise(counts[1:]):
        assert 1.4 < more / fewer < 3


@pytest.mark.parametrize("unit", [1e-6, 1e-3, 1e3])
def test_number_does_not_depend_on_the_unit(unit):
    for points in (room(200), sphere(3000), cloud(500, 3)):
        assert count(unit * points, unit * NOISE) == count(points)


def test_noise_in_another_unit_gives_one_or_the_most_components():
    assert count(1e-3 * cloud(2000, 3)) == 1
    n = count(1e3 * cloud(2000, 3))
    assert 2000 / (4 * least_support(3)) <= n <= 2000 / least_support(3)


@given(seed=st.integers(0, 10**6), n=st.integers(1, 400), dim=st.integers(1, 6), noise=st.floats(1e-4, 10))
def test_number_is_limited_by_the_points(seed, n, dim, noise):
    points = torch.rand(n, dim, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    assert 1 <= count(points, noise) <= max(1, n // least_support(dim))


def test_least_support_is_twice_the_parameters_from_3d_on():
    assert [least_support(dim) for dim in (1, 2, 3)] == [6, 6, 20]
    for dim in range(3, 8):
        assert least_support(dim) == 2 * (1 + dim + dim * (dim + 1) // 2)


def test_weights_count_as_points():
    points = room(100)
    weight = torch.randint(1, 4, (len(points),), generator=torch.Generator().manual_seed(1)).double()
    assert count(points, weight=weight) == count(points.repeat_interleave(weight.long(), 0))
    # Ten times the weight supports more components; a thousandth of it supports a single one.
    assert count(cloud(300, 3), weight=torch.full((300,), 10.0).double()) > 2 * count(cloud(300, 3))
    assert count(cloud(300, 3), weight=torch.full((300,), 1e-3).double()) == 1


@pytest.mark.parametrize("dim", [2, 3, 5])
def test_number_does_not_depend_on_motion_or_order(dim):
    points = cloud(600, dim).numpy() * np.array([3.0, 1.0, 0.02, 0.5, 1.0])[:dim]
    moved = move(rigid_motion(dim, seed=1), points)
    shuffled = np.random.default_rng(0).permutation(points)
    counts = {count(torch.from_numpy(points)) for points in (points, moved, shuffled, points + 5e5)}
    assert len(counts) == 1


def test_cells_give_nearly_the_number_of_points(monkeypatch):
    points = torch.cat([room(3000), sphere(10_000)])
    exact = count(points)
    monkeypatch.setattr(initialization, "_SURFACE_CELLS", 8000)
    assert count(points) == pytest.approx(exact, rel=0.1)


# -- GaussianMixture without a number ---------------------------------------------------------------


@pytest.mark.parametrize("algorithm", ["exact", "truncated", "auto"])
def test_em_starts_from_the_pieces(algorithm):
    points = room()
    weight = torch.ones(len(points)).double()
    center = points.mean(0)
    first, _ = surface_pieces(points - center, weight, NOISE, 1e-6)
    with pytest.warns(match="did not converge"):
        mixture = GaussianMixture(None, noise=NOISE, max_iter=1, algorithm=algorithm).fit(points)
    assert mixture.n_components is None
    assert mixture.means_.shape == first.means.shape
    given = GaussianMixture.from_parameters(*first)
    assert mixture.lower_bound_ == pytest.approx(given.score(points - center), abs=0.01)
    done = fitted(points, algorithm=algorithm)
    assert done.score(points) > given.score(points - center) + 0.05


def test_number_depends_on_the_noise():
    points = sphere(4000)
    assert len(fitted(points, noise=0.08).means_) == count(points, 0.08)
    assert len(fitted(points, noise=0.02).means_) == count(points, 0.02)
    # Without effect if the number is given.
    assert len(GaussianMixture(3, noise=0.02, random_state=0).fit(points).means_) == 3


@pytest.mark.parametrize("dim", [1, 2, 3, 5])
@pytest.mark.parametrize("algorithm", ["exact", "truncated"])
def test_degenerate_clouds_are_fitted(dim, algorithm):
    for name, points in degenerate_clouds(dim).items():
        mixture = fitted(points, algorithm=algorithm)
        check_mixture(mixture, points, at_most=len(points))
        if name != "huge":
            assert len(mixture.means_) <= max(1, len(points) // least_support(dim)) + 1, name


def test_n_components_none_is_kept_by_files_states_and_copies(tmp_path):
    points = room(200)
    mixture = fitted(points, noise=0.02)
    k = len(mixture.means_)
    mixture.save(tmp_path / "m.safetensors")
    loaded = GaussianMixture.load(tmp_path / "m.safetensors")
    taken = GaussianMixture(None)
    taken.load_state_dict(mixture.state_dict())
    numbered = GaussianMixture(2)
    numbered.load_state_dict(mixture.state_dict())
    assert numbered.n_components == k
    for other in (loaded, taken, mixture.moved(np.eye(4))):
        assert other.n_components is None
        assert torch.equal(other.means, mixture.means)
    assert loaded.get_params() == mixture.get_params()
    copy = clone(mixture)
    assert copy.n_components is None
    assert torch.equal(copy.fit(points).means, mixture.means)
    # A new fit determines a new number.
    assert len(loaded.fit(wall(500, (0, 0, 0), 2, 0)).means_) == 1


def test_warm_start_and_partial_fit_keep_the_number():
    points, other = room(300), sphere(2000)
    mixture = fitted(points, warm_start=True)
    k = len(mixture.means_)
    before = mixture.lower_bound_
    assert len(mixture.fit(points).means_) == k
    assert mixture.lower_bound_ >= before - 1e-6
    assert len(mixture.fit(other).means_) == k
    batches = GaussianMixture(None, noise=NOISE)
    batches.partial_fit(points)  # the first batch decides
    assert len(batches.means_) == count(points)
    batches.partial_fit(other)
    assert len(batches.means_) == count(points)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        *(({name: np.ones(1)}, f"{name}.*n_components=None") for name in
          ("weights_init", "means_init", "precisions_init")),
        *(({"noise": noise}, r"^noise") for noise in (0, -1.0, math.nan, math.inf, "low", None)),
    ],
)  # fmt: skip
def test_a_given_start_and_invalid_noise_are_rejected(options, message):
    with pytest.raises(InvalidArgumentError, match=message):
        GaussianMixture(None, **options).fit(room(10))


# -- k-means ---------------------------------------------------------------------------------------


def clusters(x: np.ndarray, k: int, seed: int, n_runs: int = 1) -> tuple[np.ndarray, np.ndarray]:
    points = torch.from_numpy(x - x.mean(0))
    weight = torch.ones(len(x)).double()
    nearest, scatter = kmeans(
        points, weight, *distinct(points, weight), k, torch.Generator().manual_seed(seed), n_runs
    )
    return nearest.numpy(), scatter.numpy()


def scatter_of(x: np.ndarray, labels: np.ndarray) -> float:
    return sum(float(((x[labels == k] - x[labels == k].mean(0)) ** 2).sum()) for k in np.unique(labels))


@pytest.mark.parametrize(("table", "k"), [(load_digits, 10), (load_iris, 3), (load_iris, 40)])
def test_runs_are_as_good_as_those_of_scikit_learn(table, k):
    x = table().data
    _, ours = clusters(x, k, 0, 12)
    theirs = [KMeans(k, n_init=1, random_state=seed).fit(x).inertia_ for seed in range(12)]
    assert ours.mean() < 1.02 * np.mean(theirs)
    assert ours.min() < 1.005 * np.min(theirs)


@given(st.integers(0, 999), st.integers(2, 80), st.integers(1, 7), st.integers(1, 5), st.integers(1, 3))
def test_clusters_are_not_empty_and_improve_in_no_step_of_lloyd(seed, n, dim, k, n_runs):
    x = np.random.default_rng(seed).normal(size=(n, dim))
    k = min(k, n)
    nearest, scatter = clusters(x, k, seed, n_runs)
    for labels, value in zip(nearest, scatter, strict=True):
        assert len(np.unique(labels)) == k
        means = np.stack([x[labels == j].mean(0) for j in range(k)])
        next_labels = ((x[:, None] - means) ** 2).sum(2).argmin(1)
        assert scatter_of(x, next_labels) >= (1 - 1e-3) * scatter_of(x, labels)
        assert value == pytest.approx(scatter_of(x, labels), rel=1e-3, abs=1e-9)


def test_centers_are_distinct_points_even_if_far_ones_are_few():
    x = torch.cat([torch.zeros(500, 2), torch.arange(5.0)[:, None].expand(5, 2) * 1e8]).double()
    weight = torch.ones(505).double()
    rows, mass = distinct(x, weight)
    assert len(rows) == 5
    chosen = spread_out(x, weight, rows, mass, 5, torch.Generator().manual_seed(0), 4)
    assert all(len(set(map(tuple, x[own].tolist()))) == 5 for own in chosen)


def test_empty_clusters_continue_at_the_farthest_points(monkeypatch):
    x = np.repeat(np.array([[-9.0], [0.0], [1.0], [20.0]]), 3, 0)
    monkeypatch.setattr(module, "spread_out", lambda points, *_: torch.tensor([[0, 1, 2, 3]]))
    for labels, scatter in by_both(lambda: clusters(x, 4, 0)):  # of four centers, three are equal
        assert scatter[0] < 1e-9
        assert sorted(np.bincount(labels[0]).tolist()) == [3, 3, 3, 3]


@given(st.integers(0, 999), st.integers(2, 60), st.integers(1, 9), st.integers(1, 20))
def test_one_launch_finds_what_the_twin_finds(seed, n, dim, k):
    rng = np.random.default_rng(seed)
    weight = torch.from_numpy(rng.random(n) + 0.5)
    points = torch.from_numpy(rng.normal(size=(n, dim)))
    cloud = (points, weight, *distinct(points, weight))
    twin, fused = by_both(lambda: kmeans(*cloud, min(k, n), torch.Generator().manual_seed(seed)))
    torch.testing.assert_close(fused, twin)


def test_equal_and_extreme_points_have_clusters():
    for x in (np.repeat(np.arange(5.0), 9)[:, None] * 1e8, np.full((20, 3), 1e200), np.eye(12)):
        labels, _ = clusters(x, len(np.unique(x, axis=0)), 0, 3)
        assert all(len(np.unique(own)) == len(np.unique(x, axis=0)) for own in labels)
