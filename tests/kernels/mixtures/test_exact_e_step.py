"""Exact EM's E-step in the form for a GPU, run on the CPU too, and its lists of near components."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kernels.mixtures.test_em_steps import mixture

import gmmtorch.kernels
from gmmtorch.kernels import kernels
from gmmtorch.kernels.compiler import FusedKernel
from gmmtorch.kernels.mixtures import em_steps
from gmmtorch.linalg import order_along_curve
from gmmtorch.mixture import Parameters, shift_features
from gmmtorch.mixture.em.exact import natural_of_precisions, natural_parameters, quadratic_features

FAINT = 2.0**-10  # nats: the largest error of a log-density in float32
DTYPES = [torch.float64, torch.float32]


def cloud(n: int, dim: int, seed: int = 0, in_order: bool = True) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    points = 4 * torch.rand(n, dim, generator=generator, dtype=torch.float64)
    points[:, -1] = points[:, 0].round() + 0.01 * points[:, -1]
    return points[order_along_curve(points)] if in_order else points


def assert_equals_brute_force(features, weight, natural, dtype, form=None):
    """Sums differ by at most the bounds of the forms, and of the logits' rounding, times their terms."""
    logits = features @ natural.T
    gamma = weight[:, None] * torch.softmax(logits, 1)
    size = gamma.T @ features.abs()
    terms = (features.abs() @ natural.abs().T).where(gamma > 1e-16, 0).amax()
    rounding = 1e-12 + min(1e-6, 40 * torch.finfo(torch.float64).eps * float(terms))
    sums, value = (form or em_steps._expectation_in_blocks)(features, weight, natural, dtype)
    bound = rounding * size.amax() + (3 * FAINT * size if dtype == torch.float32 else 0)
    assert bool(((sums - gamma.T @ features).abs() <= bound + 1e-300).all())
    error = (value - torch.dot(weight, torch.logsumexp(logits, 1))).abs()
    bound = rounding * (weight.sum() + torch.dot(weight, logits.amax(1).abs()))
    assert float(error) <= float(bound + (FAINT * weight.sum() if dtype == torch.float32 else 0))


@pytest.mark.parametrize("dtype", DTYPES)
@settings(max_examples=25, deadline=None)
@given(
    dim=st.integers(1, 3),
    n=st.sampled_from([1, 2, 63, 64, 65, 200, 1500]),
    k=st.sampled_from([1, 2, 7, 8, 65, 150]),
    kind=st.sampled_from(["any", "equal", "empty"]),
    in_order=st.booleans(),
    seed=st.integers(0, 9),
)
def test_sums_in_blocks_equal_brute_force(dtype, dim, n, k, kind, in_order, seed):
    features = quadratic_features(cloud(n, dim, seed, in_order))
    weight = torch.arange(n, dtype=torch.float64) % 4  # some are zero
    assert_equals_brute_force(features, weight, natural_parameters(mixture(k, dim, kind)), dtype)


@pytest.mark.parametrize("dtype", DTYPES)
def test_components_a_millimetre_thick_equal_brute_force(dtype):
    features = quadratic_features(cloud(2000, 3))
    natural = natural_parameters(mixture(100, 3, "flat"))
    assert_equals_brute_force(features, torch.ones(2000).double(), natural, dtype)


@pytest.mark.parametrize("dtype", DTYPES)
def test_components_a_hundred_kilometres_from_the_origin_equal_brute_force_near_it(dtype):
    """Float32 numbers there are multiples of 8 mm, and squares of such numbers lose everything."""
    points, weight = cloud(3000, 3, in_order=True), torch.ones(3000).double()
    near = mixture(50, 3, "any")
    near = near._replace(covariances=near.covariances + 0.1 * torch.eye(3))
    expected = em_steps._batched_expectation(
        quadratic_features(points), weight, natural_parameters(near), torch.float64
    )
    away = torch.tensor([1e5, -7e4, 3e4]).double()
    far = near._replace(means=near.means + away)
    sums, value = em_steps._expectation_in_blocks(
        quadratic_features(points + away), weight, natural_parameters(far), dtype
    )
    torch.testing.assert_close(sums[:, 0], expected[0][:, 0], rtol=2e-4, atol=1e-3)
    means = (sums[:, 1:4] / sums[:, :1] - away)[sums[:, 0] > 1]
    torch.testing.assert_close(
        means, (expected[0][:, 1:4] / expected[0][:, :1])[sums[:, 0] > 1], rtol=0, atol=1e-3
    )
    torch.testing.assert_close(value, expected[1], rtol=1e-4, atol=0)


