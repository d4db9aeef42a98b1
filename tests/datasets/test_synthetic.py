"""The embedded data sets: deterministic, as announced, and honest about beams that saw nothing."""

from __future__ import annotations

import time

import pytest
import torch

from gmmtorch.datasets import load
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.scan import Scan

SETS = [
    ("synthetic_building_2d", {}),
    ("synthetic_building", {}),
    ("synthetic_building", {"sensor": "depth_camera"}),
]
IDS = ["2d", "lidar", "depth_camera"]
SENSOR_RANGE = {"synthetic_building_2d": 12.0, "synthetic_building": 10.0}

each_set = pytest.mark.parametrize(("name", "options"), SETS, ids=IDS)


def same(a: Scan, b: Scan) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a.ends(), b.ends(), strict=True)) and torch.equal(
        a.origin, b.origin
    )


def reach(ends: torch.Tensor, scan: Scan) -> torch.Tensor:
    return (ends - scan.origin).norm(dim=1)


@pytest.mark.parametrize(
    ("name", "n_scans", "n_beams", "limit"),
    [("synthetic_building_2d", 120, 180, 2.0), ("synthetic_building", 40, 5120, 8.0)],
)
def test_size_and_speed(name, n_scans, n_beams, limit):
    begin = time.process_time()
    scans = list(load(name))
    seconds = time.process_time() - begin
    assert len(scans) == n_scans
    assert all(scan.n_beams == n_beams for scan in scans)
    assert all(scan.points.dtype == torch.float64 for scan in scans)
    empty = sum(len(scan.no_return) for scan in scans) / (n_scans * n_beams)
    assert 0.01 < empty < 0.2
    assert seconds < limit


@each_set
def test_a_scan_does_not_depend_on_what_was_read_before(name, options):
    forwards = load(name, n_scans=6, **options)
    backwards = load(name, n_scans=6, **options)
    late = {i: backwards[i] for i in (5, 0, 3)}
    assert all(same(forwards[i], scan) for i, scan in late.items())
    assert same(forwards[3], forwards[3])


@each_set
def test_random_numbers_elsewhere_neither_matter_nor_are_touched(name, options):
    before = torch.get_rng_state()
    first = load(name, n_scans=2, **options)[1]
    assert torch.equal(before, torch.get_rng_state())
    torch.rand(7)
    assert same(first, load(name, n_scans=2, **options)[1])


@each_set
def test_another_seed_is_another_building(name, options):
    first, second = (load(name, n_scans=2, seed=seed, **options) for seed in (0, 1))
    assert not same(first[0], second[0])
    assert torch.equal(first[0].origin, second[0].origin)


@each_set
def test_stride_reads_every_nth(name, options):
    every, third = load(name, n_scans=7, **options), load(name, n_scans=7, stride=3, **options)
    assert len(third) == 3
    assert same(every[6], third[2])


@each_set
def test_empty_beams_free_no_return_range_and_never_become_points(name, options):
    sensor_range = SENSOR_RANGE[name]
    for wanted, freed in ((None, 8.0), (5.0, 5.0), (100.0, sensor_range)):
        scans = list(load(name, n_scans=5, no_return_range=wanted, **options))
        assert all(bool((reach(s.points, s) < sensor_range).all()) for s in scans)
        lengths = torch.cat([reach(s.no_return, s) for s in scans])
        assert len(lengths) > 0
        torch.testing.assert_close(lengths, torch.full_like(lengths, freed))
    dropped = load(name, n_scans=5, no_return_range=0, **options)
    assert all(len(scan.no_return) == 0 for scan in dropped)


@each_set
def test_a_shorter_limit_turns_far_points_into_empty_beams(name, options):
    full, short = load(name, n_scans=5, **options), load(name, n_scans=5, max_range=3.0, **options)
    for a, b in zip(full, short, strict=True):
        assert a.n_beams == b.n_beams
        assert torch.equal(b.points, a.points[reach(a.points, a) < 3.0])
        assert bool((reach(b.no_return, b) <= 3.0 + 1e-9).all())


@each_set
def test_a_longer_limit_does_not_let_the_sensor_see_further(name, options):
    full, longer = load(name, n_scans=5, **options), load(name, n_scans=5, max_range=99.0, **options)
    assert all(same(a, b) for a, b in zip(full, longer, strict=True))


@each_set
def test_noise_is_one_centimetre(name, options):
    dataset = load(name, n_scans=4, no_return_range=0, **options)
    errors = []
    for scan, pose in zip(dataset, dataset.poses, strict=True):
        directions = torch.nn.functional.normalize(scan.points - scan.origin, dim=1)
        errors.append(reach(scan.points, scan) - dataset.world.distances(pose[:-1, -1], directions))
    error = torch.cat(errors)
    error = error[error.abs() < 0.1]  # at an edge, rounding may decide between near and far
    assert float(error.std()) == pytest.approx(0.01, rel=0.1)
    assert abs(float(error.mean())) < 0.002


@each_set
def test_empty_beams_cross_no_surface(name, options):
    dataset = load(name, n_scans=5, no_return_range=100.0, **options)
    for scan in dataset:
        if len(scan.no_return):
            directions = torch.nn.functional.normalize(scan.no_return - scan.origin, dim=1)
            clear = dataset.world.distances(scan.origin, directions) > SENSOR_RANGE[name] - 0.1
            assert bool(clear.all())


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"seed": -1}, "seed=-1"),
        ({"n_scans": 0}, "n_scans=0"),
        ({"sensor": "sonar"}, "sensor='sonar'.*lidar or depth_camera"),
        ({"stride": 0}, "stride=0"),
        ({"max_range": -1.0}, r"max_range=-1\.0"),
    ],
)
def test_refuses_what_does_not_fit_and_names_it(options, named):
    with pytest.raises(InvalidArgumentError, match=named):
        load("synthetic_building", **options)
