"""gmmtorch-fit: learn a Gaussian mixture from the points of scans, score it, show it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import hydra
from omegaconf import DictConfig

from gmmtorch.cli import common, schema

if TYPE_CHECKING:
    from torch import Tensor

    from gmmtorch.evaluation.fitting import FitOutcome

_TABLE = (
    "method n_points n_components seconds n_iterations log_likelihood held_out_log_likelihood psnr2_db nbytes"
)


def main() -> None:
    """Entry point of the command."""
    schema.register()
    hydra.main(version_base="1.3", config_path=common.conf_dir(), config_name="fit")(_guarded)()


def _guarded(config: DictConfig) -> float | None:
    return common.run_guarded(run, config)


def run(config: DictConfig) -> float:
    """One run; returns the held-out (else the training) log-likelihood of the last method."""
    from gmmtorch.evaluation import fitting
    from gmmtorch.report.progress import ProgressBars

    device = common.set_up(config)
    folder = common.run_dir()
    dataset = common.open_dataset(config.dataset)
    with ProgressBars(enabled=config.report.progress) as bars:
        points = _points(config, dataset, device, bars)
        outcome = fitting.compare(
            dataset.name,
            points,
            list(config.method),
            fitting.FitOptions(**common.as_options(config.mixture), dtype=config.runtime.dtype),
            config.test_share,
            config.seed,
            bars,
        )
    for method, mixture in outcome.mixtures.items():
        mixture.save(folder / f"{method}.safetensors")
    path = common.write_results("fit", config, outcome.rows, folder)
    _show(config, points, outcome, folder)
    common.print_table(outcome.rows, _TABLE.split(), f"{dataset.name}: {points.shape[0]} points")
    common.print_files(folder, path)
    last = outcome.rows[-1]
    held_out = last["held_out_log_likelihood"]
    return float(last["log_likelihood"] if held_out is None else held_out)


def _points(config: DictConfig, dataset: Any, device: str, bars: Any) -> Tensor:
    """The points (N, D) of the chosen scans, thinned to `max_points`."""
    import torch

    from gmmtorch.errors import InvalidArgumentError

    indices = list(range(len(dataset))) if config.scans is None else list(config.scans)
    for index in indices:
        if not -len(dataset) <= index < len(dataset):
            raise InvalidArgumentError(f"scans={indices}: {dataset.name} has scans 0 to {len(dataset) - 1}.")
    if not indices:
        raise InvalidArgumentError("scans is empty; name at least one, or null for all.")
    points = torch.cat([scan.points for scan in common.read_scans(dataset, indices, device, bars)])
    if config.max_points is not None and points.shape[0] > config.max_points:
        if config.max_points < 1:
            raise InvalidArgumentError(f"max_points={config.max_points} must be at least 1, or null.")
        generator = torch.Generator().manual_seed(config.seed)
        chosen = torch.randperm(points.shape[0], generator=generator)[: config.max_points].sort().values
        points = points[chosen.to(points.device)]
    return points


def _show(config: DictConfig, points: Tensor, outcome: FitOutcome, folder: Path) -> None:
    """Figures as PNG and, with the numbers, in TensorBoard."""
    if not (config.report.figures or config.report.tensorboard):
        return
    from gmmtorch.report import Board, convergence_figure, mixture_figure, save_figure

    figures = {"convergence": convergence_figure(outcome.lower_bounds)}
    for method, mixture in outcome.mixtures.items():
        figures[f"mixture_{method}"] = mixture_figure(
            points, mixture.means, mixture.covariances, mixture.weights
        )
    if config.report.figures:
        for name, figure in figures.items():
            save_figure(figure, folder / f"{name}.png")
    if not config.report.tensorboard:
        return
    with Board(folder / "tensorboard") as board:
        for row in outcome.rows:
            board.scalars(row, str(row["method"]), step=0)
        for method, bounds in outcome.lower_bounds.items():
            for iteration, bound in enumerate(bounds, 1):
                board.scalars({"lower_bound": bound}, method, step=iteration)
        for name, figure in figures.items():
            board.figure(f"figures/{name}", figure)
        board.cloud("points", points)
        for method, mixture in outcome.mixtures.items():
            board.ellipsoids(f"mixture_{method}", mixture.means, mixture.covariances)
        metrics = {f"hparam/log_likelihood_{row['method']}": row["log_likelihood"] for row in outcome.rows}
        board.hparams(common.flat(config), metrics)


if __name__ == "__main__":
    main()
