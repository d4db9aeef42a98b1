"""gmmtorch-export: formats and errors."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from command_runs import Finished, as_it_was, refused, run_here, succeeded
from export.map_examples import read_map_image

from gmmtorch import GaussianMap, GaussianMixture, OccupancyGrid, Scan
from gmmtorch.cli.reporting import exported_files
from gmmtorch.datasets import load
from gmmtorch.export import read_gira_csv, read_npz, write_tum
from gmmtorch.occupancy.occupancy_grid import LogOdds

Run = Callable[..., Finished]


@pytest.fixture(autouse=True)
def hydra_as_it_was():
    with as_it_was():
        yield


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """Runs the command in this process, in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def run_command(*options: str) -> Finished:
        return run_here(monkeypatch, "export", tmp_path, "report.progress=false", *options)

    return run_command


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Maps and grids in 2D and 3D, and a mixture."""
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("files")
    for dim, name in ((2, "synthetic_building_2d"), (3, "synthetic_building")):
        dataset = load(name, n_scans=3)
        built, counted = GaussianMap(n_samples=20_000), OccupancyGrid(0.25)
        updated = OccupancyGrid(0.25, log_odds=LogOdds())
        for i in range(3):
            scan = dataset[i]
            thinned = scan.select(torch.arange(scan.n_beams) % (1 if dim == 2 else 5) == 0)
            for place in (built, counted, updated):
                place.insert(thinned)
        built.save(folder / f"map_{dim}.safetensors")
        counted.save(folder / f"grid_{dim}.safetensors")
        updated.save(folder / f"log_odds_{dim}.safetensors")
    points = np.random.default_rng(0).normal(size=(200, 3))
    GaussianMixture(3, random_state=0).fit(points).save(folder / "mixture.safetensors")
    return folder


# -- space ----------------------------------------------------------------------------------------


def test_image_of_a_2d_map_has_its_occupancy(run, files, tmp_path):
    done = succeeded(run(f"path={files / 'map_2.safetensors'}", "output=floor.yaml", "resolution=0.2"))
    found = read_map_image(tmp_path / "floor.yaml")
    built = GaussianMap.load(files / "map_2.safetensors")
    theta = torch.as_tensor(built.occupancy(found.grid.centers(), 0.2)).view(found.grid.shape)
    assert float((found.probability - theta).abs().max()) <= 1 / 255
    assert found.grid.resolution == 0.2
    assert {"floor.yaml", "floor.pgm"} == {path.name for path in tmp_path.iterdir()}
    assert re.search(r"floor\.pgm  [\d,]+ bytes: \d+ × \d+ cells of 0\.2 m", done.stdout)
    inside = (
        (built.components().origins / 0.2).floor() * 0.2 >= torch.tensor(found.grid.origin) - 1e-9
    ).all()
    assert bool(inside)


def test_image_by_another_form_of_evidence(run, files, tmp_path):
    source = f"path={files / 'map_2.safetensors'}"
    succeeded(run(source, "output=a.yaml", "method=monte_carlo", "resolution=0.2"))
    found = read_map_image(tmp_path / "a.yaml")
    built = GaussianMap.load(files / "map_2.safetensors")
    theta = built.evidence(found.grid, "monte_carlo").probability()
    assert float((found.probability - theta).abs().max()) <= 1 / 255


@pytest.mark.parametrize("kind", ["grid", "log_odds"])
def test_image_of_a_grid_has_its_occupancy(kind, run, files, tmp_path):
    succeeded(run(f"path={files / f'{kind}_2.safetensors'}", "output=floor.yaml"))
    found = read_map_image(tmp_path / "floor.yaml")
    grid = OccupancyGrid.load(files / f"{kind}_2.safetensors")
    theta = torch.as_tensor(grid.occupancy(found.grid.centers())).view(found.grid.shape)
    assert float((found.probability - theta).abs().max()) <= 1 / 255
    n_cells = grid.evidence().n_blocks * grid.evidence().cells_per_block
    assert 0 < int((theta != 0.5).sum()) <= n_cells


def test_image_of_a_height_band_has_the_highest_occupancy(run, files, tmp_path):
    options = ["output=band.yaml", "resolution=0.5", "z_min=0.3", "z_max=1.2"]
    succeeded(run(f"path={files / 'map_3.safetensors'}", *options))
    found = read_map_image(tmp_path / "band.yaml")
    built = GaussianMap.load(files / "map_3.safetensors")
    columns = torch.cat(
        [
            torch.cat([found.grid.centers(), torch.full((found.grid.n_cells, 1), z)], 1)
            for z in (0.25, 0.75, 1.25)  # the cells that the band intersects
        ]
    )
    theta = torch.as_tensor(built.occupancy(columns, 0.5)).view(3, *found.grid.shape).amax(0)
    assert float((found.probability - theta).abs().max()) <= 1 / 255


@pytest.mark.parametrize(
    ("kind", "dim", "form"), [("map", 2, "ply"), ("map", 3, "pcd"), ("grid", 2, "pcd"), ("grid", 3, "ply")]
)
def test_point_cloud_of_occupied_cells(kind, dim, form, run, files, tmp_path):
    name = f"cells.{form}"
    open3d = pytest.importorskip("open3d")
    resolution = ["resolution=0.5"] if kind == "map" else []
    succeeded(
        run(
            f"path={files / f'{kind}_{dim}.safetensors'}",
            f"format={form}",
            f"output={name}",
            "occupied_thresh=0.55",
            *resolution,
        )
    )
    cloud = open3d.t.io.read_point_cloud(str(tmp_path / name))
    points, theta = cloud.point.positions.numpy(), cloud.point.intensity.numpy()[:, 0]
    assert len(points) > 10
    assert theta.min() > 0.55
    load_map = GaussianMap.load if kind == "map" else OccupancyGrid.load
    answers = load_map(files / f"{kind}_{dim}.safetensors").occupancy(points[:, :dim].astype(float), 0.5)
    np.testing.assert_allclose(theta, answers, atol=1e-5)


def test_mesh_of_a_height_band_lies_on_the_surfaces_of_the_map(run, files, tmp_path):
    open3d = pytest.importorskip("open3d")
    done = succeeded(
        run(f"path={files / 'map_3.safetensors'}", "format=mesh", "output=a.ply", "resolution=0.1", "z_max=1")
    )
    mesh = open3d.io.read_triangle_mesh(str(tmp_path / "a.ply"))
    corners = np.asarray(mesh.vertices)
    assert corners[:, 2].max() <= 1
    assert f"{len(mesh.triangles):,} triangles" in done.stdout
    theta = GaussianMap.load(files / "map_3.safetensors").occupancy(corners, 0.1)
    assert np.mean(theta > 0.5) > 0.9
    error = run(f"path={files / 'grid_3.safetensors'}", "format=mesh", "output=b.ply")
    assert error.status == 1
    assert "is an occupancy grid" in error.stderr


def test_distance_field_of_a_map_is_zero_in_its_occupied_cells(run, files, tmp_path):
    source = f"path={files / 'map_2.safetensors'}"
    succeeded(run(source, "format=distance_field", "output=a.npz", "resolution=0.2"))
    with np.load(tmp_path / "a.npz") as field:
        cells = np.stack(np.meshgrid(*map(np.arange, field["distance"].shape), indexing="ij"), -1) + 0.5
        centers = field["origin"] + cells.reshape(-1, 2) * field["resolution"]
        theta = GaussianMap.load(files / "map_2.safetensors").occupancy(centers, 0.2)
        assert np.array_equal(field["distance"].ravel() == 0, theta > 0.65)


@pytest.mark.parametrize("name", ["map_3", "grid_3", "log_odds_2"])
def test_octree_has_the_occupancy_of_the_map(name, run, files, tmp_path):
    pyoctomap = pytest.importorskip("pyoctomap")
    resolution = ["resolution=0.5"] if name == "map_3" else []
    options = ["format=octomap", "output=map.ot", *resolution]
    done = succeeded(run(f"path={files / f'{name}.safetensors'}", *options))
    said = int(re.search(r"([\d,]+) cells", done.stdout)[1].replace(",", ""))
    tree = pyoctomap.OcTree(1.0).read(str(tmp_path / "map.ot"))
    assert tree.getResolution() == (0.5 if name == "map_3" else 0.25)
    assert 0 < tree.getNumLeafNodes() <= said
    loaded = (GaussianMap if name == "map_3" else OccupancyGrid).load(files / f"{name}.safetensors")
    leaves = [leaf.getCoordinate() for leaf in tree.begin_leafs(16) if leaf.getSize() == tree.getResolution()]
    centers = np.array(leaves[::7])
    answers = loaded.occupancy(centers[:, : int(name[-1])], 0.5)
    found = [tree.search(center).getOccupancy() for center in centers]
    np.testing.assert_allclose(found, answers, atol=1e-5)


def test_octomap_without_its_package_is_refused_before_the_cells_are_computed(run, files, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyoctomap", None)
    monkeypatch.setattr(exported_files, "write_space", pytest.fail)
    assert "pip install 'gmmtorch[baselines]'" in refused(
        run(f"path={files / 'map_3.safetensors'}", "output=map.ot", "resolution=0.5")
    )


def test_bounds_limit_the_cells(run, files, tmp_path):
    succeeded(
        run(f"path={files / 'map_2.safetensors'}", "output=cut.yaml", "bounds=[1,2,4,3]", "resolution=0.1")
    )
    assert read_map_image(tmp_path / "cut.yaml").grid.shape == (30, 10)


@pytest.mark.parametrize(
    ("source", "output", "written"),
    [
        ("map_2", "floor.pgm", {"floor.pgm", "floor.yaml"}),
        ("map_2", "cells.ply", {"cells.ply"}),
        ("grid_2", "cells.PCD", {"cells.PCD"}),
        ("map_2", "gira.csv", {"gira.csv"}),
        ("map_3", "arrays.npz", {"arrays.npz"}),
        ("mixture", "copy.safetensors", {"copy.safetensors"}),
    ],
)
def test_the_ending_of_the_output_selects_the_format(source, output, written, run, files, tmp_path):
    resolution = [] if "grid" in source else ["resolution=0.5"]
    succeeded(run(f"path={files / f'{source}.safetensors'}", f"output={output}", *resolution))
    assert {path.name for path in tmp_path.iterdir()} == written


def test_an_image_of_a_3d_map_is_of_the_space_between_floor_and_ceiling(run, files, tmp_path):
    source = f"path={files / 'map_3.safetensors'}"
    done = succeeded(run(source, "output=room.yaml", "resolution=0.25"))
    said = re.search(r"z_min=([\d.]+) z_max=([\d.]+) \(m\) were chosen: the floor at (\S+) m", done.stdout)
    low, high, floor = (float(text) for text in said.groups())
    assert abs(floor) < 0.05  # the floor of the simulated hall, whose ceiling is at 4 m
    assert low == pytest.approx(floor + 0.5, abs=0.02)
    assert 2.0 < high < 4.0
    succeeded(run(source, "output=same.yaml", "resolution=0.25", f"z_min={low}", f"z_max={high}"))
    chosen, given = (read_map_image(tmp_path / f"{name}.yaml").probability for name in ("room", "same"))
    assert chosen.shape == given.shape
    assert float((chosen > 0.65).double().mean()) < 0.3


# -- components -----------------------------------------------------------------------------------


def test_components_survive_all_formats(run, files, tmp_path):
    succeeded(run(f"path={files / 'map_3.safetensors'}", "format=npz", "output=a.npz"))
    succeeded(run("path=a.npz", "format=csv", "output=b.csv"))
    succeeded(run("path=b.csv", "format=mixture", "output=c.safetensors"))
    succeeded(run("path=c.safetensors", "format=npz", "output=d.npz"))
    built = GaussianMap.load(files / "map_3.safetensors").components()
    surface = ~built.max_range
    assert bool(built.max_range.any())  # some components are left out
    first, last = read_npz(tmp_path / "a.npz"), read_npz(tmp_path / "d.npz")
    assert torch.equal(first.support, built.support[surface])
    for found in (first, read_gira_csv(tmp_path / "b.csv"), last):
        torch.testing.assert_close(found.means, built.means[surface], rtol=1e-14, atol=0)
        torch.testing.assert_close(found.covariances, built.covariances[surface], rtol=1e-14, atol=0)
        torch.testing.assert_close(found.weights, first.weights, rtol=1e-14, atol=0)
    assert last.support is None


def test_a_fitted_mixture_is_written_as_csv(run, files, tmp_path):
    done = succeeded(run(f"path={files / 'mixture.safetensors'}", "format=csv", "output=m.csv"))
    assert "3 components in 3D" in done.stdout
    fitted = GaussianMixture.load(files / "mixture.safetensors")
    np.testing.assert_allclose(read_gira_csv(tmp_path / "m.csv").means, fitted.means_, rtol=1e-15)


def test_a_trajectory_becomes_kitti_rows(run, tmp_path):
    poses = np.array([np.eye(4), [[0, -1, 0, 3], [1, 0, 0, 4], [0, 0, 1, 5], [0, 0, 0, 1]]])
    write_tum(tmp_path / "t.tum", [0.5, 1.5], poses)
    done = succeeded(run("path=t.tum", "output=poses.txt", "format=kitti"))
    assert "2 poses" in done.stdout
    rows = np.loadtxt(tmp_path / "poses.txt")
    np.testing.assert_allclose(rows[1], [0, -1, 0, 3, 1, 0, 0, 4, 0, 0, 1, 5], atol=1e-8)
    assert "path=none.tum does not exist" in refused(run("path=none.tum", "output=a.txt", "format=kitti"))


# -- errors ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["path={map_2}"], "output is not set"),
        (["output=a.yaml"], "path is not set"),
        (["path={map_2}", "output=a.dwg"], r"none of the endings \.yaml, \.pgm, \.bt.*format="),
        (["path={map_2}", "output=a"], "none of the endings"),
        (["path={map_2}", "output=a.yaml", "bounds=[1,1,0,0]"], r"bounds=\[1.0, 1.0, 0.0, 0.0\]: the lowest"),
        (["path={map_2}", "output=a", "format=dwg"], "format='dwg' is not one of map_server"),
        (["path=nowhere.safetensors", "output=a.yaml"], "nowhere.safetensors does not exist"),
        (["path={mixture}", "output=a.yaml"], "is not a map that can be exported"),
        (["path={grid_2}", "output=a.csv", "format=csv"], "contains no components to export"),
        (["path={grid_2}", "output=a.yaml", "resolution=0.1"], "cells of .* are 0.25 m"),
        (["path={map_2}", "output=a.yaml", "method=guess"], "method='guess' is not one of"),
        (["path={map_2}", "output=a.yaml", "bounds=[0,1]"], "must be 4 numbers in 2D"),
        (["path={map_2}", "output=a.yaml", "z_min=0"], "a 2D map has no heights"),
        (["path={map_3}", "output=a.yaml", "z_min=50"], "is outside the map"),
        (["path={map_3}", "output=a.yaml", "resolution=0.0001"], "above the limit of .* m or more fits"),
        (["path={map_2}", "output=a.yaml", "resolution=-1"], "resolution=-1"),
        (["path={map_2}", "output=a.txt", "format=octomap", "resolution=1"], r"must end in \.bt"),
        (["path={map_2}", "output=a.yaml", "occupied_thresh=0.1"], "occupied_thresh=0.1"),
        (["path={map_2}", "output=a.yaml", "runtime.device=abacus"], "runtime.device=abacus"),
    ],
)
def test_an_invalid_option_gives_a_one_line_error_and_no_file(options, says, run, files, tmp_path):
    names = {path.stem: str(path) for path in files.iterdir()}
    done = run(*(option.format(**names) for option in options))
    assert done.status == 1
    assert re.search(says, done.stderr), done.stderr
    assert done.stderr.startswith("gmmtorch: error: ")
    assert len(done.stderr.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_an_empty_map_needs_bounds(run, tmp_path):
    empty = GaussianMap()
    empty.insert(Scan(torch.empty(0, 2), torch.zeros(2)))
    empty.save(tmp_path / "empty.safetensors")
    done = run("path=empty.safetensors", "output=a.yaml")
    assert "is an empty map; give bounds" in done.stderr
    succeeded(run("path=empty.safetensors", "output=a.yaml", "bounds=[0,0,1,1]"))
    assert bool((read_map_image(tmp_path / "a.yaml").probability - 0.5).abs().max() <= 1 / 255)
