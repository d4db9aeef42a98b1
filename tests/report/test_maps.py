"""Images and figures of maps, and the moving picture of a map that grows."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image

from gmmtorch.datasets import load
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.occupancy import Evidence, SparseEvidence, VoxelGrid
from gmmtorch.report import style
from gmmtorch.report.map_figures import GrowthFrame, map_figure, save_growth
from gmmtorch.report.map_images import MapPanel, height_image, robust_bounds, roof_above, slice_image


def wall_map(dim: int) -> SparseEvidence:
    """Rays from the origin to the plane x = 2, cells of 0.5 m."""
    evidence = SparseEvidence(0.5, dim)
    side = torch.linspace(-1.9, 1.9, 21, dtype=torch.float64)
    others = torch.cartesian_prod(side, side) if dim == 3 else side[:, None]
    ends = torch.cat([torch.full((len(others), 1), 2.1, dtype=torch.float64), others], 1)
    evidence.add_rays(torch.zeros_like(ends) + 0.05, ends)
    return evidence


def unknown(points: torch.Tensor) -> torch.Tensor:
    return torch.full((len(points),), 0.5)


def box(dim: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
    return (-1.0,) * dim, (3.0,) * dim


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("n_panels", [5])
def test_map_figure_draws_one_panel_per_map(dim, n_panels):
    low, high = box(dim)
    panels = [MapPanel(f"map {i}", wall_map(dim).lookup, 0.5, low, high) for i in range(n_panels)]
    path = torch.tensor([[0.0] * dim, [1.0] * dim])
    figure = map_figure(panels, [path], title="wall")
    shown = [axes for axes in figure.axes if axes.get_visible() and axes.get_images()]
    assert len(shown) == n_panels * (dim - 1)
    assert all(axes.get_aspect() == 1 for axes in shown)
    texts = {text.get_text() for text in figure.legends[0].get_texts()}
    assert {"sensor path", "start", "end"} <= texts


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("path", ["empty", "one"])
def test_map_figure_draws_an_unknown_map(dim, path):
    panel = MapPanel("nothing", unknown, 0.5, *box(dim))
    trajectory = torch.zeros(1, dim) if path == "one" else torch.empty(0, dim)
    map_figure([panel], [trajectory]).canvas.draw()
    assert slice_image(panel).image.isnan().all()


def test_slice_pixels_are_grid_cells():
    evidence = Evidence.empty(VoxelGrid((-1.0, 2.0), 0.5, (3, 2)))
    evidence.hits[2, 0] = 3.0
    evidence.misses[0, 1] = 1.0
    panel = MapPanel("grid", evidence.lookup, 0.5, (-1.0, 2.0), (0.5, 3.0))
    found = slice_image(panel)
    assert found.extent == (-1.0, 0.5, 2.0, 3.0)
    expected = np.full((3, 2), np.nan)
    expected[2, 0], expected[0, 1] = 4 / 5, 1 / 3
    np.testing.assert_allclose(found.image, expected)


def test_large_slices_query_the_centres_of_every_nth_cell():
    asked = []

    def occupancy(points):
        asked.append(points)
        return unknown(points)

    panel = MapPanel("large", occupancy, 0.1, (0.0, 0.0), (100.0, 50.0))
    found = slice_image(panel, max_pixels=100)
    points = torch.cat(asked)
    assert found.image.shape == (100, 50)
    assert len(points) == 5000
    assert found.resolution == pytest.approx(1.0)
    inside_a_cell = (points / 0.1) % 1.0
    torch.testing.assert_close(inside_a_cell, torch.full_like(inside_a_cell, 0.5), atol=1e-6, rtol=0)


def test_reduced_slices_keep_walls_and_unknown_space():
    theta = torch.full((4, 4), 0.5, dtype=torch.float64)
    theta[0, :2] = torch.tensor([0.9, 0.1])  # a wall cell among free and unknown ones
    theta[2:, 2:] = 0.2
    theta[3, 3] = 0.4

    def occupancy(points):
        cell = points.floor().long()
        return theta[cell[:, 0], cell[:, 1]]

    found = slice_image(MapPanel("m", occupancy, 1.0, (0.0, 0.0), (4.0, 4.0)), shown_pixels=2)
    np.testing.assert_allclose(found.image, [[0.9, np.nan], [np.nan, 0.25]])
    assert found.extent == (0.0, 4.0, 0.0, 4.0)


def test_height_image_gives_the_highest_occupied_cell():
    def occupancy(points):
        x, _, z = points.unbind(1)
        occupied = ((x < 1) & (z < 1)) | ((x > 2) & (z > 1) & (z < 2))
        return torch.where(occupied, 0.9, 0.1)

    panel = MapPanel("steps", occupancy, 1.0, (0.0, 0.0, 0.0), (3.0, 1.0, 4.0))
    found = height_image(panel)
    np.testing.assert_allclose(found.image, [[0.5], [np.nan], [1.5]])
    assert found.resolution == 1.0
    assert height_image(panel, max_queries=4).image.numel() < found.image.numel()


@pytest.mark.parametrize("roof", [2.0, 100.0])
def test_map_figure_leaves_out_a_roof(roof):
    def occupancy(points):
        return torch.where((points[:, 2] < 0) | (points[:, 2] > roof), 0.9, 0.1)

    panel = MapPanel("room", occupancy, 0.5, (0.0, 0.0, -1.0), (4.0, 4.0, 3.0))
    path = torch.tensor([[1.0, 1.0, 1.0], [3.0, 3.0, 1.0]], dtype=torch.float64)
    assert roof_above(panel, path.numpy()) == (roof == 2.0)
    titles = [axes.get_title() for axes in map_figure([panel], [path]).axes]
    assert any("below z = 1.5 m" in title for title in titles) == (roof == 2.0)


def test_robust_bounds_ignore_stray_points():
    points = torch.zeros(1000, 2)
    points[0] = torch.tensor([1e4, -1e4])
    low, high = robust_bounds(points, torch.tensor([[5.0, 0.0]]), margin=1.0)
    assert low == (-1.0, -1.0)
    assert high == (6.0, 1.0)
    assert robust_bounds(torch.empty(0, 3)) == ((-1.0,) * 3, (1.0,) * 3)


def test_panels_accept_numpy_answers():
    panel = MapPanel("array", lambda points: np.full(len(points), 0.25), 0.5, *box(2))
    assert (slice_image(panel).image == 0.25).all()


def test_images_cover_the_region_aligned_with_cells():
    image = slice_image(MapPanel("m", unknown, 0.1, (-0.25, 0.3), (0.31, 0.4)))
    assert image.extent == pytest.approx((-0.3, 0.4, 0.3, 0.4))
    assert image.image.shape == (7, 1)


def grown(n_frames: int) -> list[GrowthFrame]:
    """The map of the building after one scan, two, …"""
    scans, built, frames = load("synthetic_building_2d", n_scans=n_frames), GaussianMap(), []
    for k, scan in enumerate(scans):
        built.insert(scan)
        path = torch.stack([scans[i].origin for i in range(k + 1)])
        frames.append(GrowthFrame(k + 1, GaussianMap.of(built.components()), path, scan.points))
    return frames


def test_unknown_space_shrinks_and_the_last_frame_is_held(tmp_path):
    written = save_growth(tmp_path / "map.gif", grown(3), resolution=0.3, period=0.1)
    unknown = np.array([int(style.UNKNOWN[k : k + 2], 16) for k in (1, 3, 5)])
    path_colour = np.array([int(style.PALETTE[1][k : k + 2], 16) for k in (1, 3, 5)])
    durations, shares = [], []
    with Image.open(written) as picture:
        assert picture.n_frames == 3
        for k in range(3):
            picture.seek(k)
            durations.append(picture.info["duration"])
            pixels = np.asarray(picture.convert("RGB")).astype(int)
            shares.append((np.abs(pixels - unknown).max(-1) < 8).mean())
            assert (np.abs(pixels - path_colour).max(-1) < 16).sum() > 30  # the robot
    assert durations == [100, 100, 4000]
    assert shares[0] > shares[1] > shares[2] > 0.01


@pytest.mark.parametrize(("name", "words"), [("map.mp4", r"\.webp or \.gif"), ("map.gif", "only maps in 2D")])
def test_other_files_and_maps_are_refused(name, words, tmp_path):
    with pytest.raises(InvalidArgumentError, match=words):
        save_growth(
            tmp_path / name,
            [GrowthFrame(0, GaussianMap(), torch.zeros(1, 2), torch.zeros(0, 2))],
            resolution=0.1,
        )
