"""Maps in space: which cells are asked, what is drawn and what hides the inside."""

from __future__ import annotations

import itertools

import numpy as np
import torch
from matplotlib.axes import Axes

from gmmtorch.mapping.components import Components
from gmmtorch.report import scenes
from gmmtorch.report.scenes import OccupancyPanel, cells_near, map_scene_figure


def test_cells_near_points_are_those_of_a_search(generator):
    points = torch.randn(30, 3, generator=generator, dtype=torch.float64)
    centres, side = cells_near(points, 0.25)
    expected = {
        tuple(cell + np.array(offset))
        for cell in np.floor(points.numpy() / 0.25).astype(int)
        for offset in itertools.product(range(-2, 3), repeat=3)
    }
    assert side == 0.25
    assert {tuple(cell) for cell in (centres / 0.25 - 0.5).round().long().tolist()} == expected


def test_cells_are_larger_if_there_are_too_many(monkeypatch, generator):
    monkeypatch.setattr(scenes, "_MAX_CELLS", 500)
    points = 5 * torch.rand(1000, 3, generator=generator, dtype=torch.float64)
    centres, side = cells_near(points, 0.25)
    assert side in (0.5, 1.0, 2.0, 4.0)
    assert len(centres) <= 500


def room() -> tuple[torch.Tensor, Components]:
    """Points and components of the floor, the north wall and the south wall of a room of 4 m × 4 m, observed
    from its middle."""
    along = torch.arange(0.25, 4, 0.5, dtype=torch.float64)
    u, v = torch.cartesian_prod(along, along).unbind(1)
    zero = torch.zeros_like(u)
    means = torch.stack([torch.stack(m, 1) for m in ((u, v, zero), (u, zero + 4, v / 2), (u, zero, v / 2))])
    variances = torch.tensor([[4e-2, 4e-2, 1e-5], [4e-2, 1e-5, 1e-2], [4e-2, 1e-5, 1e-2]]).double()
    k = means[..., 0].numel()
    components = Components(
        means=means.flatten(0, 1),
        covariances=torch.diag_embed(variances).repeat_interleave(len(u), 0),
        support=torch.ones(k),
        max_range=torch.zeros(k, dtype=torch.bool),
        ids=torch.zeros(k, 2, dtype=torch.int64),
        origins=[[2.0, 2.0, 1.0]],
        seen_by=torch.arange(k),
        seen_from=torch.zeros(k, dtype=torch.int64),
        seen_count=torch.ones(k),
    )
    return components.means, components


def drawn(axes: Axes) -> int:
    """Number of pixels of a panel that show something."""
    return int((axes.get_images()[0].get_array()[..., 3] > 0).sum())


def test_panels_show_points_components_and_the_occupied_cells_of_each_map():
    points, components = room()
    maps = [
        OccupancyPanel("north wall", lambda at: 0.66 * (at[:, 1] > 3.9)),
        OccupancyPanel("south wall", lambda at: 0.66 * ((at[:, 1].abs() < 0.2) & (at[:, 2] > 0.4))),
        OccupancyPanel("unknown", lambda at: torch.full((len(at),), 0.5), 0.1),
        OccupancyPanel("not sure", lambda at: torch.full((len(at),), 0.64)),
    ]
    figure = map_scene_figure(points, components.origins, maps, 0.25, components, title="room")
    panels = [axes for axes in figure.axes if axes.get_images()]
    titles = ["measured: 192 points, 2.30 kB", "surfaces of the map: 192 components"]
    assert [axes.get_title() for axes in panels] == [*titles, *(one.title for one in maps)]
    pixels = [drawn(axes) for axes in panels]
    path = pixels[-1]  # cells with θ < 0.65 are not drawn
    assert pixels[-2] == path
    assert pixels[0] > path > 0
    assert pixels[2] > 10 * path  # the far wall
    assert pixels[3] == path  # the near wall, which would hide the room, is left out
    assert pixels[1] > pixels[2]


def test_maps_without_components_or_points_are_drawn():
    nothing = torch.empty(0, 3, dtype=torch.float64)
    panel = OccupancyPanel("empty", lambda at: torch.full((len(at),), 0.5))
    figure = map_scene_figure(nothing, nothing, [panel], 0.25)
    assert [axes.get_title() for axes in figure.axes if axes.get_images()] == [
        "measured: 0 points, 0 B",
        "empty",
    ]
    figure = map_scene_figure(nothing, nothing, [panel], 0.25, Components.empty(3))
    figure.canvas.draw()
