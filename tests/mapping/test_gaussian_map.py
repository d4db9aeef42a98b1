"""GaussianMap: learning by windows, ids, and the module. What every map does: see test_protocol."""

from __future__ import annotations

import copy
import math

import numpy as np
import pytest
import torch
from mapping.map_cases import FINE, assert_same_components, built, drive, given_parts, names, sightings
from occupancy.protocol_contract import RESOLUTION, dims, lattice, open_scan, wall_scan

from gmmtorch.baselines.occupancy_grid import OccupancyGrid
from gmmtorch.errors import GmmTorchError, InvalidArgumentError
from gmmtorch.mapping.codec.component_batch import quantized
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mapping.learning.rules import IncrementalRule, WindowedRule
from gmmtorch.scan import Scan

BUFFERS = [
    "covariances",
    "ids",
    "max_range",
    "means",
    "origins",
    "seen_by",
    "seen_count",
    "seen_from",
    "support",
]


# -- learning by windows ---------------------------------------------------------------------------------


@dims
@pytest.mark.parametrize("learning", [WindowedRule(), FINE])
def test_components_describe_the_points(dim, learning):
    scan = wall_scan(dim)
    parts = built([scan], learning).components()
    cloud = scan.points.numpy()
    support = parts.support.numpy()
    mean = np.average(parts.means.numpy(), axis=0, weights=support)
    np.testing.assert_allclose(support.sum(), len(cloud), rtol=1e-6)
    np.testing.assert_allclose(mean, cloud.mean(0), atol=2e-3)
    offset = parts.means.numpy() - mean
    spread = np.einsum("k,ki,kj->ij", support, offset, offset) + np.einsum(
        "k,kij->ij", support, parts.covariances.numpy()
    )
    expected = np.cov(cloud.T, ddof=0) + 0.01**2 * np.eye(dim)
    np.testing.assert_allclose(spread / support.sum(), expected, rtol=1e-2, atol=1e-4)


@dims
@pytest.mark.parametrize("window", [1, 3, 20])
def test_counts_of_sightings_add_up_to_the_support(dim, window):
    parts = built(drive(5, dim), window=window).components()
    total = np.bincount(parts.seen_by.numpy(), weights=parts.seen_count.numpy(), minlength=len(parts))
    np.testing.assert_allclose(total, parts.support.numpy(), rtol=1e-9)
    np.testing.assert_allclose(float(parts.support.sum()), 5 * len(wall_scan(dim).points), rtol=1e-6)
    assert float(parts.seen_count.min()) > 0


@pytest.mark.parametrize("max_origins", [1, 2, 8])
def test_components_keep_a_few_origins_and_real_ones(max_origins):
    scans = drive(6)
    parts = built(scans, WindowedRule(max_origins=max_origins, window=6)).components()
    real = {tuple(scan.origin.tolist()) for scan in scans}
    table = sightings(parts)
    assert max(len(seen) for seen in table) == min(max_origins, 6)
    assert min(len(seen) for seen in table) >= 1
    assert {place for seen in table for place in seen} <= real


def test_with_room_for_every_origin_the_counts_are_those_of_the_points():
    near, far = drive(5)[::4]
    half = Scan(far.points[::2], far.origin)
    parts = built([near, half], WindowedRule(max_origins=2, window=2)).components()
    for seen in sightings(parts):
        counts = [seen[tuple(s.origin.tolist())] for s in (near, half)]
        assert counts[0] / counts[1] == pytest.approx(2, rel=0.15)


def test_the_thesis_map_has_one_origin_a_component_that_of_its_scan():
    scans, rule = drive(3), WindowedRule(max_origins=1, window=1)
    made = built(scans, rule)
    one_by_one = [built([scan], rule) for scan in scans]
    assert all(len(seen) == 1 for seen in sightings(made.components()))
    assert torch.equal(made.means, torch.cat([m.means for m in one_by_one]))


@pytest.mark.parametrize("learning", [WindowedRule(), FINE])
def test_a_window_is_closed_when_it_is_full(learning):
    made = built([], learning, window=3)
    sizes = []
    for scan in drive(7):
        made.insert(scan)
        sizes.append(made.means.shape[0])
    assert sizes[:2] == [0, 0]
    assert 0 < sizes[2] == sizes[3] == sizes[4] < sizes[5] == sizes[6]
    assert made.n_components > sizes[6]  # the unfinished window counts at once


