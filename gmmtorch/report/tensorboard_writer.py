"""TensorBoard events of a run: numbers, curves, figures, point clouds and ellipsoids."""

from __future__ import annotations

import math
import os
import socket
import struct
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.colors import to_rgb
from torch import Tensor

from gmmtorch.errors import OutputError
from gmmtorch.report.ellipsoids import checked_components, ellipsoid_mesh
from gmmtorch.report.style import as_array, colour, even_sample, picture
from gmmtorch.report.text import format_value
from gmmtorch.scan import ArrayLike

_MAX_POINTS = 50_000
"""Limit of points per cloud and vertices per mesh: browsers still turn these smoothly. More are thinned."""

_MIN_VERTICES, _MAX_VERTICES = 12, 162  # of an ellipsoid


class Board:
    """Writes the events of one TensorBoard run.

        with Board("outputs/run/tensorboard") as board:
            board.scalars({"auc": 0.97}, prefix="occupancy", step=0)

    It is written in the thread of the caller, to whom a full disk is an error; torch's SummaryWriter has a
    thread whose errors nobody can catch.

    Args:
        directory: folder of the event file; created if missing.

    Raises `OutputError` if an event cannot be written; later events are then dropped.
    """

    def __init__(self, directory: str | Path) -> None:
        from tensorboard.compat.proto.event_pb2 import Event
        from tensorboard.summary.writer.record_writer import RecordWriter

        self._directory, self._is_full, self._event = Path(directory), False, Event
        name = f"events.out.tfevents.{time.time():017.6f}.{socket.gethostname()}.{os.getpid()}"
        with self._errors():
            self._directory.mkdir(parents=True, exist_ok=True)
            self._file = (self._directory / name).open("xb")
            self._records = RecordWriter(self._file)
        self._append(Event(wall_time=time.time(), file_version="brain.Event:2"))
        self._first: dict[tuple[str, str], tuple[float, int, float] | None] = {}
        """Value, step and time of a tag's first value; None once the tag is a curve."""

    def scalars(self, row: Mapping[str, Any], prefix: str = "", step: int = 0) -> None:
        """Writes every finite number of a row with the tag prefix/name; skips all other values.

        A tag becomes a curve with its second step. Tags that have only one step when the board is closed go
        to one table of text, `results`, because a chart of one dot shows nothing.
        """
        for name, value in row.items():
            if not _is_number(value):
                continue
            tag, now = (prefix, name), (float(value), step, time.time())
            if tag not in self._first:
                self._first[tag] = now
                continue
            first = self._first[tag]
            if first is not None and first[1] == step:
                self._first[tag] = now
                continue
            for number, at, moment in (first, now) if first is not None else (now,):
                self._add("scalar", "/".join(filter(None, tag)), number, step=at, moment=moment)
            self._first[tag] = None

    def _write_results(self) -> None:
        """Writes the numbers that are no curves as one table: a line for each name, a column each prefix."""
        single = {tag: first[0] for tag, first in self._first.items() if first is not None}
        if not single:
            return
        prefixes = list(dict.fromkeys(prefix for prefix, _ in single))
        lines = [["", *prefixes], ["---"] * (len(prefixes) + 1)]
        for name in dict.fromkeys(name for _, name in single):
            values = (single.get((prefix, name)) for prefix in prefixes)
            lines.append([name, *("" if value is None else format_value(name, value) for value in values)])
        self._add("text", "results", "\n".join(f"| {' | '.join(line)} |" for line in lines))
        self._first = {}

    def curve(self, tag: str, labels: ArrayLike, probabilities: ArrayLike) -> None:
        """Writes the precision-recall curve of probabilities (M,) for labels (M,), 1 occupied and 0 free,
        and a figure of the ROC curve (tag/roc) if both labels occur."""
        truth, theta = as_array(labels) > 0.5, as_array(probabilities)
        if len(truth) == 0:
            return
        self._add("pr_curve", tag, truth, theta, step=0)
        if truth.all() or not truth.any():
            return
        from sklearn.metrics import roc_auc_score, roc_curve

        from gmmtorch.report.accuracy_figures import roc_figure

        false_rate, true_rate, _ = roc_curve(truth, theta)
        name = tag.rsplit("/", 1)[-1]
        curves = {name: (false_rate, true_rate, float(roc_auc_score(truth, theta)))}
        self.figure(f"{tag}/roc", picture(roc_figure(curves)))

    def figure(self, tag: str, png: bytes) -> None:
        """Writes an image: a PNG file, as `picture` makes it."""
        from tensorboard.compat.proto.summary_pb2 import Summary

        # summary.image would need the pixels, only to make such a file of them.
        width, height = struct.unpack_from(">II", png, 16)
        image = Summary.Image(height=height, width=width, colorspace=4, encoded_image_string=png)
        self._write(Summary(value=[Summary.Value(tag=tag, image=image)]))

    def cloud(self, tag: str, points: ArrayLike, colors: ArrayLike | None = None, step: int = 0) -> None:
        """Writes points (N, D), metres, with colours (N, 3) from 0 to 255; writes nothing for no points."""
        cloud = torch.as_tensor(points).detach().cpu()
        kept = torch.from_numpy(even_sample(len(cloud), _MAX_POINTS))
        colour = None if colors is None else torch.as_tensor(colors).detach().cpu()[kept]
        if len(cloud):
            flat = cloud.new_zeros(len(kept), 3 - cloud.shape[1])
            self._add_mesh(tag, torch.cat([cloud[kept], flat], 1), colour, None, step)

    def paths(self, tag: str, trajectories: Sequence[ArrayLike], step: int = 0) -> None:
        """Writes the poses (T, ≥ 3) of each robot, world metres, as points in the colour of the robot."""
        paths = [torch.from_numpy(as_array(path)[:, :3]) for path in trajectories]
        if paths:
            hues = [torch.tensor(to_rgb(colour(i))).expand(len(path), 3) for i, path in enumerate(paths)]
            self.cloud(tag, torch.cat(paths), 255 * torch.cat(hues), step)

    def ellipsoids(self, tag: str, means: ArrayLike, covariances: ArrayLike, step: int = 0) -> None:
        """Writes 2σ ellipsoids of components (K, D), (K, D, D), coloured by height, as finely as the limit of
        vertices permits; writes nothing for no components."""
        mean, covariance = (value.cpu() for value in checked_components(means, covariances))
        if len(mean) == 0:
            return
        n_vertices = min(max(_MAX_POINTS // len(mean), _MIN_VERTICES), _MAX_VERTICES)
        kept = torch.from_numpy(even_sample(len(mean), max(1, _MAX_POINTS // n_vertices)))
        mesh = ellipsoid_mesh(mean[kept], covariance[kept], n_vertices)
        self._add_mesh(tag, mesh.vertices, mesh.colors, mesh.faces, step)

    def hparams(self, config_flat: Mapping[str, Any], metrics: Mapping[str, Any]) -> None:
        """Writes the settings of the run and its results as columns of TensorBoard's HPARAMS page.

        Settings other than numbers, truth values and text are written as text; metrics that are not finite
        numbers are left out. Metrics are columns like settings, because TensorBoard would show a chart of one
        dot for each.
        """
        from torch.utils.tensorboard.summary import hparams

        settings = {
            k: v if isinstance(v, bool | int | float | str) else str(v) for k, v in config_flat.items()
        }
        results = {key: float(value) for key, value in metrics.items() if _is_number(value)}
        for summary in hparams({**settings, **results}, {}):
            self._write(summary)

    def close(self) -> None:
        """Writes pending events and closes the file."""
        try:
            self._write_results()
        finally:
            with suppress(OSError) if self._is_full else self._errors():  # of a full disk the caller knows
                self._file.close()

    def __enter__(self) -> Board:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _add_mesh(
        self, tag: str, vertices: Tensor, colors: Tensor | None, faces: Tensor | None, step: int
    ) -> None:
        self._add(
            "mesh",
            tag,
            vertices.float()[None],
            None if colors is None else colors.clamp(0, 255).to(torch.uint8)[None],
            None if faces is None else faces.int()[None],
            None,
            step=step,
        )

    def _add(
        self, kind: str, *content: Any, step: int = 0, moment: float | None = None, **options: Any
    ) -> None:
        """Adds what the function `kind` of torch.utils.tensorboard.summary makes of a tag and its content."""
        from torch.utils.tensorboard import summary

        self._write(getattr(summary, kind)(*content, **options), step, moment)

    def _write(self, summary: Any, step: int = 0, moment: float | None = None) -> None:
        self._append(self._event(summary=summary, step=int(step), wall_time=moment or time.time()))

    def _append(self, event: Any) -> None:
        if self._is_full:
            return
        with self._errors():
            self._records.write(event.SerializeToString())
            self._file.flush()

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self._is_full = True
            raise OutputError(
                f"{self._directory} cannot be written: {error.strerror or error}; the events of TensorBoard "
                "are incomplete."
            ) from error


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool) and math.isfinite(value)
