"""Runs a study: an experiment of gmmtorch-fit or gmmtorch-occupancy with rows and figures of its own.

To add a study, write a function in `fit_studies` or `occupancy_studies` that returns `Found`, a class
with its options in `evaluation.studies.study_options`, an entry in `options.schema.STUDIES`, and a file in
conf/experiment.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from omegaconf import DictConfig

from gmmtorch.cli import chosen_options, print_table, show, write_results
from gmmtorch.errors import check_choice
from gmmtorch.events import Event, OnRows, Row
from gmmtorch.report import Board


class Found(NamedTuple):
    """The results of a study.

    Attributes:
        rows: of results.json.
        figures: makes the figures of the rows, by file name.
        table: columns of the printed table. about: its title. shown: its rows; None: all rows.
        line: the field that names the curve of a row in TensorBoard.
        step: the field with the step of a row in TensorBoard; None: the row's index.
        scores: metrics of the run for TensorBoard's table of hyperparameters.
    """

    rows: list[Row]
    figures: Callable[[list[Row]], Mapping[str, Any]]
    table: str
    about: str
    shown: list[Row] | None = None
    line: str = "method"
    step: str | None = None
    scores: Mapping[str, float] = {}


Study = Callable[[DictConfig, str, Event, OnRows], Found]
"""(config, device, on_event, on_rows) → the results."""


def run(
    command: str,
    studies: Mapping[str, Study],
    config: DictConfig,
    device: str,
    folder: Path,
    on_event: Event,
) -> list[Row]:
    """Run the study that `config.study` names; returns its rows.

    Writes results.json after each row, then the figures as PNG and in TensorBoard, and prints the table.
    """
    check_choice("study.name", config.study.name, studies)

    def on_rows(rows: list[Row]) -> None:
        write_results(command, config, rows, folder)

    found = studies[config.study.name](config, device, on_event, on_rows)
    on_rows(found.rows)
    shown = found.rows if found.shown is None else found.shown

    def write(board: Board) -> None:
        step = found.step
        rows = shown if step is None else sorted(shown, key=lambda row: row[step])
        for index, row in enumerate(rows):
            board.scalars(row, str(row[found.line]), step=index if step is None else int(row[step]))
        if found.scores:
            board.hparams(chosen_options(config), dict(found.scores))

    show(config, folder, lambda: found.figures(found.rows), write)
    print_table(shown, found.table.split(), found.about)
    return found.rows
