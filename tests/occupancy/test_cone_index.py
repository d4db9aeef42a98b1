"""ConeIndex: candidates contain all cones that meet a box, and few others."""

from __future__ import annotations

import itertools

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from occupancy.cone_cases import (
    draw_ends,
    every_pair,
    joined,
    moved,
    normal,
    one_each,
    only,
    random_cones,
    random_covariances,
    tiled,
    uniform,
)

from gmmtorch import VoxelGrid
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.occupancy import CUTOFF, ConeIndex, Cones, PointForm, cells_in_chunks, cone_bounds, cone_index
from gmmtorch.occupancy import cones as culling
from gmmtorch.occupancy.cones import (
    WhitenedCones,
    ball_rows,
    candidate_pairs,
    cross,
    face_rows,
    outside_ball,
    outside_cone,
)
from gmmtorch.occupancy.forms import point as point_form


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
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cone_index, "_ENTRIES_PER_CONE", {dim: entries})
        index = ConeIndex(cones, extent, cutoff)
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
    both = joined(small, moved(small, 1.2e7))
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


# -- cones that change, and what is kept -------------------------------------------------------------------


def assert_is_of_all(form: PointForm, places: torch.Tensor) -> None:
    for found, expected in zip(form(places), every_pair(form, places), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("dim", [2, 3])
@settings(max_examples=15)
@given(
    seed=st.integers(0, 10_000),
    n_points=st.sampled_from([3, 100, 400]),
    largest=st.sampled_from([0, 1 << 21]),
)
def test_evidence_of_cones_that_come_and_go_is_that_of_all(dim, seed, n_points, largest):
    generator = torch.Generator().manual_seed(seed)
    cones = random_cones(dim, 30, seed, room=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(point_form, "_FEW_PAIRS", 0)
        patch.setattr(cone_index, "_FEW_PAIRS", 0)
        patch.setattr(cone_index, "_TABLE", largest)
        patch.setattr(cone_index, "_CELLS_PER_POINT", 1 << 21)
        form = PointForm(cones, 0.1)
        for step in range(4):
            places, _ = places_on_rays(cones, n_points, CUTOFF, seed + step)
            for _ in range(2):  # the second time from lists that are all there
                assert_is_of_all(form, places)
            kept = (torch.rand(len(cones.counts), generator=generator) < 0.9).nonzero().squeeze(1)
            new = random_cones(dim, 4, seed + 100 + step, room=True)
            new = new._replace(means=new.means - 3.0 * step)  # also beyond the box of the first ones
            former = torch.cat([kept, torch.full((4,), -1)])
            cones = joined(cones.taken(kept), new)
            form = form.replaced(cones, former)


def test_only_lists_near_changed_cones_are_made_again(smallest):
    near = random_cones(3, 60, 0, room=True)
    shift = torch.tensor([40.0, 0, 0], dtype=torch.float64)
    both = joined(near, moved(near, 40.0))
    index = ConeIndex(both, 0.1)
    here, _ = places_on_rays(near, 300, CUTOFF, 0)
    index.buckets(torch.cat([here, here + shift]))
    former = torch.cat([torch.arange(119), torch.tensor([-1])])  # the last cone changes
    changed = both._replace(counts=both.counts + (torch.arange(120) == 119))
    made = index.replaced(changed, former)
    n_lists = len(made.lists.lengths())
    assert 0 < n_lists < len(index.lists.lengths())
    made.buckets(here)
    largest = made._n_levels - 1
    assert int((made._levels[n_lists:] < largest).sum()) == 0  # those that the change can reach
    made.buckets(here + shift)
    assert int((made._levels[n_lists:] < largest).sum()) > 0


def test_lists_that_are_kept_are_bounded(monkeypatch, smallest):
    monkeypatch.setattr(cone_index, "_KEPT", 1 << 12)
    monkeypatch.setattr(cone_index, "_BUCKETS_AT_ONCE", 16)
    monkeypatch.setattr(point_form, "_FEW_PAIRS", 0)
    cones = random_cones(3, 50, 2, room=True)
    form, most = PointForm(cones, 0.1), 0
    for step in range(6):
        places, _ = places_on_rays(cones, 300, CUTOFF, step)
        assert_is_of_all(form, places)
        index = form.index
        one_part = 16 * index._n_levels * (len(cones.counts) + cone_index._PER_LIST)
        assert len(index.lists.entries) <= max(1 << 12, cone_index._KEPT_PER_CONE * 50) + one_part
        most = max(most, len(index.lists.entries))
    assert most > 1 << 10


def test_places_that_are_asked_again_get_shorter_lists_and_the_same_answers(monkeypatch):
    monkeypatch.setattr(cone_index, "_FEW_PAIRS", 1500)
    monkeypatch.setattr(point_form, "_FEW_PAIRS", 0)
    cones = random_cones(3, 200, 2, room=True)
    places, _ = places_on_rays(cones, 40, CUTOFF, 0)
    form, n_listed = PointForm(cones, 0.1), []
    for _ in range(8):
        assert_is_of_all(form, places)
        number = form.index.buckets(places).clamp_min(0)
        n_listed.append(int(form.index.lists.lengths()[number].sum()))
    assert n_listed[-1] < 0.7 * n_listed[0]


@pytest.mark.parametrize("case", ["clusters", "hundred metres", "needles", "one component", "one place"])
def test_strange_cones_give_the_evidence_of_all(case, monkeypatch):
    for module in (point_form, cone_index):
        monkeypatch.setattr(module, "_FEW_PAIRS", 0)
    cones = random_cones(3, 40, 7, room=True)
    if case == "clusters":
        far = (torch.arange(40) % 2 * 1e6)[:, None].double()
        cones = cones._replace(means=cones.means + far, origins=cones.origins + far)
    elif case == "hundred metres":
        large = torch.diag(torch.tensor([100.0**2, 50.0**2, 1e-4], dtype=torch.float64))
        cones = cones._replace(covariances=torch.cat([large[None], cones.covariances[1:]]))
    elif case == "needles":
        needle = torch.diag(torch.tensor([25.0, 1e-8, 1e-8], dtype=torch.float64))
        cones = cones._replace(covariances=needle.repeat(40, 1, 1))
    else:
        first = torch.zeros(3000, dtype=torch.int64)
        origins = torch.rand(3000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 6
        if case == "one place":
            first, origins = torch.arange(3000) % 40, origins[:1].repeat(3000, 1)
        cones = cones.taken(first)._replace(origins=origins)
    places, _ = places_on_rays(cones, 60, CUTOFF, 0)
    outside = torch.tensor([[torch.inf, 0, 0], [0, -torch.inf, 1], [1e300, 0, 0], [-1e9, 5, 5]]).double()
    form = PointForm(cones, 0.1)
    found = form(torch.cat([places, outside]))
    assert float(found.hits[-4:].abs().max() + found.misses[-4:].abs().max()) == 0
    for values, expected in zip(found, every_pair(form, places), strict=True):
        torch.testing.assert_close(values[:60], expected, rtol=1e-6, atol=1e-9)


# -- culling: all cells and boxes that a cone meets are kept, and few others ---------------------------


GRIDS = {2: VoxelGrid((-2.0, -1.8), 0.2, (20, 18)), 3: VoxelGrid((-2.0, -1.8, -2.1), 0.4, (10, 9, 11))}


def some_cones(dim: int, n: int, seed: int, inside: bool = False) -> Cones:
    generator = torch.Generator().manual_seed(seed)
    deviations = 10 ** uniform(generator, n, dim, low=-2, high=-0.3)
    means = normal(generator, n, dim)
    origins = means + 0.3 * deviations if inside else 2 * normal(generator, n, dim)
    return one_each(means, random_covariances(generator, deviations), origins)


def ends_within(cones: Cones, n: int) -> torch.Tensor:
    """Ends of rays within the cutoff."""
    ends = draw_ends(cones, n)
    white = WhitenedCones.of(cones)
    return ends[(white.apply((ends - cones.means).T).norm(dim=0) < CUTOFF)]


@given(dim=st.sampled_from([2, 3]), seed=st.integers(0, 10**6), inside=st.booleans(), size=st.floats(0.01, 3))
def test_a_box_that_a_ray_meets_is_a_candidate(dim, seed, inside, size):
    cones = some_cones(dim, 1, seed, inside)
    generator = torch.Generator().manual_seed(seed)
    ends = ends_within(cones, 64)
    share = uniform(generator, len(ends), 1)
    low = cones.origins + share * (ends - cones.origins) - size * uniform(generator, len(ends), dim)
    met = [box for box, _ in candidate_pairs(cones, low, low + size)]
    assert torch.cat(met).tolist() == list(range(len(ends)))


def test_most_boxes_without_rays_are_no_candidates(monkeypatch):
    monkeypatch.setattr(culling, "_PAIRS_AT_ONCE", 5000)
    cones = some_cones(3, 30, 0)
    low = GRIDS[3].centers() - 0.2
    pairs = [torch.stack(pair, 1) for pair in candidate_pairs(cones, low, low + 0.4)]
    kept = torch.cat(pairs)
    assert len(torch.unique(kept, dim=0)) == len(kept)  # no pair twice
    assert 0 < len(kept) < 0.25 * len(low) * 30


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("seed", range(6))
def test_a_face_that_a_ray_crosses_is_visited(dim, seed):
    grid, cones = GRIDS[dim], some_cones(dim, 4, seed, inside=seed % 3 == 0)
    for axis, rows in enumerate(face_rows(cones, grid)):
        visited = set()
        for row, cells in cells_in_chunks(rows.first, rows.number, 1000):
            key = [rows.cone[row], rows.forward[row].long(), rows.plane[row], *cells]
            visited |= set(zip(*(k.tolist() for k in key), strict=True))
        crossed = set()
        for index in range(4):
            cone = only(cones, index)
            start, stop = grid.to_units(cone.origins)[0], grid.to_units(ends_within(cone, 300))
            for forward, plane in itertools.product((0, 1), range(grid.shape[axis] + 1)):
                sign = 1 if forward else -1
                through = (sign * (plane - start[axis]) > 0) & (sign * (stop[:, axis] - plane) > 0)
                if plane == (0 if forward else grid.shape[axis]):
                    continue  # no cell of the grid lies before this plane
                share = (plane - start[axis]) / (stop[through, axis] - start[axis])
                place = (start + share[:, None] * (stop[through] - start)).floor().long()
                others = [b for b in range(dim) if b != axis]
                for cell in place[:, others].tolist():
                    if all(0 <= i < grid.shape[b] for i, b in zip(cell, others, strict=True)):
                        crossed.add((index, forward, plane, *cell))
        assert crossed
        assert crossed <= visited
        total = 4 * grid.n_cells // grid.shape[axis] * grid.shape[axis]
        if seed % 3:
            assert len(visited) < 0.5 * total


def test_ball_rows_contain_all_ends():
    grid, cones = GRIDS[3], some_cones(3, 4, 2)
    cones = cones._replace(max_range=torch.tensor([False, True, False, False]))
    cone, first, number = ball_rows(cones, grid)
    assert cone.tolist() == [0, 2, 3]
    held = {index: set() for index in cone.tolist()}
    for row, cells in cells_in_chunks(first, number, 77):
        for index, *cell in zip(cone[row].tolist(), *(c.tolist() for c in cells), strict=True):
            held[index].add(tuple(cell))
    for index, cells in held.items():
        place = grid.to_units(ends_within(only(cones, index), 300)).floor().long()
        inside = ((place >= 0) & (place < torch.tensor(grid.shape))).all(1)
        assert {tuple(c) for c in place[inside].tolist()} <= cells


@pytest.mark.parametrize("size", [1, 7, 10**6])
def test_chunks_contain_each_cell_once(size):
    first = torch.tensor([[3, 0], [5, 5], [0, 2]])
    count = torch.tensor([[2, 3], [0, 4], [1, 2]])
    chunks = list(cells_in_chunks(first, count, size))
    assert max(len(row) for row, _ in chunks) <= size
    listed = [(int(r), *c.tolist()) for row, cells in chunks for r, c in zip(row, cells.T, strict=True)]
    assert listed == [(0, 3, 0), (0, 3, 1), (0, 3, 2), (0, 4, 0), (0, 4, 1), (0, 4, 2), (2, 0, 2), (2, 0, 3)]


def test_cone_bounds_is_the_box_around_ellipsoid_and_sensor_origin():
    cones = some_cones(3, 5, 1)
    low, high = cone_bounds(cones, 2.0)
    for i in range(5):
        surface = torch.nn.functional.normalize(
            draw_ends(
                one_each(
                    *(torch.zeros(1, 3).double(), torch.eye(3).double()[None], torch.zeros(1, 3).double())
                ),
                20000,
            )
        )
        points = cones.means[i] + 2 * surface @ torch.linalg.cholesky(cones.covariances[i]).T
        points = torch.cat([points, cones.origins[i : i + 1]])
        torch.testing.assert_close(points.amin(0), low[i], atol=0.02, rtol=0)
        torch.testing.assert_close(points.amax(0), high[i], atol=0.02, rtol=0)


@given(dim=st.sampled_from([2, 3]), seed=st.integers(0, 10**6))
def test_outside_tests_never_exclude_a_cell_that_is_reached(dim, seed):
    """The bounds against a dense sample of each whitened cell."""
    generator = torch.Generator().manual_seed(seed)
    ray, mean = 3 * normal(generator, dim, 20), 6 * normal(generator, dim, 1)
    edges = normal(generator, dim, dim, 20) * 2
    offset = ray - mean
    f = torch.cartesian_prod(*[torch.linspace(-0.5, 0.5, 9).double()] * dim)
    shift = torch.einsum("ne,edp->ndp", f, edges)
    w, d = ray + shift, offset + shift
    across = cross(d, w).norm(dim=1) / w.norm(dim=1)
    along = (d * w).sum(1) / w.norm(dim=1)
    out = outside_cone(ray, offset, edges, CUTOFF)
    met = (across < CUTOFF) & (along < CUTOFF)
    assert not bool((met & out).any())
    assert not bool(((d.norm(dim=1) < CUTOFF) & outside_ball(offset, edges, CUTOFF)).any())
