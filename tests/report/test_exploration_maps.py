"""Figures of explorations from above and in space, and the renderer against ray intersections."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from exploration_rows import flights
from matplotlib.colors import to_rgb

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.report import UNKNOWN, Camera, MapImage, cut_away, highest_occupancy, mixture_scene_figure
from gmmtorch.report.scene_renderer import Canvas, render
from gmmtorch.report.scenes import smooth_path
from gmmtorch.team.exploration.planning.primitives import Dynamics, Primitives
from gmmtorch.team.exploration.world.scoring import BeliefRule
from gmmtorch.team.report.mission_maps import TeamSnapshot, team_map_figure, trajectories_figure


def components(k: int, size: float = 0.5) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    means = 4 * torch.rand(k, 3, dtype=torch.float64, generator=generator)
    factors = size * torch.randn(k, 3, 3, dtype=torch.float64, generator=generator)
    return means, factors @ factors.mT + 0.01 * torch.eye(3, dtype=torch.float64)


# -- from above -----------------------------------------------------------------------------------


def test_highest_occupancy_uses_known_cells():
    theta = torch.full((2, 2, 2), 0.5)
    theta[0, 0] = torch.tensor([0.1, 0.2])
    theta[0, 1] = torch.tensor([0.5, 0.505])
    theta[1, 0] = torch.tensor([0.1, 0.7])
    view = highest_occupancy(theta, (1.0, 2.0, 0.0), 0.5)
    np.testing.assert_allclose(view.image, [[0.2, 0.5], [0.7, 0.5]], atol=1e-7)
    assert view.band == (0.0, 1.0)
    assert view.extent == (1.0, 2.0, 2.0, 3.0)
    truth = highest_occupancy(theta > 0.5, (0, 0, 0), 0.5)
    assert truth.image.tolist() == [[0, 1], [1, 0]]


def test_coverage_is_shaded_by_the_number_of_robots():
    world = MapImage(torch.zeros(6, 4, dtype=torch.bool), (-1.0, 0.0), 0.5)
    world.image[5, 0] = True
    coverage = torch.zeros(6, 4, dtype=torch.int64)
    coverage[1, 2], coverage[2, 2], coverage[3, 3] = 1, 1, 2
    figure = trajectories_figure(world, flights(2, 20), coverage)
    figure.canvas.draw()
    image = figure.axes[0].get_images()[0]
    pixels = np.asarray(image.get_array())
    assert image.get_extent() == [-1.0, 2.0, 0.0, 2.0]
    assert pixels.shape[:2] == (4, 6)  # rows are y
    np.testing.assert_allclose(pixels[2, 1], pixels[2, 2])
    np.testing.assert_allclose(pixels[0, 1], to_rgb(UNKNOWN))
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) == 4  # not seen, one, two, surface
    shown_texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert "seen by 1 robot: 67 %" in shown_texts
    assert "seen by 2 robots: 33 %" in shown_texts
    assert [name for name in shown_texts if name.startswith("robot ")] == ["robot 0", "robot 1"]


@pytest.mark.parametrize(("n_robots", "n_poses"), [(0, 5), (1, 0), (1, 1), (16, 5)])
def test_figures_accept_any_number_of_robots_and_poses(n_robots, n_poses):
    world = MapImage(torch.rand(5, 9), (0.0, 0.0), 1.0)
    coverage = torch.randint(0, n_robots + 1, (5, 9))
    paths = [path[:n_poses] for path in flights(n_robots, max(n_poses, 1))]
    trajectories_figure(world, paths, coverage).canvas.draw()
    scene = mixture_scene_figure(*components(3), trajectories=paths, max_pixels=200)
    scene.canvas.draw()
    shown_texts = [text.get_text() for legend in scene.legends for text in legend.get_texts()]
    named = [name for name in shown_texts if name.startswith(("robot ", "path"))]
    assert named == (["path"] if n_robots == 1 else [f"robot {i}" for i in range(min(n_robots, 7))])


def test_team_map_outlines_components_within_the_band():
    view = highest_occupancy(torch.rand(8, 8, 3), (0, 0, 0.5), 0.5)
    means, covariances = components(40)
    snapshots = [
        TeamSnapshot(60.0, view, [p[:5, :2] for p in flights(2, 5)]),
        TeamSnapshot(120.0, view, flights(2, 9), means, covariances, torch.arange(40) % 2, "half is known"),
        TeamSnapshot(180.0, view),
    ]
    figure = team_map_figure(snapshots)
    figure.canvas.draw()
    shown = [axes for axes in figure.axes if axes.get_visible()]
    assert [axes.get_title() for axes in shown] == ["t = 60 s", "t = 120 s, half is known", "t = 180 s"]
    within = ((means[:, 2] >= 0.5) & (means[:, 2] <= 2.0)).nonzero()[:, 0]
    outlines = shown[1].collections[0].get_paths()
    assert len(outlines) == len(within)
    # A 2σ outline reaches to ±2σ along either axis, but for its corners.
    reach = 2 * covariances[within].diagonal(dim1=1, dim2=2).sqrt()[:, :2].numpy()
    for outline, mean, half in zip(outlines, means[within].numpy(), reach, strict=True):
        np.testing.assert_allclose(outline.vertices.max(0), mean[:2] + half, atol=0.02 * half.max() + 1e-9)
    assert "between z = 0.5 m and 2 m" in figure.get_suptitle()


def test_team_map_classifies_cells_by_the_belief_rule():
    view = MapImage(torch.tensor([[0.1, 0.3, 0.5, 0.6, 0.7]]), (0.0, 0.0), 1.0)
    free, unknown, occupied = (1.0, 1.0, 1.0), to_rgb(UNKNOWN), to_rgb("#2b2b2b")
    usual = [free, unknown, unknown, unknown, occupied]
    for belief, expected in (
        (None, usual),
        (BeliefRule(free=0.4, occupied=0.55), [free, free, unknown, occupied, occupied]),
    ):
        image = team_map_figure([TeamSnapshot(1.0, view)], belief=belief).axes[0].get_images()[0]
        np.testing.assert_allclose(np.asarray(image.get_array())[:, 0], expected)


@pytest.mark.parametrize(("height", "shown_texts"), [(1.0, []), (3.0, ["path above or below these heights"])])
def test_paths_outside_the_band_have_a_white_core(height, shown_texts):
    world = MapImage(torch.zeros(8, 8), (0.0, 0.0), 1.0, (0.8, 1.8))
    poses = np.array([[1.0, 1, 1.0, 0], [3, 1, height, 0], [5, 1, 1.0, 0]])
    figure = trajectories_figure(world, [poses])
    assert figure.get_suptitle() == "Robot paths\nsurfaces between z = 0.8 m and 1.8 m"
    assert [t.get_text() for t in figure.legends[0].get_texts() if "heights" in t.get_text()] == shown_texts
    paths = [line for line in figure.axes[0].lines if line.get_linestyle() != "None"]
    above = [line for line in paths if len(line.get_path_effects()) == 3]
    assert len(above) == len(shown_texts)
    for line in above:
        crossed = np.interp(line.get_xdata()[[0, -1]], [1, 3, 5], [1.0, height, 1.0])
        np.testing.assert_allclose(crossed, 1.8, atol=0.5)
    assert sum(np.abs(np.diff(line.get_xdata())).sum() for line in paths) == pytest.approx(4)
    below = trajectories_figure(world, [poses - [0, 0, 1, 0]])
    assert "path above or below these heights" in [t.get_text() for t in below.legends[0].get_texts()]


def test_smooth_paths_follow_the_flown_trajectory():
    dynamics = Dynamics()
    library = Primitives(dynamics)
    state = torch.zeros(1, 7, dtype=torch.float64)
    flown = [state]
    for command in (0, 3, 8, 12, 4, 19, 1):  # ahead, arcs that climb and descend, a turn in place, an arc
        flown.append(library.rollout(state)[0, command])
        state = flown[-1][-1:]
    every = torch.cat(flown).numpy()

    def farthest(path: np.ndarray) -> float:
        fine = np.concatenate([np.linspace(a, b, 20) for a, b in pairwise(path)])
        return float(np.linalg.norm(every[:, None, :2] - fine[None, :, :2], axis=2).min(1).max())

    kept = every[::5, :4]  # once a second
    path = smooth_path(kept)
    assert farthest(path) < 0.03
    assert farthest(kept) > 0.2
    np.testing.assert_allclose(path[[0, -1]], kept[[0, -1], :3])
    assert (np.diff(path[:, 2]) >= -1e-12)[: np.argmax(path[:, 2])].all()  # up, and down once
    assert (np.diff(path[:, 2]) <= 1e-12)[np.argmax(path[:, 2]) :].all()
    assert path[:, 2].max() == kept[:, 2].max()


def test_smooth_paths_without_forward_heading_are_straight():
    poses = np.array([[0.0, 0, 1, math.pi], [2, 0, 1, math.pi], [2, 2, 1, 0]])
    for path in (smooth_path(poses[:, :2]), smooth_path(poses)):
        assert np.minimum(np.abs(path[:, 0] - 2), np.abs(path[:, 1])).max() < 1e-12
    assert smooth_path(np.empty((0, 4))).shape == (0, 3)
    assert smooth_path(poses[:1]).shape == (1, 3)


def test_map_errors_name_the_argument():
    world = MapImage(torch.zeros(3, 3), (0.0, 0.0), 1.0)
    with pytest.raises(InvalidArgumentError, match="coverage has shape"):
        trajectories_figure(world, [], torch.zeros(2, 3))
    with pytest.raises(InvalidArgumentError, match="snapshots is empty"):
        team_map_figure([])
    with pytest.raises(InvalidArgumentError, match="owners has shape"):
        team_map_figure([TeamSnapshot(0.0, world, [], *components(3), owners=[0])])


# -- in space -------------------------------------------------------------------------------------


def test_camera_axes_are_a_right_handed_frame():
    for azimuth, elevation in ((-60, 45), (200, 10), (0, 90)):
        axes = Camera(azimuth, elevation).axes
        torch.testing.assert_close(axes @ axes.T, torch.eye(3, dtype=torch.float64))
        assert float(torch.linalg.det(axes)) == pytest.approx(1)
    assert Camera(0, 45).project(torch.tensor([0.0, 0.0, 1.0]))[1] > 0  # up is up


def test_depth_matches_ray_quadric_intersection():
    means, covariances = components(12)
    camera = Camera(-70, 35)
    canvas = Canvas(-6.0, 6.0, -6.0, 6.0, 8.0)
    depth = render(means, covariances, torch.ones(12, 3), camera, canvas, smoothing=1).depth
    rows, columns = canvas.shape
    right = canvas.left + (torch.arange(columns) + 0.5) / canvas.scale
    up = canvas.top - (torch.arange(rows) + 0.5) / canvas.scale
    v, u = torch.meshgrid(up.double(), right.double(), indexing="ij")
    x, y, z = camera.axes
    start = u[..., None] * x + v[..., None] * y
    # (s + t z − μ)ᵀ Σ⁻¹ (s + t z − μ) = 4 by the formula for quadratics, the larger root.
    precision = torch.linalg.inv(covariances)
    offset = start[:, :, None] - means
    a = (z @ precision @ z[:, None])[:, 0]
    b = torch.einsum("rckd,kde,e->rck", offset, precision, z)
    c = torch.einsum("rckd,kde,rcke->rck", offset, precision, offset) - 4
    root = (-b + (b**2 - a * c).clamp_min(0).sqrt()) / a
    nearest = torch.where(b**2 - a * c > 0, root, -math.inf).amax(2)
    agree = torch.isfinite(depth) == torch.isfinite(nearest)
    assert agree.double().mean() > 0.97  # outlines are a little blurred
    both = torch.isfinite(depth) & torch.isfinite(nearest)
    assert both.double().mean() > 0.1
    error = (depth - nearest)[both].abs()
    assert float(error.median()) < 0.01
    assert float(error.quantile(0.95)) < 0.15  # steep rims


def test_nearer_ellipsoids_hide_farther_ones_and_light_comes_from_above():
    means = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 3.0]])
    covariances = torch.eye(3).expand(2, 3, 3) * 0.25
    colours = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    canvas = Canvas(-2.0, 2.0, -2.0, 2.0, 20.0)
    from_above = render(means, covariances, colours, Camera(0, 90), canvas)
    middle = from_above.rgb[40, 40]
    assert middle[2] > 0.5
    assert middle[0] == 0
    assert float(from_above.depth[40, 40]) == pytest.approx(4.0, abs=0.02)
    aside = render(means[:1], covariances[:1], colours[:1], Camera(0, 0), canvas).rgb[..., 0]
    assert aside[25, 40] > aside[55, 40]  # rows from the top
    assert torch.equal(aside[0], torch.ones(80))  # background


def test_singular_components_are_visible():
    means = torch.tensor([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 3.0, 0.0], [3.0, 3.0, 0.0]])
    covariances = torch.diag_embed(
        torch.tensor([[0.2, 0.2, 0.0], [1e-9, 1e-9, 0.3], [0.0, 0.0, 0.0], [0.0, 0.2, 0.2]])
    )
    canvas = Canvas(-5.0, 5.0, -5.0, 5.0, 10.0)
    picture = render(means, covariances, torch.zeros(4, 3), Camera(0, 60), canvas)
    assert bool(torch.isfinite(picture.rgb).all())
    for place in Camera(0, 60).project(means)[:, :2].tolist():
        row, column = int((5 - place[1]) * 10), int((place[0] + 5) * 10)
        assert bool(torch.isfinite(picture.depth[row - 1 : row + 2, column - 1 : column + 2]).any())


def test_cutaway_removes_ceilings_and_near_walls():
    # A room seen from within: floor, ceiling, near and far wall, and a ball that has no side.
    means = torch.tensor([[0.0, 0, 0], [0, 0, 4], [2, 0, 2], [-2, 0, 2], [0, 0, 2]], dtype=torch.float64)
    thin = torch.tensor([[1, 1, 0.001], [1, 1, 0.001], [0.001, 1, 1], [0.001, 1, 1], [0.1, 0.1, 0.1]])
    covariances = torch.diag_embed(thin.double())
    inside = torch.tensor([[0.0, 0.1, 2.0]], dtype=torch.float64).expand(5, 3)
    from_front = Camera(0, 40)  # the viewer is at +x

    assert cut_away(means, covariances, inside, from_front)[0].tolist() == [True, False, False, True, True]
    assert cut_away(means, covariances, None, from_front)[0].tolist() == [True, False, True, True, True]
    figure = mixture_scene_figure(means, covariances, seen_from=inside, camera=from_front, max_pixels=200)
    assert "3 of 5 components" in figure.get_suptitle()


def test_cutaway_removes_components_attached_to_removed_walls():
    # A near wall at x = 4 and a far one at −4, of ten flat pieces each, with a blob at each of them; and a
    # long bar from one to the other.
    z = torch.linspace(0.5, 3.5, 10, dtype=torch.float64)
    near, far = (torch.stack([torch.full_like(z, x), torch.zeros_like(z), z], 1) for x in (4.0, -4.0))
    rest = torch.tensor([[3.8, 0.0, 2.0], [-3.8, 0.0, 2.0], [0.0, 0.0, 2.0]], dtype=torch.float64)
    means = torch.cat([near, far, rest])
    flat, ball, bar = ([0.001, 0.2, 0.2], [0.02, 0.02, 0.02], [4.0, 0.01, 0.01])
    covariances = torch.diag_embed(torch.tensor([*[flat] * 20, ball, ball, bar], dtype=torch.float64))
    seen_from = torch.zeros(23, 3, dtype=torch.float64)
    kept, ceiling = cut_away(means, covariances, seen_from, Camera(0, 40))
    assert kept.tolist() == [*[False] * 10, *[True] * 10, False, True, False]
    assert ceiling == math.inf  # nothing is overhead


def test_cutaway_cuts_level_ceilings_only():
    x = torch.linspace(-8, 8, 40, dtype=torch.float64)
    floor, roof = (torch.stack([x, 0 * x, torch.full_like(x, z)], 1) for z in (0.0, 5.0))
    covariances = torch.diag_embed(torch.tensor([0.2, 0.2, 0.001], dtype=torch.float64)).expand(80, 3, 3)
    seen_from = torch.stack([x, 0 * x, torch.full_like(x, 2.0)], 1).repeat(2, 1)
    for lean, cut in ((0.0, 3.9), (0.5, math.inf)):
        slope = torch.stack([0 * x, 0 * x, lean * x], 1).repeat(2, 1)
        means = torch.cat([floor, roof]) + slope
        kept, ceiling = cut_away(means, covariances, seen_from + slope, Camera())
        assert kept.tolist() == [*[True] * 40, *[False] * 40]
        assert ceiling == pytest.approx(cut)


def test_ellipsoids_are_cut_off_at_their_top():
    means = torch.tensor([[0.0, -2.0, 0.0], [0.0, 2.0, 0.0]])
    covariances = torch.eye(3).expand(2, 3, 3) * 0.25
    camera, canvas = Camera(0, 30), Canvas(-4.0, 4.0, -2.0, 2.0, 20.0)
    tops = torch.tensor([0.25, math.inf])
    depth = render(means, covariances, torch.ones(2, 3), camera, canvas, smoothing=1, tops=tops).depth
    rows, _ = canvas.shape
    up = canvas.top - (torch.arange(rows, dtype=torch.float64) + 0.5) / canvas.scale
    height = up[:, None] * camera.axes[1, 2] + depth * camera.axes[2, 2]
    left, right = (half[torch.isfinite(half)] for half in height.chunk(2, dim=1))
    assert 0.2 < float(left.max()) <= 0.25 + 1e-4
    assert float(right.max()) > 0.9


@pytest.mark.parametrize("k", [0, 1, 30])
def test_scene_figure_accepts_any_number_of_components(k):
    means, covariances = components(k)
    figure = mixture_scene_figure(means, covariances, trajectories=flights(2, 20), max_pixels=300)
    figure.canvas.draw()
    assert any(axes.get_ylabel() == "height z [m]" for axes in figure.axes)
    named = mixture_scene_figure(means, covariances, title="mine", max_pixels=300)
    assert named.get_suptitle() == "mine"


def test_rendering_is_deterministic_and_accurate_far_from_the_origin():
    means, covariances = components(20)
    far = means + torch.tensor([500e3, -500e3, 100.0])
    canvas = Canvas(-3.0, 3.0, -3.0, 3.0, 20.0)
    camera = Camera()
    shift = camera.project(torch.tensor([500e3, -500e3, 100.0], dtype=torch.float64))
    moved = Canvas(
        -3.0 + float(shift[0]), 3.0 + float(shift[0]), -3.0 + float(shift[1]), 3.0 + float(shift[1]), 20.0
    )
    first = render(means, covariances, torch.ones(20, 3), camera, canvas)
    again = render(means, covariances, torch.ones(20, 3), camera, canvas)
    assert torch.equal(first.rgb, again.rgb)
    away = render(far, covariances, torch.ones(20, 3), camera, moved)
    assert float((away.rgb[:100, :100] - first.rgb[:100, :100]).abs().mean()) < 1e-3


def test_scene_errors_name_the_argument():
    means, covariances = components(3)
    with pytest.raises(InvalidArgumentError, match=r"a scene needs \(K, 3\)"):
        mixture_scene_figure(means[:, :2], covariances[:, :2, :2])
    with pytest.raises(InvalidArgumentError, match="seen_from has shape"):
        mixture_scene_figure(means, covariances, seen_from=means[:2])
