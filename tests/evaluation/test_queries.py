"""The split into training and test scans, removal of training data, perturbed poses, and the test points."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from pillar_room import room_scans
from scipy.stats import kstest
from sklearn.metrics import brier_score_loss, roc_auc_score
from torch import Tensor

from gmmtorch import GaussianMap, OccupancyGrid, Scan
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.evaluation import (
    FREE,
    OCCUPIED,
    Queries,
    choose,
    evaluate,
    hit_and_free,
    keep_share,
    methods,
    split_indices,
)
from gmmtorch.experiments.evaluation import (
    queries as query_points,  # pytest would collect the name `test_beams`
)
from gmmtorch.experiments.evaluation.held_out import Protocol
from gmmtorch.experiments.evaluation.queries import UNKNOWN, perturb_poses, ray_evidence, save_queries, unseen
from gmmtorch.occupancy.voxels.sparse_evidence import SparseEvidence

SHARES = (0.8, 0.3, 0.1, 0.02)


def beams(scans: list[Scan]) -> list[set[tuple[float, ...]]]:
    """The beam ends of each scan, no-return beams included."""
    return [{tuple(row) for row in scan.ends()[0].tolist()} for scan in scans]


@pytest.mark.parametrize(("n_scans", "test_every"), [(2, 2), (10, 10), (11, 10), (45, 5), (7, 3), (5, 100)])
def test_every_nth_scan_is_held_out_from_the_first(n_scans, test_every):
    train, test = split_indices(n_scans, test_every)
    assert test == [i for i in range(n_scans) if i % test_every == 0]
    assert train == [i for i in range(n_scans) if i % test_every]
    assert train


@pytest.mark.parametrize("n_scans", [0, 1])
def test_fewer_than_two_scans_raise(n_scans):
    with pytest.raises(InvalidArgumentError, match=rf"has {n_scans} scans; at least 2 are needed"):
        split_indices(n_scans, 10)


def test_a_smaller_share_of_beams_is_a_subset_of_a_larger_one():
    scans = room_scans(8)
    larger = beams(scans)
    for share in SHARES:
        kept = beams(keep_share(scans, share, "beams", seed=3))
        assert len(kept) == len(scans)
        assert all(small <= large for small, large in zip(kept, larger, strict=True))
        larger = kept


@pytest.mark.parametrize("share", SHARES)
def test_the_kept_share_of_beams_matches_the_option(share):
    scans = room_scans(10, n_beams=2000)
    kept = keep_share(scans, share, "beams", seed=0)
    tolerance = 5 * math.sqrt(share * (1 - share))
    for part in ("points", "no_return"):
        before = sum(len(getattr(scan, part)) for scan in scans)
        after = sum(len(getattr(scan, part)) for scan in kept)
        assert after / before == pytest.approx(share, abs=tolerance / math.sqrt(before))


def test_a_smaller_share_of_scans_is_a_subset_in_the_same_order():
    scans = room_scans(20)
    larger = scans
    for share in SHARES:
        kept = keep_share(scans, share, "scans", seed=3)
        assert len(kept) == max(1, math.ceil(share * len(scans)))
        assert [id(scan) for scan in kept] == [
            id(scan) for scan in larger if any(scan is other for other in kept)
        ]
        larger = kept


# -- pose noise -----------------------------------------------------------------------------------


def rotation_vector(rotation: Tensor) -> Tensor:
    """Rotation vector (3,), or angle (1,), of a rotation by less than π."""
    if rotation.shape[0] == 2:
        return torch.atan2(rotation[1, 0], rotation[0, 0])[None]
    axis = torch.stack([
        rotation[2, 1] - rotation[1, 2],
        rotation[0, 2] - rotation[2, 0],
        rotation[1, 0] - rotation[0, 1],
    ]) / 2  # fmt: skip
    sine = axis.norm()
    return axis * (torch.atan2(sine, (rotation.trace() - 1) / 2) / sine.clamp_min(1e-300))


def gaps(points: Tensor) -> Tensor:
    """Distances (N, N) between all pairs of points."""
    return torch.cdist(points, points, compute_mode="donot_use_mm_for_euclid_dist")


def unit_scans(n_scans: int, dim: int) -> list[Scan]:
    """Scans far from the world's origin, whose points are the unit vectors of the sensor frame."""
    origin = torch.arange(5.0, 5.0 + dim, dtype=torch.float64)
    return [Scan(origin + torch.eye(dim, dtype=torch.float64), origin)] * n_scans


