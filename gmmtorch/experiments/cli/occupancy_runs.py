"""The maps of gmmtorch-occupancy: their methods, their test, and their figures, as PNG and in TensorBoard."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from torch import Tensor

from gmmtorch import cli, report
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments import evaluation
from gmmtorch.experiments.evaluation import OCCUPIED, Built, MapFactory, Outcome, Protocol
from gmmtorch.mapping import Components, GaussianMap
from gmmtorch.report import Board, Event, Row
from gmmtorch.scan import Scan

_N_REGIONS = 2
"""Magnified regions of a 2D map with `report.detail`."""


def known_methods(config: DictConfig) -> dict[str, MapFactory]:
    """Every method by name."""
    options = cli.as_options(config.method_options)
    return evaluation.methods(cli.map_factory(config), options, **cli.limits(config))


def check_factories(factories: Mapping[str, MapFactory], resolution: float) -> None:
    """Make an empty map with each factory, so that an invalid option fails before any map is built."""
    for name, factory in factories.items():
        try:
            factory(resolution)
        except TypeError as error:  # for example text, where a baseline compares numbers
            raise InvalidArgumentError(
                f"method_options.{name} has a value of the wrong type: {error}."
            ) from error


def map_all(
    config: DictConfig, columns: Sequence[str], device: str, folder: Path, on_event: Event
) -> list[Row]:
    """A row for each method, share kept and resolution."""
    factories = evaluation.choose(list(config.method), known_methods(config))
    protocol = cli.build(Protocol, config, "evaluation")
    check_factories(factories, protocol.resolution[0])
    name, scans = cli.all_scans(config, device, on_event)
    outcome = evaluation.evaluate(
        name,
        scans,
        factories,
        protocol,
        config.seed,
        on_event,
        # Rows are written one by one, so that a run that fails late keeps them.
        lambda rows: cli.write_results("occupancy", config, rows, folder),
    )
    draw(config, scans, outcome, folder)
    cli.print_table(outcome.rows, columns, f"{name}: {len(scans)} scans")
    return outcome.rows


def draw(config: DictConfig, scans: Sequence[Scan], outcome: Outcome, folder: Path) -> None:
    """Write the figures as PNG, and figures and numbers to TensorBoard."""
    figures = partial(_figures, config, scans, outcome)
    cli.show(config, folder, figures, partial(_write_board, config, scans, outcome))


def _figures(config: DictConfig, scans: Sequence[Scan], outcome: Outcome) -> dict[str, Any]:
    """The figures of a run by file name."""
    detailed = config.report.detail
    trajectory = torch.stack([scan.origin.double().cpu() for scan in scans])
    points = torch.cat([scan.points.double().cpu() for scan in scans])
    low, high = report.robust_bounds(points[:: max(1, len(points) // 200_000)], trajectory)
    surfaces = _surfaces(outcome)
    figures: dict[str, Any] = {"auc_against_kept": report.auc_against_kept_figure(outcome.rows)}
    for resolution in dict.fromkeys(built.row["resolution"] for built in outcome.shown):
        shown = [built for built in outcome.shown if built.row["resolution"] == resolution]
        panels = [report.MapPanel(_label(built), built.answer, resolution, low, high) for built in shown]
        figures[f"map_{resolution:g}m"] = _map_figure(shown)(panels, [trajectory])
        regions = report.busiest_regions(points, _N_REGIONS) if detailed and len(low) == 2 else []
        for number, (corner, other) in enumerate(regions, 1):
            close = [report.MapPanel(p.title, p.occupancy, resolution, corner, other) for p in panels]
            figures[f"map_{resolution:g}m_region_{number}"] = report.map_figure(close)
        if detailed and len(low) == 3:
            figures[f"scene_{resolution:g}m"] = _scene(shown, points, trajectory, surfaces)
        rocs = {_label(built): built.roc for built in shown}
        curves = {name: (r.false_positive, r.true_positive, r.auc) for name, r in rocs.items()}
        about = f"{shown[0].row['dataset']}, {resolution:g} m"
        figures[f"roc_{resolution:g}m"] = report.roc_figure(curves, about)
        figures[f"reliability_{resolution:g}m"] = _reliability(shown, about)
    if surfaces is not None:
        figures["mixture"] = report.mixture_figure(
            points,
            surfaces.means,
            surfaces.covariances,
            surfaces.support,
            seen_from=report.first_viewpoints(surfaces) if surfaces.dim == 3 else None,
            title="Surfaces of the map",
        )
    return figures


def _reliability(shown: Sequence[Built], about: str) -> Any:
    """The reliability diagram of the maps at one resolution."""
    curves = {}
    for built in shown:
        known = built.asked.labels <= OCCUPIED
        curves[_label(built)] = evaluation.reliability(built.theta[known], built.asked.labels[known])
    return report.reliability_figure(curves, f"Reliability: {about}")


def _scene(shown: Sequence[Built], points: Tensor, trajectory: Tensor, surfaces: Components | None) -> Any:
    """The maps of one resolution in space, beside the points and the surfaces of the `GaussianMap`."""
    maps = []
    for built in shown:
        row = built.row
        # Thresholds of their own, because maps differ in calibration.
        least = built.roc.separating
        n = "" if row["n_components"] is None else f"{row['n_components']:,} components, "
        title = (
            f"{_label(built)}: {n}{report.byte_text(row['nbytes'])}, AUC {row['auc']:.3f}, θ ≥ {least:.2f}"
        )
        maps.append(report.OccupancyPanel(title, built.answer, least))
    resolution = shown[0].row["resolution"]
    name = report.label_of(shown[0].row["dataset"])
    title = f"{name}: cells of {100 * resolution:g} cm that each map calls occupied"
    return report.map_scene_figure(points, trajectory, maps, resolution, surfaces, title=title)


def _map_figure(shown: Sequence[Built]) -> Callable[..., Any]:
    """The function that draws the maps; small pictures of forms that integrate over cells: slow in 3D."""
    if shown[0].asked.points.shape[1] == 3 and any(b.row["method"] in ("flux", "cone") for b in shown):
        return partial(report.map_figure, max_pixels=250, max_queries=100_000)
    return report.map_figure


def _surfaces(outcome: Outcome) -> Components | None:
    """The surface components of the first `GaussianMap`; None if there is none."""
    for built in outcome.shown:
        if isinstance(built.map, GaussianMap):
            return cli.surfaces_of(built.map.components())
    return None


def _label(built: Built) -> str:
    return report.label_of(built.row["method"])


def _write_board(config: DictConfig, scans: Sequence[Scan], outcome: Outcome, board: Board) -> None:
    # The step is the percentage of data kept. Steps must not decrease, which would mean a restart.
    for row in sorted(outcome.rows, key=lambda row: row["kept"]):
        tag = f"{row['method']}/{row['resolution']:g}m"
        board.scalars(row, tag, step=round(100 * row["kept"]))
    scores = {}
    for built in outcome.shown:
        method, resolution = built.row["method"], f"{built.row['resolution']:g}m"
        known = built.asked.labels <= OCCUPIED
        board.curve(f"{method}/{resolution}", built.asked.labels[known] == OCCUPIED, built.theta[known])
        scores[f"auc_{method}_{resolution}"] = built.row["auc"]
    board.cloud("points", torch.cat([scan.points.double().cpu() for scan in scans]))
    if (surfaces := _surfaces(outcome)) is not None:
        board.ellipsoids("mixture", surfaces.means, surfaces.covariances)
    board.hparams(cli.chosen_options(config), scores)
