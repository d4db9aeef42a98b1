"""Comparison of mixtures: rows, and likelihoods against scikit-learn."""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from pillar_room import timeless
from sklearn.mixture import GaussianMixture as ScikitLearnMixture
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.evaluation.fits import ESTIMATORS, FitOutcome, Views, compare, means, split
from gmmtorch.experiments.evaluation.metrics import psnr2
from gmmtorch.experiments.evaluation.protocol_options import FitOptions
from gmmtorch.mixture import PruneOptions, measured_sensor, prune
from gmmtorch.report import ignore

SMALL = FitOptions(n_components=6, max_iter=60)


def blobs(n: int = 1200, dim: int = 3) -> Tensor:
    """Points (n, dim) of six well separated Gaussians of different shapes."""
    generator = torch.Generator().manual_seed(0)
    centers = 6 * torch.rand(6, dim, generator=generator, dtype=torch.float64)
    scale = 0.1 + 0.4 * torch.rand(6, dim, generator=generator, dtype=torch.float64)
    owner = torch.arange(n) % 6
    return centers[owner] + scale[owner] * torch.randn(n, dim, generator=generator, dtype=torch.float64)


def fit(
    *methods: str, points: Tensor | None = None, test_share: float = 0.2, seed: int = 0, **options: Any
) -> FitOutcome:
    cloud = blobs() if points is None else points
    data = split("blobs", cloud, test_share, seed)
    return compare(data, methods, replace(SMALL, **options), seed, ignore)


class All(NamedTuple):
    """The outcome of all methods, the events, and the numbers of rows that were reported."""

    outcome: FitOutcome
    events: list[tuple[str, int, int | None]]
    counts: list[int]


@pytest.fixture(scope="module")
def everything() -> All:
    torch.set_num_threads(1)
    events: list[tuple[str, int, int | None]] = []
    counts: list[int] = []
    outcome = compare(
        split("blobs", blobs(), 0.2, 0),
        list(ESTIMATORS),
        SMALL,
        0,
        lambda *event: events.append(event),
        lambda rows: counts.append(len(rows)),
    )
    return All(outcome, events, counts)


def test_rows_have_every_documented_field_with_its_type(everything):
    rows = everything.outcome.rows
    assert everything.counts == list(range(1, len(rows) + 1))
    assert [row["method"] for row in rows] == list(ESTIMATORS)
    kinds: dict[str, type] = {
        "dataset": str,
        "method": str,
        "n_points": int,
        "n_components": int,
        "seconds": float,
        "n_iterations": int,
        "log_likelihood": float,
        "held_out_log_likelihood": float,
        "psnr2_db": float,
        "psnr_forward_db": float,
        "psnr_backward_db": float,
        "held_out_psnr2_db": float,
        "n_components_used": int,
        "nbytes": int,
        "converged": bool,
    }
    for row in rows:
        for name, kind in kinds.items():
            assert type(row[name]) is kind, f"{name} is {row[name]!r}"
        assert row["n_points"] == 960
        assert 0 < row["n_components_used"] <= row["n_components"] <= 6
        assert row["seconds"] > 0
        assert row["psnr2_db"] == pytest.approx(row["psnr_forward_db"] + row["psnr_backward_db"])
    json.dumps(rows, allow_nan=False)


@pytest.mark.parametrize("dim", [2, 3])
def test_likelihood_of_em_matches_scikit_learn(dim):
    ours, theirs = fit("em", "scikit_learn", points=blobs(dim=dim)).rows
    for name in ("log_likelihood", "held_out_log_likelihood"):
        assert ours[name] == pytest.approx(theirs[name], abs=0.02)
    assert ours["nbytes"] == pytest.approx(theirs["nbytes"], rel=0.1)  # stored in the same way


def test_scikit_learn_mixture_is_converted_exactly():
    points = blobs()
    outcome = fit("scikit_learn", points=points, test_share=0.0, seed=3)
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(3)).sort().values
    peer = ScikitLearnMixture(6, max_iter=60, random_state=3).fit(points[order].numpy())
    assert outcome.rows[0]["log_likelihood"] == pytest.approx(peer.score(points.numpy()), abs=1e-6)
    np.testing.assert_allclose(outcome.mixtures["scikit_learn"].means_, peer.means_, atol=1e-8)


def test_likelihoods_are_means_over_train_and_test_points(everything, tmp_path):
    row, mixture, points = everything.outcome.rows[0], everything.outcome.mixtures["em"], blobs()
    path = tmp_path / "mixture.safetensors"
    mixture.save(path)
    assert path.stat().st_size == row["nbytes"]
    each = torch.as_tensor(mixture.score_samples(points)).double()
    both = 960 * row["log_likelihood"] + 240 * row["held_out_log_likelihood"]
    assert both / 1200 == pytest.approx(float(each.mean()), abs=1e-6)
    assert row["log_likelihood"] != row["held_out_log_likelihood"]


