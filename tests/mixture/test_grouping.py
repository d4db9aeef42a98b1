"""Rows in groups, and the E-step over a few candidates, against brute force."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from mixture.mixture_cases import cloud, random_parameters, random_weight, rows_of, scipy_log_joint
from scipy.special import logsumexp

from gmmtorch.kernels import chunks
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em import truncated
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.mixture.em.truncated import choose_candidates, group_rows, nearest, truncated_expectation

pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
dims = pytest.mark.parametrize("dim", [1, 2, 3, 5])
kinds = pytest.mark.parametrize("are_points", [True, False])


# -- rows in blocks --------------------------------------------------------------------------------


@given(
    seed=st.integers(0, 10**6),
    n=st.integers(1, 300),
    k=st.integers(1, 9),
    dim=st.integers(1, 3),
    one_group=st.booleans(),
    are_points=st.booleans(),
    build_rows=st.sampled_from([1 << 18, 7]),
)
def test_group_rows_puts_each_row_into_one_slot_of_its_owner(
    seed, n, k, dim, one_group, are_points, build_rows
):
    points, weight, centers = cloud(n, dim, seed), random_weight(n, seed), cloud(k, dim, seed + 1)
    owner = torch.randint(0, k, (n,), generator=torch.Generator().manual_seed(seed))
    owner = owner // 2 * 2 if not one_group else torch.full_like(owner, k - 1)  # with empty groups
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(truncated, "_BUILD_ROWS", build_rows)
        groups = group_rows(rows_of(points, weight, are_points), owner, centers, torch.float64)
    block = groups.weight.shape[1]
    assert sorted(groups.row.tolist()) == list(range(n))
    assert len(set(groups.slot.tolist())) == n
    assert (groups.owner[groups.slot // block] == owner[groups.row]).all()
    assert (groups.owner[1:] >= groups.owner[:-1]).all()
    assert groups.n_rows.tolist() == np.bincount(owner.numpy(), minlength=k).tolist()
    features, found = groups.features.flatten(0, 1), groups.weight.flatten()
    expected = em.quadratic_features((points - centers[owner])[groups.row])
    torch.testing.assert_close(features[groups.slot], expected, rtol=1e-12, atol=1e-12)
    assert torch.equal(found[groups.slot], weight[groups.row])
    empty = torch.ones(len(found), dtype=torch.bool)
    empty[groups.slot] = False
    assert (found[empty] == 0).all()
    assert (features[empty] == 0).all()
    assert int(empty.sum()) < block * len(set(owner.tolist()))  # no block is empty


# -- the E-step ------------------------------------------------------------------------------------


@dims
@kinds
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-10), (torch.float32, 2e-5)])
def test_e_step_over_all_candidates_equals_exact_e_step(dim, are_points, dtype, tolerance, monkeypatch):
    monkeypatch.setattr(chunks, "CHUNK_ELEMENTS", 500)  # several chunks
    points, weight, parameters = cloud(400, dim), random_weight(400), random_parameters(7, dim)
    owner = torch.randint(0, 7, (400,), generator=torch.Generator().manual_seed(3))
    groups = group_rows(rows_of(points, weight, are_points), owner, parameters.means, dtype)
    candidates = choose_candidates(groups, parameters, 16)
    assert [sorted(row) for row in candidates.tolist()] == [list(range(7))] * 7
    found = truncated_expectation(groups, candidates, parameters)
    statistics, value = em.expectation(
        em.quadratic_features(points), weight, em.natural_parameters(parameters), torch.float64
    )
    about_means = em.shift_features(statistics, -parameters.means)
    assert found.value == pytest.approx(float(value), rel=tolerance)
    assert found.statistics.dtype == torch.float64
    scale = float(about_means.abs().max())
    torch.testing.assert_close(found.statistics, about_means, rtol=0, atol=tolerance * scale)
    assert found.owner is None


@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("m", [1, 3])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_e_step_over_few_candidates_equals_brute_force(dim, m, dtype):
    k, n = 8, 300
    tolerance = {torch.float64: 1e-10, torch.float32: 1e-4}[dtype]
    points, weight, parameters = cloud(n, dim), random_weight(n), random_parameters(k, dim, seed=2)
    generator = torch.Generator().manual_seed(1)
    owner = torch.randint(0, k, (n,), generator=generator)
    candidates = torch.stack([torch.randperm(k, generator=generator)[:m] for _ in range(k)])
    groups = group_rows(rows_of(points, weight), owner, parameters.means, dtype)
    found = truncated_expectation(groups, candidates, parameters, want_owner=True)

    joint = scipy_log_joint(points, parameters)
    offered = np.zeros((n, k), dtype=bool)
    np.put_along_axis(offered, candidates[owner].numpy(), True, axis=1)
    allowed = np.where(offered, joint, -np.inf)
    norm = logsumexp(allowed, axis=1)
    value = (weight.numpy() * norm).sum()
    assert found.value == pytest.approx(value, rel=tolerance)
    assert found.value < (weight.numpy() * logsumexp(joint, axis=1)).sum()
    assert found.owner is not None
    assert (found.owner.numpy() == allowed.argmax(1)).all()
    gamma = np.exp(allowed - norm[:, None]) * weight.numpy()[:, None]
    for component in range(k):
        local = em.quadratic_features(points - parameters.means[component]).numpy()
        expected = (gamma[:, component, None] * local).sum(0)
        np.testing.assert_allclose(found.statistics[component], expected, atol=tolerance * n)


# -- candidates ------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_candidates_are_the_owner_and_the_most_likely_components(dtype):
    k, m, n = 40, 5, 250  # few rows in each group, so that the sample has all of them
    points, parameters = 2 * cloud(n, 2), random_parameters(k, 2)
    joint = scipy_log_joint(points, parameters)
    owner = torch.from_numpy(joint.argmax(1))
    groups = group_rows(rows_of(points), owner, parameters.means, dtype)
    assert int(groups.n_rows.max()) <= 64
    candidates = choose_candidates(groups, parameters, m)
    assert candidates.shape == (k, m)
    relative = joint - joint.max(1, keepdims=True)
    for group in range(k):
        assert group in candidates[group]
        assert len(set(candidates[group].tolist())) == m
        own = relative[(owner == group).numpy()]
        if len(own) == 0:
            continue
        score = own.max(0)
        score[group] = np.inf
        assert set(candidates[group].tolist()) == set(np.argsort(score)[-m:].tolist())


@pytest.mark.parametrize("reverse", [False, True])
def test_candidate_sample_covers_a_group_in_any_row_order(reverse):
    along = torch.linspace(-10, 10, 5000, dtype=torch.float64)
    points = torch.stack([along.flip(0) if reverse else along, 0 * along], 1)
    means = torch.zeros(20, 2, dtype=torch.float64)
    means[1, 0], means[2, 0] = -11.0, 11.0
    means[3:, 0], means[3:, 1] = torch.tensor([-11.0, 11.0]).repeat(9)[:17], 5.0 + torch.arange(17)
    covariances = torch.eye(2, dtype=torch.float64).repeat(20, 1, 1)
    covariances[0, 0, 0] = 16.0
    parameters = Parameters(torch.full((20,), 0.05, dtype=torch.float64), means, covariances)
    groups = group_rows(rows_of(points), torch.zeros(5000, dtype=torch.int64), means, torch.float32)
    assert sorted(choose_candidates(groups, parameters, 3)[0].tolist()) == [0, 1, 2]


def test_nearest_equals_brute_force():
    points, means = cloud(200, 3), cloud(11, 3, seed=1)
    assert torch.equal(nearest(points, means), torch.cdist(points, means).argmin(1))
