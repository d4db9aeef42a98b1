"""gmmtorch-occupancy: learns maps from scans, scores them on held-out scans and draws them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig

from gmmtorch.cli import app, common
from gmmtorch.cli.from_options import maps
from gmmtorch.cli.studies import occupancy_studies, study

if TYPE_CHECKING:
    from torch import Tensor

    from gmmtorch.evaluation.events import Event, Row
    from gmmtorch.evaluation.held_out import Built, Outcome
    from gmmtorch.mapping.components import Components
    from gmmtorch.scan import Scan

TABLE = "method resolution kept auc auc_low auc_high brier n_components nbytes build_seconds query_seconds"


def main() -> None:
    """Entry point of the command."""
    app.start("occupancy", run)


def run(config: DictConfig) -> float | None:
    """Run the command; returns the AUC of the last row, which a sweep can optimize."""
    from gmmtorch.report.progress import ProgressBars

    device = common.set_up(config)
    folder = common.run_dir()
    with ProgressBars(enabled=config.report.progress) as bars:
        if config.study is None:
            rows = _compare(config, device, folder, bars)
        else:
            rows = study.run("occupancy", occupancy_studies.STUDIES, config, device, folder, bars)
    common.print_files(folder, folder / "results.json")
    return rows[-1].get("auc")


def _compare(config: DictConfig, device: str, folder: Path, on_event: Event) -> list[Row]:
    """A row for each method, share kept and resolution."""
    from gmmtorch.errors import check_whole
    from gmmtorch.evaluation import methods
    from gmmtorch.evaluation.held_out import evaluate

    check_whole("report.magnify", config.report.magnify, 0)
    factories = methods.choose(list(config.method), maps.known_methods(config))
    protocol = occupancy_studies.protocol_of(config)
    maps.check_factories(factories, protocol.resolution[0])
    name, scans = common.all_scans(config, device, on_event)
    outcome = evaluate(
        name,
        scans,
        factories,
        protocol,
        config.seed,
        on_event,
        # Rows are written one by one, so that a run that fails late keeps them.
        lambda rows: common.write_results("occupancy", config, rows, folder),
    )
    _show(config, scans, outcome, folder)
    common.print_table(outcome.rows, TABLE.split(), f"{name}: {len(scans)} scans")
    return outcome.rows


def _show(config: DictConfig, scans: Sequence[Scan], outcome: Outcome, folder: Path) -> None:
    """Write the figures as PNG, and figures and numbers to TensorBoard."""
    if not (config.report.figures or config.report.tensorboard):
        return
    figures = _figures(config, scans, outcome)
    common.save_figures(config, figures, folder)
    if config.report.tensorboard:
        _write_board(config, scans, outcome, figures, folder / "tensorboard")


def _figures(config: DictConfig, scans: Sequence[Scan], outcome: Outcome) -> dict[str, Any]:
    """The figures of a run by file name."""
    import torch

    from gmmtorch.report.maps.accuracy_figures import auc_against_kept_figure, roc_figure
    from gmmtorch.report.maps.map_figures import map_figure
    from gmmtorch.report.maps.map_images import MapPanel
    from gmmtorch.report.maps.map_regions import busiest_regions, robust_bounds
    from gmmtorch.report.scenes.ellipsoids import first_viewpoints
    from gmmtorch.report.scenes.mixture_figures import mixture_figure

    trajectory = torch.stack([scan.origin.double().cpu() for scan in scans])
    points = torch.cat([scan.points.double().cpu() for scan in scans])
    low, high = robust_bounds(points[:: max(1, len(points) // 200_000)], trajectory)
    surfaces = _surfaces(outcome)
    figures: dict[str, Any] = {"auc_against_kept": auc_against_kept_figure(outcome.rows)}
    for resolution in dict.fromkeys(built.row["resolution"] for built in outcome.shown):
        shown = [built for built in outcome.shown if built.row["resolution"] == resolution]
        panels = [MapPanel(_label(built), built.answer, resolution, low, high) for built in shown]
        # Grazing beams count more misses than hits in a surface cell, so ½ would hide thin surfaces.
        figures[f"map_{resolution:g}m"] = map_figure(
            panels, [trajectory], occupied_above=0.4, **_image_limits(shown)
        )
        regions = busiest_regions(points, config.report.magnify) if len(low) == 2 else []
        for number, (corner, other) in enumerate(regions, 1):
            close = [MapPanel(p.title, p.occupancy, resolution, corner, other) for p in panels]
            figures[f"map_{resolution:g}m_region_{number}"] = map_figure(close)
        if config.report.scene and len(low) == 3:
            figures[f"scene_{resolution:g}m"] = _scene(shown, points, trajectory, surfaces)
        curves = {_label(built): built.roc for built in shown}
        about = f"{shown[0].row['dataset']}, {resolution:g} m"
        figures[f"roc_{resolution:g}m"] = roc_figure(curves, about)
        figures[f"reliability_{resolution:g}m"] = _reliability(shown, about)
    if surfaces is not None:
        figures["mixture"] = mixture_figure(
            points,
            surfaces.means,
            surfaces.covariances,
            surfaces.support,
            seen_from=first_viewpoints(surfaces) if surfaces.dim == 3 else None,
            title="Surfaces of the map",
        )
    return figures


def _reliability(shown: Sequence[Built], about: str) -> Any:
    """The reliability diagram of the maps at one resolution."""
    from gmmtorch.evaluation.calibration import reliability
    from gmmtorch.evaluation.queries import OCCUPIED
    from gmmtorch.report.maps.accuracy_figures import reliability_figure

    curves = {}
    for built in shown:
        known = built.asked.labels <= OCCUPIED
        curves[_label(built)] = reliability(built.theta[known], built.asked.labels[known])
    return reliability_figure(curves, f"Reliability: {about}")


def _scene(shown: Sequence[Built], points: Tensor, trajectory: Tensor, surfaces: Components | None) -> Any:
    """The maps of one resolution in space, beside the points and the surfaces of the `GaussianMap`."""
    from gmmtorch.evaluation.metrics import separating_threshold
    from gmmtorch.evaluation.queries import FREE, OCCUPIED
    from gmmtorch.report.scenes.map_scenes import OccupancyPanel, map_scene_figure
    from gmmtorch.report.style import label_of
    from gmmtorch.report.table import byte_text

    maps = []
    for built in shown:
        row, theta = built.row, built.theta
        # Thresholds of their own, because maps differ in calibration.
        least = separating_threshold(theta[built.asked.of(OCCUPIED)], theta[built.asked.of(FREE)])
        n = "" if row["n_components"] is None else f"{row['n_components']:,} components, "
        title = f"{_label(built)}: {n}{byte_text(row['nbytes'])}, AUC {row['auc']:.3f}, θ ≥ {least:.2f}"
        maps.append(OccupancyPanel(title, built.answer, least))
    resolution = shown[0].row["resolution"]
    title = (
        f"{label_of(shown[0].row['dataset'])}: cells of {100 * resolution:g} cm that each map calls occupied"
    )
    return map_scene_figure(points, trajectory, maps, resolution, surfaces, title=title)


def _image_limits(shown: Sequence[Built]) -> dict[str, Any]:
    """Limits of the image size for forms that integrate over cells, which are slow in 3D."""
    if shown[0].asked.points.shape[1] == 3 and any(b.row["method"] in ("flux", "cone") for b in shown):
        return {"max_pixels": 250, "max_queries": 100_000}
    return {}


def _surfaces(outcome: Outcome) -> Components | None:
    """The surface components of the first `GaussianMap`; None if there is none."""
    from gmmtorch.mapping.gaussian_map import GaussianMap

    for built in outcome.shown:
        if isinstance(built.map, GaussianMap):
            components = built.map.components()
            return components.selected((~components.max_range).nonzero().squeeze(1))
    return None


def _label(built: Built) -> str:
    from gmmtorch.report.style import label_of

    return label_of(built.row["method"])


def _write_board(
    config: DictConfig, scans: Sequence[Scan], outcome: Outcome, figures: dict[str, Any], folder: Path
) -> None:
    import torch

    from gmmtorch.evaluation.queries import OCCUPIED
    from gmmtorch.report.tensorboard_writer import Board

    with Board(folder) as board:
        # The step is the percentage of data kept. Steps must not decrease, which would mean a restart.
        for row in sorted(outcome.rows, key=lambda row: row["kept"]):
            tag = f"{row['method']}/{row['resolution']:g}m"
            board.scalars(row, tag, step=round(100 * row["kept"]))
        for built in outcome.shown:
            tag = f"{built.row['method']}/{built.row['resolution']:g}m"
            known = built.asked.labels <= OCCUPIED
            board.curve(tag, built.asked.labels[known] == OCCUPIED, built.theta[known])
        for name, figure in figures.items():
            board.figure(f"figures/{name}", figure)
        points = torch.cat([scan.points.double().cpu() for scan in scans])
        board.cloud("points", points)
        surfaces = _surfaces(outcome)
        if surfaces is not None:
            board.ellipsoids("mixture", surfaces.means, surfaces.covariances)
        scores = {
            f"auc_{built.row['method']}_{built.row['resolution']:g}m": built.row["auc"]
            for built in outcome.shown
        }
        board.hparams(common.chosen_options(config), scores)


if __name__ == "__main__":
    main()
