"""Studies: experiments that ask more of gmmtorch-occupancy than a row for each method.

To add one: a function here that makes its rows and figures, its options in `schema`, and a file in
conf/experiment that says what it runs on.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from omegaconf import DictConfig

from gmmtorch.cli import common, maps

if TYPE_CHECKING:
    from gmmtorch.evaluation.events import Event
    from gmmtorch.scan import Scan

Rows = list[dict[str, Any]]
Keep = Callable[[Rows], object]


class Found(NamedTuple):
    """Rows of results.json, figures by file name, columns of the table, and what it is about.

    shown: the rows of the table; all of them if None.
    """

    rows: Rows
    figures: dict[str, Any]
    table: str
    about: str
    shown: Rows | None = None


def run(config: DictConfig, device: str, folder: Path, on_event: Event) -> Rows:
    """Make the rows of the study that `config.study` names, and show them.

    results.json is written with each row; then the figures, as PNG and in TensorBoard, and the table.
    """
    from gmmtorch.errors import InvalidArgumentError

    if config.study.name not in STUDIES:
        raise InvalidArgumentError(
            f"study.name={config.study.name!r} is not known; known are {', '.join(STUDIES)}."
        )

    def keep(rows: Rows) -> None:
        common.write_results("occupancy", config, rows, folder)

    found = STUDIES[config.study.name](config, device, on_event, keep)
    keep(found.rows)
    shown = found.rows if found.shown is None else found.shown
    common.save_figures(config, found.figures, folder)
    if config.report.tensorboard:
        from gmmtorch.report.tensorboard_writer import Board

        with Board(folder / "tensorboard") as board:
            for step, row in enumerate(shown):
                board.scalars(row, str(row["method"]), step=step)
            for name, figure in found.figures.items():
                board.figure(f"figures/{name}", figure)
    common.print_table(shown, found.table.split(), found.about)
    return found.rows


def _options(config: DictConfig) -> dict[str, Any]:
    """The options `study.*` but for the study's name."""
    return {name: value for name, value in common.as_options(config.study).items() if name != "name"}


def _scans(config: DictConfig, device: str, on_event: Event) -> tuple[str, list[Scan]]:
    dataset = common.open_dataset(config.dataset)
    return dataset.name, common.read_scans(dataset, range(len(dataset)), device, on_event)


def _auc_memory(config: DictConfig, device: str, on_event: Event, keep: Keep) -> Found:
    """Our map and BGK's at each of their sizes, and `study.others` at the one they have."""
    from gmmtorch.errors import InvalidArgumentError
    from gmmtorch.evaluation import held_out as occupancy
    from gmmtorch.evaluation import methods as contenders
    from gmmtorch.evaluation.studies import auc_memory
    from gmmtorch.evaluation.studies.auc_memory import Sized
    from gmmtorch.mapping.query_options import check_method
    from gmmtorch.report.studies import auc_memory_figures as report

    protocol = occupancy.Protocol(**common.as_options(config.evaluation))
    options = _options(config)
    for form in options["forms"]:
        check_method(form)
    found = [
        Sized(form, n, contenders.Form(maps.map_factory(config, n_components=n), form))
        for form in options["forms"]
        for n in options["n_components"]
    ]
    limits = maps.limits(config)
    found += [
        Sized("bgk_points", n, contenders.baseline("bgk_points", limits, max_points=n))
        for n in options["bgk_points"]
    ]
    others = contenders.choose(options["others"], maps.known_methods(config)) if options["others"] else {}
    found += [Sized(name, None, factory) for name, factory in others.items()]
    if not found:
        raise InvalidArgumentError(
            "study.n_components, .bgk_points and .others leave no map; give one of them."
        )
    for sized in found:
        maps.check_factories({sized.method: sized.factory}, protocol.resolution[0])
    name, scans = _scans(config, device, on_event)
    rows = auc_memory.run(name, scans, found, protocol, config.seed, on_event, keep)
    table = "method size resolution auc auc_low auc_high brier nbytes build_seconds query_seconds"
    return Found(rows, report.figures(rows), table, f"{name}: {len(scans)} scans")


def _variance_threshold(config: DictConfig, device: str, on_event: Event, keep: Keep) -> Found:
    """Maps of several sizes under several thresholds."""
    import torch

    from gmmtorch.evaluation.studies import variance_threshold
    from gmmtorch.mapping.query_options import check_method
    from gmmtorch.report.studies import variance_threshold_figures as report

    options = _options(config)
    method = options.pop("method")
    check_method(method)
    study = variance_threshold.ThresholdStudy(**options)
    name, scans = _scans(config, device, on_event)

    def new_map(n: int) -> Any:
        return maps.map_factory(config, n_components=n)()

    found = variance_threshold.run(name, scans, new_map, study, method, config.seed, on_event, keep)
    figures = report.figures(found.rows)
    if found.hits.shape[1] == 3:
        low, high = report.closest_look(found.thin if len(found.thin) else found.hits, found.hits)
        asked = {
            n: lambda points, built=built: torch.as_tensor(built.occupancy(points, study.resolution, method))
            for n, built in found.maps.items()
        }
        figures["variance_threshold_cells"] = report.cells_figure(
            asked, study.variance_threshold, found.hits, low, high, study.resolution
        )
    table = (
        "n_components variance_threshold occupied_recall thin_recall free_recall share_decided "
        "accuracy_decided auc auc_thin nbytes"
    )
    return Found(found.rows, figures, table, f"{name}: {len(scans)} scans")


def _approximation_error(config: DictConfig, device: str, on_event: Event, keep: Keep) -> Found:
    """Every form of evidence against the exact angular form; needs no data set."""
    from gmmtorch.evaluation.studies import approximation_error
    from gmmtorch.report.studies import approximation_error_figures as report

    options = approximation_error.Options(**_options(config))
    rows = approximation_error.run(options, config.seed, on_event, keep)
    swept = [row for row in rows if row["study"] == "sweep"]
    table = "method dim hits_max hits_p99 hits_median misses_max misses_p99 misses_median probability_max"
    return Found(rows, report.figures(rows), table, "errors a ray of one component, at random", swept)


def _pose_correction(config: DictConfig, device: str, on_event: Event, keep: Keep) -> Found:
    """Maps of perturbed poses, before and after the poses are put right."""
    from gmmtorch.errors import InvalidArgumentError
    from gmmtorch.evaluation import held_out as occupancy
    from gmmtorch.evaluation.studies import pose_correction
    from gmmtorch.mapping.query_options import METHODS, check_method
    from gmmtorch.report.studies import pose_correction_figures as report

    protocol = occupancy.Protocol(**common.as_options(config.evaluation))
    methods = _options(config)["methods"]
    if not methods:
        raise InvalidArgumentError(f"study.methods is empty; name at least one of {', '.join(METHODS)}.")
    for method in methods:
        check_method(method)
    new_map = maps.map_factory(config)
    name, scans = _scans(config, device, on_event)
    rows = pose_correction.evaluate_correction(
        name, scans, new_map, protocol, methods, config.seed, on_event, keep
    )
    table = "method resolution auc auc_corrected auc_clean n_components nbytes"
    return Found(rows, report.figures(rows), table, f"{name}: {len(scans)} scans")


STUDIES = {
    "approximation_error": _approximation_error,
    "auc_memory": _auc_memory,
    "pose_correction": _pose_correction,
    "variance_threshold": _variance_threshold,
}
