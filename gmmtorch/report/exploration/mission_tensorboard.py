"""The results of trials in TensorBoard."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from gmmtorch.exploration.mission.results import differing
from gmmtorch.report.style import Rows
from gmmtorch.report.tensorboard_writer import Board

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SERIES = (
    "entropy_bits",
    "bytes_over_time",
    "wire_bytes_over_time",
    "missing_share",
    "raw_points_bytes_over_time",
    "octree_bytes_over_time",
    "draco_bytes_over_time",
)


def write_exploration_board(board: Board, rows: Rows, figures: Mapping[str, Figure]) -> None:
    """Writes trials and figures to one TensorBoard run.

    Tags name the framework, the options in which rows differ, and the seed. Each trial has its entropy (bits,
    and as a share of the observable), the entropies of its robots, cumulative bytes and the share of missing
    records over simulated seconds, and every number of the row at the end.

    Args:
        board: the run; the caller closes it.
        rows: explore rows of `results.json`.
        figures: by name.
    """
    fields = differing(rows, without=["framework"])
    for row in rows:
        tag = f"{row['framework']}/{_variant(row, fields)}seed_{row['seed']}"
        _write_series(board, row, tag)
        board.scalars(row, tag, step=int(row["times"][-1]))
    for name, figure in figures.items():
        board.figure(f"figures/{name}", figure)


def _variant(row: Mapping[str, Any], fields: Sequence[str]) -> str:
    """Returns each field with its value as part of a tag: planner_mcts_loss_0.3/; "" without fields."""
    parts = [f"{field}_{_short(row.get(field))}" for field in fields]
    return "_".join(parts) + "/" if parts else ""


def _short(value: Any) -> str:
    """Returns a value as part of a tag; partitions as times and groups: 60-120_0_1.2."""
    if not isinstance(value, list):
        return str(value)
    cuts = [(f"{cut['begin']:g}-{cut['end']:g}", cut["groups"]) for cut in value]
    names = ["_".join([span, *(".".join(map(str, group)) for group in groups)]) for span, groups in cuts]
    return "_".join(names) or "none"


def _write_series(board: Board, row: Mapping[str, Any], tag: str) -> None:
    observable = max(float(row["observable_bits"]), 1.0)
    for i, time in enumerate(row["times"]):
        numbers = {name: row[name][i] for name in _SERIES if row.get(name)}
        numbers["entropy_left"] = row["entropy_bits"][i] / observable
        robots = row.get("entropy_bits_per_robot") or []
        numbers |= {f"robot_{n}/entropy_bits": bits[i] for n, bits in enumerate(robots)}
        board.scalars(numbers, tag, step=int(time))