@pytest.mark.parametrize("dim", [2, 3])
def test_perturbation_is_a_rigid_motion_and_zero_noise_keeps_the_scans(dim):
    scans = room_scans(5, dim=dim)
    still = perturb_poses(scans, (0.0, 0.0), seed=0)
    assert all(a is b for a, b in zip(still, scans, strict=True))
    for before, after in zip(scans, perturb_poses(scans, (0.2, 0.3), seed=1), strict=True):
        ends, moved = before.ends()[0], after.ends()[0]
        assert not torch.allclose(ends, moved, atol=1e-3)
        torch.testing.assert_close(gaps(moved), gaps(ends))
        # The sensor moves with its points, so the ranges do not change.
        torch.testing.assert_close((moved - after.origin).norm(dim=1), (ends - before.origin).norm(dim=1))
        frame = torch.linalg.lstsq(ends - before.origin, moved - after.origin).solution
        assert float(torch.linalg.det(frame)) == pytest.approx(1)  # not a mirror image


@pytest.mark.parametrize("dim", [2, 3])
def test_noise_has_the_given_standard_deviations(dim):
    n_scans, sigma_shift, sigma_angle = 1500, 0.3, 0.05
    scans = unit_scans(n_scans, dim)
    moved = perturb_poses(scans, (sigma_shift, sigma_angle), seed=4)
    shifts = torch.stack([after.origin - before.origin for before, after in zip(scans, moved, strict=True)])
    turns = torch.stack([rotation_vector((scan.points - scan.origin).T) for scan in moved])
    for values, sigma in ((shifts, sigma_shift), (turns, sigma_angle)):
        assert bool((values.mean(0).abs() < 4 * sigma / math.sqrt(n_scans)).all())
        torch.testing.assert_close(values.std(0), torch.full_like(values[0], sigma), rtol=0.08, atol=0)
    both = torch.cat([shifts / sigma_shift, turns / sigma_angle], 1)
    correlation = torch.corrcoef(both.T) - torch.eye(both.shape[1], dtype=torch.float64)
    assert float(correlation.abs().max()) < 0.12


MANY = 1_000_000


def along(points: Tensor, origins: Tensor, ends: Tensor) -> Tensor:
    """Position of each point along its beam, 0 at the sensor and 1 at the hit; fails if it is off the
    beam."""
    beam = ends - origins
    share = ((points - origins) * beam).sum(1) / (beam**2).sum(1)
    torch.testing.assert_close(origins + share[:, None] * beam, points, atol=1e-9, rtol=0)
    return share


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("free", ["uniform", "near_surface"])
def test_every_beam_has_one_occupied_and_one_free_point(dim, free):
    origins, ends = query_points.test_beams(room_scans(4, dim=dim), MANY, seed=0)
    asked = hit_and_free(origins, ends, free, 0.1, seed=0)
    assert asked.labels.dtype == torch.int64
    assert asked.points.dtype == torch.float64
    assert int(asked.of(OCCUPIED).sum()) == int(asked.of(FREE).sum()) == len(ends)
    torch.testing.assert_close(asked.points[asked.of(OCCUPIED)], ends, atol=0, rtol=0)
    share = along(asked.points[asked.of(FREE)], origins, ends)
    assert bool(((share >= 0) & (share <= 1)).all())


def test_no_return_beams_are_left_out_of_the_test():
    scans = room_scans(3)
    origins, ends = query_points.test_beams(scans, MANY, seed=0)
    torch.testing.assert_close(ends, torch.cat([scan.points for scan in scans]))
    torch.testing.assert_close(
        origins, torch.cat([scan.origin.expand(len(scan.points), -1) for scan in scans])
    )


@pytest.mark.parametrize("dim", [2, 3])
def test_free_points_are_uniform_along_the_beam(dim):
    origins, ends = query_points.test_beams(room_scans(5, n_beams=4000, dim=dim), MANY, seed=0)
    asked = hit_and_free(origins, ends, "uniform", 0.1, seed=0)
    share = along(asked.points[asked.of(FREE)], origins, ends)
    assert kstest(share.numpy(), "uniform").pvalue > 0.01
    length = (ends - origins).norm(dim=1)
    assert abs(np.corrcoef(share.numpy(), length.numpy())[0, 1]) < 0.03


@pytest.mark.parametrize("resolution", [0.02, 0.2])
def test_near_surface_points_are_half_to_two_cells_before_the_hit(resolution):
    origins, ends = query_points.test_beams(room_scans(5, n_beams=4000), MANY, seed=0)
    asked = hit_and_free(origins, ends, "near_surface", resolution, seed=0)
    points = asked.points[asked.of(FREE)]
    gap = (ends - points).norm(dim=1) / resolution
    assert float(gap.min()) >= 0.5 - 1e-9
    assert float(gap.max()) <= 2 + 1e-9
    assert kstest(gap.numpy(), "uniform", args=(0.5, 1.5)).pvalue > 0.01
    assert bool((along(points, origins, ends) > 0).all())


