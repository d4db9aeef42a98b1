"""SweepTable: the results of all jobs of a sweep in one table."""

from __future__ import annotations

import importlib
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

ERROR_FILE = "error.txt"
"""Name of the file that a failed job leaves in its folder."""
_CLOCK_STEP = 2.0
"""Seconds by which the times of files may be coarse."""


class Job(NamedTuple):
    """A job of a sweep: its folder's name, its options, its rows, and its error ("" without)."""

    name: str
    options: dict[str, str]
    rows: list[dict[str, Any]]
    error: str


class SweepTable(Callback):
    """Prints the rows of all jobs when a sweep ends. The exit status is 1 if a job failed.

    module: dotted name of the command's module, whose `TABLE` names the columns.
    """

    def __init__(self, module: str) -> None:
        self._module = module

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        self._begin = time.time()

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        from gmmtorch.report import format_table

        folder = Path(config.hydra.sweep.dir)
        jobs = read_jobs(folder, self._begin - _CLOCK_STEP)
        if not jobs:  # the command writes no folders
            return
        table = str(getattr(importlib.import_module(self._module), "TABLE", ""))
        rows, columns = joint_rows(jobs, table.split())
        print(f"\n{len(jobs)} jobs in {folder}\n{format_table(rows, columns)}")
        print(f"\nresults   {folder}/*/results.json\nbrowse    tensorboard --logdir {folder}")
        if failed := [job.name for job in jobs if job.error]:
            sys.exit(f"gmmtorch: error: {len(failed)} of {len(jobs)} jobs failed: {', '.join(failed)}.")


def read_jobs(folder: Path, begin: float) -> list[Job]:
    """The jobs below a sweep's folder that started after a time (s since the epoch), in their order."""
    jobs = []
    for path in folder.rglob(".hydra/overrides.yaml"):
        if path.stat().st_mtime >= begin:
            job = path.parent.parent
            overrides = [str(item).partition("=") for item in OmegaConf.load(path)]
            jobs.append(
                Job(
                    str(job.relative_to(folder)),
                    {name.lstrip("+"): value for name, _, value in overrides},
                    *_results(job),
                )
            )
    return sorted(jobs, key=lambda job: (len(job.name), job.name))


def _results(folder: Path) -> tuple[list[dict[str, Any]], str]:
    """The rows and the error of a job."""
    error = folder / ERROR_FILE
    if error.is_file():
        return [], error.read_text("utf-8").splitlines()[-1]
    try:
        return json.loads((folder / "results.json").read_text("utf-8"))["rows"], ""
    except (OSError, ValueError, LookupError) as reason:
        return [], f"no results ({reason})"


def joint_rows(jobs: Sequence[Job], columns: Sequence[str]) -> tuple[list[dict[str, Any]], list[str]]:
    """The rows of a sweep's table, and its columns: job, options that differ, the command's, error."""
    names = list(dict.fromkeys(name for job in jobs for name in job.options))
    swept = [name for name in names if len({job.options.get(name) for job in jobs}) > 1]
    rows: list[dict[str, Any]] = []
    for job in jobs:
        head = {"job": job.name, **{name: job.options.get(name) for name in swept}}
        rows += [{**row, **head} for row in job.rows] or [{**head, "error": job.error}]
    shown = [name for name in columns if any(name in row for row in rows)]
    if len(shown) < 3:  # rows of a study have columns of their own
        found = dict.fromkeys(
            k for row in rows for k, value in row.items() if not isinstance(value, list | dict)
        )
        shown = [name for name in found if name not in ("job", "error", *swept)]
    error = ["error"] if any(job.error for job in jobs) else []
    return rows, ["job", *swept, *(name for name in shown if name not in swept), *error]
