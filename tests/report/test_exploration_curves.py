"""Curves and bars of explorations, compared with their rows."""

from __future__ import annotations

import numpy as np
import pytest
from exploration_rows import OBSERVABLE_BITS, planner_variants, protocol, trial
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from shown import texts

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.report.style import PALETTE, LineEnd, label_ends, new_figure
from gmmtorch.team.exploration.mission.results import mean_band, paired_interval
from gmmtorch.team.report.mission_bars import deviations_figure, summary_bars
from gmmtorch.team.report.mission_curves import bandwidth_figure, entropy_figure, planner_comparison_figure
from gmmtorch.team.report.trial_groups import (
    FRAMEWORKS,
    framework_colour,
    framework_name,
    seeds_note,
    study_summary,
)


def lines(axes: Axes, colour: str, n_points: int) -> list[np.ndarray]:
    """Heights of the lines of a colour that have so many points."""
    return [
        np.asarray(line.get_ydata())
        for line in axes.lines
        if to_hex(line.get_color()) == to_hex(colour) and len(line.get_ydata()) == n_points
    ]


def test_entropy_figure_draws_mean_and_band_over_seeds():
    rows = protocol(n_seeds=4)
    figure = entropy_figure(rows)
    axes = figure.axes[0]
    for place, framework in enumerate(FRAMEWORKS):
        left = [
            100 * np.array(r["entropy_bits"]) / OBSERVABLE_BITS for r in rows if r["framework"] == framework
        ]
        mean, low, high = mean_band(np.stack(left))
        (drawn,) = lines(axes, framework_colour(framework), len(mean))
        np.testing.assert_allclose(drawn, mean)
        corners = axes.collections[place].get_paths()[0].vertices
        np.testing.assert_allclose(corners[:, 1].max(), high.max())
        np.testing.assert_allclose(corners[:, 1].min(), low.min())
        assert framework_name(framework) in texts(axes)
    said = [text.get_text() for text in figure.legends[0].get_texts()]
    assert said == ["t50", "t90", "50 % and 90 % of E1's final reduction"]
    assert "mean of 4 seeds" in figure.get_suptitle()


def test_milestones_are_marked_only_if_every_seed_reached_them():
    rows = [trial("grid_shared", seed) for seed in range(3)]
    rows[0] |= {"t50": 100.0, "t90": None}
    rows[1] |= {"t50": 200.0, "t90": 700.0}
    rows[2] |= {"t50": 600.0, "t90": 800.0}
    axes = entropy_figure(rows).axes[0]
    marks = [line for line in axes.lines if line.get_marker() in ("o", "s")]
    assert [float(mark.get_xdata()[0]) for mark in marks] == [300.0]
    assert "t50 300 s, t90 in 2 of 3" in texts(axes)


def test_a_single_trial_has_lines_of_its_robots_and_no_band():
    row = trial("grid_isolated", 0, n_robots=2)
    axes = entropy_figure([row]).axes[0]
    assert len(axes.collections) == 0
    drawn = lines(axes, framework_colour("grid_isolated"), len(row["times"]))
    assert len(drawn) == 3
    for bits in row["entropy_bits_per_robot"]:
        assert any(np.allclose(line, 100 * np.array(bits) / OBSERVABLE_BITS) for line in drawn)


@pytest.mark.parametrize(("distance", "drawn"), [(1.0, 0), (3.0, 3)])
def test_maps_of_robots_are_drawn_and_named_only_if_they_differ_visibly(distance, drawn):
    row = trial("gmm_shared", 0)
    others = np.array(row["entropy_bits"]) + distance / 100 * OBSERVABLE_BITS
    row["entropy_bits_per_robot"] = [others.tolist()] * 3
    figure = entropy_figure([row])
    assert len(lines(figure.axes[0], framework_colour("gmm_shared"), len(row["times"]))) == 1 + drawn
    said = [text.get_text() for text in figure.legends[0].get_texts()]
    assert ("map of one robot" in said) is bool(drawn)


def test_bandwidth_labels_give_total_and_ratio_to_e0():
    row = trial("gmm_shared", 0)
    final = {"bytes_over_time": 50e3, "raw_points_bytes_over_time": 2e6, "octree_bytes_over_time": 150e3}
    for field, total in final.items():
        row[field] = np.linspace(0, total, len(row["times"])).tolist()
    row["draco_bytes_over_time"] = None
    alone = trial("grid_isolated", 0)
    figure = bandwidth_figure([row, alone])
    said = texts(figure.axes[0])
    assert "E0, as sent\n50.0 kB" in said
    assert "E0's novel points, raw\n2.00 MB, 40.0× E0" in said
    assert "zstd octree\n150 kB, 3.00× E0" in said
    assert "Draco" not in said
    assert "E2" not in said
    assert figure.axes[0].get_yscale() == "log"


