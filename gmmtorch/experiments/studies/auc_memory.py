"""AUC against map size in bytes (thesis Table 3.1): every method at several sizes, on one test."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from gmmtorch.events import Event, OnRows, Row, ignore
from gmmtorch.experiments.evaluation import MapFactory, Protocol, evaluate
from gmmtorch.scan import Scan


class Sized(NamedTuple):
    """A method with one size: its number of components or stored points; None if the method has one size."""

    method: str
    size: int | None
    factory: MapFactory


def run_auc_memory(
    name: str,
    scans: Sequence[Scan],
    methods: Sequence[Sized],
    protocol: Protocol,
    seed: int = 0,
    on_event: Event = ignore,
    on_rows: OnRows = lambda rows: None,
) -> list[Row]:
    """A row of `held_out.evaluate` for each sized method, with the field `size`."""
    by_label = {_label(sized): sized for sized in methods}

    def with_size(rows: Sequence[Row]) -> list[Row]:
        return [
            {**row, "method": by_label[row["method"]].method, "size": by_label[row["method"]].size}
            for row in rows
        ]

    factories = {label: sized.factory for label, sized in by_label.items()}
    outcome = evaluate(
        name, scans, factories, protocol, seed, on_event, lambda rows: on_rows(with_size(rows))
    )
    return with_size(outcome.rows)


def _label(sized: Sized) -> str:
    return sized.method if sized.size is None else f"{sized.method} {sized.size}"