def test_near_surface_points_are_never_behind_the_sensor():
    length = torch.linspace(0.01, 0.5, 200, dtype=torch.float64)
    origins = torch.tensor([[3.0, -2.0]], dtype=torch.float64).expand(200, 2)
    ends = origins + length[:, None] * torch.tensor([0.6, 0.8], dtype=torch.float64)
    asked = hit_and_free(origins, ends, "near_surface", 0.2, seed=0)
    share = along(asked.points[asked.of(FREE)], origins, ends)
    assert bool((share >= 0).all())
    assert bool((share[length < 0.1] == 0).all())  # shorter than half a cell: the sensor itself


def test_random_choices_depend_only_on_the_seed():
    scans = room_scans(10)
    rays = query_points.test_beams(scans[:2], MANY, seed=0)
    for drawn in (
        lambda seed: beams(keep_share(scans, 0.3, "beams", seed)),
        lambda seed: beams(keep_share(scans, 0.3, "scans", seed)),
        lambda seed: beams(perturb_poses(scans, (0.1, 0.1), seed)),
        lambda seed: hit_and_free(*rays, "uniform", 0.1, seed).points.tolist(),
    ):
        assert drawn(1) == drawn(1) != drawn(2)


def test_max_beams_draws_a_random_subset():
    scans = room_scans(6)
    _, every_end = query_points.test_beams(scans, MANY, seed=0)
    origins, ends = query_points.test_beams(scans, 50, seed=0)
    assert len(origins) == len(ends) == 50
    whole = {tuple(row): i for i, row in enumerate(every_end.tolist())}
    chosen = [whole[tuple(row)] for row in ends.tolist()]
    assert len(set(chosen)) == 50
    assert max(chosen) > len(every_end) // 2  # from all scans
    for origin, end in zip(origins, ends, strict=True):  # each with its own sensor origin
        scan = next(s for s in scans if bool((s.points == end).all(1).any()))
        assert torch.equal(scan.origin, origin)
    assert torch.equal(query_points.test_beams(scans, 50, seed=0)[1], ends)
    assert not torch.equal(query_points.test_beams(scans, 50, seed=1)[1], ends)
    assert len(query_points.test_beams(scans, len(every_end), seed=0)[1]) == len(every_end)


def test_test_scans_without_returns_raise():
    scan = Scan(torch.empty(0, 2), torch.zeros(2), torch.ones(5, 2))
    with pytest.raises(InvalidArgumentError, match=r"no return beams.*test_every"):
        query_points.test_beams([scan, scan], MANY, seed=0)


# -- unseen space ---------------------------------------------------------------------------------


def rays_of(scans: list[Scan]) -> tuple[Tensor, Tensor]:
    """Origins and ends (R, D) of all beams, no-return beams included."""
    origins = torch.cat([scan.origin.expand(scan.n_beams, -1) for scan in scans])
    return origins, torch.cat([scan.ends()[0] for scan in scans])


def enters(box_low: Tensor, box_high: Tensor, origins: Tensor, ends: Tensor) -> bool:
    """Whether one of the segments (R, D) crosses the interior of a box (slab test)."""
    beam = ends - origins
    near, far = (box_low - origins) / beam, (box_high - origins) / beam
    first = torch.minimum(near, far).amax(1).clamp_min(0)
    last = torch.maximum(near, far).amin(1).clamp_max(1)
    return bool((last - first > 1e-12).any())


@pytest.mark.parametrize(("dim", "n_beams", "resolution"), [(2, 90, 0.1), (2, 90, 0.3), (3, 150, 0.3)])
def test_unseen_points_match_brute_force_box_intersections(dim, n_beams, resolution):
    scans = room_scans(12, n_beams=n_beams, dim=dim)
    train, test = scans[:8], scans[8:]
    origins, ends = query_points.test_beams(test, 250, seed=0)
    grid = OccupancyGrid(resolution)
    for scan in train:
        grid.insert(scan)
    found = unseen(origins, ends, grid.evidence(), seed=0)
    assert bool((found.labels == UNKNOWN).all())
    # Without evidence all candidates are unseen, in the order of the beams.
    candidates = unseen(origins, ends, SparseEvidence(resolution, dim), seed=0).points
    assert len(candidates) == len(ends)
    behind = (candidates - ends).norm(dim=1) / resolution
    assert 2 - 1e-9 <= float(behind.min()) < 3 < 11 < float(behind.max()) <= 12 + 1e-9
    assert bool((along(candidates, origins, ends) > 1).all())
    starts, stops = rays_of(train)
    low = (candidates / resolution).floor() - 1
    observed = torch.tensor([
        enters(corner * resolution, (corner + 3) * resolution, starts, stops) for corner in low
    ])  # fmt: skip
    assert 0.05 < float(observed.double().mean()) < 0.95  # both cases occur
    torch.testing.assert_close(found.points, candidates[~observed], atol=0, rtol=0)


