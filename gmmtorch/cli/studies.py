"""Studies: experiments that ask more of gmmtorch-fit than a row for each method.

To add one: a function here that makes its rows, a line in `STUDIES` that says how they are shown, its
options in `schema`, and a file in conf/experiment that says what it runs on.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from omegaconf import DictConfig

from gmmtorch.cli import common
from gmmtorch.cli.material import chosen_scans, material, material_of

if TYPE_CHECKING:
    from gmmtorch.evaluation.estimators import FitOptions
    from gmmtorch.evaluation.events import Event
    from gmmtorch.evaluation.studies.fitting import OnRows, Row

Work = Callable[[DictConfig, str, "Event", "OnRows"], "list[Row]"]
"""(config, device, on_event, on_rows) → the rows of results.json; on_rows is told of them as they come."""


class Study(NamedTuple):
    """Where a study's rows come from, and how they are shown.

    work: makes the rows. report: the module of `gmmtorch.report.studies` whose `figures(rows)` draws them.
    line: the field of which every value has a line of its own, in the table and in TensorBoard.
    step: the whole number that its points are drawn against. table: further columns of the table.
    """

    work: Work
    report: str
    line: str
    step: str
    table: str


def run(config: DictConfig, device: str, folder: Path, on_event: Event) -> list[Row]:
    """Make the rows of the study that `config.study` names, and show them.

    results.json is written with each row; then the figures as PNG and, with the numbers, in
    TensorBoard; then the table, of means over the seeds, on standard output.
    """
    from gmmtorch.errors import InvalidArgumentError
    from gmmtorch.evaluation.studies.fitting import means

    if config.study.name not in STUDIES:
        raise InvalidArgumentError(
            f"study.name={config.study.name!r} is not known; known are {', '.join(STUDIES)}."
        )
    study = STUDIES[config.study.name]

    def keep(rows: list[Row]) -> None:
        common.write_results("fit", config, rows, folder)

    rows = study.work(config, device, on_event, keep)
    keep(rows)
    table = means(rows, (study.line, study.step))
    if config.report.figures or config.report.tensorboard:
        figures = importlib.import_module(f"gmmtorch.report.studies.{study.report}").figures(rows)
        common.save_figures(config, figures, folder)
        if config.report.tensorboard:
            _write_board(config, study, table, figures, folder / "tensorboard")
    columns = [study.line, study.step, "n_seeds", *study.table.split()]
    common.print_table(table, columns, common.headline(rows))
    return rows


def _write_board(
    config: DictConfig, study: Study, table: Sequence[Row], figures: dict[str, Any], folder: Path
) -> None:
    from gmmtorch.report.tensorboard_writer import Board

    with Board(folder) as board:
        for row in sorted(table, key=lambda row: row[study.step]):
            board.scalars(row, str(row[study.line]), step=int(row[study.step]))
        for name, figure in figures.items():
            board.figure(f"figures/{name}", figure)
        best = max(common.log_likelihood(row) for row in table)
        board.hparams(common.flat(config), {"hparam/best_log_likelihood": best})


def _options(config: DictConfig) -> dict[str, Any]:
    """The options `study.*` but for the study's name."""
    return {name: value for name, value in common.as_options(config.study).items() if name != "name"}


def _mixture(config: DictConfig) -> FitOptions:

    return common.fit_options(config)


def _initialization(config: DictConfig, device: str, on_event: Event, on_rows: OnRows) -> list[Row]:
    from gmmtorch.evaluation.studies import initialization_study as initialization

    options = initialization.Options(**_options(config))
    given = material(config, device, on_event)
    return initialization.run(given, options, _mixture(config), config.seed, on_event, on_rows)


def _sensor_model(config: DictConfig, device: str, on_event: Event, on_rows: OnRows) -> list[Row]:
    """The rows of every fit that this study does not measure are None."""
    from gmmtorch.errors import InvalidArgumentError
    from gmmtorch.evaluation.studies import sensor_noise

    options = _options(config)
    name, changes = options.pop("sensor"), options.pop("sensor_options")
    if name not in sensor_noise.SENSORS:
        raise InvalidArgumentError(f"study.sensor={name!r} is not one of {', '.join(sensor_noise.SENSORS)}.")
    model = sensor_noise.SENSORS[name]
    known = {item.name for item in fields(model)}
    if unknown := set(changes) - known:
        raise InvalidArgumentError(
            f"study.sensor_options.{min(unknown)} is not an option of {name}, which takes "
            f"{', '.join(sorted(known))}."
        )
    study = sensor_noise.NoiseStudy(**options)
    dataset, scans = chosen_scans(config, device, on_event)
    rows = sensor_noise.run(dataset, scans, model(**changes), study, config.seed, on_event)
    return [
        {"method": row["variant"], "n_points": row["n_train_points"], **_UNMEASURED, **row} for row in rows
    ]


def _component_count(config: DictConfig, device: str, on_event: Event, on_rows: OnRows) -> list[Row]:
    from gmmtorch.evaluation.studies import component_count

    study = component_count.CountStudy(**_options(config))
    dataset, scans = chosen_scans(config, device, on_event)
    given = material_of(config, dataset, component_count.middle(scans, study.window))
    return component_count.run(given, scans, study, _mixture(config), config.seed, on_event, on_rows)


_UNMEASURED = {"log_likelihood": None, "psnr2_db": None}

STUDIES = {
    "component_count": Study(
        _component_count,
        "component_count_figures",
        "rule",
        "n_components",
        "setting component_bytes held_out_psnr2_db held_out_log_likelihood auc count_seconds seconds",
    ),
    "initialization": Study(
        _initialization,
        "initialization_figures",
        "init_params",
        "n_components",
        "init_seconds n_iterations seconds psnr2_db held_out_psnr2_db log_likelihood held_out_log_likelihood",
    ),
    "sensor_model": Study(
        _sensor_model,
        "sensor_noise_figures",
        "variant",
        "n_components",
        "held_out_log_likelihood auc auc_near_surface thickness sensor_deviation seconds n_iterations nbytes",
    ),
}
