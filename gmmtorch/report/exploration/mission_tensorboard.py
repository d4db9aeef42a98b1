"""An exploration in TensorBoard: while it runs, and what came of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from matplotlib.colors import to_rgb
from torch import Tensor

from gmmtorch.exploration.mission.variants import differing
from gmmtorch.mapping.components import Components
from gmmtorch.report.style import Rows, as_array, colour
from gmmtorch.report.tensorboard_writer import Board
from gmmtorch.scan import ArrayLike

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


class MissionBoard:
    """A mission as it runs, by simulated time.

        with Board("outputs/run/tensorboard") as board:
            live = MissionBoard(board)
            live.step(12.0, {"entropy_bits": 1.2e6, "bytes_sent": 48_000})
            live.scene(12.0, mixture, trajectories)

    A mission that resumes from a checkpoint goes back in time; TensorBoard then forgets what it had
    been told of later times.

    Args:
        board: the run; who opened it closes it.
        prefix: of the tags.
    """

    def __init__(self, board: Board, prefix: str = "mission") -> None:
        self.board, self.prefix = board, prefix

    def step(self, time: float, scalars: Mapping[str, Any]) -> None:
        """Write the finite numbers of `scalars`; the step is the whole simulated second (s)."""
        self.board.scalars(scalars, self.prefix, step=int(time))

    def scene(self, time: float, components: Components | None, trajectories: Sequence[ArrayLike]) -> None:
        """The mixture and the paths so far, at a simulated time (s), in 3D.

        Args:
            components: shown as ellipsoids; beams without return are left out. None: there is no mixture.
            trajectories: of each robot, poses (T, ≥ 3), world metres, shown as a cloud in their colours.
        """
        if components is not None:
            surface = ~components.max_range
            means, covariances = components.means[surface], components.covariances[surface]
            self.board.ellipsoids("mixture", means, covariances, step=int(time))
        self.board.cloud("paths", *_path_cloud(trajectories), step=int(time))


def write_exploration_board(
    board: Board,
    rows: Rows,
    figures: Mapping[str, Figure],
) -> None:
    """Trials and their pictures into one TensorBoard run.

    By framework, options in which the rows differ, and seed: entropy (bits, and the share left of the
    observable), the robots' own entropies, cumulative bytes and the share of records missing over simulated
    seconds, and every number of the row at its end.

    Args:
        board: the run; who opened it closes it.
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
    """A part of a tag: each field with its value, as planner_mcts_loss_0.3; empty if there is none."""
    parts = [f"{field}_{_short(row.get(field))}" for field in fields]
    return "_".join(parts) + "/" if parts else ""


def _short(value: Any) -> str:
    """A value in a tag; of partitions, when and who: 60-120_0_1.2."""
    if not isinstance(value, list):
        return str(value)
    cuts = [(f"{cut['begin']:g}-{cut['end']:g}", cut["groups"]) for cut in value]
    names = ["_".join([when, *(".".join(map(str, group)) for group in groups)]) for when, groups in cuts]
    return "_".join(names) or "none"


def _write_series(board: Board, row: Mapping[str, Any], tag: str) -> None:
    observable = max(float(row["observable_bits"]), 1.0)
    for i, time in enumerate(row["times"]):
        now = {name: row[name][i] for name in _SERIES if row.get(name)}
        now["entropy_left"] = row["entropy_bits"][i] / observable
        robots = row.get("entropy_bits_per_robot") or []
        now |= {f"robot_{n}/entropy_bits": bits[i] for n, bits in enumerate(robots)}
        board.scalars(now, tag, step=int(time))


def _path_cloud(trajectories: Sequence[ArrayLike]) -> tuple[Tensor, Tensor]:
    """Points (N, 3) of all paths, and the robots' colours (N, 3), 0 to 255."""
    paths = [as_array(path)[:, :3] for path in trajectories]
    if not paths:
        return torch.empty(0, 3), torch.empty(0, 3)
    hues = [np.tile(255 * np.array(to_rgb(colour(i))), (len(path), 1)) for i, path in enumerate(paths)]
    return torch.from_numpy(np.concatenate(paths)), torch.from_numpy(np.concatenate(hues))
