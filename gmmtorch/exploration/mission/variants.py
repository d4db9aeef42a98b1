"""What makes a mission one variant or another: the options that its seeds have in common."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

PLANNING = ("planner", "information", "coordination", "planning_prior")
NETWORK = (
    *("delay", "jitter", "bandwidth", "loss", "duplication", "reach", "partitions"),
    *("announce", "budget"),
)
VARIANT = ("framework", *PLANNING, "codec", *NETWORK)
"""Fields of a row that say which variant it is of."""


def variant_of(
    row: Mapping[str, Any], fields: Sequence[str] = VARIANT, without: Collection[str] = ()
) -> tuple[Any, ...]:
    """What a row has in `fields`, in their order and less those left out, to be counted by."""
    return tuple(_countable(row.get(field)) for field in fields if field not in without)


def differing(rows: Sequence[Mapping[str, Any]], without: Collection[str] = ()) -> list[str]:
    """The fields of a variant that not all rows have the same in."""
    return [
        field
        for field in VARIANT
        if field not in without and len({_countable(row.get(field)) for row in rows}) > 1
    ]


def _countable(value: Any) -> Any:
    return str(value) if isinstance(value, list) else value