@pytest.mark.parametrize("dtype", DTYPES)
def test_needles_of_one_to_ten_thousand_equal_brute_force(dtype):
    generator = torch.Generator().manual_seed(3)
    axes = torch.linalg.qr(torch.randn(40, 3, 3, generator=generator).double())[0]
    size = torch.tensor([1e-4, 1e-2, 1.0]).double()
    means = torch.rand(40, 3, generator=generator).double()
    needles = Parameters(torch.full_like(means[:, 0], 1 / 40), means, (axes * size.square()) @ axes.mT)
    number = torch.arange(4000, device=means.device) % 40
    steps = torch.randn(4000, 3, generator=generator).double() * size
    points = means[number] + (axes[number] @ steps[:, :, None])[..., 0]
    order = torch.cat([number.argsort(stable=True)[:2000], torch.arange(2000, device=means.device)])
    features = quadratic_features(points[order])
    weight = torch.ones(4000).double()
    assert_equals_brute_force(features, weight, natural_parameters(needles), dtype)


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_million_terms_do_not_add_up_rounding(dtype):
    n = 1_000_000 if type(torch.ones(1)) is torch.Tensor else 4000  # the pretended GPU is slow
    points = torch.rand(n, 2, generator=torch.Generator().manual_seed(0)).double()
    points = points[order_along_curve(points)]
    whole = Parameters(torch.ones(1).double(), torch.full((1, 2), 0.5).double(), torch.eye(2).double()[None])
    features, weight = quadratic_features(points), torch.ones(n).double()
    sums, _ = em_steps._expectation_in_blocks(features, weight, natural_parameters(whole), dtype)
    torch.testing.assert_close(
        sums[0], features.sum(0), rtol=1e-7 if dtype == torch.float32 else 1e-13, atol=0
    )


@pytest.mark.parametrize("dtype", DTYPES)
def test_cells_equal_brute_force(dtype):
    """Mean features of cells: their scatter counts."""
    features = quadratic_features(cloud(2000, 3)).unflatten(0, (500, 4)).mean(1)
    weight = torch.full((500,), 4.0).double()
    assert_equals_brute_force(features, weight, natural_parameters(mixture(60, 3, "any")), dtype)


@pytest.mark.parametrize("dtype", DTYPES)
def test_components_that_are_impossible_or_no_gaussians_equal_brute_force(dtype):
    features = quadratic_features(cloud(300, 3))
    natural = natural_parameters(mixture(20, 3, "any"))
    natural[3], natural[3, 0] = 0.0, -1e300
    natural[5], natural[5, 0] = 0.0, -3.0  # as likely everywhere
    natural[6] *= -1e-3
    weight = torch.ones(300).double()
    assert_equals_brute_force(features, weight, natural, dtype)
    assert_equals_brute_force(features, weight, natural[3:4], dtype)


@pytest.mark.parametrize("dtype", DTYPES)
def test_no_rows_have_sums_of_zero(dtype):
    features = quadratic_features(torch.ones(0, 3).double())
    natural = natural_parameters(mixture(5, 3, "any"))
    sums, value = em_steps._expectation_in_blocks(features, torch.ones(0).double(), natural, dtype)
    assert sums.tolist() == torch.zeros_like(natural).tolist()
    assert float(value) == 0


def test_rows_beyond_the_reach_of_every_component_equal_brute_force():
    """Outliers whose likeliest component is millions of nats below those of their neighbours."""
    points = cloud(640, 3)
    points[::50] += 3000.0
    features, natural = quadratic_features(points), natural_parameters(mixture(70, 3, "any"))
    shifted = shift_features(features, torch.ones(640, 3).double())
    for rows in (features, shifted):
        for dtype in DTYPES:
            assert_equals_brute_force(rows, torch.ones(640).double(), natural, dtype)