@pytest.mark.parametrize("duration", [60.0, 1600.0])
def test_byte_axis_begins_at_the_first_bytes_sent(duration):
    rows = [trial(framework, 0, duration) for framework in ("gmm_shared", "grid_shared")]
    axes = bandwidth_figure(rows).axes[0]
    first = min(rows[0][f][1] for f in ("bytes_over_time", "octree_bytes_over_time"))
    assert first / 2 < axes.get_ylim()[0] < first
    assert rows[1]["bytes_over_time"][-1] < axes.get_ylim()[1] < 2 * rows[1]["bytes_over_time"][-1]
    rows[0]["octree_bytes_over_time"][1] = 1  # a single byte does not take the axis along
    assert bandwidth_figure(rows).axes[0].get_ylim()[0] > 10


def test_draco_label_gives_its_error():
    rows = [trial("gmm_shared", 0)]
    assert "same points, Draco, 3 cm RMS\n" in texts(bandwidth_figure(rows).axes[0])
    assert "Draco, 2.5 cm RMS\n" in texts(bandwidth_figure(rows, draco_error=0.025).axes[0])


def test_seeds_note_describes_seeds_and_missions():
    one, other = trial("gmm_shared", 3), trial("grid_shared", 3)
    assert seeds_note([one]) == "one mission of E0, seed 3"
    assert seeds_note([one, other]) == "one mission each, seed 3"
    assert seeds_note([one, {**other, "seed": 4}]) == "one mission each"
    assert seeds_note([{**one, "framework": "another_one"}]) == "one mission of another one, seed 3"
    assert seeds_note([one, {**one, "seed": 4}]).startswith("mean of 2 seeds")
    assert seeds_note([one, {**one, "seed": 4}, other]).startswith("mean of 1 to 2 seeds")


def test_planners_share_one_reference_reduction():
    rows = planner_variants(n_seeds=2)
    for row in rows:  # by its own reduction even a poor planner reaches 90 %
        row["reference_bits"], row["t90"] = row["entropy_reduction_bits"], 1.0
    axes = planner_comparison_figure(rows).axes[0]
    said = texts(axes)
    assert "random, CSQMI, prior 0.125\nt50" in said
    assert "t90 not reached" in said
    assert "MCTS, CSQMI, prior 0.5\n" in said
    assert "t90 1 s" not in said


def test_summary_draws_seeds_and_paired_differences():
    rows = protocol(n_seeds=3)
    figure = summary_bars(rows)
    assert [axes.get_title() for axes in figure.axes[:4]] == [
        "bytes sent",
        "t90",
        "AUC",
        "coverage per metre flown",
    ]
    auc, difference = figure.axes[2], figure.axes[6]
    dots = [line for line in auc.lines if line.get_marker() == "o"]
    assert [len(line.get_ydata()) for line in dots] == [3, 3, 3, 3]
    by = {f: np.array([r["auc"] for r in rows if r["framework"] == f]) for f in FRAMEWORKS}
    means = [float(line.get_ydata()[0]) for line in difference.lines if len(line.get_ydata()) == 2][1:]
    expected = [by["gmm_shared"] - by[name] for name in FRAMEWORKS if name != "gmm_shared"]
    assert len(means) == len(expected)  # four frameworks: the first beside the others
    for value in expected:
        assert any(np.isclose(mean, value.mean()) for mean in means)
    ratio = [float(line.get_ydata()[0]) for line in figure.axes[4].lines if len(line.get_ydata()) == 2][1]
    sent = {f: np.array([r["bytes_sent"] for r in rows if r["framework"] == f]) for f in FRAMEWORKS}
    assert ratio == pytest.approx(np.exp(np.log(sent["gmm_shared"] / sent["grid_shared"]).mean()))
    summary_bars([trial("grid_isolated", 0)]).canvas.draw()


def deviations(n_seeds: int = 3) -> list[dict]:
    """Trials of E0, of E0 without shell and of E0 of the thesis."""
    ours = {"codec": "quantized", "shell": 0.5, "update_stride": 11, "update_novel": False}
    thesis = {"codec": "thesis", "shell": 0.0, "update_stride": None, "update_novel": True}
    return [
        row
        for seed in range(n_seeds)
        for row in (
            trial("gmm_shared", seed, **ours),
            trial("gmm_shared", seed, pace=400 + 10 * seed, **{**ours, "shell": 0.0}),
            trial("gmm_shared", seed, pace=400, **{**ours, "update_stride": None}),
            trial("gmm_thesis", seed, **thesis),
        )
    ]


