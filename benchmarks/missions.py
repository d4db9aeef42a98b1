"""What teams send and know in missions: E0 and E1, on networks that lose, and with few bytes a second.

    python benchmarks/missions.py                             # three seeds; E0 and E1 for 600 s
    python benchmarks/missions.py --only networks --seeds 0

Three robots explore the warehouse. The octree of a mission is that of its novel points, cells of 0.2 m; its
bytes are those of zstd, or the entropy given contexts, which an adaptive coder does not reach (as in
shared_knowledge.py). Finished missions are kept in a folder, so that a killed run continues.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from shared_knowledge import Cells
from torch import Tensor

from gmmtorch.experiments.harness import Case, Row, run
from gmmtorch.team.exploration.mission import mission as missions
from gmmtorch.team.exploration.mission.options import TeamOptions, WorldOptions
from gmmtorch.team.exploration.mission.results import compared
from gmmtorch.team.exploration.mission.trials import Trial, run_mission
from gmmtorch.team.sharing import bytes_of_points

_TEAMS = {"E0": "gmm_shared", "E1": "grid_shared"}
_LOSSES = {"lossless": 0.0, "30 % lost": 0.3, "50 % lost": 0.5}
_BUDGETS = {"no limit": None, "20 kbit/s": 2500.0, "5 kbit/s": 625.0, "1 kbit/s": 125.0}
_SHORT = 300.0  # seconds of the missions on networks that lose


def flown(options: Any, team: TeamOptions) -> list[dict[str, Any]]:
    """The rows of missions of all seeds."""
    torch.set_num_threads(1)
    rows = []
    for seed in options.seeds:
        trial = Trial(WorldOptions(), replace(team, seed=seed))
        trial = replace(trial, folder=Path(options.missions) / trial.digest)
        row = trial.kept_row()
        if row is None:
            row = _with_octree(trial)
            trial.keep_row(row)
        rows.append(row)
    return rows


def _with_octree(trial: Trial) -> dict[str, Any]:
    """The row of a mission, with the bytes of the octree of its novel points."""
    cells = Cells(0.2, counts=False)

    def counted(ends: Tensor, *others: Any, **names: Any) -> dict[str, int]:
        cells.send(ends, torch.zeros(0))
        return bytes_of_points(ends, *others, **names)

    missions.bytes_of_points = counted  # type: ignore[attr-defined]
    try:
        _, row = run_mission(trial)
    finally:
        missions.bytes_of_points = bytes_of_points  # type: ignore[attr-defined]
    return {**row, **{f"octree_{code}": size for code, size in cells.finish().items()}}


def _cell(values: Sequence[float | None], form: str, scale: float = 1.0) -> str:
    """The mean and the range."""
    known = [scale * value for value in values if value is not None]
    if len(known) < len(values):
        return "–"
    mean, low, high = sum(known) / len(known), min(known), max(known)
    same = format(low, form) == format(high, form)
    return format(mean, form) if same else f"{mean:{form}} ({low:{form}} to {high:{form}})"


def _of(rows: Sequence[dict[str, Any]], field: str, form: str, scale: float = 1.0) -> str:
    return _cell([row[field] for row in rows], form, scale)


def _kind(rows: Sequence[dict[str, Any]], *kinds: str) -> str:
    return _cell([sum(row["bytes_by_kind"].get(kind, 0) for kind in kinds) for row in rows], ",.0f", 1e-3)


def _groups(
    options: Any, teams: dict[str, TeamOptions], duration: float | None = None
) -> dict[str, list[dict[str, Any]]]:
    """Rows by name of a team, with the times that need all of them."""
    parts = {name: flown(options, team) for name, team in teams.items()}
    rows = iter(compared([row for part in parts.values() for row in part]))
    seconds = options.duration if duration is None else duration
    options.about = f"Three robots in the embedded warehouse (50×40×8 m), {seconds:g} s, "
    options.about += f"{len(options.seeds)} seeds: mean (range)."
    return {name: [next(rows) for _ in part] for name, part in parts.items()}


def _table(groups: dict[str, list[dict[str, Any]]], *facts: tuple[str, str, str, float]) -> Iterator[Row]:
    for label, field, form, scale in facts:
        yield {"": label, **{name: _of(rows, field, form, scale) for name, rows in groups.items()}}


def exploration(options: Any) -> Iterator[Row]:
    team = TeamOptions(duration=options.duration, sample_every=10.0, codecs=("draco",))
    groups = _groups(options, {name: replace(team, framework=kind) for name, kind in _TEAMS.items()})
    yield from _table(
        groups,
        ("entropy taken away (kbit)", "entropy_reduction_bits", ",.0f", 1e-3),
        ("t50 (s)", "t50", ".0f", 1.0),
        ("t90 (s)", "t90", ".0f", 1.0),
        ("AUC, all observable cells", "auc", ".3f", 1.0),
        ("cross-entropy (bits a cell)", "cross_entropy_bits", ".3f", 1.0),
        ("cells observed (%)", "observed_share", ".1f", 100.0),
        ("cells on which two robots differ (%)", "map_disagreement", ".1f", 100.0),
        ("coverage (m³/m)", "coverage_per_metre", ".1f", 1.0),
        ("flown (m)", "path_length", ",.0f", 1.0),
        ("collisions", "collisions", ".0f", 1.0),
        ("sent (kB)", "bytes_sent", ",.0f", 1e-3),
        ("novel points, 12 B each (kB)", "bytes_raw_points", ",.0f", 1e-3),
        ("the same by Draco (kB)", "bytes_draco", ",.0f", 1e-3),
        ("the same as an octree, zstd (kB)", "octree_zstd", ",.0f", 1e-3),
        ("the same as an octree, contexts (kB)", "octree_contexts", ",.0f", 1e-3),
        ("on the wire, with headers (kB)", "wire_bytes", ",.0f", 1e-3),
        ("maps equal after the end (s)", "converged_after", ".0f", 1.0),
    )
    for kind in ("components", "counts", "views", "plans", "announcements"):
        kinds = (kind, "supersessions") if kind == "counts" else (kind,)
        yield {"": f"of what is sent: {kind} (kB)", **{name: _kind(r, *kinds) for name, r in groups.items()}}


def networks(options: Any) -> Iterator[Row]:
    team = TeamOptions(duration=_SHORT, sample_every=10.0)
    yield from _table(
        _groups(options, {name: replace(team, loss=loss) for name, loss in _LOSSES.items()}, _SHORT),
        ("entropy taken away (kbit)", "entropy_reduction_bits", ",.0f", 1e-3),
        ("t90 (s)", "t90", ".0f", 1.0),
        ("on the wire, with headers (kB)", "wire_bytes", ",.0f", 1e-3),
        ("bytes on the wire, lossless = 1", "wire_ratio", ".2f", 1.0),
        ("maps equal seconds after the end (s)", "converged_after", ".0f", 1.0),
    )


def budgets(options: Any) -> Iterator[Row]:
    team = TeamOptions(duration=_SHORT, sample_every=10.0, loss=0.3)
    groups = _groups(options, {name: replace(team, budget=most) for name, most in _BUDGETS.items()}, _SHORT)
    known = {
        name: [
            [(row["observable_bits"] - curve[-1]) / 1e3 for curve in row["entropy_bits_per_robot"]]
            for row in rows
        ]
        for name, rows in groups.items()
    }
    means = {name: _cell([sum(each) / len(each) for each in rows], ",.0f") for name, rows in known.items()}
    yield {"": "entropy that a robot's map lost (kbit)", **means}
    yield {"": "that of the worst robot (kbit)"} | {
        name: _cell([min(each) for each in rows], ",.0f") for name, rows in known.items()
    }
    yield from _table(groups, ("sent (kB)", "bytes_sent", ",.0f", 1e-3))


CASES = (
    Case("exploration", exploration, needs_data=False),
    Case("networks", networks, "E0.", needs_data=False),
    Case("budgets", budgets, "E0; 30 % of the datagrams are lost.", needs_data=False),
)

if __name__ == "__main__":
    run(
        __doc__ or "",
        *CASES,
        seeds={"type": int, "nargs": "+", "default": [0, 1, 2]},
        duration={"type": float, "default": 600.0},
        missions={"default": "outputs/missions", "help": "folder of finished missions"},
    )