@pytest.mark.parametrize("learning", [WindowedRule(), FINE])
def test_each_window_is_learned_alone(learning):
    scans = drive(6)
    both, first, second = (built(part, learning, window=3) for part in (scans, scans[:3], scans[3:]))
    assert torch.equal(both.means, torch.cat([first.means, second.means]))
    torch.testing.assert_close(both.covariances, torch.cat([first.covariances, second.covariances]))
    # The origins of the incremental map are limited over all of it.
    if isinstance(learning, WindowedRule):
        assert sightings(both.components()) == sightings(first.components()) + sightings(second.components())


def test_ids_name_the_robot_and_count_on():
    ids = built(drive(5), window=2, robot=3).components().ids
    assert ids[:, 0].unique().tolist() == [3]
    assert ids[:, 1].tolist() == list(range(len(ids)))


@pytest.mark.parametrize("learning", [WindowedRule(), FINE])
def test_beams_without_return_become_flagged_components_of_their_own(learning):
    parts = built([wall_scan(2), open_scan(2)], learning).components()
    support = float(parts.support[parts.max_range].sum())
    assert support == pytest.approx(len(open_scan(2).no_return), rel=1e-6)
    assert 0 < int(parts.max_range.sum()) < len(parts)
    assert not bool(built([wall_scan(2)], learning).components().max_range.any())


def test_a_bound_on_the_components_of_a_window_is_kept():
    assert built(drive(4), WindowedRule(n_components=5, length=0.05), window=2).n_components <= 10
    assert built(drive(4), WindowedRule(length=0.05), window=2).n_components > 20


def test_the_seed_decides_which_origins_are_kept():
    rule = WindowedRule(max_origins=1, window=6)
    first, again, other = (built(drive(6), rule, random_state=seed) for seed in (0, 0, 1))
    assert torch.equal(first.seen_from, again.seen_from)
    assert not torch.equal(first.seen_from, other.seen_from)


@dims
def test_what_is_answered_from_is_the_rounded_map_and_learning_goes_on_from_the_exact_one(dim):
    rounded, exact = (built(drive(4, dim), window=2, codec=codec) for codec in ("quantized", "float"))
    assert torch.equal(rounded.means, exact.means)
    assert_same_components(rounded.components(), quantized(exact.components()))
    theta = [made.occupancy(lattice(dim)) for made in (rounded, exact)]
    assert not torch.equal(*theta)
    assert float((theta[0] - theta[1]).abs().mean()) < 0.02


# -- settings --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("window", 0),
        ("window", 1.5),
        ("window", "2"),
        ("n_samples", 0),
        ("sampling", "halton"),
        ("resolution", 0.0),
        ("resolution", math.nan),
        ("prior", -1.0),
        ("prior", math.nan),
        ("random_state", 2**70),
        ("random_state", None),
        ("robot", -1),
        ("robot", "r2"),
        ("method", "magic"),
        ("codec", "zip"),
        ("cutoff", 0.0),
        ("hit_length", -1.0),
    ],
)
def test_bad_settings_are_named_when_the_map_is_made(name, value):
    with pytest.raises(InvalidArgumentError, match=name):
        GaussianMap(**{name: value})


@pytest.mark.parametrize(
    "name", ["noise", "length", "min_points", "n_components", "max_origins", "iterations", "max_cells"]
)
@pytest.mark.parametrize("value", [0, -1])
def test_bad_learning_rules_are_named(name, value):
    with pytest.raises(InvalidArgumentError, match=name):
        WindowedRule(**{name: value})


@pytest.mark.parametrize("name", ["noise", "length", "min_points"])
def test_learning_rules_that_are_no_numbers_are_named(name):
    with pytest.raises(InvalidArgumentError, match=name):
        WindowedRule(**{name: math.nan})


def test_the_window_given_is_the_rules():
    assert GaussianMap(window=3).learning == IncrementalRule(window=3)
    assert GaussianMap(WindowedRule(noise=0.02), window=3).learning == WindowedRule(noise=0.02, window=3)


# -- what is inserted ------------------------------------------------------------------------------------


def test_what_is_no_scan_is_refused():
    with pytest.raises(InvalidArgumentError, match=r"Tensor.*Scan"):
        GaussianMap().insert(torch.zeros(3, 2))


