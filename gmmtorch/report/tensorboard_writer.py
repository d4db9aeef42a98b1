"""A TensorBoard run: numbers, curves, figures, clouds and ellipsoids of one run directory."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.report.maps.mesh_figures import checked_components, ellipsoid_mesh
from gmmtorch.report.style import as_array, evenly
from gmmtorch.scan import ArrayLike

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_POINTS = 50_000
"""Points of a cloud, or vertices of a mesh: what a browser still turns smoothly."""

_FINEST = 2  # subdivisions of an ellipsoid


class Board:
    """Writes the events of one TensorBoard run.

        with Board("outputs/run/tensorboard") as board:
            board.scalars({"auc": 0.97}, prefix="occupancy", step=0)

    Args:
        directory: where the event file goes; made if it is not there.
        max_points: points a cloud, and vertices a mesh, may have; of more an even share is kept.
    """

    def __init__(self, directory: str | Path, max_points: int = MAX_POINTS) -> None:
        from torch.utils.tensorboard import SummaryWriter

        if max_points < 1:
            raise InvalidArgumentError(f"max_points={max_points} must be at least 1.")
        self.directory = Path(directory)
        self.max_points = max_points
        self._writer = SummaryWriter(str(self.directory))

    def scalars(self, row: Mapping[str, Any], prefix: str = "", step: int = 0) -> None:
        """Every finite number of a row, tagged prefix/name; what is no finite number is not written."""
        for name, value in row.items():
            if _is_number(value):
                tag = f"{prefix}/{name}" if prefix else name
                self._writer.add_scalar(tag, float(value), step)

    def curve(self, tag: str, labels: ArrayLike, probabilities: ArrayLike, step: int = 0) -> None:
        """How well probabilities (M,) tell labels (M,), 1 occupied and 0 free: a precision-recall curve
        and, where both labels occur, a picture of the receiver operating characteristic (tag/roc)."""
        truth, theta = as_array(labels) > 0.5, as_array(probabilities)
        if truth.shape != theta.shape or truth.ndim != 1:
            raise InvalidArgumentError(
                f"labels has shape {truth.shape} and probabilities {theta.shape}; both must be (M,)."
            )
        if len(truth) == 0:
            return
        self._writer.add_pr_curve(tag, truth, theta, step)
        if truth.all() or not truth.any():
            return
        from sklearn.metrics import roc_auc_score, roc_curve

        from gmmtorch.report.curves import roc_figure

        false_rate, true_rate, _ = roc_curve(truth, theta)
        name = tag.rsplit("/", 1)[-1]
        curves = {name: (false_rate, true_rate, float(roc_auc_score(truth, theta)))}
        self.figure(f"{tag}/roc", roc_figure(curves), step)

    def figure(self, tag: str, figure: Figure, step: int = 0) -> None:
        """A figure, as a picture."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        # SummaryWriter.add_figure would load pyplot only to close what pyplot never opened.
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        pixels = np.asarray(canvas.buffer_rgba())[..., :3].copy()
        self._writer.add_image(tag, pixels, step, dataformats="HWC")

    def cloud(self, tag: str, points: ArrayLike, colors: ArrayLike | None = None, step: int = 0) -> None:
        """Points (N, D), metres, with colours (N, 3) from 0 to 255; nothing is written for no points."""
        cloud = torch.as_tensor(points).detach().cpu()
        if cloud.ndim != 2 or cloud.shape[1] not in (2, 3):
            raise InvalidArgumentError(f"points has shape {tuple(cloud.shape)}; expected (N, 2) or (N, 3).")
        kept = torch.from_numpy(evenly(len(cloud), self.max_points))
        colour = None
        if colors is not None:
            colour = torch.as_tensor(colors).detach().cpu()
            if colour.shape != (len(cloud), 3):
                raise InvalidArgumentError(
                    f"colors has shape {tuple(colour.shape)}; expected ({len(cloud)}, 3), 0 to 255."
                )
            colour = colour[kept]
        if len(cloud):
            flat = cloud.new_zeros(len(kept), 3 - cloud.shape[1])
            self._add_mesh(tag, torch.cat([cloud[kept], flat], 1), colour, None, step)

    def ellipsoids(
        self, tag: str, means: ArrayLike, covariances: ArrayLike, n_sigma: float = 2.0, step: int = 0
    ) -> None:
        """Ellipsoids of components (K, D), (K, D, D), coloured by height; nothing is written for none.

        They are as finely cut as the vertices allowed permit.
        """
        mean, covariance = (value.cpu() for value in checked_components(means, covariances))
        if len(mean) == 0:
            return
        fits = [n for n in range(_FINEST + 1) if len(mean) * _vertices(n) <= self.max_points]
        subdivisions = max(fits, default=0)
        kept = torch.from_numpy(evenly(len(mean), max(1, self.max_points // _vertices(subdivisions))))
        mesh = ellipsoid_mesh(mean[kept], covariance[kept], n_sigma, subdivisions)
        self._add_mesh(tag, mesh.vertices, mesh.colors, mesh.faces, step)

    def hparams(self, config_flat: Mapping[str, Any], metrics: Mapping[str, Any]) -> None:
        """The settings of the run and what came of them, for TensorBoard's HPARAMS page, in this same run.

        Settings other than numbers, truth values and text are written as text, metrics that are
        not finite numbers are left out.
        """
        from torch.utils.tensorboard.summary import hparams

        settings = {key: _plain(value) for key, value in config_flat.items()}
        results = {key: float(value) for key, value in metrics.items() if _is_number(value)}
        # SummaryWriter.add_hparams would open a run of its own, named by the time of day.
        file_writer = self._writer._get_file_writer()
        for summary in hparams(settings, results):
            file_writer.add_summary(summary)
        self.scalars(results)

    def close(self) -> None:
        """Write what is waiting, and close the file."""
        self._writer.close()

    def __enter__(self) -> Board:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _add_mesh(
        self, tag: str, vertices: Tensor, colors: Tensor | None, faces: Tensor | None, step: int
    ) -> None:
        self._writer.add_mesh(
            tag,
            vertices.float()[None],
            None if colors is None else colors.clamp(0, 255).to(torch.uint8)[None],
            None if faces is None else faces.int()[None],
            global_step=step,
        )


def _vertices(subdivisions: int) -> int:
    """Of one ellipsoid."""
    return 10 * 4**subdivisions + 2


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool) and math.isfinite(value)


def _plain(value: Any) -> Any:
    return value if isinstance(value, bool | int | float | str) else str(value)
