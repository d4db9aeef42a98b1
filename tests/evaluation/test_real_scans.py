"""AUC of mixture and grid on real scans."""

from __future__ import annotations

from pathlib import Path

import pytest

from gmmtorch import GaussianMap, Scan
from gmmtorch.datasets import load
from gmmtorch.experiments.evaluation.held_out import Protocol, choose, evaluate, methods

pytestmark = [pytest.mark.real_data, pytest.mark.slow]

Scores = dict[tuple[str, float, float], float]


def scores(scans: list[Scan], protocol: Protocol) -> Scores:
    """AUC by method, share kept and resolution."""
    chosen = choose(["occupancy_grid", "monte_carlo"], methods(GaussianMap))
    rows = evaluate("real", scans, chosen, protocol).rows
    return {(row["method"], row["kept"], row["resolution"]): row["auc"] for row in rows}


@pytest.fixture
def intel(real_data: Path) -> list[Scan]:
    path = real_data / "laser2d" / "intel.log.gz"
    if not path.is_file():
        pytest.skip(f"{path} is not there")
    return list(load("carmen", path))


@pytest.fixture
def hall(real_data: Path) -> list[Scan]:
    path = real_data / "hall"
    if not path.is_dir():
        pytest.skip(f"{path} is not there")
    pytest.importorskip("open3d", exc_type=ImportError)
    return list(load("scan_folder", path))


def test_mixture_matches_the_grid_on_intel_and_beats_it_on_a_tenth_of_the_beams(intel):
    auc = scores(intel, Protocol(test_every=10, kept=(1.0, 0.1), resolution=(0.1,)))
    grid = auc["occupancy_grid", 1.0, 0.1]
    assert grid == pytest.approx(0.974, abs=0.003)
    assert auc["monte_carlo", 1.0, 0.1] >= grid - 0.0005
    assert auc["monte_carlo", 0.1, 0.1] >= auc["occupancy_grid", 0.1, 0.1] + 0.003


def test_mixture_matches_the_grid_in_the_hall(hall):
    auc = scores(hall, Protocol(test_every=5, resolution=(0.2,)))
    assert auc["monte_carlo", 1.0, 0.2] >= auc["occupancy_grid", 1.0, 0.2] - 0.001
