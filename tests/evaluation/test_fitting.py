"""Mixtures side by side: what a row says, and that ours is as likely as scikit-learn's."""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from sklearn.mixture import GaussianMixture as ScikitLearnMixture
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.evaluation.estimators import METHODS, FitOptions
from gmmtorch.evaluation.events import ignore
from gmmtorch.evaluation.metrics import psnr2
from gmmtorch.evaluation.studies.fitting import FitOutcome, compare, means, split

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
    material = split("blobs", cloud, test_share, seed)
    return compare(material, methods, replace(SMALL, **options), seed, ignore)


def test_rows_carry_every_field_of_the_contract_with_its_type():
    rows = fit(*METHODS).rows
    assert [row["method"] for row in rows] == list(METHODS)
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
def test_our_mixture_is_as_likely_as_that_of_scikit_learn(dim):
    ours, theirs = fit("em", "scikit_learn", points=blobs(dim=dim)).rows
    for name in ("log_likelihood", "held_out_log_likelihood"):
        assert ours[name] == pytest.approx(theirs[name], abs=0.02)
    assert ours["nbytes"] == pytest.approx(theirs["nbytes"], rel=0.1)  # stored in the same way


def test_the_mixture_of_scikit_learn_is_taken_over_as_it_is():
    points = blobs()
    outcome = fit("scikit_learn", points=points, test_share=0.0, seed=3)
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(3)).sort().values
    peer = ScikitLearnMixture(6, max_iter=60, random_state=3).fit(points[order].numpy())
    assert outcome.rows[0]["log_likelihood"] == pytest.approx(peer.score(points.numpy()), abs=1e-6)
    np.testing.assert_allclose(outcome.mixtures["scikit_learn"].means_, peer.means_, atol=1e-8)


def test_likelihoods_are_means_over_the_points_held_out_and_over_the_others(tmp_path):
    points = blobs()
    outcome = fit("em", points=points)
    row, mixture = outcome.rows[0], outcome.mixtures["em"]
    path = tmp_path / "mixture.safetensors"
    mixture.save(path)
    assert path.stat().st_size == row["nbytes"]
    each = torch.as_tensor(mixture.score_samples(points)).double()
    both = 960 * row["log_likelihood"] + 240 * row["held_out_log_likelihood"]
    assert both / 1200 == pytest.approx(float(each.mean()), abs=1e-6)
    assert row["log_likelihood"] != row["held_out_log_likelihood"]


def test_psnr2_is_that_of_as_many_points_as_are_compared_with():
    material = split("blobs", blobs(), 0.25, 0)
    outcome = compare(material, ["em"], SMALL, 0, ignore)
    row, mixture = outcome.rows[0], outcome.mixtures["em"]
    for points, name in ((material.train, "psnr2_db"), (material.test, "held_out_psnr2_db")):
        drawn, _ = mixture.sample(len(points), random_state=0)
        assert row[name] == pytest.approx(psnr2(points, drawn))


def test_a_split_parts_the_points_at_random():
    points = blobs()
    _, train, test = split("blobs", points, 0.25, 0)
    assert (len(train), len(test)) == (900, 300)
    assert sorted(torch.cat([train, test]).tolist()) == sorted(points.tolist())
    assert not torch.equal(test, split("blobs", points, 0.25, 1).test)


def test_components_that_no_point_belongs_to_are_not_in_use():
    points = torch.cat([torch.zeros(600, 2), torch.ones(600, 2)]).double()
    points = points + 1e-3 * torch.randn(1200, 2, generator=torch.Generator().manual_seed(0)).double()
    for method in ("variational", "scikit_learn_bayesian"):
        row = fit(method, points=points, n_components=10, max_iter=500, test_share=0.0).rows[0]
        assert (row["n_components"], row["n_components_used"]) == (10, 2)


def test_components_in_use_are_counted_by_enumeration():
    points = blobs()
    outcome = fit("em", points=points, n_components=40, test_share=0.0)
    likeliest = np.asarray(outcome.mixtures["em"].predict_proba(points)).argmax(1)
    assert outcome.rows[0]["n_components_used"] == len(set(likeliest.tolist()))


def test_rows_are_handed_on_as_they_come():
    seen: list[int] = []
    material = split("blobs", blobs(), 0.2, 0)
    compare(material, ["em", "scikit_learn"], SMALL, 0, ignore, lambda rows: seen.append(len(rows)))
    assert seen == [1, 2]


