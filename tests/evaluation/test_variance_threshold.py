"""Variance thresholds on thin structures: hand counts, and detection of thin structures."""

from __future__ import annotations

import pytest
import torch
from evaluation.pillar_room import room_scans

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.evaluation.studies.study_options import VarianceThresholdStudy
from gmmtorch.evaluation.studies.variance_threshold import decided, on_lines, run
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mapping.learning.rules import WindowedRule


def test_decided_matches_a_hand_count():
    occupied = torch.tensor([0.99, 0.97, 0.6, 0.4, 0.01], dtype=torch.float64)
    free = torch.tensor([0.02, 0.3, 0.5, 0.98], dtype=torch.float64)
    thin = torch.tensor([True, False, True, False, False])
    # v = 0.0475: free below 0.05, occupied above 0.95.
    assert decided(occupied, free, thin, 0.0475) == {
        "share_decided": 5 / 9,
        "accuracy_decided": 3 / 5,
        "occupied_recall": 2 / 5,
        "thin_recall": 1 / 2,
        "free_recall": 1 / 4,
    }
    nothing = decided(torch.full((2,), 0.5), torch.full((2,), 0.5), torch.zeros(2, dtype=torch.bool), 0.06)
    assert nothing["accuracy_decided"] is None
    assert nothing["thin_recall"] is None


def test_rails_are_thin_and_walls_are_not(generator):
    def uniform(n: int, d: int) -> torch.Tensor:
        return torch.rand(n, d, generator=generator, dtype=torch.float64)

    wall = torch.cat([uniform(4000, 2) * 3, torch.zeros(4000, 1, dtype=torch.float64)], 1)
    rail = torch.cat([uniform(300, 1) * 3, torch.full((300, 2), 2.0, dtype=torch.float64)], 1)
    rail = rail + 0.01 * torch.randn(rail.shape, generator=generator, dtype=torch.float64)
    lone = torch.tensor([[50.0, 50, 50]], dtype=torch.float64)
    thin = on_lines(torch.cat([wall, rail, lone]), 0.4)
    assert thin[4000:4300].double().mean() > 0.95
    inner = ((wall[:, :2] > 0.4) & (wall[:, :2] < 2.6)).all(1)
    assert not bool(thin[:4000][inner].any())
    assert not bool(thin[-1])


def test_on_lines_does_not_depend_on_chunks_order_or_translation(generator, monkeypatch):
    rail = torch.rand(150, 3, generator=generator, dtype=torch.float64) * torch.tensor([5.0, 0.08, 0.05])
    blob = 9 + torch.rand(50, 3, generator=generator, dtype=torch.float64)
    points = torch.cat([rail, blob])
    whole = on_lines(points, 0.4)
    assert bool(whole.any())
    assert not bool(whole.all())
    monkeypatch.setattr("gmmtorch.evaluation.studies.variance_threshold._CHUNK", 7)
    assert torch.equal(on_lines(points, 0.4), whole)
    order = torch.randperm(200, generator=generator)
    assert torch.equal(on_lines(points[order] + 1000, 0.4), whole[order])


def test_a_larger_threshold_decides_more_points():
    study = VarianceThresholdStudy(
        n_components=(5, 20), variance_threshold=(0.06, 0.2), resolution=0.2, test_every=4
    )

    def new_map(n: int) -> GaussianMap:
        return GaussianMap(window=20, learning=WindowedRule(n_components=n))

    found = run("room", room_scans(12, dim=3, n_beams=400), new_map, study)
    cases = [(row["n_components"], row["variance_threshold"]) for row in found.rows]
    assert [v for _, v in cases] == [0.06, 0.2, 0.06, 0.2]
    assert cases[0][0] < cases[2][0]
    for strict, loose in zip(found.rows[::2], found.rows[1::2], strict=True):
        assert strict["share_decided"] < loose["share_decided"]
        assert strict["occupied_recall"] <= loose["occupied_recall"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n_components": ()}, r"n_components=\[\] is empty"),
        ({"method": "grid"}, "method='grid'"),
        ({"variance_threshold": (0.3,)}, "variance_threshold=0.3"),
        ({"thin_radius": 0.0}, "thin_radius=0"),
        ({"resolution": -1.0}, "resolution=-1"),
        ({"test_every": 1}, "test_every=1"),
    ],
)
def test_invalid_options_raise(options, message):
    with pytest.raises(InvalidArgumentError, match=message):
        VarianceThresholdStudy(**options)
