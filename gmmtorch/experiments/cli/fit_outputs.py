"""The outputs of gmmtorch-fit: title and score of its rows, and figures as PNG and in TensorBoard."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig
from torch import Tensor

from gmmtorch.cli import chosen_options, show
from gmmtorch.experiments.evaluation import NO_LIKELIHOODS, FitOutcome, in_use
from gmmtorch.report import Row

if TYPE_CHECKING:
    from gmmtorch.report import Board


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

        likelihoods = {name: b for name, b in outcome.lower_bounds.items() if name not in NO_LIKELIHOODS}
        found = {"convergence": convergence_figure(likelihoods)}
        if len(outcome.rows) > 1:
            found["comparison"] = comparison_figure(outcome.rows)
        for method, mixture in outcome.mixtures.items():
            used = in_use(mixture, points)  # the positions of unused components are arbitrary
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
        for method, bounds in outcome.lower_bounds.items():
            for iteration, bound in enumerate(bounds, 1):
                board.scalars({"lower_bound": bound}, method, step=iteration)
        board.cloud("points", points)
        for method, mixture in outcome.mixtures.items():
            used = in_use(mixture, points)
            board.ellipsoids(f"mixture_{method}", mixture.means[used], mixture.covariances[used])
        metrics = {f"log_likelihood_{row['method']}": row["log_likelihood"] for row in outcome.rows}
        board.hparams(chosen_options(config), metrics)

    show(config, folder, figures, write)
