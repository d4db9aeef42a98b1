"""Options of every baseline: invalid values are refused with the name of the option."""

from __future__ import annotations

import math
from typing import Any

import pytest

from gmmtorch import baselines
from gmmtorch.errors import InvalidArgumentError

NO_LENGTH = (0, -1.0, math.nan, math.inf, "much")
NO_PROBABILITY = (0.0, 1.0, -1.0, math.nan)
SAMPLED = ("free_resolution", "ds_resolution", "max_range")

INVALID: dict[str, dict[str, tuple[Any, ...]]] = {
    "BGKMap": dict.fromkeys(("length", "prior", "scale", *SAMPLED), NO_LENGTH),
    "BGKPointsMap": {"max_points": (0,), **dict.fromkeys(("length", "prior", "scale", *SAMPLED), NO_LENGTH)},
    "GPMap": {
        "block_side": NO_LENGTH,
        **dict.fromkeys(("length", "variance", "noise", "gain", *SAMPLED), NO_LENGTH),
        **dict.fromkeys(("min_variance", "max_variance", "known_variance"), NO_LENGTH),
    },
    "NDTMap": {
        "spread": (0, -1.0, math.nan, "x"),
        "evidence": (0, -1.0, math.nan, "x", 0.5),
        "max_log_odds": (0, -1.0, math.nan, "x", math.inf),
        "gate": (-0.1, 1.0, math.nan),
        "max_points": (2,),
        **dict.fromkeys(("sensor_noise", "min_deviation", "max_range"), (0, math.inf)),
    },
    "OccupancyGrid": {"resolution": (0, -0.1, math.nan, math.inf), "prior": (-1.0, math.nan, math.inf)},
    "OctoMapMap": dict.fromkeys(("hit", "miss", "clamp_low", "clamp_high"), NO_PROBABILITY),
    "HilbertMap": {
        "features": ("wavelets",),
        "length": (0,),
        "spacing": (math.nan,),
        "n_features": (0,),
        "alpha": (-1,),
        "l1_ratio": (1.5,),
        "free_spacing": (0,),
        "gap": (-0.1,),
        "thin": (0,),
        "epochs": (0,),
        "batch_size": (1.5,),
        "learning_rate": (0,),
        "random_state": (-1,),
    },
    "BayesianHilbertMap": {
        "gamma": (0,),
        "spacing": (-1,),
        "covariance": ("round",),
        "prior_variance": (math.nan,),
        "n_iter": (0,),
        "free_spacing": (0,),
        "gap": (-1,),
        "thin": (0,),
        "random_state": (-1,),
    },
}


@pytest.mark.parametrize(("kind", "name"), [(kind, name) for kind in INVALID for name in INVALID[kind]])
def test_an_invalid_option_is_named(kind, name):
    needed = {} if "Hilbert" in kind else {"resolution": 0.1}
    for value in INVALID[kind][name]:
        with pytest.raises(InvalidArgumentError, match=name):
            getattr(baselines, kind)(**{**needed, name: value})


@pytest.mark.parametrize("rule", [{"hit": math.nan}, {"miss": math.inf}])
def test_log_odds_rejects_values_that_are_not_finite(rule):
    with pytest.raises(InvalidArgumentError, match=next(iter(rule))):
        baselines.LogOdds(**rule)
