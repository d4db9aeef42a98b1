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
    """Rows of results.json, figures by file name, columns of the table, and what it is about."""

    rows: Rows
    figures: dict[str, Any]
    table: str
    about: str


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
    common.save_figures(config, found.figures, folder)
    if config.report.tensorboard:
        from gmmtorch.report import Board

        with Board(folder / "tensorboard") as board:
            for step, row in enumerate(found.rows):
                board.scalars(row, str(row["method"]), step=step)
            for name, figure in found.figures.items():
                board.figure(f"figures/{name}", figure)
    common.print_table(found.rows, found.table.split(), found.about)
    return found.rows


def _options(config: DictConfig) -> dict[str, Any]:
    """The options `study.*` but for the study's name."""
    return {name: value for name, value in common.as_options(config.study).items() if name != "name"}


def _scans(config: DictConfig, device: str, on_event: Event) -> tuple[str, list[Scan]]:
    dataset = common.open_dataset(config.dataset)
    return dataset.name, common.read_scans(dataset, range(len(dataset)), device, on_event)


def _auc_memory(config: DictConfig, device: str, on_event: Event, keep: Keep) -> Found:
    """Every method of the run at its one size, and those of `study.sizes` at each of theirs."""
    from gmmtorch.evaluation import auc_memory, contenders, occupancy
    from gmmtorch.evaluation.auc_memory import Sized
    from gmmtorch.report import auc_memory as report

    protocol = occupancy.Protocol(**common.as_options(config.evaluation))
    options = _options(config)
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
    name, scans = _scans(config, device, on_event)
    rows = auc_memory.run(name, scans, found, protocol, config.seed, on_event, keep)
    table = "method size resolution auc auc_low auc_high brier nbytes build_seconds query_seconds"
    return Found(rows, report.figures(rows), table, f"{name}: {len(scans)} scans")


def _variance_threshold(config: DictConfig, device: str, on_event: Event, keep: Keep) -> Found:
    """Maps of several sizes under several thresholds."""
    import torch

    from gmmtorch.evaluation import variance_threshold
    from gmmtorch.report import variance_threshold as report

    options = _options(config)
    method = options.pop("method")
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


STUDIES = {"auc_memory": _auc_memory, "variance_threshold": _variance_threshold}