def test_nothing_held_out_has_no_held_out_likelihood():
    row = fit("em", test_share=0.0).rows[0]
    assert row["held_out_log_likelihood"] is None
    assert row["held_out_psnr2_db"] is None
    assert row["n_points"] == 1200


def test_all_methods_see_the_same_points_and_the_same_seed_gives_the_same_rows():
    def timeless(outcome: FitOutcome) -> list[dict[str, Any]]:
        return [{k: v for k, v in row.items() if not k.endswith("seconds")} for row in outcome.rows]

    first = timeless(fit(*METHODS))
    assert timeless(fit(*METHODS)) == first
    assert timeless(fit(*METHODS, seed=1)) != first
    assert timeless(fit("scikit_learn")) == [r for r in first if r["method"] == "scikit_learn"]


@pytest.mark.parametrize("method", METHODS)
def test_lower_bounds_rise_and_there_is_one_for_each_iteration(method):
    outcome = fit(method)
    bounds = outcome.lower_bounds[method]
    assert len(bounds) == outcome.rows[0]["n_iterations"] > 1
    assert all(math.isfinite(bound) for bound in bounds)
    if method in ("sliced_wasserstein", "hierarchical"):  # a stochastic descent; begins anew on each level
        assert bounds[-1] > bounds[0]
    else:
        assert all(b >= a - 1e-5 for a, b in itertools.pairwise(bounds))


@pytest.mark.parametrize("method", METHODS)
def test_progress_begins_at_nothing_and_ends_at_all(method):
    events: list[tuple[str, int, int | None]] = []
    compare(split("blobs", blobs(), 0.1, 0), [method], SMALL, 0, lambda *event: events.append(event))
    assert {stage for stage, _, _ in events} == {method}
    assert events[0][1] == 0
    assert events[-1][1] == events[-1][2]
    assert [done for _, done, _ in events] == sorted(done for _, done, _ in events)


def test_a_fit_that_is_cut_short_says_so():
    row = fit("em", max_iter=1, tol=0.0).rows[0]
    assert row["converged"] is False
    assert row["n_iterations"] == 1


def test_means_are_over_the_rows_that_share_the_fields():
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


def test_a_methods_own_options_are_for_its_estimator_alone():
    material = split("blobs", blobs(), 0.2, 0)
    own = {"hierarchical": {"max_levels": 1, "branching": 3}}
    outcome = compare(material, ["em", "hierarchical"], SMALL, 0, ignore, own=own)
    assert [row["n_components"] for row in outcome.rows] == [6, 3]


# -- what is refused ------------------------------------------------------------------------------


def test_an_unknown_method_lists_the_known_ones():
    with pytest.raises(
        InvalidArgumentError, match=r"method='kmeans' is not known; known are em, .*scikit_learn"
    ):
        fit("em", "kmeans")


def test_no_method_at_all_is_refused():
    with pytest.raises(InvalidArgumentError, match="method is empty"):
        fit()


@pytest.mark.parametrize("test_share", [1.0, -0.1, 2.0, math.nan])
def test_a_share_that_leaves_nothing_to_learn_from_is_refused(test_share):
    with pytest.raises(InvalidArgumentError, match=r"test_share=.* must be a share in \[0, 1\)"):
        fit("em", test_share=test_share)


def test_a_cloud_without_points_is_refused():
    with pytest.raises(InvalidArgumentError, match="hold no points"):
        fit("em", points=torch.empty(0, 3))


@pytest.mark.parametrize("method", ["scikit_learn", "scikit_learn_bayesian"])
def test_scikit_learn_is_compared_from_kmeans_only(method):
    with pytest.raises(InvalidArgumentError, match=r"init_params='random_points'.*kmeans only"):
        fit(method, init_params="random_points")


@pytest.mark.parametrize("method", METHODS)
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
def test_bad_options_are_named_whichever_method_is_asked_for(method, options, message):
    with pytest.raises(InvalidArgumentError, match=message):
        fit(method, **options)


def test_options_that_a_method_does_not_have_are_named():
    material = split("blobs", blobs(), 0.2, 0)
    with pytest.raises(InvalidArgumentError, match=r"method_options\.em\.branching .*em takes .*warm_start"):
        compare(material, ["em"], SMALL, 0, ignore, own={"em": {"branching": 3}})
    with pytest.raises(InvalidArgumentError, match="method='trees' is not known"):
        compare(material, ["em"], SMALL, 0, ignore, own={"trees": {"branching": 3}})
