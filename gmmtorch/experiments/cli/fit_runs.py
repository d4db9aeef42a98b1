"""The fits of gmmtorch-fit: their points and options, one by one or streamed, and their rows and figures."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from omegaconf import DictConfig
from torch import Tensor

from gmmtorch import cli
from gmmtorch.datasets import PointChunks, in_memory, open_points
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments import evaluation
from gmmtorch.experiments.evaluation import FitData, FitOptions, FitOutcome
from gmmtorch.mixture import SAMPLE_POINTS, Checkpoint, PruneOptions, is_launched, joined
from gmmtorch.report import Event, ProgressBars, Row
from gmmtorch.scan import Scan

if TYPE_CHECKING:
    from gmmtorch.report import Board


def fit_options(config: DictConfig) -> FitOptions:
    """The options of a fit from `mixture.*` and `runtime.*`."""
    runtime = config.runtime
    return cli.build(FitOptions, config, "mixture", dtype=runtime.dtype, compiled=runtime.compile)


def fit_data(config: DictConfig, device: str, on_event: Event) -> FitData:
    """The points of the selected scans: at most `max_points`, split by `test_share`."""
    return fit_data_of(config, *selected_scans(config, device, on_event))


def fit_data_of(config: DictConfig, name: str, scans: Sequence[Scan]) -> FitData:
    """The same for given scans of the data set with this name."""
    points = torch.cat([scan.points for scan in scans])
    sizes = torch.tensor([len(scan.points) for scan in scans], device=points.device)
    views = evaluation.Views(
        torch.repeat_interleave(sizes), torch.stack([scan.origin.double() for scan in scans])
    )
    chosen = _subset(points, config.max_points, config.seed)
    views = views._replace(scan=views.scan[chosen])
    return evaluation.split(name, points[chosen], config.test_share, config.seed, views)


def selected_scans(config: DictConfig, device: str, on_event: Event) -> tuple[str, list[Scan]]:
    """The data set's name, and its scans with the indices `scans`; all scans for null."""
    dataset = cli.open_dataset(config.dataset)
    indices = list(range(len(dataset))) if config.scans is None else list(config.scans)
    for index in indices:
        if not -len(dataset) <= index < len(dataset):
            raise InvalidArgumentError(f"scans={indices}: {dataset.name} has scans 0 to {len(dataset) - 1}.")
    if not indices:
        raise InvalidArgumentError("scans is empty; give at least one index, or null for all.")
    return dataset.name, cli.read_scans(dataset, indices, device, on_event)


def _subset(points: Tensor, max_points: int | None, seed: int) -> Tensor | slice:
    """Indices of a random subset of `max_points` of the points (N, D), in their order; all if there are
    fewer."""
    if max_points is None or points.shape[0] <= max_points:
        return slice(None)
    if max_points < 1:
        raise InvalidArgumentError(f"max_points={max_points} must be at least 1, or null.")
    generator = torch.Generator().manual_seed(seed)
    return torch.randperm(points.shape[0], generator=generator)[:max_points].sort().values.to(points.device)


def fit_all(
    config: DictConfig, columns: Sequence[str], device: str, folder: Path, on_event: Event
) -> list[Row]:
    """A row for each method; saves and draws every mixture."""
    data = fit_data(config, device, on_event)
    outcome = evaluation.compare(
        data,
        list(config.method),
        fit_options(config),
        config.seed,
        on_event,
        lambda rows: cli.write_results("fit", config, rows, folder),
        cli.as_options(config.method_options),
        cli.build(PruneOptions, config, "mixture"),
    )
    for method, mixture in outcome.mixtures.items():
        mixture.save(folder / f"{method}.safetensors")
    draw(config, data.train, outcome, folder)
    cli.print_table(outcome.rows, columns, headline(outcome.rows))
    return outcome.rows


def is_streamed(config: DictConfig) -> bool:
    """Whether the options or torchrun request a streamed fit."""
    return config.points is not None or config.checkpoint is not None or config.resume or is_launched()


