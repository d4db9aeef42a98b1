"""ConeIndex: candidates contain all cones that meet a box, and few others."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from occupancy.cone_cases import random_cones, tiled

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.occupancy import cone_index
from gmmtorch.occupancy.cone_index import ConeIndex
from gmmtorch.occupancy.cones import CUTOFF, Cones


def places_on_rays(cones: Cones, n: int, cutoff: float, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """n points on segments from the sensor to the ellipsoid, many on the rim, and the cone of each."""
    generator = torch.Generator().manual_seed(seed)
    dim = cones.dim
    which = torch.randint(len(cones.counts), (n,), generator=generator)
    unit = torch.nn.functional.normalize(torch.randn(n, dim, generator=generator, dtype=torch.float64), dim=1)
    inner = torch.rand(n, 1, generator=generator, dtype=torch.float64).clamp_min(0.5) * 2
    factor = torch.linalg.cholesky(cones.covariances)[which]
    ends = cones.means[which] + (factor @ (cutoff * inner.clamp_max(0.9999) * unit)[:, :, None])[:, :, 0]
    share = torch.rand(n, 1, generator=generator, dtype=torch.float64)
    origin = cones.origins[which]
    return origin + share * (ends - origin), which


def pairs_of(index: ConeIndex, low: torch.Tensor, high: torch.Tensor) -> list[tuple[int, int]]:
    parts = index.candidates(low, high)
    return [pair for box, cone in parts for pair in zip(box.tolist(), cone.tolist(), strict=True)]


@pytest.mark.parametrize("dim", [2, 3])
@given(
    seed=st.integers(0, 10_000),
    extent=st.sampled_from([0.001, 0.02, 0.2, 1.0, 10.0]),
    entries=st.sampled_from([1, 20, 200]),
    cutoff=st.sampled_from([1.0, 3.0, CUTOFF]),
)
def test_candidates_contain_all_cones_that_meet_a_box(dim, seed, extent, entries, cutoff):
    cones = random_cones(dim, 12, seed)
    index = ConeIndex(cones, extent, cutoff, entries_per_cone=entries)
    places, which = places_on_rays(cones, 400, cutoff, seed)
    generator = torch.Generator().manual_seed(seed)
    # Boxes that contain the point, often close to a corner.
    side = extent * torch.rand(400, dim, generator=generator, dtype=torch.float64)
    corner = torch.rand(400, dim, generator=generator, dtype=torch.float64).mul(3).sub(1).clamp(0.001, 0.999)
    low = places - corner * side
    pairs = set(pairs_of(index, low, low + side))
    assert all((box, int(cone)) in pairs for box, cone in enumerate(which))


def test_boxes_far_from_all_rays_have_no_candidates():
    cones = random_cones(3, 30, 0)
    index = ConeIndex(cones, 0.1)
    low = torch.tensor([[50.0, 0, 0], [-1e9, 0, 0], [float("inf"), 0, 0]], dtype=torch.float64)
    assert pairs_of(index, low, low + 0.1) == []


@pytest.fixture
def smallest(monkeypatch):
    """Each point is served by the smallest bucket."""
    monkeypatch.setattr(cone_index, "_FEW_PAIRS", 0)
    monkeypatch.setattr(cone_index, "_POINTS_PER_LIST", 1)


def test_lists_contain_few_unneeded_cones(smallest):
    """Mean list length at points on the rays."""
    cones = random_cones(3, 300, 1, room=True)
    index = ConeIndex(cones, 0.05)
    places, _ = places_on_rays(cones, 500, CUTOFF, 0)
    numbers = index.buckets(places)
    assert float(index.lists.lengths()[numbers].double().mean()) < 0.45 * 300


def test_pairs_occur_once_for_any_chunk_size(monkeypatch):
    cones = random_cones(2, 20, 3)
    index = ConeIndex(cones, 0.1)
    places, _ = places_on_rays(cones, 200, CUTOFF, 0)
    whole = pairs_of(index, places, places)
    assert len(set(whole)) == len(whole) > 200
    monkeypatch.setattr(cone_index, "_PAIRS_AT_ONCE", 7)
    monkeypatch.setattr(cone_index, "_TESTS_AT_ONCE", 11)
    assert sorted(pairs_of(index, places, places)) == sorted(whole)
    portions = [set(box.tolist()) for box, _ in index.candidates(places, places)]
    assert sum(map(len, portions)) == len(set().union(*portions))


def test_cost_and_memory_do_not_depend_on_the_size_of_the_world(smallest):
    small, step = random_cones(3, 60, 4, room=True), 30.0
    large = tiled(small, 16, step)
    one, many = ConeIndex(small, 0.1), ConeIndex(large, 0.1)
    assert many.side == one.side
    places, _ = places_on_rays(small, 500, CUTOFF, 0)
    shift = torch.tensor([5 * step, 0, 0], dtype=torch.float64)
    here, there = one.buckets(places), many.buckets(places + shift)
    means = [index.lists.lengths()[n].double().mean() for index, n in ((one, here), (many, there))]
    assert float(means[1]) < 1.5 * float(means[0])
    assert many.lists.entries.numel() < 2 * one.lists.entries.numel()


def test_two_distant_maps_share_an_index():
    small = random_cones(3, 10, 5)
    shift = torch.tensor([1.2e7, 0, 0], dtype=torch.float64)
    far = small._replace(means=small.means + shift, origins=small.origins + shift)
    both = Cones(*(torch.cat(pair) for pair in zip(small, far, strict=True)))
    index = ConeIndex(both, 0.1)
    places, which = places_on_rays(both, 200, CUTOFF - 0.01, 0)
    pairs = set(pairs_of(index, places, places))
    assert all((box, int(cone)) in pairs for box, cone in enumerate(which))


@pytest.mark.parametrize("dim", [2, 3])
def test_an_index_without_cones_lists_nothing(dim):
    empty = Cones(*(field[:0] for field in random_cones(dim, 1, 0)))
    index = ConeIndex(empty, 0.1)
    places = torch.zeros(4, dim, dtype=torch.float64)
    assert pairs_of(index, places, places) == []
    full = ConeIndex(random_cones(dim, 3, 0), 0.1)
    assert pairs_of(full, places[:0], places[:0]) == []


def test_a_box_larger_than_the_extent_is_refused():
    index = ConeIndex(random_cones(3, 3, 0), 0.1)
    low = torch.zeros(1, 3, dtype=torch.float64)
    with pytest.raises(InvalidArgumentError, match="extent"):
        list(index.candidates(low, low + 0.2))


@pytest.mark.parametrize("extent", [0, -1, float("nan")])
def test_an_invalid_extent_is_refused(extent):
    with pytest.raises(InvalidArgumentError):
        ConeIndex(random_cones(3, 3, 0), extent)