def test_arrays_that_are_used_again_do_not_change_what_was_inserted():
    points = np.random.default_rng(0).normal(size=(50, 2)) * 0.01 + [3.0, 0.0]
    for empty in (GaussianMap(window=2), OccupancyGrid(0.1)):
        buffer = points.copy()
        empty.insert(Scan(buffer, np.zeros(2)))
        buffer[:] = -100.0
        empty.insert(Scan(points, np.zeros(2)))
        theta = empty.occupancy(np.array([[3.0, 0.02], [-100.0, -100.0]]), 0.1)
        assert theta[0] > 0.5
        assert theta[1] == 0.5


@pytest.mark.parametrize("learning", [WindowedRule(window=2), IncrementalRule(window=2)])
def test_a_scan_that_cannot_be_learned_from_is_refused_and_the_map_goes_on_without_it(learning):
    scans = drive(3)
    made = built(scans[:1], learning, codec="quantized")
    before = made.occupancy(lattice(2))
    for _ in range(2):  # 10⁹ m away: neither learned from with the other scan, nor stored
        with pytest.raises(GmmTorchError):
            made.insert(Scan(torch.full((5, 2), 1e9, dtype=torch.float64), torch.zeros(2)))
    assert torch.equal(made.occupancy(lattice(2)), before)
    made.insert(scans[1])
    assert_same_components(made.components(), built(scans[:2], learning, codec="quantized").components())


# -- the module ------------------------------------------------------------------------------------------


def committed(made: GaussianMap) -> Components:
    return Components(**{name: getattr(made, name).clone() for name in BUFFERS})


def test_an_empty_map_has_no_evidence_nor_components():
    made = GaussianMap()
    assert (made.n_components, made.dim, made.nbytes) == (0, None, 0)
    assert list(made.state_dict()) == ["_extra_state"]
    with pytest.raises(InvalidArgumentError, match="empty"):
        made.transform(torch.eye(3))
    with pytest.raises(InvalidArgumentError, match="empty"):
        made.components()


@pytest.mark.parametrize("change", ["float", "half", "double", "to_cpu", "deepcopy"])
def test_a_change_of_dtype_or_place_leaves_the_components_and_the_waiting_scans_as_they_are(change):
    made = built(drive(3), FINE)
    assert sorted(made.state_dict()) == ["_extra_state", *BUFFERS]
    buffers, answers = committed(made), made.occupancy(lattice(2))
    if change == "deepcopy":
        other = copy.deepcopy(made)
    else:
        other = made.to("cpu") if change == "to_cpu" else getattr(made, change)()
        assert other is made
    assert_same_components(committed(other), buffers)
    assert torch.equal(other.occupancy(lattice(2)), answers)
    other.insert(drive(4)[3])
    assert_same_components(committed(other), committed(built(drive(4), FINE)))


def test_networks_of_another_dtype_leave_positions_exact_far_from_the_origin():
    made = GaussianMap(window=1)
    made.insert(Scan(np.random.default_rng(0).normal(5e5, size=(50, 2)), np.full(2, 5e5)))
    before = made.means.clone()
    assert torch.equal(made.half().means, before)


@dims
def test_a_state_restores_the_components_and_the_answers(dim, tmp_path):
    first, other = (
        GaussianMap.from_components(**given_parts(dim, seed=seed), resolution=RESOLUTION) for seed in (0, 1)
    )
    expected, before = (made.occupancy(lattice(dim)) for made in (first, other))
    assert not torch.equal(expected, before)
    torch.save(first.state_dict(), tmp_path / "state.pt")
    other.insert(wall_scan(dim))  # waits, and is none of what is restored
    other.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    assert torch.equal(other.occupancy(lattice(dim)), expected)
    assert_same_components(other.components(), first.components())


def test_ids_go_on_from_those_of_a_restored_state():
    first = GaussianMap.from_components(**given_parts())
    first.ids += torch.tensor([0, 100])
    other = GaussianMap.from_components(**given_parts(seed=1))
    other.load_state_dict(first.state_dict())
    other.insert(wall_scan(2))
    assert min(names(other.components().ids) - names(first.ids)) == (0, 104)
    assert other.means.shape == first.means.shape  # the window is not full yet
