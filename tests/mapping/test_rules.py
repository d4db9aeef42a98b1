"""Learning rules: files keep them, and invalid options are refused by name."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from evaluation.pillar_room import room_scans
from hypothesis import given
from hypothesis import strategies as st
from invalid_values import each_value
from torch import Tensor

from gmmtorch import Components, GaussianMap, IncrementalRule, NoveltyRule, Scan, WindowedRule
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mapping.learning.fitting import DepthFrame, fit_window
from gmmtorch.mapping.learning.merging import all_origins
from gmmtorch.mapping.learning.rules import read_rule, rule_facts
from gmmtorch.mapping.learning.windows import surface_fit
from gmmtorch.mixture import Parameters, density_share, measured_sensor

MIXTURE = {
    "prune": ["weight"],
    "min_support": [-1.0],
    "min_density_share": [math.nan],
    "learner": ["tree"],
    "planarity": [0.0, 2.0],
    "free_points": [-1, 0.5],
    "forget": ["never", True, -1.0, 0.0, math.nan, math.inf, None],
}
INVALID = {
    WindowedRule: {
        **MIXTURE,
        **dict.fromkeys(("noise", "length", "min_points"), (0, -1, math.nan)),
        **dict.fromkeys(("n_components", "max_origins", "iterations", "max_cells"), (0, -1)),
        "dtype": ["float16"],
    },
    IncrementalRule: {
        **MIXTURE,
        "noise": [0.0],
        "length": [math.nan],
        "cell": [math.inf],
        **dict.fromkeys(("window", "window_components", "iterations", "max_bytes", "max_origins"), (0,)),
        "n_components": [0],
        "mean_origins": [0.5],
        "max_cost": [1.0, -0.1],
    },
    NoveltyRule: {
        "resolution": [0.0],
        "threshold": [-1.0, math.nan],
        "observed": [math.inf],
        "prior": [-1.0],
        "cutoff": [0.0],
        "explained": [0.0],
        "distance": [-0.1],
        "distance_for": ["some"],
    },
}


@pytest.mark.parametrize(
    ("rule", "name", "value"),
    [(rule, *case) for rule, table in INVALID.items() for case in each_value(table)],
)
def test_invalid_options_are_named(rule, name, value):
    with pytest.raises(InvalidArgumentError, match=f"^{name}="):
        rule(**{name: value})


@given(st.sampled_from(["none", "support", "density"]), st.sampled_from(["flat_pieces", "hierarchical"]))
def test_rules_are_written_and_read(prune, learner):
    for rule in (
        IncrementalRule(prune=prune, learner=learner, free_points=2),
        WindowedRule(prune=prune, learner=learner, planarity=0.01),
    ):
        assert read_rule(**rule_facts(rule)) == rule
    assert set(rule_facts(IncrementalRule())) == {"kind"}


# -- learners of a window ------------------------------------------------------------------------------


dims = pytest.mark.parametrize("dim", [2, 3])
RULE = IncrementalRule(noise=0.02, length=0.3, cell=0.05, window=4)


def scans_of(dim: int, n: int = 4) -> list[Scan]:
    return room_scans(n, dim=dim, n_beams=300)


def learned(scans: list[Scan], **options: Any) -> Components:
    rule = IncrementalRule(**{"noise": 0.02, "length": 0.3, "cell": 0.05, "window": 4, **options})
    return fit_window(scans, surface_fit(rule, scans[0].dim), all_origins())


def counts_of(components: Components) -> Tensor:
    counts = torch.zeros(len(components), len(components.origins)).double()
    return counts.index_put_((components.seen_by, components.seen_from), components.seen_count)


@dims
def test_pruning_by_support_keeps_the_components_of_enough_points(dim):
    scans = scans_of(dim)
    plain, pruned = learned(scans), learned(scans, prune="support", min_support=12.0)
    kept = plain.max_range | (plain.support >= 12)
    assert int((~kept).sum()) > 0
    torch.testing.assert_close(pruned.means, plain.means[kept])
    torch.testing.assert_close(
        pruned.support[~pruned.max_range].sum(), plain.support[kept & ~plain.max_range].sum()
    )


@dims
def test_pruning_by_density_keeps_the_components_that_are_dense_for_the_scan(dim):
    scans = scans_of(dim)
    plain, pruned = learned(scans), learned(scans, prune="density", min_density_share=0.5)
    largest = max(scans, key=lambda scan: len(scan.points))
    sensor = measured_sensor(largest.points, largest.origin)
    mixture = Parameters(plain.support, plain.means, plain.covariances)
    share = density_share(plain.support, mixture, sensor, plain.origins, counts_of(plain))
    # Of components without points of their own, the window knows nothing; near the limit, rounding decides.
    kept = plain.max_range | (share >= 0.5)
    sure = ((share - 0.5).abs() > 0.02) | plain.max_range
    distance = torch.cdist(plain.means[sure], pruned.means).amin(1)
    assert torch.equal(distance < 1e-6, kept[sure])
    assert 0 < int((~kept).sum()) < len(plain)


@dims
@pytest.mark.parametrize("prune", ["support", "density"])
def test_a_window_may_lose_all_components(dim, prune):
    found = learned(scans_of(dim), prune=prune, min_support=1e9, min_density_share=1e9)
    assert bool(found.max_range.all())
    made = GaussianMap(WindowedRule(prune=prune, min_support=1e9, min_density_share=1e9, window=1))
    made.insert(Scan(scans_of(dim)[0].points, scans_of(dim)[0].origin))
    assert made.n_components == 0


@dims
@pytest.mark.parametrize("options", [{}, {"planarity": 0.05}, {"prune": "support"}, {"prune": "density"}])
def test_a_tree_learns_all_points_of_a_window(dim, options):
    scans = scans_of(dim)
    found = learned(scans, learner="hierarchical", **options)
    surface = ~found.max_range
    assert float(found.support[surface].sum()) == pytest.approx(sum(len(scan.points) for scan in scans))
    assert float(found.support[~surface].sum()) == pytest.approx(sum(len(scan.no_return) for scan in scans))
    assert 1 < int(surface.sum()) < 500
    if options.get("prune") == "support":
        assert float(found.support[surface].min()) > 10


@dims
def test_planarity_stops_the_tree(dim):
    numbers = [
        len(learned(scans_of(dim), learner="hierarchical", planarity=planarity))
        for planarity in (1.0, 0.1, 0.001)
    ]
    assert numbers[0] <= numbers[1] <= numbers[2]
    assert numbers[0] < numbers[2]


@dims
@pytest.mark.parametrize("n", [1, 3])
def test_free_points_are_learned_from_each_beam(dim, n):
    scans = scans_of(dim)
    plain, found = learned(scans), learned(scans, free_points=n)
    n_returns, n_ends = (
        sum(len(rows) for rows in clouds)
        for clouds in zip(*((s.points, s.no_return) for s in scans), strict=True)
    )
    assert float(found.support[found.max_range].sum()) == pytest.approx(n * n_returns + n_ends)
    torch.testing.assert_close(found.means[~found.max_range], plain.means[~plain.max_range])


@dims
def test_free_points_lower_the_occupancy_before_a_surface(dim):
    scans = scans_of(dim, 1)
    middle = 0.5 * (scans[0].points + scans[0].origin)
    plain, free = (
        GaussianMap(RULE),
        GaussianMap(IncrementalRule(noise=0.02, length=0.3, cell=0.05, free_points=2)),
    )
    for made in (plain, free):
        made.insert(scans[0])
    assert float(free.occupancy(middle).mean()) < float(plain.occupancy(middle).mean())


@pytest.mark.parametrize("options", [{"learner": "hierarchical"}, {"prune": "support"}, {"free_points": 1}])
def test_depth_images_are_learned_as_their_points(options):
    intrinsics = torch.tensor([[60.0, 0.0, 31.5], [0.0, 60.0, 23.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
    depth = 2 + 0.5 * torch.rand(48, 64, generator=torch.Generator().manual_seed(0))
    rule = IncrementalRule(noise=0.02, length=0.3, cell=0.05, window=1, **options)
    by_image, by_points = GaussianMap(rule, codec="float"), GaussianMap(rule, codec="float")
    by_image.insert_depth([(depth, torch.eye(4))], intrinsics, pixel_stride=1)
    by_points.insert(DepthFrame.of(depth, torch.eye(4), intrinsics).scan())
    torch.testing.assert_close(by_image.means, by_points.means)
    assert torch.equal(by_image.max_range, by_points.max_range)
