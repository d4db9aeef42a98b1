"""GaussianMap: learning by windows, settings, ids, and the module."""

from __future__ import annotations

import copy
import math
import re
from functools import cache

import numpy as np
import pytest
import torch
from invalid_values import each_value
from mapping.map_cases import FINE, assert_same_components, built, drive, given_parts, sightings
from occupancy.protocol_contract import RESOLUTION, OccupancyMapContract, dims, lattice, open_scan, wall_scan
from torch import Tensor

from gmmtorch.datasets import load
from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError, MemoryLimitError
from gmmtorch.mapping import Components, GaussianMap, IncrementalRule, NoveltyRule, WindowedRule, quantized
from gmmtorch.mapping.components import TENSORS
from gmmtorch.occupancy import OccupancyGrid, VoxelGrid
from gmmtorch.scan import Scan

BUFFERS = sorted(TENSORS)


# -- learning by windows ---------------------------------------------------------------------------------


@dims
@pytest.mark.parametrize("learning", [WindowedRule(), FINE])
def test_components_have_the_moments_of_the_points(dim, learning):
    scan = wall_scan(dim)
    parts = built([scan], learning).components()
    cloud = scan.points.numpy()
    support = parts.support.numpy()
    mean = np.average(parts.means.numpy(), axis=0, weights=support)
    np.testing.assert_allclose(support.sum(), len(cloud), rtol=1e-6)
    np.testing.assert_allclose(mean, cloud.mean(0), atol=2e-3)
    offset = parts.means.numpy() - mean
    spread = np.einsum("k,ki,kj->ij", support, offset, offset)
    spread += np.einsum("k,kij->ij", support, parts.covariances.numpy())
    expected = np.cov(cloud.T, ddof=0) + 0.01**2 * np.eye(dim)
    np.testing.assert_allclose(spread / support.sum(), expected, rtol=1e-2, atol=1e-4)


@pytest.mark.parametrize("max_origins", [1, 2, 8])
def test_components_keep_at_most_max_origins_sensor_origins(max_origins):
    scans = drive(6)
    parts = built(scans, WindowedRule(max_origins=max_origins, window=6)).components()
    real = {tuple(scan.origin.tolist()) for scan in scans}
    table = sightings(parts)
    assert max(len(seen) for seen in table) == min(max_origins, 6)
    assert min(len(seen) for seen in table) >= 1
    assert {place for seen in table for place in seen} <= real


@pytest.mark.parametrize("learning", [WindowedRule(), FINE])
def test_a_full_window_is_learned(learning):
    made = built([], learning, window=3)
    sizes = []
    for scan in drive(7):
        made.insert(scan)
        sizes.append(len(made.state_dict()["means"]))
    assert sizes[:2] == [0, 0]
    assert 0 < sizes[2] == sizes[3] == sizes[4] < sizes[5] == sizes[6]
    assert made.n_components > sizes[6]  # n_components includes the pending window


@pytest.mark.parametrize("finish", [True, False])
def test_attributes_show_the_unfinished_window(finish):
    made = built(drive(1), FINE)
    if finish:
        made.finish()
    assert made.n_pending == 1
    known = made.components()
    assert len(made.means) == len(made.support) == len(known) > 0
    for name in known.tensors():
        assert torch.equal(getattr(made, name), getattr(known, name)), name
    made.insert(drive(2)[1])  # the window of two is full
    assert made.n_pending == 0
    assert torch.equal(made.means, made.state_dict()["means"])
    assert not hasattr(GaussianMap(), "means")


def test_repr_is_true_before_and_after_the_window_is_learned():
    made = GaussianMap(FINE)
    assert repr(made) == "GaussianMap(empty, IncrementalRule)"
    made.insert(drive(1)[0])
    assert repr(made) == (
        "GaussianMap(0 components and 1 pending scan not learned yet in 2D, IncrementalRule, cpu)"
    )
    made.finish()
    assert re.fullmatch(
        rf"GaussianMap\({made.n_components} components in 2D, x .* to .*, y .* to .* m, {made.nbytes} bytes, "
        r"1 pending scan, IncrementalRule, cpu\)",
        repr(made),
    )
    made.insert(drive(2)[1])
    assert "pending" not in repr(made)


@pytest.mark.parametrize("learning", ["incremental", 3, IncrementalRule])
def test_learning_that_is_no_rule_and_what_is_no_scan_are_refused(learning):
    with pytest.raises(InvalidArgumentError, match=r"^learning=.* give IncrementalRule\(\)"):
        GaussianMap(learning)
    with pytest.raises(InvalidArgumentError, match=r"Tensor.*Scan"):
        GaussianMap().insert(torch.zeros(3, 2))