def test_deviations_are_drawn_as_paired_differences():
    rows = deviations()
    figure = deviations_figure(rows)
    entropy, t90, _, sent = figure.axes
    names = [text.get_text() for text in entropy.get_yticklabels()]
    assert names == ["E0, shell=0", "E0, update_stride=null", "thesis"]
    groups = [[row for row in rows if row["shell"] == 0.0 and row["framework"] == "gmm_shared"]]
    groups += [[row for row in rows if row["framework"] == "gmm_thesis"]]
    usual = rows[::4]
    for place, group in ((0, groups[0]), (2, groups[1])):
        change = np.array([row["t90"] for row in group]) - np.array([row["t90"] for row in usual])
        mean, low, high = paired_interval(change, np.zeros(3))
        (dot,) = (
            x
            for line in t90.lines
            if line.get_marker() == "o"
            for x, y in [line.get_xydata()[0]]
            if y == place
        )
        assert dot == pytest.approx(mean)
        (ends,) = (line.get_xdata() for line in t90.lines if list(line.get_ydata()) == [place, place])
        np.testing.assert_allclose(ends, [low, high])
    ratio = np.exp(
        np.mean([np.log(a["bytes_sent"] / b["bytes_sent"]) for a, b in zip(groups[1], usual, strict=True)])
    )
    assert any(
        line.get_marker() == "o" and line.get_xdata()[0] == pytest.approx(ratio) for line in sent.lines
    )
    with pytest.raises(InvalidArgumentError, match="rows contain one variant, E0;"):
        deviations_figure(usual)
    assert "E0, shell=0 − E0" in study_summary(rows)
    deviations_figure(rows[:4]).canvas.draw()  # one seed has no intervals
    rows[0]["t90"] = None
    assert [one.axes[1].get_title() for one in (figure, deviations_figure(rows))] == ["t90", "t50"]


def test_summary_draws_no_mean_if_a_seed_has_no_value():
    rows = [trial(framework, seed) for framework in ("gmm_shared", "grid_shared") for seed in range(3)]
    rows[0]["t90"] = None
    figure = summary_bars(rows)
    above, beneath = (figure.axes[i] for i in (1, 5))
    figure.draw_without_rendering()
    (note,) = (text for text in above.texts if text.get_text() == "2 of 3")
    box, dots = note.get_window_extent(), above.lines[0].get_xydata()
    assert box.y0 > above.transData.transform(dots)[:, 1].max()
    assert box.y1 < above.bbox.y1
    assert [len(line.get_ydata()) for line in above.lines if line.get_marker() == "o"] == [2, 3]
    assert len(beneath.lines) == 1  # the line at zero
    assert "none" in texts(beneath)


def test_line_end_labels_keep_order_and_do_not_overlap():
    figure = new_figure(6, 4)
    axes = figure.subplots()
    axes.set(xlim=(0, 1), ylim=(0, 100))
    label_ends(
        axes, [LineEnd(v, t, "k") for v, t in ((50, "b"), (50, "c"), (49, "a"), (90, "alone"), (0, "low"))]
    )
    heights = {text.get_text(): text.get_position()[1] for text in axes.texts}
    assert heights["a"] < heights["b"] < heights["c"]
    assert heights["alone"] == pytest.approx(0.9)
    assert heights["low"] > 0
    assert heights["a"] + heights["b"] + heights["c"] == pytest.approx(3 * 0.4966, abs=1e-2)


def test_frameworks_have_fixed_names_and_colours():
    assert [framework_colour(name) for name in FRAMEWORKS] == [*PALETTE[:3], PALETTE[5]]
    assert framework_name("gmm_shared") == "E0 shared mixtures"
    assert framework_name("another_one") == "another one"
    rows = [trial("gmm_shared", 0), {**trial("gmm_shared", 0), "framework": "another_one"}]
    entropy_figure(rows).canvas.draw()


def test_curve_errors_name_the_argument():
    for draw in (entropy_figure, bandwidth_figure, planner_comparison_figure, summary_bars):
        with pytest.raises(InvalidArgumentError, match="rows is empty"):
            draw([])
    with pytest.raises(InvalidArgumentError, match="observable_bits=0"):
        entropy_figure([trial("gmm_shared", 0, observable_bits=0.0)])
    with pytest.raises(InvalidArgumentError, match="no byte that was sent"):
        bandwidth_figure([trial("grid_isolated", 0)])
