"""Simulated data sets, in buildings and meshes: reproducibility, sizes, noise, and beams without return."""

from __future__ import annotations

import functools
from pathlib import Path

import pytest
import torch

from gmmtorch.datasets import Ranges, load
from gmmtorch.errors import DataError, InvalidArgumentError, MissingDataError
from gmmtorch.scan import Scan

SETS = [
    ("synthetic_building_2d", {}),
    ("synthetic_building", {}),
    ("synthetic_building", {"sensor": "depth_camera"}),
]
SENSOR_RANGE = {"synthetic_building_2d": 12.0, "synthetic_building": 10.0}
N_SCANS = 3

each_set = pytest.mark.parametrize(("name", "options"), SETS, ids=["2d", "lidar", "depth_camera"])


@functools.cache
def scans_of(name: str, **options) -> list[Scan]:
    """The first scans of a data set, computed once for all tests."""
    return list(load(name, n_scans=N_SCANS, **options))


def same(a: Scan, b: Scan) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a.ends(), b.ends(), strict=True)) and torch.equal(
        a.origin, b.origin
    )


def length(ends: torch.Tensor, scan: Scan) -> torch.Tensor:
    return (ends - scan.origin).norm(dim=1)


@pytest.mark.parametrize(
    ("name", "n_scans", "n_beams"), [("synthetic_building_2d", 120, 180), ("synthetic_building", 40, 5120)]
)
def test_synthetic_data_sets_have_the_documented_size(name, n_scans, n_beams):
    dataset = load(name)
    assert (len(dataset), dataset.times) == (n_scans, None)
    assert torch.equal(dataset.pose(1)[:-1, -1], dataset[1].origin)
    scans = dataset[:: n_scans // 8]
    assert all(scan.n_beams == n_beams for scan in scans)
    assert all(scan.points.dtype == torch.float64 for scan in scans)
    no_return = sum(len(scan.no_return) for scan in scans) / (len(scans) * n_beams)
    assert 0.01 < no_return < 0.2


@each_set
def test_a_synthetic_scan_depends_only_on_its_seed_and_index(name, options):
    expected, state = scans_of(name, **options), torch.get_rng_state()
    dataset = load(name, n_scans=N_SCANS, **options)
    torch.rand(7)
    assert all(same(dataset[i], expected[i]) for i in (2, 0, 2))
    torch.set_rng_state(state)
    assert same(dataset[1], expected[1])
    assert torch.equal(state, torch.get_rng_state())


@each_set
def test_another_seed_gives_another_building_on_the_same_path(name, options):
    other = load(name, n_scans=N_SCANS, seed=1, **options)[0]
    assert not same(scans_of(name, **options)[0], other)
    assert torch.equal(scans_of(name, **options)[0].origin, other.origin)


@each_set
def test_no_return_beams_have_no_return_range_and_cross_no_surface(name, options):
    sensor_range = SENSOR_RANGE[name]
    dataset = load(name, n_scans=N_SCANS, no_return_range=100.0, **options)
    for scans, expected in ((scans_of(name, **options), 8.0), (list(dataset), sensor_range)):
        assert all(bool((length(s.points, s) < sensor_range).all()) for s in scans)
        lengths = torch.cat([length(s.no_return, s) for s in scans])
        assert len(lengths) > 0
        torch.testing.assert_close(lengths, torch.full_like(lengths, expected))
    for scan in scans:
        directions = torch.nn.functional.normalize(scan.no_return - scan.origin, dim=1)
        assert bool((dataset.world.distances(scan.origin, directions) > sensor_range - 0.1).all())
    dataset.ranges = Ranges(None, 0.0)
    assert len(dataset[0].no_return) == 0


@each_set
def test_a_smaller_max_range_turns_far_hits_into_no_return_beams(name, options):
    short = load(name, n_scans=N_SCANS, max_range=3.0, **options)
    for a, b in zip(scans_of(name, **options), short, strict=True):
        assert a.n_beams == b.n_beams
        assert torch.equal(b.points, a.points[length(a.points, a) < 3.0])
        assert bool((length(b.no_return, b) <= 3.0 + 1e-9).all())


@each_set
def test_a_larger_max_range_does_not_extend_the_sensor(name, options):
    longer = load(name, n_scans=N_SCANS, max_range=99.0, **options)
    assert all(same(a, b) for a, b in zip(scans_of(name, **options), longer, strict=True))


@each_set
def test_synthetic_range_noise_is_one_centimetre(name, options):
    dataset = load(name, n_scans=N_SCANS, **options)
    errors = []
    for scan, pose in zip(scans_of(name, **options), dataset.poses, strict=True):
        directions = torch.nn.functional.normalize(scan.points - scan.origin, dim=1)
        errors.append(length(scan.points, scan) - dataset.world.distances(pose[:-1, -1], directions))
    error = torch.cat(errors)
    error = error[error.abs() < 0.1]  # at an edge, rounding can select another surface
    assert float(error.std()) == pytest.approx(0.01, rel=0.1)
    assert abs(float(error.mean())) < 0.002


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"seed": -1}, "seed=-1"),
        ({"n_scans": 0}, "n_scans=0"),
        ({"sensor": "sonar"}, "sensor='sonar'.*lidar, depth_camera"),
        ({"stride": 0}, "stride=0"),
        ({"max_range": -1.0}, r"max_range=-1\.0"),
    ],
)
def test_synthetic_building_rejects_invalid_options(options, message):
    with pytest.raises(InvalidArgumentError, match=message):
        load("synthetic_building", **options)


# -- in a mesh -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def hall(tmp_path_factory) -> Path:
    """A box of 20 × 6 × 3 m as PLY."""
    import open3d

    path = tmp_path_factory.mktemp("mesh") / "hall.ply"
    assert open3d.io.write_triangle_mesh(str(path), open3d.geometry.TriangleMesh.create_box(20, 6, 3))
    return path


@pytest.mark.parametrize("sensor", ["lidar", "depth_camera"])
def test_mesh_scan_points_lie_on_the_surfaces_within_noise(hall, sensor):
    dataset = load("mesh_scans", hall, n_scans=4, sensor=sensor)
    assert len(dataset) == 4
    size = torch.tensor([20.0, 6.0, 3.0], dtype=torch.float64)
    for scan in dataset:
        points = scan.points.double()
        assert len(points) > 1000
        distance = torch.minimum(points.abs(), (points - size).abs()).amin(1)
        assert float(distance.max()) < 0.06  # noise of 1 cm along the beam
        assert bool(((scan.origin > 0) & (scan.origin < size)).all())


def test_mesh_scans_reject_invalid_input(hall, tmp_path):
    with pytest.raises(MissingDataError, match=r"nowhere\.ply"):
        load("mesh_scans", tmp_path / "nowhere.ply")
    for option, value in (("sensor", "radar"), ("n_scans", 0), ("seed", 2**60)):
        with pytest.raises(InvalidArgumentError, match=f"{option}={value!r}"):
            load("mesh_scans", hall, **{option: value})
    bad = tmp_path / "bad.ply"
    bad.write_text("not a mesh")
    with pytest.raises(DataError, match=r"bad\.ply"):
        load("mesh_scans", bad, n_scans=2)[0]


@pytest.mark.real_data
def test_mesh_scans_of_a_real_mine_cover_a_long_path(real_data):
    dataset = load("mesh_scans", real_data / "meshes" / "edgar_mine.ply", n_scans=50)
    scan = dataset[25]
    assert len(scan.points) > 2000
    travelled = (dataset.poses[-1, :3, 3] - dataset.poses[0, :3, 3]).norm()
    assert float(travelled) > 40
