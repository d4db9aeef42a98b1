"""Learning rules: files keep them, and invalid options are refused by name."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from invalid_values import each_value

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mapping.learning.rules import IncrementalRule, NoveltyRule, WindowedRule, read_rule, rule_facts

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