def test_the_end_cell_of_a_no_return_beam_is_observed():
    """A no-return beam ends in cell (10, 0), a neighbour of the cells (11, -1) to (11, 1)."""
    beam = Scan(torch.empty(0, 2), torch.tensor([0.05, 0.05]), torch.tensor([[1.03, 0.05]]))
    ends = torch.tensor([[1.15, 0.65]], dtype=torch.float64).expand(200, 2)
    found = unseen(ends + torch.tensor([0.0, 1.4]), ends, ray_evidence([beam], 0.1), seed=0)
    row = (found.points[:, 1] / 0.1).floor()
    assert set(row[(row >= 2) | (row <= -2)].tolist()) >= {3.0, 2.0, -2.0, -3.0}
    assert not bool(((row >= -1) & (row <= 1)).any())


# -- the file of queries --------------------------------------------------------------------------


def some_queries(shift: float = 0.0) -> Queries:
    return Queries(torch.tensor([[0.0, 1.0], [2.0 + shift, 3.0]]).double(), torch.tensor([OCCUPIED, FREE]))


def test_points_shared_by_all_resolutions_are_saved_once(tmp_path):
    save_queries(tmp_path / "q.npz", {0.1: some_queries(), 0.02: some_queries()}, [1, 2], [0, 3])
    with np.load(tmp_path / "q.npz", allow_pickle=False) as file:
        assert set(file) == {"points", "labels", "resolution", "train_scans", "test_scans"}
        np.testing.assert_array_equal(file["points"], some_queries().points.numpy())
        np.testing.assert_array_equal(file["labels"], [OCCUPIED, FREE])
        np.testing.assert_array_equal(file["resolution"], [0, 0])
        np.testing.assert_array_equal(file["train_scans"], [1, 2])
        np.testing.assert_array_equal(file["test_scans"], [0, 3])
        assert file["points"].dtype == np.float64
        assert all(file[name].dtype == np.int64 for name in ("labels", "train_scans", "test_scans"))


def test_saved_maps_and_queries_reproduce_the_rows(tmp_path):
    protocol = Protocol(
        test_every=4,
        kept=(0.3,),
        resolution=(0.2, 0.1),
        free="near_surface",
        unknown=True,
        save_queries=str(tmp_path / "q.npz"),
        save_map=str(tmp_path / "maps"),
    )
    ours, grids = ("point", "monte_carlo"), ("occupancy_grid", "occupancy_log_odds")
    known = choose([*ours, *grids], methods(lambda: GaussianMap(window=5, n_samples=5_000)))
    rows = evaluate("room", room_scans(16), known, protocol, seed=5).rows
    assert len(rows) == len(known) * 2 == len(list((tmp_path / "maps").iterdir()))
    with np.load(tmp_path / "q.npz", allow_pickle=False) as file:
        saved = dict(file)
    np.testing.assert_array_equal(saved["test_scans"], [0, 4, 8, 12])
    np.testing.assert_array_equal(saved["train_scans"], [i for i in range(16) if i % 4])
    assert set(saved["labels"]) == {FREE, OCCUPIED, UNKNOWN}
    for row in rows:
        path = tmp_path / "maps" / f"{row['method']}_{row['kept']:g}_{row['resolution']:g}.safetensors"
        assert path.stat().st_size == row["nbytes"]
        kind = GaussianMap if row["method"] in ours else OccupancyGrid
        asked = np.isin(saved["resolution"], [0, row["resolution"]])
        theta = kind.load(path).occupancy(saved["points"][asked], row["resolution"])
        labels = saved["labels"][asked]
        sure = labels <= OCCUPIED
        assert len(theta) == row["n_queries"]
        assert roc_auc_score(labels[sure], theta[sure]) == pytest.approx(row["auc"], abs=1e-12)
        assert brier_score_loss(labels[sure], theta[sure]) == pytest.approx(row["brier"], abs=1e-12)
        doubt, no_hit = -np.abs(theta - 0.5), labels != OCCUPIED
        expected = roc_auc_score(labels[no_hit] == UNKNOWN, doubt[no_hit])
        assert expected == pytest.approx(row["unknown_auc"], abs=1e-12)
        assert math.isfinite(expected)
