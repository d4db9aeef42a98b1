"""What a network made of missions: entropy a byte, and each beside the lossless mission of its seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from gmmtorch.exploration.mission.variants import variant_of

_TROUBLE = ("loss", "partitions")


def with_network_costs(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows that also say what sharing cost them, and how much later it made them.

    - `bits_per_byte`: entropy taken away (bits) for each byte on the wire, headers included.
    - `t90_ratio`, `wire_ratio`: t90 and bytes on the wire over those of the lossless companion, which is
      the mission of the same seed that differs in `loss` and `partitions` alone, and has neither.
    - `healed_after`: simulated seconds from the end of the last partition to the first sample at which
      `missing_share` is no more than the companion has at most while that partition lasts.

    None of what nothing was sent for, was never reached, or has no companion in `rows`.

    Args:
        rows: explore rows with t90 (`outcome.with_times`).
    """
    lossless: dict[tuple[Any, ...], dict[str, Any]] = {}
    for row in rows:
        if not any(row.get(field) for field in _TROUBLE):
            lossless.setdefault(_kin(row), row)
    return [{**row, **_costs(row, lossless.get(_kin(row), {}))} for row in rows]


def _kin(row: Mapping[str, Any]) -> tuple[Any, ...]:
    """What a mission and its lossless companion have in common."""
    return (row.get("seed"), *variant_of(row, without=_TROUBLE))


def _costs(row: Mapping[str, Any], companion: Mapping[str, Any]) -> dict[str, float | None]:
    return {
        "bits_per_byte": _ratio(row["entropy_reduction_bits"], row["wire_bytes"]),
        "t90_ratio": _ratio(row["t90"], companion.get("t90")),
        "wire_ratio": _ratio(row["wire_bytes"], companion.get("wire_bytes")),
        "healed_after": _healed_after(row, companion),
    }


def _ratio(part: float | None, whole: float | None) -> float | None:
    return None if part is None or whole is None or whole <= 0 else part / whole


def _healed_after(row: Mapping[str, Any], companion: Mapping[str, Any]) -> float | None:
    if not row.get("partitions") or not companion:
        return None
    last = max(row["partitions"], key=lambda cut: cut["end"])
    usual = [share for time, share in _missing(companion) if last["begin"] <= time < last["end"]]
    if not usual:  # samples further apart than the partition was long
        return None
    healed = (t for t, share in _missing(row) if t >= last["end"] and share <= max(usual))
    when = next(healed, None)
    return None if when is None else when - last["end"]


def _missing(row: Mapping[str, Any]) -> list[tuple[float, float]]:
    """(time, missing share) of each sample."""
    return list(zip(row["times"], row["missing_share"], strict=True))
