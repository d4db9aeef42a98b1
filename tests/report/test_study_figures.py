"""Figures of the occupancy studies, and the regions they select."""

from __future__ import annotations

import pytest
import torch

from gmmtorch.experiments.report import map_study_figures
from gmmtorch.report.map_images import busiest_regions


def memory_rows() -> list[dict]:
    sizes = [("point", n, 0.98 + 0.005 * i, 16 * n) for i, n in enumerate((100, 300, 1000))]
    sizes += [("bgk_points", n, 0.93 + 0.02 * i, 13 * n) for i, n in enumerate((500, 5000))]
    sizes += [("occupancy_grid", None, 0.985, 2_000_000)]
    return [
        {
            "dataset": "hall",
            "method": method,
            "size": size,
            "resolution": 0.2,
            "auc": auc,
            "auc_low": auc - 0.001,
            "auc_high": auc + 0.001,
            "nbytes": nbytes,
        }
        for method, size, auc, nbytes in sizes
    ]


def test_auc_memory_draws_each_method_through_its_sizes():
    (figure,) = map_study_figures.auc_memory_figures(memory_rows()).values()
    (axes,) = figure.axes
    lines = {line.get_label(): line for line in axes.lines if not line.get_label().startswith("_")}
    assert list(lines) == ["point", "bgk points", "occupancy grid"]
    assert lines["point"].get_xdata().tolist() == [1600, 4800, 16000]
    assert lines["point"].get_ydata().tolist() == pytest.approx([0.98, 0.985, 0.99])
    assert {text.get_text() for text in axes.texts} == {"100", "300", "1,000", "500", "5,000"}
    assert axes.get_xscale() == "log"


def test_variance_threshold_draws_bars_of_the_first_resolution_and_threshold():
    rows = [
        {
            "dataset": "hall",
            "method": method,
            "n_components": n,
            "resolution": h,
            "prior": prior,
            "variance_threshold": v,
            "occupied_recall": v,
            "thin_recall": None,
            "thin_kept": 0.5,
            "free_recall": 0.75 if prior is None else 0.25,
        }
        for method, n in (("counts", None), ("point", 200))
        for h in (0.1, 0.2)
        for prior in (1.0, None)
        for v in (0.06, 0.2)
    ]
    (figure,) = map_study_figures.variance_threshold_figures(rows).values()
    thin, kept, hits, free = figure.axes
    assert not thin.patches
    assert [bar.get_height() for bar in kept.patches] == [0.5] * 4
    assert [bar.get_height() for bar in hits.patches] == [0.06] * 4
    assert [bar.get_height() for bar in free.patches] == [0.25, 0.25, 0.75, 0.75]
    labels = [text.get_text() for text in free.get_xticklabels()]
    assert labels == ["counted rays", "point,\n200 components"]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [
        "counts, prior 1",
        "calibrated",
    ]


def test_cells_figure_draws_the_cells_of_each_mask(generator):
    def masks(centers: torch.Tensor) -> dict[str, torch.Tensor]:
        return {"low": centers[:, 2] < 0.5, "all": torch.ones(len(centers), dtype=torch.bool)}

    hits = torch.rand(100, 3, generator=generator, dtype=torch.float64)
    box = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    figure = map_study_figures.cells_figure({20: masks}, hits, *box, 0.1)
    titles = [axes.get_title() for axes in figure.axes[:3]]
    assert titles == ["20 components:\nheld-out points", "low", "all"]
    assert figure.axes[3].get_ylabel() == "height z [m]"
    shares = [(axes.get_images()[0].get_array()[..., 3] > 0).mean() for axes in figure.axes[:3]]
    assert 0 < shares[1] < shares[2]  # more cells cover more of the picture
    for axes in figure.axes[:3]:
        assert {"x [m]", "y [m]"} < {text.get_text() for text in axes.texts}


def test_closest_look_contains_the_most_thin_points():
    thin = torch.tensor([[x, 9.0, 1.0] for x in torch.linspace(8.2, 9.8, 50)] + [[1.0, 1.0, 1.0]])
    hits = torch.cat([thin, torch.tensor([[9.0, 9.0, 3.0]])]).double()
    low, high = map_study_figures.closest_look(thin.double(), hits)
    assert low[:2] == (8.0, 8.0)
    assert high[:2] == (12.0, 12.0)
    assert low[2] == pytest.approx(0.8, abs=0.02)
    assert high[2] > 2.5


def test_busiest_regions_contain_the_most_surface_and_are_not_adjacent(generator):
    def uniform(n: int) -> torch.Tensor:
        return torch.rand(n, 2, generator=generator, dtype=torch.float64)

    sparse, dense, denser = uniform(50) * 100, 20 + 10 * uniform(2000), 70 + 10 * uniform(4000)
    stacked = torch.full((50_000, 2), 45.0, dtype=torch.float64)  # one place, however often it was measured
    points = torch.cat([sparse, dense, denser, stacked])
    assert busiest_regions(points, 2, 10.0) == [((70.0, 70.0), (80.0, 80.0)), ((20.0, 20.0), (30.0, 30.0))]
    assert busiest_regions(points, 0) == [] == busiest_regions(torch.empty(0, 2), 3)
    assert len(busiest_regions(torch.zeros(5, 2), 3)) == 1