def stream(config: DictConfig, columns: Sequence[str], folder: Path) -> Row | None:
    """Run a streamed fit, save and draw its mixture, and print its row; returns the row, or None in workers.

    columns: of the printed table.
    """
    device = cli.set_up(config)
    if device == "cuda":
        device = f"cuda:{os.environ.get('LOCAL_RANK', '0')}"
    _check(config)
    with (
        joined(device) as processes,
        ProgressBars(enabled=config.report.progress and processes.rank == 0) as bars,
    ):
        row, mixture, sample = evaluation.fit_streamed(
            *_sources(config, device, bars),
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
    cli.write_results("fit", config, [row], folder)
    outcome = FitOutcome([row], {"em": mixture})
    draw(config, sample.train, outcome, folder)
    cli.print_table([row], columns, headline([row]))
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
        cli.logger.warning("checkpoint=%s does not exist: the fit starts from the beginning.", path)


def _checkpoint(config: DictConfig) -> Checkpoint | None:
    if config.checkpoint is None:
        return None
    path = Path(config.checkpoint).expanduser()
    return Checkpoint(path, seconds=config.checkpoint_seconds, resume=config.resume)


def _sources(
    config: DictConfig, device: str, on_event: Event
) -> tuple[tuple[PointChunks, PointChunks], int | None]:
    """Training and test sources, and how many points are sampled from each; None: all."""
    if config.points is None:
        data = fit_data(config, device, on_event)
        train, test = (
            in_memory(points, data.dataset, chunk_points=config.stream.chunk_points)
            for points in (data.train, data.test)
        )
        return (train, test), None
    source = open_points(
        config.points, chunk_points=config.stream.chunk_points, max_range=config.dataset.max_range
    )
    return evaluation.split_source(source, config.test_share, config.seed), SAMPLE_POINTS


def headline(rows: Sequence[Row]) -> str:
    """The title of a table of fits."""
    return f"{rows[0]['dataset']}: {rows[0]['n_points']:,} points"


def log_likelihood(row: Row) -> float:
    """The log-likelihood of a fit's held-out points, or of its training points if none are held out."""
    held_out = row["held_out_log_likelihood"]
    return float(row["log_likelihood"] if held_out is None else held_out)


def draw(config: DictConfig, points: Tensor, outcome: FitOutcome, folder: Path) -> None:
    """Write the figures as PNG, and figures and numbers to TensorBoard.

    points: (N, D), which the mixtures were fitted to.
    """

    def figures() -> dict[str, Any]:
        from gmmtorch.report import comparison_figure, convergence_figure, label_of, mixture_figure

        mixtures = outcome.mixtures
        likelihoods = {
            name: mixtures[name].lower_bounds_ for name in mixtures if name not in evaluation.NO_LIKELIHOODS
        }
        found = {"convergence": convergence_figure(likelihoods)}
        if len(outcome.rows) > 1:
            found["comparison"] = comparison_figure(outcome.rows)
        for method, mixture in outcome.mixtures.items():
            used = evaluation.in_use(mixture, points)  # the positions of unused components are arbitrary
            found[f"mixture_{method}"] = mixture_figure(
                points,
                mixture.means[used],
                mixture.covariances[used],
                mixture.weights[used],
                title=f"Gaussian mixture by {label_of(method)}",
            )
        return found

    def write(board: Board) -> None:
        for row in outcome.rows:
            board.scalars(row, str(row["method"]), step=0)
        board.cloud("points", points)
        for method, mixture in outcome.mixtures.items():
            for iteration, bound in enumerate(mixture.lower_bounds_, 1):
                board.scalars({"lower_bound": bound}, method, step=iteration)
            used = evaluation.in_use(mixture, points)
            board.ellipsoids(f"mixture_{method}", mixture.means[used], mixture.covariances[used])
        metrics = {f"log_likelihood_{row['method']}": row["log_likelihood"] for row in outcome.rows}
        board.hparams(cli.chosen_options(config), metrics)

    cli.show(config, folder, figures, write)