@pytest.mark.cpu_only
@pytest.mark.parametrize("in_order", [True, False])
def test_the_kernel_of_a_cpu_equals_brute_force_with_lists(in_order):
    features = quadratic_features(cloud(em_steps._FEW_PAIRS // 101 + 37, 3, in_order=in_order))
    weight = torch.arange(len(features), dtype=torch.float64) % 4
    natural = natural_parameters(mixture(101, 3, "any"))
    with kernels("fused"):
        assert_equals_brute_force(features, weight, natural, torch.float64, form=em_steps.expectation)


LISTS = """#include "{folder}/mixtures/near_components.h"
namespace gmm {{
GMM_KERNEL near_lists(int64_t item, Given given, double* upper, int64_t* listed, int64_t* count) {{
    GMM_SHARED Search<3> search;
    const Squad squad = squad_of(item);
    const int64_t begin = squad.item * ROWS, stop = minimum(begin + ROWS, given.n_rows);
    const Block<3> block = block_of_rows(squad, search, given, begin, stop);
    const double peak = bound_logits(squad, search, given, block, upper + squad.item * given.n_padded);
    int64_t* own = listed + squad.item * given.n_padded;
    count[squad.item] =
        list_components(squad, search, given, upper + squad.item * given.n_padded, peak, own);
}}
}}
"""


def listed(features: torch.Tensor, natural: torch.Tensor, folder: Path) -> list[list[int]]:
    """The components that each block of 64 rows lists."""
    source = folder / "near_lists.h"
    source.write_text(LISTS.format(folder=Path(gmmtorch.kernels.__file__).parent))
    n, k = len(features), len(natural)
    n_padded, n_blocks, device = k + -k % 8, -(-n // 64), features.device
    table, weight = em_steps._table(natural, n_padded), torch.ones(n).double()
    upper = torch.zeros(n_blocks, n_padded).double()
    found, count = torch.zeros(n_blocks, n_padded).long(), torch.zeros(n_blocks).long()
    sizes = k, n_padded, n_blocks
    n_items = n_blocks * em_steps.squad_size(device)
    kernel = FusedKernel(str(source), "near_lists")
    kernel(n_items, features, weight, n, natural, table, *sizes, upper, found, count)
    return [row[:m] for row, m in zip(found.tolist(), count.tolist(), strict=True)]


@pytest.mark.parametrize("kind", ["any", "flat", "equal", "empty"])
@pytest.mark.parametrize("in_order", [True, False])
def test_a_block_lists_every_component_that_matters_to_one_of_its_rows(kind, in_order, tmp_path):
    features, natural = (
        quadratic_features(cloud(1000, 3, 1, in_order)),
        natural_parameters(mixture(90, 3, kind)),
    )
    logits = features @ natural.T
    matters = (logits > logits.amax(1, keepdim=True) - 37).split(64)
    for found, needed in zip(listed(features, natural, tmp_path), matters, strict=True):
        assert found == sorted(set(found))
        assert set(needed.any(0).nonzero()[:, 0].tolist()) <= set(found)


def test_blocks_in_spatial_order_list_few_components(tmp_path):
    points = cloud(6400, 3)
    means = points[::32]
    precisions = 400.0 * torch.eye(3).double().expand(len(means), 3, 3)
    natural = natural_of_precisions(precisions, means, torch.zeros(len(means)).double())
    lengths = [len(found) for found in listed(quadratic_features(points), natural, tmp_path)]
    assert sum(lengths) / len(lengths) < 0.2 * len(means)


def test_float32_is_used_where_its_bound_allows_and_is_better_than_its_bound():
    points = cloud(6400, 3)
    means, width = points[::32], torch.tensor([0.3, 0.3, 0.02]).double()
    precisions = torch.diag(width**-2).expand(len(means), 3, 3)
    natural = natural_of_precisions(precisions, means, torch.zeros(len(means)).double())
    given = quadratic_features(points), torch.ones(6400).double(), natural
    exact, rounded = (em_steps._expectation_in_blocks(*given, dtype) for dtype in DTYPES)
    for one, other in zip(exact, rounded, strict=True):
        assert 1e-11 < float((one - other).abs().amax() / one.abs().amax()) < 1e-5
