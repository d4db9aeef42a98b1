"""The studies of gmmtorch-fit."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from omegaconf import DictConfig

from gmmtorch.cli import build, naming
from gmmtorch.events import Event, OnRows, Row
from gmmtorch.experiments.cli import fit_outputs
from gmmtorch.experiments.cli.fits_of_options import fit_data, fit_data_of, fit_options, selected_scans
from gmmtorch.experiments.cli.studies.study import Found, Study
from gmmtorch.experiments.evaluation import means
from gmmtorch.experiments.report import component_count_figures, initialization_figures, sensor_model_figures
from gmmtorch.experiments.studies import (
    ComponentCountStudy,
    InitializationStudy,
    SensorModelStudy,
    middle,
    run_component_count,
    run_initialization,
    run_sensor_noise,
    sensor_model,
)

Figures = Callable[[list[Row]], Mapping[str, Any]]


def _initialization(config: DictConfig, device: str, on_event: Event, on_rows: OnRows) -> Found:
    study = build(InitializationStudy, config, "study")
    data = fit_data(config, device, on_event)
    rows = run_initialization(data, study, fit_options(config), config.seed, on_event, on_rows)
    return _found(
        rows,
        initialization_figures,
        "start",
        "init_seconds n_iterations seconds psnr2_db held_out_psnr2_db log_likelihood held_out_log_likelihood",
    )


def _sensor_model(config: DictConfig, device: str, on_event: Event, on_rows: OnRows) -> Found:
    """Fields of a fit that this study does not measure are None."""
    study = build(SensorModelStudy, config, "study")
    with naming({name: f"study.{name}" for name in ("sensor", "sensor_options")}):
        sensor_model(study)  # an invalid option fails before the scans are read
    dataset, scans = selected_scans(config, device, on_event)
    rows = [
        {
            "method": row["variant"],
            "n_points": row["n_train_points"],
            "log_likelihood": None,
            "psnr2_db": None,
            **row,
        }
        for row in run_sensor_noise(dataset, scans, study, config.seed, on_event)
    ]
    return _found(
        rows,
        sensor_model_figures,
        "variant",
        "held_out_log_likelihood auc auc_near_surface thickness sensor_deviation seconds n_iterations nbytes",
    )


def _component_count(config: DictConfig, device: str, on_event: Event, on_rows: OnRows) -> Found:
    study = build(ComponentCountStudy, config, "study")
    dataset, scans = selected_scans(config, device, on_event)
    data = fit_data_of(config, dataset, middle(scans, study.window))
    options = fit_options(config)
    rows = run_component_count(data, scans, study, options, config.seed, on_event, on_rows)
    return _found(
        rows,
        component_count_figures,
        "rule",
        "setting component_bytes held_out_psnr2_db held_out_log_likelihood auc count_seconds seconds",
    )


def _found(rows: list[Row], figures: Figures, line: str, columns: str) -> Found:
    """The table shows means over the seeds for each value of the field `line` and number of components."""
    table = means(rows, (line, "n_components"))
    return Found(
        rows,
        figures,
        f"{line} n_components n_seeds {columns}",
        fit_outputs.headline(rows),
        shown=table,
        line=line,
        step="n_components",
        scores={"best_log_likelihood": max(fit_outputs.log_likelihood(row) for row in table)},
    )


STUDIES: dict[str, Study] = {
    "component_count": _component_count,
    "initialization": _initialization,
    "sensor_model": _sensor_model,
}
