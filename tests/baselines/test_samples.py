"""Labelled points on beams: positions, numbers and labels, with and without thinning."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.errors import MemoryLimitError
from gmmtorch.experiments.baselines.samples import beam_samples, centroids, thinned_samples
from gmmtorch.scan import Scan


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def random_scan(n: int, m: int, dim: int, seed: int, offset: float = 0.0) -> Scan:
    generator = torch.Generator().manual_seed(seed)
    ends = 8 * torch.rand(n + m, dim, generator=generator, dtype=torch.float64) + offset
    return Scan(ends[:n], torch.full((dim,), offset - 1.0, dtype=torch.float64), ends[n:])


@given(
    n=st.integers(0, 20),
    m=st.integers(0, 20),
    dim=st.integers(2, 3),
    seed=st.integers(0, 10**6),
    spacing=st.floats(0.05, 20),
    gap=st.floats(0, 3),
)
def test_each_segment_of_a_beam_has_one_free_point(n, m, dim, seed, spacing, gap):
    scan = random_scan(n, m, dim, seed)
    points, is_hit = beam_samples(scan, spacing, gap=gap, generator=seeded(seed))
    assert torch.equal(points[is_hit], scan.points)
    free = points[~is_hit]
    start = 0
    for beam, end in enumerate(torch.cat([scan.points, scan.no_return])):
        length = float((end - scan.origin).norm()) - (gap if beam < n else 0)
        count = max(0, math.ceil(length / spacing))
        chosen = free[start : start + count]
        start += count
        along = (chosen - scan.origin) @ (end - scan.origin) / (end - scan.origin).norm()
        offset = (
            chosen - scan.origin - along[:, None] * (end - scan.origin) / (end - scan.origin).norm()
        ).norm(dim=1)
        assert float(offset.max() if count else 0) < 1e-9
        assert (along * count / length if count else along).floor().tolist() == list(range(count))
    assert start == len(free)


def test_random_free_points_are_uniform_along_the_beam():
    scan = Scan(torch.tensor([[5.0, 0.0]]).repeat(20_000, 1), [0.0, 0.0])
    points, is_hit = beam_samples(scan, 9.0, generator=seeded())
    share = points[~is_hit, 0] / 5
    assert abs(float(share.mean()) - 0.5) < 4 * (1 / 12 / 20_000) ** 0.5
    expected = (torch.arange(20_000) + 0.5) / 20_000
    assert float((share.sort().values - expected).abs().max()) < 1.95 / 20_000**0.5  # Kolmogorov, p = 0.001


def test_beams_without_return_have_free_points_and_beams_of_zero_length_none():
    scan = Scan([[0.0, 0.0]], [0.0, 0.0], [[3.0, 0.0], [0.0, 0.0]])
    points, is_hit = beam_samples(scan, 1.5, generator=seeded())
    assert points[is_hit].tolist() == [[0, 0]]
    assert (points[~is_hit, 0] / 1.5).floor().tolist() == [0, 1]
    points, is_hit = beam_samples(Scan(torch.empty(0, 3), torch.zeros(3)), 1.0, generator=seeded())
    assert (points.shape, is_hit.shape) == ((0, 3), (0,))


def test_thin_replaces_beam_ends_by_their_mean_per_cube():
    scan = Scan([[4.1, 0.1], [4.3, 0.3], [4.1, 1.1]], [0.0, 0.0])
    points, is_hit = beam_samples(scan, 9.0, thin=1.0, generator=seeded())
    torch.testing.assert_close(
        points[is_hit].sort(dim=0).values, torch.tensor([[4.1, 0.2], [4.2, 1.1]], dtype=torch.float64)
    )
    assert int((~is_hit).sum()) == 2


def test_beam_samples_rejects_a_spacing_with_too_many_points():
    with pytest.raises(MemoryLimitError, match="spacing"):
        beam_samples(random_scan(3, 0, 2, 0), 1e-9, generator=seeded())


# -- thinned samples ----------------------------------------------------------------------------------


def test_thinned_samples_have_the_positions_of_la3dm():
    scan = Scan(torch.tensor([[1.1, 0.0]]).double(), torch.zeros(2).double())
    samples, is_hit = thinned_samples(scan, 0.5, 1e-3)
    assert samples[is_hit].tolist() == [[pytest.approx(1.1), 0.0]]
    assert sorted(samples[~is_hit][:, 0].tolist()) == pytest.approx([0.0, 0.5, 0.6, 1.0])


def test_thinned_samples_drop_hits_and_cut_no_return_beams_beyond_max_range():
    scan = Scan(torch.tensor([[3.0, 0.0], [0.0, 1.0]]), torch.zeros(2), torch.tensor([[0.0, -9.0]]))
    samples, is_hit = thinned_samples(scan, 0.5, 0.01, max_range=2.0)
    assert samples[is_hit].tolist() == [[0.0, 1.0]]
    assert float(samples[:, 0].max()) == 0.0
    assert float(samples[:, 1].min()) == pytest.approx(-2.0)


@pytest.mark.parametrize("dim", [2, 3])
def test_centroids_are_the_means_of_cubes(dim):
    points = torch.randn(300, dim, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    cubes: dict[tuple[int, ...], list[list[float]]] = {}
    for point in points.tolist():
        cubes.setdefault(tuple(math.floor(x / 0.7) for x in point), []).append(point)
    expected = sorted(
        [sum(column) / len(column) for column in zip(*rows, strict=True)] for rows in cubes.values()
    )
    torch.testing.assert_close(torch.tensor(sorted(centroids(points, 0.7).tolist())), torch.tensor(expected))