def test_psnr2_uses_as_many_samples_as_points(everything):
    row, mixture = everything.outcome.rows[0], everything.outcome.mixtures["em"]
    data = split("blobs", blobs(), 0.2, 0)
    for points, name in ((data.train, "psnr2_db"), (data.test, "held_out_psnr2_db")):
        drawn, _ = mixture.sample(len(points), random_state=0)
        assert row[name] == pytest.approx(psnr2(points, drawn))


def test_split_is_a_random_partition_of_the_points():
    points = blobs()
    _, train, test, _ = split("blobs", points, 0.25, 0)
    assert (len(train), len(test)) == (900, 300)
    assert sorted(torch.cat([train, test]).tolist()) == sorted(points.tolist())
    assert not torch.equal(test, split("blobs", points, 0.25, 1).test)


def test_components_without_points_are_not_counted_as_used():
    points = torch.cat([torch.zeros(600, 2), torch.ones(600, 2)]).double()
    points = points + 1e-3 * torch.randn(1200, 2, generator=torch.Generator().manual_seed(0)).double()
    for method in ("variational", "scikit_learn_bayesian"):
        row = fit(method, points=points, n_components=10, max_iter=500, test_share=0.0).rows[0]
        assert (row["n_components"], row["n_components_used"]) == (10, 2)


@pytest.mark.slow
def test_rows_depend_only_on_the_seed(everything):
    """The methods run in another order, so the rows do not depend on it either."""
    first = timeless(everything.outcome.rows)
    again = timeless(fit(*reversed(ESTIMATORS)).rows)
    assert again[::-1] == first
    for method in ("em", "scikit_learn"):
        assert timeless(fit(method, seed=1).rows)[0] not in first


@pytest.mark.parametrize("method", ESTIMATORS)
def test_lower_bounds_increase_and_progress_goes_from_zero_to_the_total(method, everything):
    bounds = everything.outcome.mixtures[method].lower_bounds_
    (row,) = (row for row in everything.outcome.rows if row["method"] == method)
    assert len(bounds) == row["n_iterations"] > 1
    assert all(math.isfinite(bound) for bound in bounds)
    if method in ("sliced_wasserstein", "hierarchical"):  # stochastic; restarts at each level
        assert bounds[-1] > bounds[0]
    else:
        assert all(b >= a - 1e-5 for a, b in itertools.pairwise(bounds))
    events = [(done, total) for stage, done, total in everything.events if stage == method]
    assert events[0][0] == 0
    assert events[-1][0] == events[-1][1]
    assert events == sorted(events)


def test_means_group_rows_by_fields():
    rows = [
        {
            "start": start,
            "k": k,
            "seed": seed,
            "n": 10 * k,
            "seconds": k + seed + 0.5,
            "name": f"{start}{seed}",
        }
        for seed in (0, 1)
        for start in ("a", "b")
        for k in (2, 5)
    ]
    rows[0]["seconds"] = None
    table = means(rows, ("start", "k"))
    assert [(row["start"], row["k"]) for row in table] == [("a", 2), ("a", 5), ("b", 2), ("b", 5)]
    assert [row["n_seeds"] for row in table] == [2] * 4
    assert [row["seconds"] for row in table] == [None, 6.0, 3.0, 6.0]
    assert table[3] == {
        "n_seeds": 2, "start": "b", "k": 5, "seed": 0.5, "n": 50, "seconds": 6.0, "name": None,
    }  # fmt: skip


def test_own_options_apply_only_to_their_estimator():
    data = split("blobs", blobs(), 0.2, 0)
    own = {"hierarchical": {"max_levels": 1, "branching": 3}}
    outcome = compare(data, ["em", "hierarchical"], SMALL, 0, ignore, own=own)
    assert [row["n_components"] for row in outcome.rows] == [6, 3]


