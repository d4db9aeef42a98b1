"""Schemas and objects from dataclasses: every kind of field, and every kind of wrong value."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import pytest
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gmmtorch.cli.schema import build, schema_of
from gmmtorch.errors import InvalidArgumentError, check_number


@dataclass(frozen=True)
class Inner:
    threshold: float = 1.0

    def __post_init__(self) -> None:
        check_number("threshold", self.threshold)


@dataclass(frozen=True)
class Rule:
    noise: float = 0.1
    window: int | None = None
    kind: Literal["fast", "slow"] = "fast"
    size: tuple[int, int, int] = (8, 8, 4)
    shares: Sequence[float] = (1.0, 0.5)
    options: dict[str, Any] = field(default_factory=dict)
    inner: Inner | None = None
    dtype: str = "float32"

    def __post_init__(self) -> None:
        check_number("noise", self.noise)


@dataclass(frozen=True)
class Query:
    prior: float = 1.0


def composed(schema: type, **values: Any) -> Any:
    return OmegaConf.to_container(OmegaConf.merge(OmegaConf.structured(schema), values))


def test_schema_has_the_fields_and_defaults_of_its_classes():
    found = composed(schema_of(Rule, Query, without=("dtype",), name="rule", window=3))
    assert found == {
        "noise": 0.1,
        "window": 3,
        "kind": "fast",
        "size": [8, 8, 4],
        "shares": [1.0, 0.5],
        "options": {},
        "inner": None,
        "prior": 1.0,
        "name": "rule",
    }


def test_a_dataclass_among_the_options_is_a_group():
    assert composed(schema_of(Query, rule=schema_of(Inner)), rule={"threshold": 2})["rule"] == {
        "threshold": 2.0
    }


@pytest.mark.parametrize(
    "values",
    [{"noise": "loud"}, {"window": 2.5}, {"size": ["a"]}, {"shares": 0.5}, {"nose": 1}, {"noise": None}],
)
def test_schema_refuses_wrong_types_and_names(values):
    with pytest.raises(OmegaConfBaseException):
        composed(schema_of(Rule), **values)


def test_build_returns_the_defaults_for_the_defaults():
    assert build(Rule, composed(schema_of(Rule, Query, name="rule")), "map") == Rule()


def test_build_converts_lists_and_optional_dataclasses():
    found = build(
        Rule,
        composed(schema_of(Rule), size=[1, 2, 3], shares=[2], inner={"threshold": 3}, window=4),
        "map",
        dtype="float64",
    )
    assert found == Rule(size=(1, 2, 3), shares=(2.0,), inner=Inner(3.0), window=4, dtype="float64")
    assert isinstance(found.shares, tuple)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"noise": -1}, r"^map\.noise=-1.0 must"),
        ({"size": [1, 2]}, r"map\.size=\[1, 2\] must have 3 entries"),
        ({"inner": {"threshold": -1}}, r"map\.inner\.threshold=-1"),
        ({"inner": {"treshold": 1}}, r"map\.inner=.*treshold.*\{threshold\}"),
        ({"inner": {"threshold": "high"}}, r"map\.inner=.*high.*Float"),
        ({"inner": "all"}, r"map\.inner=all: not a group of options; give null"),
    ],
)
def test_build_names_the_option_of_a_wrong_value(values, message):
    with pytest.raises(InvalidArgumentError, match=message):
        build(Rule, composed(schema_of(Rule), **values), "map")
