"""AUC against the bytes of the map (thesis Table 3.1): every method at several sizes, on one test."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from gmmtorch.evaluation import held_out as occupancy
from gmmtorch.evaluation.events import Event, ignore
from gmmtorch.evaluation.held_out import Protocol
from gmmtorch.evaluation.methods import MapFactory
from gmmtorch.scan import Scan


class Sized(NamedTuple):
    """A method at one of its sizes: of components, or of stored points; None if it has but one."""

    method: str
    size: int | None
    factory: MapFactory


def run(
    name: str,
    scans: Sequence[Scan],
    contenders: Sequence[Sized],
    protocol: Protocol,
    seed: int = 0,
    on_event: Event = ignore,
    on_rows: Callable[[list[dict[str, Any]]], object] = lambda rows: None,
) -> list[dict[str, Any]]:
    """A row of `occupancy.evaluate` for each contender, with its `size`; see there."""
    by_label = {_label(contender): contender for contender in contenders}

    def sized(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        return [
            {**row, "method": by_label[row["method"]].method, "size": by_label[row["method"]].size}
            for row in rows
        ]

    factories = {label: contender.factory for label, contender in by_label.items()}
    outcome = occupancy.evaluate(
        name, scans, factories, protocol, seed, on_event, lambda rows: on_rows(sized(rows))
    )
    return sized(outcome.rows)


def _label(contender: Sized) -> str:
    return contender.method if contender.size is None else f"{contender.method} {contender.size}"
