"""Tables of invalid values as parameters of tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any


def each_value(table: Mapping[str, Sequence[Any]]) -> list[tuple[str, Any]]:
    """(name, value) for each value of each name, as parameters of a test."""
    return [(name, value) for name, values in table.items() for value in values]
