"""The split into training and test scans, removal of training data, and perturbed poses."""

from __future__ import annotations

import math

import pytest
import torch
from pillar_room import room_scans
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.evaluation.queries import keep_share, perturb_poses, split_indices
from gmmtorch.scan import Scan

SHARES = (0.8, 0.3, 0.1, 0.02)


def beams(scans: list[Scan]) -> list[set[tuple[float, ...]]]:
    """The beam ends of each scan, no-return beams included."""
    return [{tuple(row) for row in scan.ends()[0].tolist()} for scan in scans]


def sensors(scans: list[Scan]) -> list[tuple[float, ...]]:
    return [tuple(scan.origin.tolist()) for scan in scans]


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
    larger = sensors(scans)
    for share in SHARES:
        kept = keep_share(scans, share, "scans", seed=3)
        assert len(kept) == max(1, math.ceil(share * len(scans)))
        assert sensors(kept) == [origin for origin in larger if origin in set(sensors(kept))]
        assert all(any(scan is whole for whole in scans) for scan in kept)  # the same objects
        larger = sensors(kept)


@pytest.mark.parametrize("removal", ["beams", "scans"])
def test_kept_data_depends_only_on_the_seed(removal):
    scans = room_scans(20)
    first, again, other = (keep_share(scans, 0.3, removal, seed=seed) for seed in (1, 1, 2))
    assert beams(first) == beams(again)
    assert beams(first) != beams(other)


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
def test_zero_noise_keeps_the_scans(dim):
    scans = room_scans(3, dim=dim)
    moved = perturb_poses(scans, (0.0, 0.0), seed=0)
    assert all(a is b for a, b in zip(moved, scans, strict=True))


@pytest.mark.parametrize("dim", [2, 3])
def test_perturbation_is_a_rigid_motion(dim):
    scans = room_scans(5, dim=dim)
    for before, after in zip(scans, perturb_poses(scans, (0.2, 0.3), seed=1), strict=True):
        ends, moved = before.ends()[0], after.ends()[0]
        assert not torch.allclose(ends, moved, atol=1e-3)
        torch.testing.assert_close(gaps(moved), gaps(ends))
        # The sensor moves with its points, so the ranges do not change.
        torch.testing.assert_close((moved - after.origin).norm(dim=1), (ends - before.origin).norm(dim=1))
        frame = torch.linalg.lstsq(ends - before.origin, moved - after.origin).solution
        assert float(torch.linalg.det(frame)) == pytest.approx(1)  # not a mirror image


@pytest.mark.parametrize("dim", [2, 3])
def test_translation_and_rotation_noise_are_independent(dim):
    scan = room_scans(1, dim=dim)[0]
    shifted, turned = (perturb_poses([scan], noise, seed=2)[0] for noise in ((0.1, 0.0), (0.0, 0.1)))
    torch.testing.assert_close(shifted.points - shifted.origin, scan.points - scan.origin)
    assert not torch.allclose(shifted.origin, scan.origin)
    torch.testing.assert_close(turned.origin, scan.origin)
    assert not torch.allclose(turned.points, scan.points)


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


def test_noise_depends_only_on_the_seed():
    scans = room_scans(3)
    first, again, other = (perturb_poses(scans, (0.1, 0.1), seed) for seed in (0, 0, 1))
    assert beams(first) == beams(again)
    assert beams(first) != beams(other)
