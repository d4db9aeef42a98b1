"""Thin structures and variance thresholds: hand counts, a rail of known width, a simulated railing."""

from __future__ import annotations

from functools import partial

import pytest
import torch

from gmmtorch import GaussianMap, IncrementalRule, Scan
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.studies.study_options import COUNTS, VarianceThresholdStudy
from gmmtorch.experiments.studies.variance_threshold import (
    cells_by_setting,
    decided,
    is_of_railing,
    railing_scans,
    run_variance_threshold,
    seen_past,
)
from gmmtorch.occupancy import Calibration, PointEvidence, SparseEvidence, probability


def test_decided_matches_a_hand_count():
    occupied = torch.tensor([0.99, 0.97, 0.6, 0.4, 0.01], dtype=torch.float64)
    free = torch.tensor([0.02, 0.3, 0.5, 0.98], dtype=torch.float64)
    thin = torch.tensor([0.96, 0.6, 0.3, 0.01], dtype=torch.float64)
    # v = 0.0475: free below 0.05, occupied above 0.95.
    assert decided(occupied, free, thin, 0.0475) == {
        "share_decided": 5 / 9,
        "accuracy_decided": 3 / 5,
        "occupied_recall": 2 / 5,
        "thin_recall": 1 / 4,
        "thin_kept": 3 / 4,
        "free_recall": 1 / 4,
        "free_occupied": 1 / 4,
    }
    nothing = decided(torch.full((2,), 0.5), torch.full((2,), 0.5), torch.zeros(0), 0.06)
    assert nothing["accuracy_decided"] is None
    assert nothing["thin_recall"] is None


def test_beams_pass_rails_and_not_walls():
    for scan in railing_scans(0.04, 3, seed=1):
        found, truth = seen_past(scan, 0.3), is_of_railing(scan, 0.04)
        assert truth.sum() > 50
        assert truth[found].double().mean() > 0.95
        assert found[truth].double().mean() > 0.5  # not where posts, bars and floor meet


def test_thin_structures_of_a_laser_are_passed_on_both_sides():
    angle = torch.linspace(-0.5, 0.5, 201, dtype=torch.float64)
    reading = torch.full_like(angle, 5.0)
    reading[100:103] = 2.0  # a pole of about 3 cm
    reading[170:] = 2.0  # the edge of a wall
    points = reading[:, None] * torch.stack([angle.cos(), angle.sin()], 1)
    thin = seen_past(Scan(points, torch.zeros(2)), 0.3)
    assert thin.nonzero().flatten().tolist() == [100, 101, 102]
    far = reading > 4
    open_sky = Scan(points[~far], torch.zeros(2), points[far])
    assert seen_past(open_sky, 0.3).nonzero().flatten().tolist() == [0, 1, 2]
    assert not bool(seen_past(Scan(points[:0], torch.zeros(2), points), 0.3).any())


@pytest.mark.parametrize("width", [0.02, 0.04])
def test_the_occupancy_of_a_rail_cell_follows_from_its_width(width):
    """docs/occupancy.md: by counts θ = w/h."""
    side, depth, n = 0.1, 3.0, 100_000
    height = (torch.arange(n, dtype=torch.float64) + 0.5) / n * side
    on_rail = (height - 0.5 * side).abs() < 0.5 * width
    ends = torch.stack([torch.where(on_rail, 1.05, depth), height], 1)
    lattice = SparseEvidence(side, 2)
    lattice.add_rays(torch.stack([torch.zeros(n), height], 1), ends)
    evidence = PointEvidence(*lattice.at_points(torch.tensor([[1.05, 0.05]], dtype=torch.float64)))
    hits, misses = evidence
    assert float(probability(hits, misses, side, 2, 0.0)) == pytest.approx(width / side, abs=1e-3)
    known = Calibration.prior(10.0).probability(hits, misses, side, 2)
    assert float(known) > 0.9  # a beam that ends here says more than one that passes beside the rail


def test_a_larger_threshold_decides_more_points_and_calibration_keeps_the_rail():
    study = VarianceThresholdStudy(
        method=(COUNTS, "point"), n_components=(20, 80), resolution=(0.2,), prior=(1.0, None), test_every=4
    )

    def new_map(n: int) -> GaussianMap:
        return GaussianMap(window=4, learning=IncrementalRule(n_components=n))

    scans, is_thin = railing_scans(0.04, 5, seed=0), partial(is_of_railing, width=0.04)
    found = run_variance_threshold("railing", scans, new_map, study, is_thin=is_thin)
    assert [row["n_components"] for row in found.rows[:4]] == [None] * 4
    assert len(found.rows) == 3 * 2 * 2
    for strict, loose in zip(found.rows[::2], found.rows[1::2], strict=True):
        assert strict["share_decided"] < loose["share_decided"]
        assert strict["occupied_recall"] <= loose["occupied_recall"]
    for rows in (found.rows[:4], found.rows[4:8], found.rows[8:]):
        counts, known = rows[0], rows[2]
        assert (counts["prior"], known["prior"]) == (1.0, None)
        assert counts["thin_recall"] == 0
        assert known["thin_kept"] > counts["thin_kept"]
        assert known["brier"] < counts["brier"]
    centers = torch.cartesian_prod(*[torch.arange(-1, 1, 0.2, dtype=torch.float64)] * 3)
    drawn = cells_by_setting(found, study)
    assert list(drawn) == [20, 80]
    occupied, kept, *_ = drawn[80](centers).values()
    assert bool((kept | ~occupied).all())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n_components": ()}, r"n_components=\[\] is empty"),
        ({"railing": 0.0}, "railing=0"),
    ],
)
def test_invalid_options_raise(options, message):
    with pytest.raises(InvalidArgumentError, match=message):
        VarianceThresholdStudy(**options)
