"""Motions of a GaussianMap: transform moves components and occupancy without learning again."""

from __future__ import annotations

import math

import pytest
import torch
from mapping.map_cases import (
    FINE,
    assert_close_components,
    assert_same_components,
    built,
    drive,
    given_parts,
    moved_parts,
    names,
    open_drive,
    sightings,
    some_motion,
)
from occupancy.protocol_contract import dims, lattice, move, quarter_turn, shifted, wall_scan
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mapping.learning.rules import WindowedRule


@dims
def test_transform_equals_a_map_of_moved_components_and_origins(dim):
    parts, matrix = given_parts(dim), some_motion(dim)
    made = GaussianMap.from_components(**parts)
    made.transform(matrix)
    expected = GaussianMap.from_components(**moved_parts(parts, matrix))
    assert_close_components(made.components(), expected.components())
    torch.testing.assert_close(made.occupancy(lattice(dim)), expected.occupancy(lattice(dim)))


@dims
def test_transform_of_some_ids_leaves_other_components_unchanged(dim):
    parts, matrix = given_parts(dim), some_motion(dim)
    chosen = torch.tensor([False, True, False, True])
    made = GaussianMap.from_components(**parts)
    made.transform(matrix, ids=made.ids[chosen])
    there = moved_parts(parts, matrix)
    both = {
        name: torch.where(chosen.reshape(-1, *[1] * (value.ndim - 1)), there[name], value)
        for name, value in parts.items()
    }
    assert_close_components(made.components(), GaussianMap.from_components(**both).components())
    for name in ("means", "covariances"):
        assert torch.equal(getattr(made, name)[~chosen], parts[name][~chosen])


def test_an_origin_shared_by_moved_and_unmoved_components_is_split():
    parts = given_parts(k=2)
    shared = torch.zeros(2, 2, dtype=torch.float64)
    made = GaussianMap.from_components(parts["means"], parts["covariances"], parts["support"], shared)
    made.transform(shifted(2, (1.0, 2.0)), ids=[[0, 1]])
    assert [list(seen) for seen in sightings(made.components())] == [[(0.0, 0.0)], [(1.0, 2.0)]]


@pytest.mark.parametrize("ids", [[], [[5, 0]], [[0, 99]]])
def test_transform_of_unknown_ids_moves_nothing(ids):
    made = GaussianMap.from_components(**given_parts())
    before = made.means.clone()
    made.transform(quarter_turn(2), ids=ids)
    assert torch.equal(made.means, before)


def correction(dim: int) -> Tensor:
    """A turn by 3° about the vertical and a step of 20 cm."""
    matrix = shifted(dim, (0.2, -0.1, 0.05))
    c, s = math.cos(math.radians(3)), math.sin(math.radians(3))
    matrix[:2, :2] = torch.tensor([[c, -s], [s, c]], dtype=torch.float64)
    return matrix


@dims
def test_a_pose_correction_equals_learning_from_the_corrected_scans(dim):
    rule = WindowedRule(window=1, dtype="float64")
    scans, matrix = [drive(1, dim)[0], *open_drive(3, dim)[1:]], correction(dim)
    made = built([], rule, prior=1.0)
    of_window = []
    for scan in scans:
        known = names(made.ids) if made.dim else set()
        made.insert(scan)
        of_window.append(sorted(names(made.ids) - known))
    wrong = made.occupancy(lattice(dim))
    made.transform(matrix, ids=of_window[1])
    expected = built([scans[0], scans[1].transformed(matrix), scans[2]], rule, prior=1.0)
    # New ids follow the position, which the rotation changes: components are matched by their means.
    ours, theirs = made.components(), expected.components()
    distance, nearest = torch.cdist(theirs.means, ours.means).min(1)
    assert sorted(nearest.tolist()) == list(range(len(ours)))
    assert float(distance.max()) < 1e-6
    assert_close_components(ours.rearranged(nearest), theirs, 1e-6)
    right = expected.occupancy(lattice(dim))
    torch.testing.assert_close(made.occupancy(lattice(dim)), right, rtol=0, atol=1e-5)
    assert float((wrong - right).abs().max()) > 0.1


@pytest.mark.parametrize(("dim", "codec"), [(2, "float"), (3, "quantized")])
def test_the_occupancy_of_an_incremental_map_moves_with_it(dim, codec):
    made = built(drive(3, dim), FINE, codec=codec)
    before, ids = made.occupancy(lattice(dim)), made.components().ids
    matrix = quarter_turn(dim, (0.37, -1.21, 0.3))  # the cube at a point has the axes of the world
    made.transform(matrix)
    assert torch.equal(made.ids, ids)
    moved = made.occupancy(move(matrix, lattice(dim)))
    if codec == "float":
        torch.testing.assert_close(moved, before, rtol=0, atol=1e-6)
    assert float((moved - before).abs().mean()) < 0.02  # quantized again at the new position
    assert float((made.occupancy(lattice(dim)) - before).abs().max()) > 0.1


@pytest.mark.parametrize("codec", ["quantized", "float"])
def test_the_inverse_motion_restores_the_map(codec):
    made = built(drive(3), window=2, codec=codec)
    before = made.occupancy(lattice(2))
    made.transform(quarter_turn(2))
    assert not torch.equal(made.occupancy(lattice(2)), before)
    made.transform(torch.linalg.inv(quarter_turn(2)))
    assert torch.equal(made.occupancy(lattice(2)), before)


def test_a_distant_motion_is_exact_to_10_nm():
    parts, matrix = given_parts(), shifted(2, (500_000.0, 4_000_000.0))
    made = GaussianMap.from_components(**parts)
    made.transform(matrix)
    torch.testing.assert_close(made.means, move(matrix, parts["means"]), rtol=0, atol=1e-8)


@pytest.mark.parametrize("learning", [WindowedRule(window=20), FINE])
def test_transform_closes_the_pending_window_and_learning_continues(learning):
    made = built(drive(3), learning)
    ids = made.components().ids
    made.transform(shifted(2, (0.0, 1.0)))
    assert torch.equal(made.ids, ids)
    made.insert(wall_scan(2))
    assert names(made.components().ids) > names(ids)


@pytest.mark.parametrize(
    "matrix",
    [
        torch.eye(4),
        torch.eye(2),
        torch.diag(torch.tensor([2.0, 1.0, 1.0])),
        torch.diag(torch.tensor([1.0, -1.0, 1.0])),
        torch.full((3, 3), math.nan),
        torch.tensor([[1.0, 0.0, math.nan], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.5, 0.0, 1.0]]),
    ],
    ids=["3D", "2x2", "scaled", "mirror", "nan", "nan translation", "perspective"],
)
def test_a_matrix_that_is_no_rigid_motion_is_refused(matrix):
    made = GaussianMap.from_components(**given_parts())
    before = made.means.clone()
    with pytest.raises(InvalidArgumentError, match="transform"):
        made.transform(matrix)
    assert torch.equal(made.means, before)


@pytest.mark.parametrize(
    ("matrix", "ids"), [(torch.eye(3), [[0, 1, 2]]), (2 * torch.eye(3), None)], ids=["ids", "matrix"]
)
def test_a_refused_transform_keeps_the_pending_window(matrix, ids):
    scans = drive(3)
    made = built(scans[:2], window=3)
    with pytest.raises(InvalidArgumentError, match=r"ids has shape|transform"):
        made.transform(matrix, ids=ids)
    made.insert(scans[2])
    assert_same_components(made.components(), built(scans, window=3).components())
