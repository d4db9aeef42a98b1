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
    "ProgressBars": "progress",
    "auc_against_kept_figure": "sparsity",
    "comparison_figure": "comparison",
    "convergence_figure": "curves",
    "ellipsoid_mesh": "meshes",
    "format_table": "table",
    "map_figure": "maps",
    "mixture_figure": "mixtures",
    "reliability_figure": "calibration",
    "roc_figure": "curves",
    "save_figure": "save",
}


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])
