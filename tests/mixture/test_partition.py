"""Partition of a cloud into flat pieces."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from mixture.mixture_cases import cloud
from torch import Tensor

from gmmtorch.kernels import kernels
from gmmtorch.mixture import GaussianMixture
from gmmtorch.mixture.em.exact import quadratic_features
from gmmtorch.mixture.em.partition import FlatnessRule, Partition, partition, pool_into_cells

RULE = FlatnessRule(thickness=0.02, length=0.5, min_weight=5)


def cut(points: Tensor, rule: FlatnessRule, weight: Tensor | None = None) -> Partition:
    return partition(points, points.new_ones(len(points)) if weight is None else weight, rule)


@given(
    seed=st.integers(0, 10**6),
    n=st.integers(1, 200),
    dim=st.integers(2, 3),
    min_weight=st.floats(1, 20),
    min_weight_thick=st.floats(1, 20),
    limit=st.none() | st.integers(1, 12),
)
def test_pieces_are_supported_and_within_the_limit(seed, n, dim, min_weight, min_weight_thick, limit):
    points = cloud(n, dim, seed)
    weight = torch.rand(n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 2 + 0.1
    rule = FlatnessRule(0.02, 0.3, min_weight, min_weight_thick, limit)
    labels, n_pieces = partition(points, weight, rule)
    assert labels.shape == (n,)
    assert labels.unique().tolist() == list(range(n_pieces))  # every label used: no piece is empty
    pieces = np.bincount(labels.numpy(), weights=weight.numpy(), minlength=n_pieces)
    if n_pieces > 1:
        assert pieces.min() >= min(min_weight, min_weight_thick) - 1e-9
    if limit is not None:
        assert n_pieces <= limit


@given(seed=st.integers(0, 10**6), dim=st.integers(2, 3))
def test_remaining_pieces_are_flat_and_short_or_cannot_be_halved(seed, dim):
    points = cloud(300, dim, seed)
    labels, n_pieces = cut(points, RULE)
    for piece in range(n_pieces):
        own = points[labels == piece].numpy()
        variances, directions = np.linalg.eigh(np.cov(own.T, ddof=0))
        flat = variances[0] <= RULE.thickness**2 * (1 + 1e-9)
        short = variances[-1] <= RULE.length**2 * (1 + 1e-9)
        beyond = ((own - own.mean(0)) @ directions[:, -1] > 0).sum()
        thick = variances[0] > (2 * RULE.thickness) ** 2
        least = RULE.min_weight_thick if thick else RULE.min_weight
        too_light = min(beyond, len(own) - beyond) < least
        assert (flat and short) or too_light


def test_integer_weights_equal_repeated_points():
    points = cloud(120, 2, 4)
    weight = torch.randint(1, 4, (120,), generator=torch.Generator().manual_seed(0)).double()
    repeated = points.repeat_interleave(weight.long(), 0)
    center = repeated.mean(0)
    labels, n_pieces = cut(points - center, RULE, weight)
    again = cut(repeated - center, RULE)
    assert n_pieces == again.n_pieces
    assert torch.equal(labels.repeat_interleave(weight.long()), again.labels)


@pytest.mark.parametrize("n", [1, 2, 100])
def test_equal_points_are_one_piece(n):
    assert cut(torch.zeros(n, 3, dtype=torch.float64), RULE).n_pieces == 1


@pytest.mark.parametrize(("n_strays", "distance"), [(9, 200.0), (9, 1000.0), (1, 500.0)])
def test_few_far_returns_do_not_prevent_the_partition(n_strays, distance, generator):
    room = torch.rand(2000, 3, generator=generator, dtype=torch.float64) * torch.tensor([6.0, 5.0, 2.5])
    strays = torch.randn(n_strays, 3, generator=generator, dtype=torch.float64) + distance
    rule = FlatnessRule(min_weight=20, min_weight_thick=20)
    separate = partition(room, torch.ones(len(room), dtype=torch.float64), rule)
    points = torch.cat([room, strays])
    both = partition(points - points.mean(0), torch.ones(len(points), dtype=torch.float64), rule)
    assert both.n_pieces >= separate.n_pieces
    of_strays = both.labels[len(room) :]
    assert not torch.isin(both.labels[: len(room)], of_strays).any()


# -- a limited number of pieces ----------------------------------------------------------------------

ALL = {"thickness": 0.0, "length": 0.0, "min_weight": 0.0, "min_weight_thick": 0.0, "outlier_gap": 0.0}


@given(
    seed=st.integers(0, 10**6),
    n=st.integers(1, 150),
    dim=st.integers(1, 3),
    limit=st.integers(1, 170),
    grain=st.sampled_from([0.0, 0.5]),
    within=st.sampled_from([0.0, 1.0]),
)
def test_number_of_pieces_is_the_limit_or_the_distinct_points(seed, n, dim, limit, grain, within):
    points = cloud(n, dim, seed)
    points = (points / grain).round() * grain if grain else points
    generator = torch.Generator().manual_seed(seed)
    weight = torch.rand(n, generator=generator, dtype=torch.float64) ** 8 + 1e-6  # few heavy cells
    features = quadratic_features(points)
    # Cells have an extent, which no cut reduces.
    spread = within * torch.rand(n, generator=generator, dtype=torch.float64)
    for i in range(dim):
        features[:, 1 + dim + i * dim - i * (i - 1) // 2] += spread
    labels, n_pieces = partition(points, weight, FlatnessRule(**ALL, max_components=limit), features)
    assert n_pieces == min(limit, len(points.unique(dim=0)))
    assert labels.unique().tolist() == list(range(n_pieces))


def sheets(gap: float, n: int = 400) -> Tensor:
    """Points of a strip of 1 m × 0.2 m, on two sheets with distance `gap`."""
    generator = torch.Generator().manual_seed(1)
    points = torch.rand(n, 3, generator=generator, dtype=torch.float64) * torch.tensor([1.0, 0.2, 0.0])
    points[::2, 2] = gap
    return points


@pytest.mark.parametrize("thick_first", [False, True])
def test_thicker_of_two_similar_pieces_is_halved_first(thick_first):
    pair = [sheets(0.1), sheets(0.0) + torch.tensor([0.0, 20.0, 0.0])]
    points = torch.cat(pair if thick_first else pair[::-1])
    labels, n_pieces = cut(points - points.mean(0), FlatnessRule(**ALL, max_components=3))
    assert n_pieces == 3
    thick, thin = (labels[:400], labels[400:]) if thick_first else (labels[400:], labels[:400])
    assert len(set(thick.tolist())) == 2
    assert len(set(thin.tolist())) == 1


def test_heavier_of_two_equal_shapes_is_halved_first():
    piece = sheets(0.02)
    points = torch.cat([piece, piece + torch.tensor([0.0, 20.0, 0.0])])
    weight = torch.cat([torch.full((400,), value, dtype=torch.float64) for value in (1.0, 1.5)])
    center = weight @ points / weight.sum()
    labels, n_pieces = cut(points - center, FlatnessRule(**ALL, max_components=3), weight)
    assert n_pieces == 3
    assert len(set(labels[:400].tolist())) == 1


def test_pieces_that_cannot_be_halved_do_not_use_up_the_levels():
    # Heavy, wide cells have the highest priority, but only the light ones can be separated.
    heavy = torch.stack([torch.arange(90.0, dtype=torch.float64) * 50, torch.zeros(90)], 1)
    light = torch.stack([torch.arange(40.0, dtype=torch.float64) * 0.01 - 300, torch.zeros(40)], 1)
    points = torch.cat([heavy, light])
    weight = torch.cat([torch.full((90,), 1e6), torch.ones(40)]).double()
    center = weight @ points / weight.sum()
    features = quadratic_features(points - center)
    features[:90, 3] += 100.0
    features[:90, 5] += 100.0
    found = partition(points - center, weight, FlatnessRule(**ALL, max_components=125), features)
    assert found.n_pieces == 125


@given(
    seed=st.integers(0, 10**6),
    n=st.integers(1, 300),
    dim=st.integers(2, 3),
    limit=st.integers(1, 300),
    finest=st.sampled_from([1e-3, 0.1, 1.0]),
)
def test_cells_conserve_moments_within_the_limit(seed, n, dim, limit, finest):
    points = cloud(n, dim, seed)
    cells = pool_into_cells(points, limit, finest)
    assert cells.weight.shape[0] <= limit
    assert float(cells.weight.min()) >= 1
    assert float(cells.weight.sum()) == n
    torch.testing.assert_close(
        (cells.features * cells.weight[:, None]).sum(0),
        quadratic_features(points).sum(0),
        rtol=1e-11,
        atol=1e-11,
    )


def test_each_cell_is_the_exact_mean_of_its_points():
    points = (cloud(200, 3, 0) * 1024).round() / 1024
    cells = pool_into_cells(points, 40, 0.01)
    for cell in range(cells.weight.shape[0]):
        own = [[Fraction(x) for x in row] for row in points[cells.member == cell].tolist()]
        assert len(own) == int(cells.weight[cell])
        products = [(i, j) for i in range(3) for j in range(i, 3)]
        expected = [Fraction(1)]
        expected += [sum(row[i] for row in own) / len(own) for i in range(3)]
        expected += [sum(row[i] * row[j] for row in own) / len(own) for i, j in products]
        # Sums of these numbers are exact in float64, so only the division may round.
        assert cells.features[cell].tolist() == [float(x) for x in expected]


@pytest.mark.parametrize("dim", [2, 3])
def test_cells_have_the_finest_side(dim):
    points = cloud(3000, dim, 1)
    cells = pool_into_cells(points, 2999, 0.3)
    assert cells.weight.shape[0] < 2999
    low = points.amin(0).numpy()
    keys = {tuple(k) for k in np.floor((points.numpy() - low) / 0.3).astype(int)}
    assert cells.weight.shape[0] == len(keys)
    for cell in range(cells.weight.shape[0]):
        own = points[cells.member == cell]
        assert float((own.amax(0) - own.amin(0)).max()) <= 0.3 + 1e-12


def test_distant_outlier_gets_its_own_cell():
    points = torch.cat([cloud(500, 3, 0), torch.full((1, 3), 5e5, dtype=torch.float64)])
    cells = pool_into_cells(points, 100, 0.01)
    assert int(cells.weight[cells.member[-1]]) == 1  # the outlier has its own cell
    assert float(cells.weight.sum()) == 501
    torch.testing.assert_close(
        (cells.features * cells.weight[:, None]).sum(0), quadratic_features(points).sum(0), rtol=1e-12, atol=0
    )


@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("limit", [30, 1000])
def test_cells_of_integer_weights_equal_those_of_repeated_points(dim, limit):
    points = cloud(200, dim, 5)
    weight = torch.randint(1, 4, (200,), generator=torch.Generator().manual_seed(0)).double()
    weighted = pool_into_cells(points, min(limit, 199), 1e-3, weight)
    repeated = pool_into_cells(points.repeat_interleave(weight.long(), 0), min(limit, 199), 1e-3)
    torch.testing.assert_close(weighted.features, repeated.features, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(weighted.weight, repeated.weight)
    assert torch.equal(weighted.member.repeat_interleave(weight.long()), repeated.member)


def test_equal_points_share_one_cell():
    cells = pool_into_cells(torch.zeros(50, 3, dtype=torch.float64), 5, 0.0)
    assert cells.weight.tolist() == [50.0]
    assert cells.member.tolist() == [0] * 50
    assert cells.features.tolist() == [[1.0] + [0.0] * 9]


@pytest.mark.parametrize("algorithm", ["exact", "truncated"])
@pytest.mark.parametrize("init", ["kmeans", "flat_pieces"])
def test_fit_with_one_cell_per_point_equals_fit_of_points(algorithm, init):
    points = cloud(300, 3, 1).numpy()
    options = {"algorithm": algorithm, "init_params": init, "random_state": 0, "dtype": "float64"}
    plain = GaussianMixture(20, **options).fit(points)
    for limit in (300, 5000):
        pooled = GaussianMixture(20, max_cells=limit, **options).fit(points)
        np.testing.assert_allclose(pooled.lower_bounds_, plain.lower_bounds_, rtol=1e-9)
        np.testing.assert_allclose(pooled.means_, plain.means_, atol=1e-6)
        np.testing.assert_allclose(pooled.covariances_, plain.covariances_, atol=1e-6)


@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("kind", ["any", "equal", "lattice"])
@pytest.mark.parametrize("limit", [1, 40, 1500])
def test_fused_cells_are_those_of_the_twin(dim, kind, limit):
    points = cloud(2000, dim, 5)
    if kind == "equal":
        points[:] = points[0].clone()
    if kind == "lattice":  # points on the planes between cells
        points = (points * 4).round() / 4
    weight, found = 1 + torch.arange(2000).double() % 3, []
    for choice in ("torch", "fused"):
        with kernels(choice):
            found.append(pool_into_cells(points, limit, 0.25, weight))
    assert torch.equal(found[1].member, found[0].member)
    torch.testing.assert_close(found[1], found[0], rtol=1e-12, atol=1e-12)
