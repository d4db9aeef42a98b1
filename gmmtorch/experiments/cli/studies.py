"""The experiments of gmmtorch-fit and gmmtorch-occupancy: cases with rows and figures of their own.

To add one, write a function that returns its rows, a class with its options in
`experiments.studies.study_options`, entries in `FITS` or `MAPS` and in `experiment_schema.STUDIES`, and a
file in conf/experiment.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from omegaconf import DictConfig

from gmmtorch import cli
from gmmtorch.errors import InvalidArgumentError, check_choice
from gmmtorch.experiments import report, studies
from gmmtorch.experiments.cli import occupancy_runs
from gmmtorch.experiments.cli.fit_runs import (
    fit_data,
    fit_data_of,
    fit_options,
    headline,
    log_likelihood,
    selected_scans,
)
from gmmtorch.experiments.evaluation import Form, MapFactory, Protocol, baseline, choose, means
from gmmtorch.experiments.harness import Case
from gmmtorch.mapping import METHODS, GaussianMap, MixtureRule
from gmmtorch.report import Board, Event, OnRows, Row
from gmmtorch.scan import Scan

T = TypeVar("T")


@dataclass
class Setting:
    """What the measure of an experiment gets, and what it says beside its rows.

    Attributes:
        config: the options of the command.
        on_event: progress callback. on_rows: writes the rows so far.
        about: title of the printed table.
        figures: more figures, by file name.
        scores: metrics of the run for TensorBoard's table of hyperparameters.
    """

    config: DictConfig
    device: str
    on_event: Event
    on_rows: OnRows
    about: str = ""
    figures: dict[str, Callable[[], Any]] = field(default_factory=dict)
    scores: Mapping[str, float] = field(default_factory=dict)

    @property
    def seed(self) -> int:
        return int(self.config.seed)

    @property
    def callbacks(self) -> tuple[Event, OnRows]:
        return self.on_event, self.on_rows

    @property
    def protocol(self) -> Protocol:
        return cli.build(Protocol, self.config, "evaluation")

    def study(self, kind: type[T]) -> T:
        """The options of the study."""
        return cli.build(kind, self.config, "study")

    def scans(self) -> tuple[str, list[Scan]]:
        """The name of the data set, and all its scans."""
        name, scans = cli.all_scans(self.config, self.device, self.on_event)
        self.about = f"{name}: {len(scans)} scans"
        return name, scans


def run(command: str, config: DictConfig, device: str, folder: Path, on_event: Event) -> list[Row]:
    """Run the case that `config.study` names, of "fit" or "occupancy"; returns its rows.

    Writes results.json after each row, then the figures as PNG and in TensorBoard, and prints the table.
    """
    check_choice("study.name", config.study.name, STUDIES[command])
    case = STUDIES[command][config.study.name]
    setting = Setting(config, device, on_event, lambda rows: cli.write_results(command, config, rows, folder))
    rows = list(case.measure(setting))
    setting.on_rows(rows)
    shown = case.shown(rows)

    def write(board: Board) -> None:
        for index, row in enumerate(sorted(shown, key=lambda row: row[case.step]) if case.step else shown):
            board.scalars(row, str(row[case.line]), step=int(row[case.step]) if case.step else index)
        if setting.scores:
            board.hparams(cli.chosen_options(config), dict(setting.scores))

    def figures() -> dict[str, Any]:
        return {**case.figures(rows), **{name: draw() for name, draw in setting.figures.items()}}

    cli.show(config, folder, figures, write)
    cli.print_table(shown, list(case.columns), setting.about)
    return rows


def _initialization(setting: Setting) -> list[Row]:
    study = setting.study(studies.InitializationStudy)
    data = fit_data(setting.config, setting.device, setting.on_event)
    return studies.run_initialization(data, study, fit_options(setting.config), *setting.callbacks)


def _sensor_model(setting: Setting) -> list[Row]:
    """Fields of a fit that this study does not measure are None."""
    study = setting.study(studies.SensorModelStudy)
    dataset, scans = selected_scans(setting.config, setting.device, setting.on_event)
    unmeasured = {"log_likelihood": None, "psnr2_db": None}
    return [
        {"method": row["variant"], "n_points": row["n_train_points"], **unmeasured, **row}
        for row in studies.run_sensor_noise(dataset, scans, study, setting.seed, setting.on_event)
    ]


def _component_count(setting: Setting) -> list[Row]:
    study = setting.study(studies.ComponentCountStudy)
    dataset, scans = selected_scans(setting.config, setting.device, setting.on_event)
    data = fit_data_of(setting.config, dataset, studies.middle(scans, study.window))
    options = fit_options(setting.config)
    return studies.run_component_count(data, scans, study, options, setting.seed, *setting.callbacks)


def _named(columns: str) -> dict[str, str]:
    return dict.fromkeys(columns.split(), "")


def _fits(
    name: str,
    measure: Callable[[Setting], list[Row]],
    figures: Callable[[list[Row]], Mapping[str, Any]],
    line: str,
    columns: str,
) -> Case:
    """The table shows means over the seeds for each value of the field `line` and number of components."""

    def shown(rows: list[Row]) -> list[Row]:
        return means(rows, (line, "n_components"))

    def headed(setting: Setting) -> list[Row]:
        rows = measure(setting)
        setting.about = headline(rows)
        best = max(log_likelihood(row) for row in shown(rows))
        setting.scores = {"best_log_likelihood": best}
        return rows

    names = _named(f"{line} n_components n_seeds {columns}")
    return Case(name, headed, columns=names, figures=figures, shown=shown, line=line, step="n_components")


FITS = (
    _fits(
        "component_count",
        _component_count,
        report.component_count_figures,
        "rule",
        "setting component_bytes held_out_psnr2_db held_out_log_likelihood auc count_seconds seconds",
    ),
    _fits(
        "initialization",
        _initialization,
        report.initialization_figures,
        "start",
        "init_seconds n_iterations seconds psnr2_db held_out_psnr2_db log_likelihood held_out_log_likelihood",
    ),
    _fits(
        "sensor_model",
        _sensor_model,
        report.sensor_model_figures,
        "variant",
        "held_out_log_likelihood auc auc_near_surface thickness sensor_deviation seconds n_iterations nbytes",
    ),
)


def _auc_memory(setting: Setting) -> list[Row]:
    """Our map and the BGK map at each of their sizes, and `study.others` at their only size."""
    config, protocol, study = setting.config, setting.protocol, setting.study(studies.AucMemoryStudy)
    sized: dict[tuple[str, int | None], MapFactory] = {
        (form, n): Form(cli.map_factory(config, n_components=n), form)
        for form in study.forms
        for n in study.n_components
    }
    for n in study.bgk_points:
        sized["bgk_points", n] = baseline("bgk_points", cli.limits(config), max_points=n)
    for name, factory in choose(study.others, occupancy_runs.known_methods(config)).items():
        sized[name, None] = factory
    for (name, _), factory in sized.items():
        occupancy_runs.check_factories({name: factory}, protocol.resolution[0])
    return studies.run_auc_memory(*setting.scans(), sized, protocol, setting.seed, *setting.callbacks)


def _variance_threshold(setting: Setting) -> list[Row]:
    """Thin structures with several forms, sizes, cells, priors and thresholds."""
    study = setting.study(studies.VarianceThresholdStudy)
    if study.railing is None:
        (name, scans), is_thin = setting.scans(), None
    else:
        name, scans = "railing", studies.railing_scans(study.railing, study.railing_scans, setting.seed)
        is_thin = partial(studies.is_of_railing, width=study.railing)

    def new_map(n: int) -> GaussianMap:
        return cli.map_factory(setting.config, n_components=n)()

    found = studies.run_variance_threshold(
        name, scans, new_map, study, setting.seed, *setting.callbacks, is_thin
    )
    setting.about = f"{name}: {len(scans)} scans; variance threshold {study.variance_threshold[0]:g}"
    if found.hits.shape[1] == 3 and (cells := studies.cells_by_setting(found, study)):
        thin = found.thin if len(found.thin) else found.hits
        low, high = studies.BOUNDS if study.railing else report.closest_look(thin, found.hits)
        draw = partial(report.cells_figure, cells, found.hits, low, high, study.resolution[0])
        setting.figures["variance_threshold_cells"] = draw
    return found.rows


def _approximation_error(setting: Setting) -> list[Row]:
    """Every form of evidence against the exact angular form; needs no data set."""
    setting.about = "errors per ray of random single components"
    return studies.run_approximation_error(
        setting.study(studies.ApproximationErrorStudy), setting.seed, *setting.callbacks
    )


def _pose_correction(setting: Setting) -> list[Row]:
    """Maps from perturbed poses, before and after the correction of the poses."""
    protocol, study = setting.protocol, setting.study(studies.PoseCorrectionStudy)
    new_map = cli.map_factory(setting.config)
    return studies.evaluate_correction(
        *setting.scans(), new_map, protocol, study.methods, setting.seed, *setting.callbacks
    )


def _map_variants(setting: Setting) -> list[Row]:
    """Maps with changed options, such as pruning."""
    config, protocol, study = setting.config, setting.protocol, setting.study(studies.MapVariantsStudy)
    form = next((method for method in config.method if method in METHODS), "point")
    variants = {}
    for name, changes in study.variants.items():
        if unknown := set(changes) - {*config.map, *(item.name for item in fields(MixtureRule))}:
            raise InvalidArgumentError(
                f"study.variants.{name}.{min(unknown)} is not an option of map={config.map.name}."
            )
        variants[name] = Form(cli.map_factory(config, **changes), form)
    return studies.run_map_variants(*setting.scans(), variants, protocol, setting.seed, *setting.callbacks)


MAPS = (
    Case(
        "approximation_error",
        _approximation_error,
        columns=_named(
            "method dim hits_max hits_p99 hits_median misses_max misses_p99 misses_median probability_max"
        ),
        figures=report.approximation_figures,
        shown=lambda rows: [row for row in rows if row["study"] == "sweep"],
    ),
    Case(
        "auc_memory",
        _auc_memory,
        columns=_named(
            "method size resolution auc auc_low auc_high brier nbytes build_seconds query_seconds"
        ),
        figures=report.auc_memory_figures,
    ),
    Case(
        "map_variants",
        _map_variants,
        columns=_named(
            "variant resolution n_components n_free_components nbytes auc auc_gain auc_gain_low "
            "auc_gain_high held_out_log_likelihood build_seconds"
        ),
        figures=report.map_variants_figures,
        line="variant",
    ),
    Case(
        "pose_correction",
        _pose_correction,
        columns=_named("method resolution auc auc_corrected auc_clean n_components nbytes"),
        figures=report.pose_correction_figures,
    ),
    Case(
        "variance_threshold",
        _variance_threshold,
        columns=_named(
            "method n_components resolution prior occupied_recall thin_recall thin_kept free_recall "
            "free_occupied auc auc_thin brier"
        ),
        figures=report.variance_threshold_figures,
        # Those of the first threshold of the study.
        shown=lambda rows: [
            row for row in rows if row["variance_threshold"] == rows[0]["variance_threshold"]
        ],
    ),
)
STUDIES = {"fit": {case.name: case for case in FITS}, "occupancy": {case.name: case for case in MAPS}}
