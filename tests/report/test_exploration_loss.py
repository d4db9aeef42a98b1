"""The figure of unreliable networks, and the names of variants."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from exploration_rows import OBSERVABLE_BITS, networks, trial
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from shown import texts

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.report.style import PALETTE
from gmmtorch.team.exploration.mission.results import mean_band
from gmmtorch.team.report import by_variant, loss_figure

CUT = {"begin": 60.0, "end": 120.0, "groups": [[0], [1, 2]]}


def line(axes: Axes, index: int, n_points: int) -> np.ndarray:
    """Heights of the one curve of a colour."""
    (found,) = (
        np.asarray(drawn.get_ydata())
        for drawn in axes.lines
        if to_hex(drawn.get_color()) == to_hex(PALETTE[index]) and len(drawn.get_ydata()) == n_points
    )
    return found


def smooth(share: np.ndarray, times: np.ndarray) -> np.ndarray:
    """The median of a thirtieth of the mission around each time."""
    half = times[-1] / 60
    return np.array([np.median(share[np.abs(times - t) <= half + 1e-6]) for t in times])


def test_loss_panels_draw_mean_and_band_of_each_variant():
    rows = networks(n_seeds=3)
    figure = loss_figure(rows)
    series = (
        lambda row: 100 * np.array(row["entropy_bits"]) / OBSERVABLE_BITS,
        lambda row: np.array(row["wire_bytes_over_time"]),
        lambda row: smooth(100 * np.array(row["missing_share"]), np.array(row["times"])),
    )
    left, sent, *multiples = figure.axes
    assert len(multiples) == 5
    for index in range(5):
        lacking = multiples[index]
        for axes, values, band in (
            (left, series[0], index),
            (sent, series[1], index),
            (lacking, series[2], 0),
        ):
            trials = np.stack([values(row) for row in rows[index::5]])
            mean, low, high = mean_band(trials)
            np.testing.assert_allclose(line(axes, index, len(mean)), mean)
            corners = axes.collections[band].get_paths()[0].vertices[:, 1]
            assert corners.max() == pytest.approx(min(high.max(), 100) if axes is lacking else high.max())
            assert corners.min() == pytest.approx(max(low.min(), 0) if axes is lacking else low.min())
    assert len(lacking.lines) == 1  # of one mission alone every number is drawn
    assert "3 robots" in figure.get_suptitle()
    assert "mean of 3 seeds" in figure.get_suptitle()


def test_loss_labels_give_times_bytes_and_ratios():
    rows = networks(n_seeds=2)
    for k, row in enumerate(rows):
        row |= {"t90": 200.0 + k // 5, "t90_ratio": 1.5, "wire_ratio": 2.0, "map_disagreement": 0.003}
    rows[3]["t90"] = None  # half lost, seed 0
    rows[2]["t90_ratio"] = None
    figure = loss_figure(rows)
    left, sent = (texts(axes) for axes in figure.axes[:2])
    lacking = "\n".join(axes.get_title() for axes in figure.axes[2:])
    assert "lossless\nt90 200 s\n" in left
    assert "10 % lost\nt90 200 s, 1.50×" in left
    assert "30 % lost\nt90 200 s\n" in left  # one seed has no companion
    assert "50 % lost\nt90 in 1 of 2" in left
    total = np.mean([rows[i]["wire_bytes_over_time"][-1] for i in (3, 8)])
    assert f"50 % lost\n{total / 1e6:.2f} MB, 2.00×" in sent
    assert "partition 0 | 1 2, 60\N{EN DASH}120 s\n0.3 % of cells differ\ncomplete after 10 s" in lacking
    assert "lossless\n0.3 % of cells differ" in lacking


def test_partitions_are_shaded_from_begin_to_end():
    figure = loss_figure(networks(n_seeds=1))
    *whole, cut = figure.axes[2:]
    for axes in (*figure.axes[:2], cut):
        (shade,) = axes.patches
        assert (shade.get_x(), shade.get_width()) == (60, 60)
    for axes in figure.axes[:2]:
        assert texts(axes).count("partition\n") + texts(axes).endswith("partition") >= 1
    assert not any(axes.patches for axes in whole)
    (axes, *_) = loss_figure(networks(n_seeds=1)[:4]).axes
    assert not axes.patches


def test_missing_records_of_a_single_mission_are_drawn_raw_and_smoothed():
    row = networks(n_seeds=1)[2]
    row["missing_share"] = [0.5 if i % 10 == 5 else 0.01 for i in range(len(row["times"]))]
    figure = loss_figure([row])
    lacking = figure.axes[2]
    smoothed, every = (np.asarray(drawn.get_ydata()) for drawn in lacking.lines)
    np.testing.assert_allclose(smoothed, 1)
    np.testing.assert_allclose(every, 100 * np.array(row["missing_share"]))
    assert "one mission of E0, seed 0" in figure.get_suptitle()


@pytest.mark.parametrize("n", [1, 6])
def test_loss_panels_do_not_overlap_for_any_number_of_variants(n):
    rows = [{**networks(n_seeds=1)[0], "loss": 0.05 * i} for i in range(n)]
    figure = loss_figure(rows)
    figure.canvas.draw()
    shown = [axes for axes in figure.axes if axes.get_visible()]
    assert len(shown) == 2 + n
    boxes = [axes.get_window_extent() for axes in shown]
    assert all(not a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])


def test_loss_figure_accepts_a_mission_without_missing_records():
    row = networks(n_seeds=1)[0]
    row |= {"missing_share": [0.0] * len(row["times"]), "map_disagreement": None, "t90": None}
    figure = loss_figure([row])
    assert all(np.max(drawn.get_ydata()) == 0 for drawn in figure.axes[2].lines)
    assert "lossless\nt90 not reached" in texts(figure.axes[0])


@pytest.mark.parametrize(
    ("options", "names"),
    [
        ([{"loss": 0.0}, {"loss": 0.125}], ["lossless", "12.5 % lost"]),
        ([{}, {"partitions": [CUT]}], ["lossless", "partition 0 | 1 2, 60\N{EN DASH}120 s"]),
        ([{"budget": None}, {"budget": 2000.0}], ["no budget", "budget 2.00 kB/s"]),
        ([{"bandwidth": None}, {"bandwidth": 2e4, "loss": 0.1}], ["no limit", "20.0 kB/s, 10 % lost"]),
        ([{"reach": 15.0}, {"duplication": 0.2}], ["reach 15 m", "20 % duplicated, any reach"]),
        ([{"jitter": 0.0}, {"jitter": 0.02}], ["jitter 0 s", "jitter 0.02 s"]),
        ([{"codec": "float"}, {"codec": "thesis"}], ["codec=float", "codec=thesis"]),
        ([{"framework": "grid_shared"}, {"loss": 0.1}], ["E1, lossless", "E0, 10 % lost"]),
        ([{"planner": "mcts"}], ["MCTS"]),
    ],
)
def test_variant_names_list_the_options_that_differ(options: list[dict[str, Any]], names: list[str]):
    plain = {"loss": 0.0, "partitions": [], "duplication": 0.0, "reach": None, "bandwidth": None}
    rows = [{**trial("gmm_shared", seed, 20), **plain, **option} for seed in (0, 1) for option in options]
    groups = by_variant(rows)
    assert list(groups) == names
    assert [[row["seed"] for row in trials] for trials in groups.values()] == [[0, 1]] * len(names)


def test_loss_errors_name_the_argument():
    with pytest.raises(InvalidArgumentError, match="rows is empty"):
        loss_figure([])
    with pytest.raises(InvalidArgumentError, match="wire_bytes_over_time, missing_share"):
        loss_figure([trial("gmm_shared", 0, 20)])
    row = {**networks(n_seeds=1)[0], "observable_bits": 0.0}
    with pytest.raises(InvalidArgumentError, match="observable_bits above zero"):
        loss_figure([row])
