"""GaussianMap: windows, origins, motions, evidence and files. What every map does: see test_protocol."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from occupancy.protocol_contract import (
    RESOLUTION,
    lattice,
    move,
    open_scan,
    points,
    quarter_turn,
    shifted,
    wall_scan,
)
from scipy.stats import multivariate_normal
from torch import Tensor

from gmmtorch.baselines.occupancy_grid import OccupancyGrid
from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError, MemoryLimitError
from gmmtorch.files import pack_tensors, read_tensors
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mapping.learning import LearningRule
from gmmtorch.occupancy.grid import VoxelGrid
from gmmtorch.scan import Scan

BUFFERS = [
    "means",
    "covariances",
    "support",
    "max_range",
    "ids",
    "origins",
    "seen_by",
    "seen_from",
    "seen_count",
]
POSITION_STEP = 2.0**-16


def sensor(x: float, dim: int = 2) -> tuple[float, ...]:
    return (x + 2**-9, 0.1875 + 2**-9, 0.3125 + 2**-9)[:dim]


def drive(n: int, dim: int = 2) -> list[Scan]:
    """Scans of the wall from n places on the way to it."""
    return [wall_scan(dim, seed, sensor(0.25 * seed, dim)) for seed in range(n)]


def make(window: int = 20, **options: Any) -> GaussianMap:
    options = {"resolution": RESOLUTION, "n_samples": 20_000, **options}
    return GaussianMap(options.pop("learning", None) or LearningRule(), window=window, **options)


def built(scans: list[Scan], window: int = 20, **options: Any) -> GaussianMap:
    made = make(window, **options)
    for scan in scans:
        made.insert(scan)
    return made


def given_parts(dim: int = 2, k: int = 4, seed: int = 0) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    root = 0.2 * torch.randn(k, dim, dim, generator=generator, dtype=torch.float64)
    return {
        "means": 1.5 * torch.randn(k, dim, generator=generator, dtype=torch.float64),
        "covariances": root @ root.mT + 0.01 * torch.eye(dim).double(),
        "support": torch.arange(1.0, k + 1, dtype=torch.float64) * 10,
        "origins": torch.randn(k, dim, generator=generator, dtype=torch.float64),
    }


def sightings(made: Components) -> list[dict[tuple[float, ...], float]]:
    """For each component: origin → count."""
    table: list[dict[tuple[float, ...], float]] = [{} for _ in range(len(made))]
    for k, s, count in zip(
        made.seen_by.tolist(), made.seen_from.tolist(), made.seen_count.tolist(), strict=True
    ):
        place = tuple(made.origins[s].tolist())
        assert place not in table[k]
        table[k][place] = count
    return table


# -- learning ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
def test_components_describe_the_points(dim):
    scan = wall_scan(dim)
    parts = built([scan]).components()
    cloud = scan.points.numpy()
    support = parts.support.numpy()
    mean = np.average(parts.means.numpy(), axis=0, weights=support)
    np.testing.assert_allclose(support.sum(), len(cloud), rtol=1e-3)
    np.testing.assert_allclose(mean, cloud.mean(0), atol=2e-3)
    offset = parts.means.numpy() - mean
    spread = np.einsum("k,ki,kj->ij", support, offset, offset) + np.einsum(
        "k,kij->ij", support, parts.covariances.numpy()
    )
    expected = np.cov(cloud.T, ddof=0) + 0.01**2 * np.eye(dim)
    np.testing.assert_allclose(spread / support.sum(), expected, rtol=1e-2, atol=1e-4)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("window", [1, 3, 20])
def test_counts_of_sightings_add_up_to_the_support(dim, window):
    parts = built(drive(5, dim), window).components()
    total = np.bincount(parts.seen_by.numpy(), weights=parts.seen_count.numpy(), minlength=len(parts))
    np.testing.assert_allclose(total, parts.support.numpy(), rtol=1e-6)
    np.testing.assert_allclose(float(parts.support.sum()), 5 * len(wall_scan(dim).points), rtol=1e-3)
    assert float(parts.seen_count.min()) > 0


@pytest.mark.parametrize("max_origins", [1, 2, 8])
def test_components_keep_a_few_origins_and_real_ones(max_origins):
    scans = drive(6)
    parts = built(scans, 6, learning=LearningRule(max_origins=max_origins)).components()
    real = {tuple(scan.origin.tolist()) for scan in scans}
    table = sightings(parts)
    assert max(len(seen) for seen in table) == min(max_origins, 6)
    assert min(len(seen) for seen in table) >= 1
    assert {place for seen in table for place in seen} <= real


def test_with_room_for_every_origin_the_counts_are_those_of_the_points():
    near, far = (wall_scan(2, 0, sensor(x)) for x in (0.0, 1.0))
    half = Scan(far.points[::2], far.origin)
    parts = built([near, half], 2, learning=LearningRule(max_origins=2)).components()
    for seen in sightings(parts):
        counts = [seen[tuple(s.origin.tolist())] for s in (near, half)]
        assert counts[0] / counts[1] == pytest.approx(2, rel=0.15)


def test_the_thesis_map_has_one_origin_a_component_that_of_its_scan():
    scans = drive(3)
    made = built(scans, 1, learning=LearningRule(max_origins=1))
    one_by_one = [built([scan], 1, learning=LearningRule(max_origins=1)) for scan in scans]
    assert made.means.shape[0] == sum(m.means.shape[0] for m in one_by_one)
    assert all(len(seen) == 1 for seen in sightings(made.components()))
    assert torch.equal(made.means, torch.cat([m.means for m in one_by_one]))


def test_a_window_is_closed_when_it_is_full():
    scans = drive(7)
    made = make(3)
    sizes = []
    for scan in scans:
        made.insert(scan)
        sizes.append(made.means.shape[0])
    assert sizes[:2] == [0, 0]
    assert 0 < sizes[2] == sizes[3] == sizes[4] < sizes[5] == sizes[6]
    assert made.n_components > sizes[6]  # the unfinished window counts at once


def test_each_window_is_learned_alone():
    scans = drive(6)
    both = built(scans, 3)
    first, second = built(scans[:3], 3), built(scans[3:], 3)
    assert torch.equal(both.means, torch.cat([first.means, second.means]))
    torch.testing.assert_close(both.covariances, torch.cat([first.covariances, second.covariances]))
    assert sightings(both.components()) == sightings(first.components()) + sightings(second.components())


def test_ids_name_the_robot_and_count_on():
    made = built(drive(5), 2, robot=3)
    ids = made.components().ids
    assert ids[:, 0].unique().tolist() == [3]
    assert ids[:, 1].tolist() == list(range(len(ids)))


def test_beams_without_return_become_flagged_components_of_their_own():
    made = built([wall_scan(2), open_scan(2)])
    parts = made.components()
    support = float(parts.support[parts.max_range].sum())
    assert support == pytest.approx(len(open_scan(2).no_return), rel=1e-3)
    assert 0 < int(parts.max_range.sum()) < len(parts)
    assert not bool(built([wall_scan(2)]).components().max_range.any())


def test_a_bound_on_the_components_of_a_window_is_kept():
    made = built(drive(4), 2, learning=LearningRule(n_components=5, length=0.05))
    assert made.n_components <= 10
    assert built(drive(4), 2, learning=LearningRule(length=0.05)).n_components > 20


def test_the_seed_decides_which_origins_are_kept():
    options = {"learning": LearningRule(max_origins=1)}
    first, again, other = (built(drive(6), 6, random_state=seed, **options) for seed in (0, 0, 1))
    assert torch.equal(first.seen_from, again.seen_from)
    assert not torch.equal(first.seen_from, other.seen_from)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("window", 0),
        ("n_samples", 0),
        ("sampling", "halton"),
        ("resolution", 0.0),
        ("resolution", math.nan),
        ("prior", -1.0),
        ("prior", math.nan),
        ("random_state", 2**70),
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
        LearningRule(**{name: value})


@pytest.mark.parametrize("name", ["noise", "length", "min_points"])
def test_learning_rules_that_are_no_numbers_are_named(name):
    with pytest.raises(InvalidArgumentError, match=name):
        LearningRule(**{name: math.nan})


# -- given components ------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
def test_given_components_are_kept_with_one_origin_each(dim):
    parts = given_parts(dim)
    made = GaussianMap.from_components(**parts, max_range=[True, False, False, True], robot=7)
    for name in ("means", "covariances", "support"):
        torch.testing.assert_close(getattr(made, name), parts[name], rtol=1e-6, atol=POSITION_STEP)
    assert made.max_range.tolist() == [True, False, False, True]
    assert made.ids.tolist() == [[7, i] for i in range(4)]
    for seen, origin, count in zip(
        sightings(made.components()), parts["origins"], parts["support"], strict=True
    ):
        ((place, n),) = seen.items()
        assert place == pytest.approx(origin.tolist(), abs=POSITION_STEP)
        assert n == float(count)


def test_given_components_may_be_arrays_and_lists():
    parts = given_parts()
    first = GaussianMap.from_components(**parts, n_samples=1000)
    for convert in (lambda t: t.numpy(), lambda t: t.tolist()):
        other = GaussianMap.from_components(**{k: convert(v) for k, v in parts.items()}, n_samples=1000)
        assert torch.equal(first.occupancy(lattice(2)), other.occupancy(lattice(2)))


def test_several_origins_share_the_support_in_proportion():
    parts = given_parts(k=2)
    a, b, c = ([0.0, 0.0], [1.0, 0.0], [0.0, 2.0])
    made = GaussianMap.from_components(
        parts["means"], parts["covariances"], parts["support"], [[(a, 1.0), (b, 3.0)], [(c, 5.0)]]
    )
    assert sightings(made.components()) == [{(0.0, 0.0): 2.5, (1.0, 0.0): 7.5}, {(0.0, 2.0): 20.0}]


def test_given_components_hit_where_their_density_is():
    mean, covariance = np.array([2.0, 0.4]), np.array([[0.02, 0.01], [0.01, 0.05]])
    made = GaussianMap.from_components([mean], [covariance], [100.0], [[0.1, 0.1]], n_samples=1 << 17)
    grid = VoxelGrid((1.5, -0.5), 0.25, (5, 8))
    low = grid.centers().numpy() - 0.125
    normal = multivariate_normal(mean, covariance)
    expected = [100 * normal.cdf(a + 0.25, lower_limit=a) for a in low]
    np.testing.assert_allclose(made.evidence(grid, "monte_carlo").hits.flatten().numpy(), expected, atol=0.05)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("means", torch.zeros(4)),
        ("means", torch.zeros(4, 2, 1)),
        ("means", torch.full((4, 2), math.nan)),
        ("covariances", torch.zeros(3, 2, 2)),
        ("covariances", torch.full((4, 2, 2), math.inf)),
        ("covariances", -torch.eye(2).repeat(4, 1, 1)),
        ("covariances", torch.tensor([[1.0, 0.9], [-0.9, 1.0]]).repeat(4, 1, 1)),
        ("support", torch.ones(3)),
        ("support", -torch.ones(4)),
        ("support", torch.full((4,), math.nan)),
        ("origins", torch.zeros(3, 2)),
        ("origins", torch.zeros(4, 3)),
        ("origins", torch.full((4, 2), math.nan)),
        ("origins", [[([0.0, 0.0], 1.0)]] * 3),
        ("origins", [[([0.0, 0.0], 1.0)]] * 5),
        ("origins", [[([0.0, 0.0], 0.0)]] * 4),
        ("origins", [[([0.0, 0.0], 2.0), ([1.0, 0.0], -1.0)]] * 4),
        ("origins", [[]] * 4),
        ("max_range", [True]),
    ],
)
def test_given_components_that_do_not_fit_are_refused(name, value):
    with pytest.raises(GmmTorchError):
        GaussianMap.from_components(**{**given_parts(), name: value})


def test_no_given_components_are_an_empty_map():
    made = GaussianMap.from_components(
        torch.zeros(0, 2), torch.zeros(0, 2, 2), torch.zeros(0), torch.zeros(0, 2)
    )
    assert made.occupancy(lattice(2)).unique().tolist() == [0.5]


@pytest.mark.parametrize("sampling", ["sobol", "stratified", "plain"])
def test_components_that_stand_for_no_points_say_nothing(sampling):
    made = GaussianMap.from_components(
        torch.zeros(1, 2), torch.eye(2)[None], torch.zeros(1), torch.ones(1, 2), sampling=sampling
    )
    assert made.occupancy(lattice(2)).unique().tolist() == [0.5]


@pytest.mark.parametrize("dim", [2, 3])
def test_given_components_answer_the_same_once_saved(dim, tmp_path):
    made = GaussianMap.from_components(**given_parts(dim), n_samples=5000)
    made.save(tmp_path / "m.safetensors")
    loaded = GaussianMap.load(tmp_path / "m.safetensors")
    for name in ("means", "covariances", "support", "origins", "seen_count"):
        assert torch.equal(getattr(loaded, name), getattr(made, name)), name
    assert torch.equal(loaded.occupancy(lattice(dim)), made.occupancy(lattice(dim)))
    assert made.nbytes == (tmp_path / "m.safetensors").stat().st_size


# -- motions -----------------------------------------------------------------------------------------------


def moved_parts(parts: dict[str, Tensor], matrix: Tensor) -> dict[str, Tensor]:
    rotation = matrix[:-1, :-1]
    return {
        "means": move(matrix, parts["means"]),
        "covariances": rotation @ parts["covariances"] @ rotation.T,
        "support": parts["support"],
        "origins": move(matrix, parts["origins"]),
    }


def some_motion(dim: int) -> Tensor:
    generator = torch.Generator().manual_seed(3)
    rotation = torch.linalg.qr(torch.randn(dim, dim, generator=generator, dtype=torch.float64))[0]
    rotation[:, 0] *= torch.linalg.det(rotation).sign()
    matrix = torch.eye(dim + 1, dtype=torch.float64)
    matrix[:dim, :dim], matrix[:dim, dim] = rotation, torch.tensor([1.5, -0.7, 0.2])[:dim]
    return matrix


def assert_same_map(one: GaussianMap, other: GaussianMap) -> None:
    for name in ("means", "covariances", "support"):
        torch.testing.assert_close(
            getattr(one, name), getattr(other, name), rtol=1e-6, atol=2 * POSITION_STEP
        )
    assert torch.equal(one.max_range, other.max_range)
    for seen, expected in zip(sightings(one.components()), sightings(other.components()), strict=True):
        assert sorted(seen.values()) == pytest.approx(sorted(expected.values()))
        ours, theirs = (torch.tensor(sorted(s)) for s in (seen, expected))
        torch.testing.assert_close(ours, theirs, rtol=0, atol=2 * POSITION_STEP)


@pytest.mark.parametrize("dim", [2, 3])
def test_moving_a_map_is_moving_its_components_and_their_origins(dim):
    parts, matrix = given_parts(dim), some_motion(dim)
    made = GaussianMap.from_components(**parts, n_samples=100_000)
    made.transform(matrix)
    expected = GaussianMap.from_components(**moved_parts(parts, matrix), n_samples=100_000)
    assert_same_map(made, expected)
    assert (
        float((made.occupancy(lattice(dim), 0.25) - expected.occupancy(lattice(dim), 0.25)).abs().mean())
        < 5e-3
    )


@pytest.mark.parametrize("dim", [2, 3])
def test_moving_some_components_leaves_the_others(dim):
    parts, matrix = given_parts(dim), some_motion(dim)
    chosen = torch.tensor([False, True, False, True])
    made = GaussianMap.from_components(**parts)
    made.transform(matrix, ids=made.ids[chosen])
    both = {
        name: torch.where(
            chosen.reshape(-1, *[1] * (value.ndim - 1)), moved_parts(parts, matrix)[name], value
        )
        for name, value in parts.items()
    }
    assert_same_map(made, GaussianMap.from_components(**both))


def test_an_origin_that_moved_and_unmoved_components_share_becomes_two():
    parts = given_parts(k=2)
    shared = torch.zeros(2, 2, dtype=torch.float64)
    made = GaussianMap.from_components(parts["means"], parts["covariances"], parts["support"], shared)
    made.transform(shifted(2, (1.0, 2.0)), ids=[[0, 1]])
    assert [list(seen) for seen in sightings(made.components())] == [[(0.0, 0.0)], [(1.0, 2.0)]]


@pytest.mark.parametrize("ids", [[], [[5, 0]], [[0, 99]]])
def test_ids_that_name_nothing_move_nothing(ids):
    made = GaussianMap.from_components(**given_parts())
    before = made.means.clone()
    made.transform(quarter_turn(2), ids=ids)
    torch.testing.assert_close(made.means, before, rtol=0, atol=POSITION_STEP)


def test_moving_a_map_back_restores_it():
    made = built(drive(3), 2)
    before = made.occupancy(lattice(2))
    made.transform(quarter_turn(2))
    assert not torch.equal(made.occupancy(lattice(2)), before)
    made.transform(torch.linalg.inv(quarter_turn(2)))
    assert torch.equal(made.occupancy(lattice(2)), before)


def test_a_moved_map_answers_the_same_once_saved(tmp_path):
    made = built(drive(3, 3), 2)
    made.transform(some_motion(3))
    made.save(tmp_path / "m.safetensors")
    assert torch.equal(
        GaussianMap.load(tmp_path / "m.safetensors").occupancy(lattice(3)), made.occupancy(lattice(3))
    )


def test_a_motion_far_away_keeps_millimetres():
    parts, matrix = given_parts(), shifted(2, (500_000.0, 4_000_000.0))
    made = GaussianMap.from_components(**parts)
    made.transform(matrix)
    torch.testing.assert_close(made.means, move(matrix, parts["means"]), rtol=0, atol=1e-3)


def test_moving_closes_the_unfinished_window_and_learning_goes_on():
    made = built(drive(3), 20)
    n = made.n_components
    made.transform(shifted(2, (0.0, 1.0)))
    assert made.means.shape[0] == n
    made.insert(wall_scan(2))
    parts = made.components()
    assert len(parts) > n
    assert len({tuple(i) for i in parts.ids.tolist()}) == len(parts)


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
def test_what_is_no_rigid_motion_is_refused_and_moves_nothing(matrix):
    made = GaussianMap.from_components(**given_parts())
    before = made.means.clone()
    with pytest.raises(InvalidArgumentError, match="transform"):
        made.transform(matrix)
    assert torch.equal(made.means, before)


# -- answers -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
def test_evidence_on_a_grid_is_what_its_centres_are_told(dim):
    made = built(drive(2, dim))
    grid = VoxelGrid.covering([-1.0] * dim, [3.5] * dim, 0.25)
    theta = made.evidence(grid).probability()
    torch.testing.assert_close(made.occupancy(grid.centers(), 0.25), theta.flatten(), rtol=1e-9, atol=1e-9)
    assert len(theta.unique()) > 10


def test_the_prior_is_the_maps_own():
    weak, strong = (built([wall_scan(2)], prior=prior) for prior in (0.1, 10.0))
    query = points([3.0625], 2)
    assert 0.5 < float(strong.occupancy(query)) < float(weak.occupancy(query))


def test_without_a_resolution_it_is_the_maps_own():
    made = built([wall_scan(2)], resolution=0.25)
    assert torch.equal(made.occupancy(lattice(2)), made.occupancy(lattice(2), 0.25))
    assert not torch.equal(made.occupancy(lattice(2)), made.occupancy(lattice(2), 0.125))


def test_more_samples_are_less_noise_and_no_other_answer():
    few, many = (built(drive(2), n_samples=n) for n in (3_000, 100_000))
    assert float((few.occupancy(lattice(2)) - many.occupancy(lattice(2))).abs().mean()) < 0.01


@pytest.mark.parametrize("resolution", [0, -1.0, math.nan, math.inf])
def test_a_resolution_that_is_none_is_refused(resolution):
    with pytest.raises(InvalidArgumentError, match="resolution"):
        built([wall_scan(2)]).occupancy(lattice(2), resolution)


def test_an_unknown_method_is_refused_by_name():
    made = built([wall_scan(2)])
    with pytest.raises(InvalidArgumentError, match="method='magic'"):
        made.occupancy(lattice(2), method="magic")
    with pytest.raises(InvalidArgumentError, match="method='magic'"):
        made.evidence(VoxelGrid((0, 0), 1.0, (2, 2)), method="magic")


def test_a_grid_of_another_dimension_is_refused():
    with pytest.raises(InvalidArgumentError, match="dimensional"):
        built([wall_scan(2)]).evidence(VoxelGrid((0, 0, 0), 1.0, (2, 2, 2)))


def test_an_empty_map_has_no_evidence_nor_components():
    made = make()
    assert made.evidence(VoxelGrid((0, 0), 1.0, (2, 2))).probability().unique().tolist() == [0.5]
    assert (made.n_components, made.dim, made.nbytes) == (0, None, 0)
    with pytest.raises(InvalidArgumentError, match="empty"):
        made.transform(torch.eye(3))


def test_evidence_beyond_the_memory_limit_is_refused():
    with pytest.raises(MemoryLimitError, match="resolution"):
        built([wall_scan(2)], memory_limit=1 << 16).occupancy(lattice(2), 0.005, "monte_carlo")


def test_a_map_is_a_module_whose_buffers_are_its_components():
    made = built(drive(2), 2)
    assert sorted(made.state_dict()) == sorted(BUFFERS)
    before = made.occupancy(lattice(2))
    assert made.to("cpu") is made
    assert torch.equal(made.occupancy(lattice(2)), before)


# -- files -------------------------------------------------------------------------------------------------


def test_settings_and_components_come_back(tmp_path):
    rule = LearningRule(noise=0.02, max_origins=3)
    made = built(drive(5), 2, learning=rule, prior=0.5, random_state=4, robot=2, sampling="stratified")
    made.save(tmp_path / "m.safetensors")
    loaded = GaussianMap.load(tmp_path / "m.safetensors")
    assert loaded.learning == rule
    for name in ("window", "resolution", "method", "answering", "random_state", "robot"):
        assert getattr(loaded, name) == getattr(made, name)
    for name in ("means", "covariances", "support", "max_range", "ids"):
        assert torch.equal(getattr(loaded, name), getattr(made.components(), name))
    assert sightings(loaded.components()) == sightings(made.components())


def test_ids_stay_unique_when_a_loaded_map_goes_on(tmp_path):
    built(drive(3), 2).save(tmp_path / "m.safetensors")
    loaded = GaussianMap.load(tmp_path / "m.safetensors")
    loaded.insert(wall_scan(2))
    ids = loaded.components().ids
    assert len({tuple(i) for i in ids.tolist()}) == len(ids)


def test_more_than_255_origins_and_sightings_are_stored(tmp_path):
    k, n = 2, 300
    parts = given_parts(k=k)
    seen = [[([0.01 * i, float(j)], 1.0 + i) for i in range(n)] for j in range(k)]
    made = GaussianMap.from_components(
        parts["means"], parts["covariances"], parts["support"], seen, n_samples=5000
    )
    made.save(tmp_path / "m.safetensors")
    loaded = GaussianMap.load(tmp_path / "m.safetensors")
    assert loaded.seen_count.shape == (k * n,)
    np.testing.assert_allclose(loaded.origins.numpy(), made.origins.numpy(), atol=POSITION_STEP)
    assert torch.equal(loaded.seen_from, made.components().seen_from)


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> tuple[dict[str, Tensor], dict[str, Any]]:
    path = tmp_path_factory.mktemp("sound") / "m.safetensors"
    built(drive(3), 2, n_samples=500).save(path)
    return read_tensors(path, "gmmtorch.map", 1)


def load_parts(folder: Path, tensors: dict[str, Tensor], facts: dict[str, Any]) -> GaussianMap:
    path = folder / "m.safetensors"
    path.write_bytes(pack_tensors(tensors, "gmmtorch.map", 1, **facts))
    return GaussianMap.load(path)


def test_the_parts_that_the_hostile_files_start_from_are_sound(tmp_path, sound):
    assert load_parts(tmp_path, *sound).n_components > 0


DAMAGE = {
    "means, one dimension": lambda t: {"means": t["means"].flatten()},
    "means, four dimensions": lambda t: {"means": t["means"].repeat(1, 2)},
    "means, NaN": lambda t: {"means": t["means"] * math.nan},
    "means, doubles": lambda t: {"means": t["means"].double()},
    "covariances, indefinite": lambda t: {"covariances": -t["covariances"]},
    "covariances, infinite": lambda t: {"covariances": t["covariances"] * math.inf},
    "covariances, fewer": lambda t: {"covariances": t["covariances"][1:]},
    "support, negative": lambda t: {"support": -t["support"]},
    "support, fewer": lambda t: {"support": t["support"][1:]},
    "max_range, floats": lambda t: {"max_range": t["max_range"].float()},
    "id_runs, wrong shape": lambda t: {"id_runs": t["id_runs"][:, :2]},
    "id_runs, too many": lambda t: {"id_runs": t["id_runs"].repeat(2, 1)},
    "id_runs, negative": lambda t: {"id_runs": -t["id_runs"]},
    "id_runs, huge": lambda t: {"id_runs": t["id_runs"] + torch.tensor([0, 0, 2**62])},
    "frame, NaN": lambda t: {"frame": t["frame"] * math.nan},
    "frame, other dimension": lambda t: {"frame": torch.zeros(3, dtype=torch.float64)},
    "origins, other dimension": lambda t: {"origins": torch.zeros(3, 3)},
    "sightings, too many": lambda t: {"sightings": t["sightings"] + 1},
    "sightings, negative": lambda t: {"sightings": -t["sightings"].int()},
    "seen_from, beyond the table": lambda t: {"seen_from": t["seen_from"] + 100},
    "seen_from, negative": lambda t: {"seen_from": -1 - t["seen_from"].int()},
    "seen_from, fewer": lambda t: {"seen_from": t["seen_from"][1:]},
    "seen_share, floats": lambda t: {"seen_share": t["seen_share"].float()},
    "seen_share, none of a component": lambda t: {"seen_share": t["seen_share"] * 0},
    "seen_share, fewer": lambda t: {"seen_share": t["seen_share"][1:]},
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE.keys())
def test_a_file_whose_numbers_are_no_map_is_refused(tmp_path, sound, damage):
    tensors, facts = sound
    with pytest.raises(DataError, match=r"m\.safetensors"):
        load_parts(tmp_path, {**tensors, **damage(tensors)}, facts)


@pytest.mark.parametrize(
    "name",
    [
        "frame",
        "means",
        "covariances",
        "support",
        "max_range",
        "id_runs",
        "origins",
        "sightings",
        "seen_from",
        "seen_share",
    ],
)
def test_a_file_that_lacks_a_tensor_is_refused(tmp_path, sound, name):
    tensors, facts = sound
    with pytest.raises(DataError, match=r"m\.safetensors"):
        load_parts(tmp_path, {k: v for k, v in tensors.items() if k != name}, facts)


@pytest.mark.parametrize(
    "change",
    [
        {"window": 0},
        {"window": "x"},
        {"window": None},
        {"n_samples": -5},
        {"sampling": "magic"},
        {"resolution": 0},
        {"prior": "x"},
        {"prior": -1},
        {"random_state": None},
        {"random_state": 2**80},
        {"unheard_of": 1},
        {"learning": None},
        {"learning": {"noise": -1}},
        {"learning": {"noise": "x"}},
        {"learning": {"unheard_of": 1}},
    ],
    ids=str,
)
def test_a_file_whose_settings_are_damaged_is_refused(tmp_path, sound, change):
    tensors, facts = sound
    with pytest.raises(DataError, match=r"m\.safetensors"):
        load_parts(tmp_path, tensors, {**facts, **change})


@settings(max_examples=60)
@given(
    name=st.sampled_from(["means", "covariances", "support", "origins", "frame"]),
    place=st.integers(0, 10**6),
    value=st.floats(width=32) | st.sampled_from([1e30, -1e30, 1e-40, 1e12]),
)
def test_any_number_in_a_file_is_refused_or_answered_with(tmp_path, sound, name, place, value):
    tensors, facts = sound
    changed = tensors[name].clone()
    changed.view(-1)[place % changed.numel()] = value
    try:
        made = load_parts(tmp_path, {**tensors, name: changed}, facts)
        made.memory_limit = 1 << 24
        theta = made.occupancy(lattice(2))
    except GmmTorchError:
        return
    assert 0 <= float(theta.min()) <= float(theta.max()) <= 1


def test_the_settings_of_the_file_are_all_there_is_to_set():
    made = make()
    made.insert(wall_scan(2))
    assert asdict(made.learning).keys() == set(LearningRule.__dataclass_fields__)


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


def test_a_transform_that_fails_leaves_the_map_as_it_was():
    built = GaussianMap(window=5)
    built.insert(Scan(np.random.default_rng(0).normal(3.0, size=(50, 2)), np.zeros(2)))
    before = built.n_components
    with pytest.raises(InvalidArgumentError, match=r"ids has shape"):
        built.transform(np.eye(3), ids=[[0, 1, 2]])
    assert built.n_components == before


def test_networks_of_another_dtype_leave_positions_exact():
    built = GaussianMap(window=1)
    built.insert(Scan(np.random.default_rng(0).normal(5e5, size=(50, 2)), np.full(2, 5e5)))
    before = built.means.clone()
    assert torch.equal(built.half().means, before)


@pytest.mark.parametrize(
    "options", [{"window": 1.5}, {"window": "2"}, {"n_samples": 0}, {"random_state": None}]
)
def test_options_that_are_no_whole_numbers_are_refused(options):
    with pytest.raises(InvalidArgumentError, match=next(iter(options))):
        GaussianMap(**options)


def test_what_is_no_scan_is_refused():
    with pytest.raises(InvalidArgumentError, match=r"Tensor.*Scan"):
        GaussianMap().insert(torch.zeros(3, 2))