# -- invalid input --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("methods", "options", "message"),
    [
        (["em", "kmeans"], {}, "method='kmeans' is not known; known are em, .*scikit_learn"),
        ([], {}, "method is empty"),
        (["em"], {"test_share": 1.0}, r"test_share=1.0 must be a share in \[0, 1\)"),
        (["em"], {"test_share": math.nan}, "test_share=nan"),
        (["em"], {"points": torch.empty(0, 3)}, "have no points"),
        (["scikit_learn"], {"init_params": "random_points"}, "init_params='random_points'.*only kmeans"),
        (["scikit_learn_bayesian"], {"init_params": "random_points"}, "only kmeans"),
    ],
)
def test_what_cannot_be_compared_raises(methods, options, message):
    with pytest.raises(InvalidArgumentError, match=message):
        fit(*methods, **options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n_components": 0}, "n_components=0"),
        ({"n_components": 5000}, "n_components=5000"),
        ({"tol": -1.0}, "tol=-1"),
        ({"reg_covar": -1.0}, "reg_covar=-1"),
        ({"n_init": 0}, "n_init=0"),
        ({"seed": -1}, "-1"),
    ],
)
def test_invalid_options_raise_for_every_method(options, message):
    for method in ESTIMATORS:
        with pytest.raises(InvalidArgumentError, match=message):
            fit(method, **options)


def test_unknown_own_options_raise():
    data = split("blobs", blobs(), 0.2, 0)
    with pytest.raises(InvalidArgumentError, match=r"method_options\.em\.branching .*em takes .*warm_start"):
        compare(data, ["em"], SMALL, 0, ignore, own={"em": {"branching": 3}})
    with pytest.raises(InvalidArgumentError, match="method='trees' is not known"):
        compare(data, ["em"], SMALL, 0, ignore, own={"trees": {"branching": 3}})


# -- pruning ---------------------------------------------------------------------------------------


def two_scans() -> tuple[Tensor, Views]:
    """Two scans of a wall 4 m away, with a few stray points."""
    generator = torch.Generator().manual_seed(0)
    angle = torch.linspace(-0.7, 0.7, 500, dtype=torch.float64)
    origins = torch.tensor([[0.0, 0.0], [0.0, 1.0]], dtype=torch.float64)
    wall = [torch.stack([torch.full_like(angle, 4), y + 4 * angle.tan()], 1) for y in origins[:, 1]]
    stray = torch.rand(12, 2, generator=generator, dtype=torch.float64) * 3
    points = torch.cat([*wall, stray]) + 0.01 * torch.randn(1012, 2, generator=generator).double()
    return points, Views(torch.repeat_interleave(torch.tensor([500, 512])), origins)


@pytest.mark.parametrize("kind", ["support", "density"])
def test_fits_are_pruned_as_by_the_function(kind):
    points, views = two_scans()
    data = split("walls", points, 0.1, 0, views)
    pruning = PruneOptions(prune=kind, min_support=30, min_density_share=0.3)
    plain = compare(data, ["em"], SMALL, 0, ignore).mixtures["em"]
    outcome = compare(data, ["em"], SMALL, 0, ignore, pruning=pruning)
    known = data.views
    assert known is not None
    place = (data.train[:, None] == points).all(2).double().argmax(1)
    assert torch.equal(known.scan, (place >= 500).long())
    largest = int(known.scan.double().mean() > 0.5)
    owner = torch.as_tensor(plain.predict(data.train))
    counts = torch.zeros(len(plain.weights), 2)
    for component, scan in zip(owner.tolist(), known.scan.tolist(), strict=True):
        counts[component, scan] += 1
    sensor = measured_sensor(data.train[known.scan == largest], views.origins[largest])
    limits: dict[str, Any] = {"min_support": 30}
    if kind == "density":
        limits = {"min_density_share": 0.3, "sensor": sensor, "origins": views.origins, "counts": counts}
    expected, kept = prune(plain, len(data.train), **limits)
    assert 0 < int(kept.sum()) < 6
    torch.testing.assert_close(outcome.mixtures["em"].means, expected.means)
    assert outcome.rows[0]["n_components"] == int(kept.sum())


@pytest.mark.parametrize("kind", ["support", "density"])
def test_trees_are_pruned_while_they_grow(kind):
    points, views = two_scans()
    data = split("walls", points, 0.1, 0, views)
    pruning = PruneOptions(prune=kind, min_support=100, min_density_share=0.3)
    plain = compare(data, ["hierarchical"], SMALL, 0, ignore).mixtures["hierarchical"]
    tree = compare(data, ["hierarchical"], SMALL, 0, ignore, pruning=pruning).mixtures["hierarchical"]
    assert 0 < len(tree.weights) < len(plain.weights)
    assert float(tree.weights.sum()) == pytest.approx(1)


def test_pruning_by_density_needs_origins():
    pruning = PruneOptions(prune="density")
    for method in ("em", "hierarchical"):
        with pytest.raises(InvalidArgumentError, match="prune='density' needs scans with sensor origins"):
            compare(split("blobs", blobs(), 0.2, 0), [method], SMALL, 0, ignore, pruning=pruning)
