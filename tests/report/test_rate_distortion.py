"""Leads of curves with known crossings, and the figure of codecs."""

from __future__ import annotations

import io
import math
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gmmtorch.errors import InvalidArgumentError

MODULE = runpy.run_path(
    str(Path(__file__).resolve().parents[2] / "benchmarks" / "rate_distortion_figures.py")
)
bytes_for, figures, leads = (MODULE[name] for name in ("bytes_for", "figures", "leads"))


def rows_of(curves: dict[str, list[tuple[float, float]]], dataset: str = "room") -> list[dict[str, Any]]:
    return [
        {"dataset": dataset, "codec": codec, "nbytes": nbytes, "psnr2_db": quality, "auc": quality}
        for codec, points in curves.items()
        for nbytes, quality in points
    ]


def test_lead_ends_at_the_crossing_of_curves():
    # In log2 bytes: ours 50 + 2 (x − 5), the other 44 + 4 (x − 5): equal at x = 8.
    curves = {"ours": [(32, 50.0), (1024, 60.0)], "octree": [(32, 44.0), (1024, 64.0)]}
    lead = leads(rows_of(curves), "psnr2_db")
    step = 5 / 399  # octaves
    assert lead.low == pytest.approx(32)
    assert lead.octaves == pytest.approx(3.0, abs=step)
    assert lead.high == pytest.approx(256, rel=2**step - 1)
    assert lead.most == pytest.approx(2**1.5)  # at x = 5 the other needs 6.5
    assert lead.ended_by == "octree"


def test_lead_compares_with_the_best_codec_that_is_not_left_out():
    curves = {
        "ours": [(100, 50.0), (800, 80.0)],
        "raw": [(12_000, math.inf)],
        "draco": [(200, 50.0), (1600, 80.0)],
        "octree": [(50, 40.0), (400, 80.0)],
    }
    both = leads(rows_of(curves), "psnr2_db")
    assert both.octaves == 0
    assert both.ended_by == "octree"
    alone = leads(rows_of(curves), "psnr2_db", left_out=("octree",))
    assert (alone.low, alone.high, alone.ended_by) == (pytest.approx(100), pytest.approx(800), "")
    assert alone.most == pytest.approx(2)
    assert leads(rows_of(curves), "psnr2_db", left_out=("octree", "draco")).most == pytest.approx(120)


def test_a_lead_is_measured_where_another_codec_reaches_the_quality():
    curves = {"ours": [(100, 50.0), (800, 80.0)], "octree": [(200, 50.0), (800, 70.0)]}
    lead = leads(rows_of(curves), "auc")
    assert (lead.low, lead.high) == (pytest.approx(100), pytest.approx(800))
    assert lead.most == pytest.approx(2)


def test_curves_skip_settings_that_a_smaller_one_beats():
    curves = {
        "ours": [(100, 50.0), (150, 40.0), (800, 80.0)],
        "octree": [(300, 50.0), (350, 45.0), (900, 80.0)],
    }
    without = {name: [points[0], points[2]] for name, points in curves.items()}
    assert leads(rows_of(curves), "auc") == leads(rows_of(without), "auc")


def test_lead_ignores_other_encodings_of_our_components():
    curves = {"ours": [(100, 50.0), (800, 80.0)], "ours_without_counts": [(90, 50.0), (700, 80.0)]}
    with pytest.raises(InvalidArgumentError, match="no other codec"):
        leads(rows_of(curves), "auc")
    with pytest.raises(InvalidArgumentError, match="'ours'"):
        leads(rows_of({"raw": curves["ours"]}), "auc")
    assert leads(rows_of({**curves, "thesis": [(700, 50.0), (5600, 80.0)]}), "auc").most == pytest.approx(7)


def test_bytes_for_a_quality_interpolate_logarithms():
    rows = rows_of({"octree": [(100, 50.0), (200, 60.0), (300, 55.0), (800, 70.0)]})
    for value, expected in ((40, 100), (50, 100), (55, 100 * 2**0.5), (60, 200), (65, 400), (70, 800)):
        assert bytes_for(rows, "octree", "auc", value) == pytest.approx(expected)
    assert bytes_for(rows, "octree", "auc", 70.1) == math.inf
    assert bytes_for(rows, "draco", "auc", 50) == math.inf


points = st.lists(
    st.tuples(st.integers(10, 100_000), st.floats(10, 100)), min_size=1, max_size=6, unique_by=lambda p: p[0]
)


@settings(max_examples=60)
@given(ours=points, octree=points, draco=points)
def test_no_other_setting_is_smaller_and_as_good_within_a_lead(ours, octree, draco):
    """Point by point: a setting of another within the lead, better than our curve there, contradicts it."""
    lead = leads(rows_of({"ours": ours, "octree": octree, "draco": draco}), "auc")
    if not lead.octaves:
        return
    front = [(b, q) for b, q in sorted(ours) if all(q > q2 for b2, q2 in ours if b2 < b)]
    bytes_, quality = np.log2([b for b, _ in front]), np.array([q for _, q in front])
    for nbytes, reached in octree + draco:
        if lead.low * 1.05 < nbytes < lead.high / 1.05:
            assert reached <= np.interp(math.log2(nbytes), bytes_, quality) + 1e-6 + _slope(bytes_, quality)


def _slope(bytes_: np.ndarray, quality: np.ndarray) -> float:
    """How much quality may change between two of the 400 rates that are looked at."""
    if len(bytes_) < 2:
        return 0.0
    return float((np.diff(quality) / np.diff(bytes_)).max() * (bytes_[-1] - bytes_[0]) / 399)


def test_rate_distortion_draws_codecs_and_shades_the_lead():
    curves = {
        "ours": [(100, 50.0), (800, 80.0)],
        "octree": [(400, 50.0), (900, 90.0)],
        "raw": [(12_000, math.inf)],
        "float": [(1000, 50.0), (8000, 80.0)],
    }
    figure = figures(rows_of(curves) + rows_of(curves, "hall"))["rate_distortion"]
    assert len(figure.axes) == 4
    for axes in figure.axes:
        assert [line.get_label() for line in axes.lines] == ["mixture (gmmtorch)", "octree, zstd"]
        assert len(axes.patches) == 1
        assert any("octaves" in text.get_text() for text in axes.texts)
    figure.savefig(io.BytesIO(), dpi=40)
