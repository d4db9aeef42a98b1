"""Schemas and objects from dataclasses with options: every kind of field, and every kind of wrong value."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import pytest
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gmmtorch.cli.schema import about_of, argument_names, build, option_names, part_of, schema_of
from gmmtorch.declarations import group, option, repeated
from gmmtorch.errors import InvalidArgumentError, check_number


@dataclass(frozen=True)
class Inner:
    threshold: float = option(1.0, "bits")
    hidden: int = 3

    def __post_init__(self) -> None:
        check_number("threshold", self.threshold)


@dataclass(frozen=True)
class Rule:
    noise: float = option(0.1, "metres")
    window: int | None = option(None, "scans")
    kind: Literal["fast", "slow"] = option("fast", "fast or slow")
    size: tuple[int, int, int] = option((8, 8, 4), "cells")
    shares: Sequence[float] = option((1.0, 0.5), "shares")
    options: dict[str, Any] = option({}, "free names")
    inner: Inner | None = option(None, "null, or a rule")
    dtype: str = "float32"

    def __post_init__(self) -> None:
        check_number("noise", self.noise)


@dataclass(frozen=True)
class Team:
    n_rounds: int = option(3, "of planning", "rounds")
    rate: float = option(1.0, "frames per second", "sensor.rate")
    rule: Inner = group(Inner, "sensor", threshold=2.0, hidden=4)
    unknown: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        check_number("n_rounds", self.n_rounds)


@dataclass
class Other:
    noise: float = repeated(Rule, "noise", 0.5)
    team: Any = option(None, "the team")


def composed(schema: Any, **values: Any) -> Any:
    return OmegaConf.merge(OmegaConf.structured(schema), values)


def test_schema_has_the_options_of_its_classes_and_no_other_fields():
    found = OmegaConf.to_container(composed(schema_of(Rule, Other, name="rule")))
    assert found == {
        "noise": 0.5,
        "window": None,
        "kind": "fast",
        "size": [8, 8, 4],
        "shares": [1.0, 0.5],
        "options": {},
        "inner": None,
        "team": None,
        "name": "rule",
    }
    assert about_of(composed(schema_of(Other)), "noise") == "metres"


def test_dotted_names_and_groups_make_a_tree():
    schema = schema_of(Team, ("rule", Rule), without=("rule.options", "rule.inner"))
    found = composed(schema)
    assert found.rounds == 3
    assert found.sensor == {"rate": 1.0, "threshold": 2.0}
    assert found.rule.kind == "fast"
    assert OmegaConf.to_container(composed(part_of(Team, "sensor"))) == {"rate": 1.0, "threshold": 2.0}
    assert build(Team, found) == Team()
    assert build(Team, found).rule.hidden == 4
    assert argument_names(Team) == {
        "n_rounds": "rounds",
        "rate": "sensor.rate",
        "threshold": "sensor.threshold",
        "rule.threshold": "sensor.threshold",
    }
    assert option_names(found)["n_rounds"] == "rounds"
    with pytest.raises(InvalidArgumentError, match=r"^rounds=-1"):
        build(Team, composed(schema, rounds=-1))
    with pytest.raises(InvalidArgumentError, match=r"^sensor\.threshold=-1"):
        build(Team, composed(schema, sensor={"threshold": -1}))


@pytest.mark.parametrize(
    "values",
    [{"noise": "loud"}, {"window": 2.5}, {"size": ["a"]}, {"shares": 0.5}, {"nose": 1}, {"noise": None}],
)
def test_schema_refuses_wrong_types_and_names(values):
    with pytest.raises(OmegaConfBaseException):
        composed(schema_of(Rule), **values)


def test_build_returns_the_defaults_for_the_defaults_and_converts_values():
    schema = schema_of(("map", Rule))
    assert build(Rule, composed(schema), "map") == Rule()
    given = {"size": [1, 2, 3], "shares": [2], "inner": {"threshold": 3, "hidden": 5}, "window": 4}
    found = build(Rule, composed(schema, map=given), "map", dtype="float64")
    assert found == Rule(size=(1, 2, 3), shares=(2.0,), inner=Inner(3.0, 5), window=4, dtype="float64")
    assert isinstance(found.shares, tuple)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"noise": -1}, r"^map\.noise=-1.0 must"),
        ({"size": [1, 2]}, r"^map\.size=\[1, 2\] must have three entries"),
        ({"inner": {"threshold": -1}}, r"^map\.inner\.threshold=-1"),
        ({"inner": {"treshold": 1}}, r"^map\.inner=.*treshold.*\{threshold, hidden\}"),
        ({"inner": {"threshold": "high"}}, r"^map\.inner=.*high.*Float"),
        ({"inner": "all"}, r"^map\.inner=all: not a group of options; give null"),
    ],
)
def test_build_names_the_option_of_a_wrong_value(values, message):
    with pytest.raises(InvalidArgumentError, match=message):
        build(Rule, composed(schema_of(("map", Rule)), map=values), "map")


def test_an_argument_that_several_options_become_is_not_translated():
    found = composed(schema_of(("map", Rule), ("fit", Rule), Other))
    names = option_names(found)
    assert names["noise"] == "noise"  # at the top
    assert "window" not in names
