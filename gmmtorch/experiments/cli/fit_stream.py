"""gmmtorch-fit with a streamed cloud, with several processes, or with checkpoints."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig

from gmmtorch.cli import logger, print_table, set_up, write_results
from gmmtorch.datasets import open_points
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.cli import fit_outputs
from gmmtorch.experiments.cli.fits_of_options import fit_data, fit_options
from gmmtorch.experiments.evaluation import FitOutcome, Split, fit_streamed, split_data, split_source
from gmmtorch.mixture import Checkpoint, is_launched, joined
from gmmtorch.report import Event, ProgressBars, Row


def is_wanted(config: DictConfig) -> bool:
    """Whether the options or torchrun request a streamed fit."""
    return config.points is not None or config.checkpoint is not None or config.resume or is_launched()


def run(config: DictConfig, columns: Sequence[str], folder: Path) -> Row | None:
    """Run a streamed fit, save and draw its mixture, and print its row; returns the row, or None in workers.

    columns: of the printed table.
    """
    device = set_up(config)
    if device == "cuda":
        device = f"cuda:{os.environ.get('LOCAL_RANK', '0')}"
    _check(config)
    with (
        joined(device, config.stream.timeout) as processes,
        ProgressBars(enabled=config.report.progress and processes.rank == 0) as bars,
    ):
        row, mixture, sample = fit_streamed(
            _split(config, device, bars),
            fit_options(config),
            config.seed,
            device=device,
            processes=processes,
            checkpoint=_checkpoint(config),
            on_event=bars,
        )
    if processes.rank != 0:
        return None
    mixture.save(folder / "em.safetensors")
    write_results("fit", config, [row], folder)
    outcome = FitOutcome([row], {"em": mixture}, {"em": mixture.lower_bounds_})
    fit_outputs.draw(config, sample.train, outcome, folder)
    print_table([row], columns, fit_outputs.headline([row]))
    return row


def _check(config: DictConfig) -> None:
    if list(config.method) != ["em"]:
        raise InvalidArgumentError(
            f"method={list(config.method)}: a streamed fit, or a fit by several processes, needs method=[em]."
        )
    if config.method_options:
        raise InvalidArgumentError(
            f"method_options={config.method_options}: a streamed fit has no method options; remove them."
        )
    if config.mixture.prune != "none":
        raise InvalidArgumentError(
            f"mixture.prune={config.mixture.prune}: a streamed fit does not prune; use none, and "
            "gmmtorch.mixture.prune."
        )
    if config.study is not None:
        raise InvalidArgumentError(
            f"study={config.study.name} runs in one process on a data set; remove points, checkpoint, resume "
            "and torchrun."
        )
    if config.points is not None and config.max_points is not None:
        raise InvalidArgumentError(
            f"max_points={config.max_points} is for scans, but points={config.points} is read completely: "
            "set max_points to null."
        )
    if config.resume and config.checkpoint is None:
        raise InvalidArgumentError("resume=true needs a checkpoint; give checkpoint=FILE.")
    if config.resume and not (path := Path(config.checkpoint).expanduser()).is_file():
        if not path.parent.is_dir():
            raise InvalidArgumentError(
                f"checkpoint={path}: the folder {path.parent} does not exist, so there is nothing to resume; "
                "correct the path, or remove resume=true."
            )
        logger.warning("checkpoint=%s does not exist: the fit starts from the beginning.", path)


def _checkpoint(config: DictConfig) -> Checkpoint | None:
    if config.checkpoint is None:
        return None
    stream = config.stream
    path = Path(config.checkpoint).expanduser()
    return Checkpoint(path, stream.checkpoint_every, config.checkpoint_seconds, config.resume)


def _split(config: DictConfig, device: str, on_event: Event) -> Split:
    stream = config.stream
    if config.points is None:
        return split_data(fit_data(config, device, on_event), stream.chunk_points)
    source = open_points(config.points, chunk_points=stream.chunk_points, max_range=stream.max_range)
    return split_source(source, config.test_share, config.seed, stream.sample_points)
