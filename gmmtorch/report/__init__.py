"""What a run shows: figures, tables, progress bars and a TensorBoard run.

Nothing heavy is imported before it is used. Figures are built on `matplotlib.figure.Figure` alone:
no pyplot, no window, no global state.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gmmtorch.report.board import Board as Board
    from gmmtorch.report.calibration import reliability_figure as reliability_figure
    from gmmtorch.report.comparison import comparison_figure as comparison_figure
    from gmmtorch.report.curves import convergence_figure as convergence_figure
    from gmmtorch.report.curves import roc_figure as roc_figure
    from gmmtorch.report.exploration_bars import profile_figure as profile_figure
    from gmmtorch.report.exploration_bars import stage_means as stage_means
    from gmmtorch.report.exploration_bars import summary_bars as summary_bars
    from gmmtorch.report.exploration_board import MissionBoard as MissionBoard
    from gmmtorch.report.exploration_board import write_exploration_board as write_exploration_board
    from gmmtorch.report.exploration_curves import bandwidth_figure as bandwidth_figure
    from gmmtorch.report.exploration_curves import entropy_figure as entropy_figure
    from gmmtorch.report.exploration_curves import planner_comparison_figure as planner_comparison_figure
    from gmmtorch.report.exploration_loss import loss_figure as loss_figure
    from gmmtorch.report.exploration_maps import TeamSnapshot as TeamSnapshot
    from gmmtorch.report.exploration_maps import team_map_figure as team_map_figure
    from gmmtorch.report.exploration_maps import trajectories_figure as trajectories_figure
    from gmmtorch.report.exploration_recording import RecordedMap as RecordedMap
    from gmmtorch.report.exploration_recording import record_rerun as record_rerun
    from gmmtorch.report.exploration_scene import mixture_scene_figure as mixture_scene_figure
    from gmmtorch.report.exploration_top_view import TopView as TopView
    from gmmtorch.report.exploration_top_view import top_view as top_view
    from gmmtorch.report.maps import map_figure as map_figure
    from gmmtorch.report.meshes import ellipsoid_mesh as ellipsoid_mesh
    from gmmtorch.report.mixtures import mixture_figure as mixture_figure
    from gmmtorch.report.progress import ProgressBars as ProgressBars
    from gmmtorch.report.raster import MapPanel as MapPanel
    from gmmtorch.report.save import save_figure as save_figure
    from gmmtorch.report.sparsity import auc_against_kept_figure as auc_against_kept_figure
    from gmmtorch.report.table import format_table as format_table

_HOMES = {
    "Board": "board",
    "MapPanel": "raster",
    "MissionBoard": "exploration_board",
    "ProgressBars": "progress",
    "RecordedMap": "exploration_recording",
    "TeamSnapshot": "exploration_maps",
    "TopView": "exploration_top_view",
    "auc_against_kept_figure": "sparsity",
    "bandwidth_figure": "exploration_curves",
    "comparison_figure": "comparison",
    "convergence_figure": "curves",
    "ellipsoid_mesh": "meshes",
    "entropy_figure": "exploration_curves",
    "format_table": "table",
    "loss_figure": "exploration_loss",
    "map_figure": "maps",
    "mixture_figure": "mixtures",
    "mixture_scene_figure": "exploration_scene",
    "planner_comparison_figure": "exploration_curves",
    "profile_figure": "exploration_bars",
    "record_rerun": "exploration_recording",
    "reliability_figure": "calibration",
    "roc_figure": "curves",
    "save_figure": "save",
    "stage_means": "exploration_bars",
    "summary_bars": "exploration_bars",
    "team_map_figure": "exploration_maps",
    "top_view": "exploration_top_view",
    "trajectories_figure": "exploration_maps",
    "write_exploration_board": "exploration_board",
}


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])