@pytest.mark.parametrize("method", ["point", "monte_carlo"])
def test_evidence_of_a_grid_honours_the_memory_limit(method):
    made = GaussianMap.from_components(**given_parts(), memory_limit=16_000, n_samples=100)
    assert made.evidence(VoxelGrid((0.0, 0.0), 0.1, (10, 100)), method).hits.shape == (10, 100)
    large = VoxelGrid((0.0, 0.0), 0.001, (1 << 16, 1 << 16))
    for asked in (made, GaussianMap(memory_limit=16_000)):
        with pytest.raises(MemoryLimitError, match=r"68,719,476,736 bytes, more than memory_limit=16,000"):
            asked.evidence(large, method)
        with pytest.raises(MemoryLimitError, match="memory_limit"):
            asked.evidence(VoxelGrid((0.0, 0.0), 0.1, (10, 101)), method)


@pytest.mark.parametrize("method", ["point", "cone"])
def test_evidence_in_parts_is_that_of_the_whole(method, monkeypatch):
    made = GaussianMap.from_components(**given_parts())
    grid = VoxelGrid((-2.0, -2.0), 0.5, (9, 7))
    whole = made.evidence(grid, method)
    monkeypatch.setattr("gmmtorch.mapping.query._CELLS_AT_ONCE", 10)
    parts = made.evidence(grid, method)
    torch.testing.assert_close(parts.hits, whole.hits, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(parts.misses, whole.misses, rtol=1e-9, atol=1e-12)
    assert float(whole.hits.sum()) > 0


@pytest.mark.parametrize("far", [1e300, -1e12, 2.0**27 * 1.01])
def test_coordinates_beyond_the_largest_are_refused_with_its_value(far):
    allowed = r"largest allowed coordinate is 134217728 m"
    for points, origin in (([[far, 0.0]], [0.0, 0.0]), ([[1.0, 0.0]], [0.0, far])):
        with pytest.raises(InvalidArgumentError, match=allowed):
            Scan(points, origin)
    for name in ("means", "origins"):
        parts = given_parts()
        parts[name][1, 0] = far
        with pytest.raises(InvalidArgumentError, match=rf"^{name}\[1\] = .*{allowed}"):
            GaussianMap.from_components(**parts)
    made = built([Scan([[2.0**27, 1.0], [2.0**27, 2.0]], [2.0**27 - 3, 1.0])])
    assert made.n_components > 0


@pytest.mark.parametrize("learning", [WindowedRule(), FINE])
def test_windows_are_learned_independently(learning):
    scans = drive(6)
    both, first, second = (built(part, learning, window=3) for part in (scans, scans[:3], scans[3:]))
    assert torch.equal(both.means, torch.cat([first.means, second.means]))
    torch.testing.assert_close(both.covariances, torch.cat([first.covariances, second.covariances]))
    # The origins of the incremental map are limited over all of it.
    if isinstance(learning, WindowedRule):
        assert sightings(both.components()) == sightings(first.components()) + sightings(second.components())


def test_ids_contain_the_robot_and_ascend():
    ids = built(drive(5), window=2, robot=3).components().ids
    assert ids[:, 0].unique().tolist() == [3]
    assert ids[:, 1].tolist() == list(range(len(ids)))


@pytest.mark.parametrize("learning", [WindowedRule(), FINE])
def test_no_return_beams_become_separate_max_range_components(learning):
    parts = built([wall_scan(2), open_scan(2)], learning).components()
    support = float(parts.support[parts.max_range].sum())
    assert support == pytest.approx(len(open_scan(2).no_return), rel=1e-6)
    assert 0 < int(parts.max_range.sum()) < len(parts)
    assert not bool(built([wall_scan(2)], learning).components().max_range.any())


def test_random_state_determines_the_kept_origins():
    rule = WindowedRule(max_origins=1, window=6)
    first, again, other = (built(drive(6), rule, random_state=seed) for seed in (0, 0, 1))
    assert torch.equal(first.seen_from, again.seen_from)
    assert not torch.equal(first.seen_from, other.seen_from)


@dims
def test_queries_use_quantized_components_and_learning_uses_exact_ones(dim):
    rounded, exact = (built(drive(4, dim), window=2, codec=codec) for codec in ("quantized", "float"))
    assert torch.equal(rounded.means, exact.means)
    assert_same_components(rounded.components(), quantized(exact.components()))
    theta = [made.occupancy(lattice(dim)) for made in (rounded, exact)]
    assert not torch.equal(*theta)
    assert float((theta[0] - theta[1]).abs().mean()) < 0.02


# -- settings --------------------------------------------------------------------------------------------


INVALID = {
    "window": [0, 1.5, "2"],
    "n_samples": [0],
    "sampling": ["halton"],
    "resolution": [0.0, math.nan],
    "prior": [-1.0, math.nan],
    "random_state": [2**70, None],
    "robot": [-1, "r2"],
    "method": ["magic"],
    "codec": ["zip"],
    "cutoff": [0.0],
}


@pytest.mark.parametrize(("name", "value"), each_value(INVALID))
def test_invalid_settings_are_refused_at_construction(name, value):
    with pytest.raises(InvalidArgumentError, match=name):
        GaussianMap(**{name: value})


def test_the_window_argument_sets_that_of_the_rule():
    assert GaussianMap(window=3).learning == IncrementalRule(window=3)
    assert GaussianMap(WindowedRule(noise=0.02), window=3).learning == WindowedRule(noise=0.02, window=3)


# -- insert ----------------------------------------------------------------------------------------------


def test_overwriting_inserted_arrays_does_not_change_the_map():
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
def test_an_unusable_scan_is_refused_and_later_scans_are_learned(learning):
    scans = drive(3)
    made = built(scans[:1], learning, codec="quantized")
    before = made.occupancy(lattice(2))
    for _ in range(2):  # 10⁹ m away: beyond the codec
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
def test_module_dtype_and_device_changes_keep_components_and_pending_scans_exact(change):
    made = built(drive(3), FINE)
    assert sorted(made.state_dict()) == ["_extra_state", *BUFFERS]
    assert {"means", "covariances", "support", "origins"} < {*BUFFERS}
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


# -- state_dict: a restored map continues exactly as the map that was saved -----------------------------


RULES = {
    "windowed": WindowedRule(window=3, max_origins=1),  # draws the kept origins at random
    "incremental": IncrementalRule(window=3, n_components=40, novelty=NoveltyRule()),
    "fitted": IncrementalRule(window=4),  # fits its lengths to the first window
}
SCANS = load("synthetic_building_2d", n_scans=11)


def map_of(rule: str, n: int) -> GaussianMap:
    made = GaussianMap(RULES[rule], random_state=3)
    for scan in SCANS[:n]:
        made.insert(scan)
    return made


@cache
def whole_map(rule: str) -> GaussianMap:
    return map_of(rule, len(SCANS))


@pytest.mark.parametrize(
    ("rule", "n"), [("windowed", 0), ("windowed", 4), ("incremental", 5), ("fitted", 2), ("fitted", 9)]
)
def test_a_restored_map_continues_bit_by_bit(rule, n, tmp_path):
    first = map_of(rule, n)
    torch.save(first.state_dict(), tmp_path / "state.pt")
    again = map_of(rule, 1)  # the state replaces its pending scan
    again.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    assert again.n_pending == first.n_pending == n % {"fitted": 4}.get(rule, 3)
    assert (again.dim, again.learning) == (first.dim, first.learning)
    for scan in SCANS[n:]:
        again.insert(scan)
    assert_same_components(whole_map(rule).components(), again.components())


def test_buffers_without_the_extra_state_restore_final_components():
    first, other = map_of("windowed", 6), map_of("windowed", 1)
    other.load_state_dict({k: v for k, v in first.state_dict().items() if isinstance(v, Tensor)})
    assert torch.equal(other.components().means, first.components().means)
    assert other.n_pending == 0
    other.insert(SCANS[0])
    ids = other.components().ids
    assert len(torch.unique(ids, dim=0)) == len(ids) > first.n_components


def test_a_map_is_restored_as_part_of_a_network():
    first, other = (torch.nn.Sequential(map_of("windowed", n), torch.nn.Linear(2, 2)) for n in (5, 0))
    other.load_state_dict(first.state_dict())
    assert torch.equal(other[0].components().means, first[0].components().means)


def test_a_damaged_state_is_refused_and_changes_nothing():
    made = map_of("windowed", 4)
    before, state = made.components(), made.state_dict()
    for bad in (7.5, [3], {"points": torch.zeros(2)}, "x", None):
        for part in ("learning", "means", "pending", "n_windows", "n_numbered"):
            extra = {**state["_extra_state"], **({} if part == "means" else {part: bad})}
            damaged = {**state, "_extra_state": extra, **({"means": bad} if part == "means" else {})}
            with pytest.raises(DataError, match="damaged"):
                made.load_state_dict(damaged)
            assert made.n_pending == 1
            assert torch.equal(made.components().means, before.means)
    with pytest.raises(RuntimeError, match="seen_by"):
        made.load_state_dict({name: value for name, value in state.items() if name != "seen_by"})
    assert made.n_pending == 1


# -- the contract of occupancy maps -----------------------------------------------------------------------


class MapContract(OccupancyMapContract):
    shift_tolerance = 1e-3
    turn_tolerance = 0.05


class TestGaussianMapWindowed(MapContract):
    """With pending and with closed windows, and one origin for each component, as in the thesis."""

    def make(self) -> GaussianMap:
        return GaussianMap(WindowedRule(window=2, max_origins=1), resolution=RESOLUTION, n_samples=20_000)


class TestGaussianMapIncremental(MapContract):
    """The default map."""

    def make(self) -> GaussianMap:
        return GaussianMap(resolution=RESOLUTION, n_samples=20_000)


class TestGaussianMapUnderABudget(MapContract):
    def make(self) -> GaussianMap:
        return GaussianMap(IncrementalRule(window=2, max_bytes=1000), resolution=RESOLUTION)
