"""gmmtorch-fit: learns a Gaussian mixture from the points of scans, scores it and draws it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from gmmtorch.cli import app, common, fit_stream
from gmmtorch.cli.from_options.fit_data import fit_data
from gmmtorch.cli.options.structured import build
from gmmtorch.cli.studies import fit_studies, study
from gmmtorch.mixture.reduction.prune_options import PruneOptions

if TYPE_CHECKING:
    from torch import Tensor

    from gmmtorch.evaluation.events import Event, Row
    from gmmtorch.evaluation.fits.fit_comparison import FitOutcome

TABLE = (
    "method n_components n_components_used seconds n_iterations log_likelihood held_out_log_likelihood "
    "psnr2_db held_out_psnr2_db nbytes"
)


def main() -> None:
    """Entry point of the command."""
    with fit_stream.quiet_worker():
        app.start("fit", run)


def run(config: DictConfig) -> float | None:
    """Run the command; returns `common.log_likelihood` of the last row, which a sweep can optimize."""
    from gmmtorch.report.progress import ProgressBars

    if fit_stream.is_wanted(config):
        return _run_streamed(config)
    device = common.set_up(config)
    folder = common.run_dir()
    with ProgressBars(enabled=config.report.progress) as bars:
        if config.study is None:
            rows = _compare(config, device, folder, bars)
        else:
            rows = study.run("fit", fit_studies.STUDIES, config, device, folder, bars)
    common.print_files(folder, folder / "results.json")
    return common.log_likelihood(rows[-1])


def _run_streamed(config: DictConfig) -> float | None:
    """The same for a streamed fit; returns None in workers."""
    from gmmtorch.evaluation.fits.fit_comparison import FitOutcome

    folder = common.run_dir()
    streamed = fit_stream.run(config, folder)
    if streamed is None:
        return None
    row, mixture, sample = streamed
    _show(config, sample.train, FitOutcome([row], {"em": mixture}, {"em": mixture.lower_bounds_}), folder)
    common.print_table([row], TABLE.split(), f"{sample.dataset}: {row['n_points']:,} points")
    common.print_files(folder, folder / "results.json")
    return common.log_likelihood(row)


def _compare(config: DictConfig, device: str, folder: Path, on_event: Event) -> list[Row]:
    """A row for each method; saves and draws every mixture."""
    from gmmtorch.evaluation.fits.fit_comparison import compare

    data = fit_data(config, device, on_event)
    outcome = compare(
        data,
        list(config.method),
        common.fit_options(config),
        config.seed,
        on_event,
        lambda rows: common.write_results("fit", config, rows, folder),
        common.as_options(config.method_options),
        build(PruneOptions, common.as_options(config.mixture), "mixture"),
    )
    for method, mixture in outcome.mixtures.items():
        mixture.save(folder / f"{method}.safetensors")
    _show(config, data.train, outcome, folder)
    common.print_table(outcome.rows, TABLE.split(), common.headline(outcome.rows))
    return outcome.rows


def _show(config: DictConfig, points: Tensor, outcome: FitOutcome, folder: Path) -> None:
    """Write the figures as PNG, and figures and numbers to TensorBoard."""
    if not (config.report.figures or config.report.tensorboard):
        return
    from gmmtorch.evaluation.fits.fit_comparison import NO_LIKELIHOODS, in_use
    from gmmtorch.report.maps.accuracy_figures import comparison_figure, convergence_figure
    from gmmtorch.report.scenes.mixture_figures import mixture_figure
    from gmmtorch.report.style import label_of
    from gmmtorch.report.tensorboard_writer import Board

    likelihoods = {name: b for name, b in outcome.lower_bounds.items() if name not in NO_LIKELIHOODS}
    figures = {"convergence": convergence_figure(likelihoods)}
    if len(outcome.rows) > 1:
        figures["comparison"] = comparison_figure(outcome.rows)
    for method, mixture in outcome.mixtures.items():
        used = in_use(mixture, points)  # the positions of unused components are arbitrary
        figures[f"mixture_{method}"] = mixture_figure(
            points,
            mixture.means[used],
            mixture.covariances[used],
            mixture.weights[used],
            title=f"Gaussian mixture by {label_of(method)}",
        )
    common.save_figures(config, figures, folder)
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
            used = in_use(mixture, points)
            board.ellipsoids(f"mixture_{method}", mixture.means[used], mixture.covariances[used])
        metrics = {f"log_likelihood_{row['method']}": row["log_likelihood"] for row in outcome.rows}
        board.hparams(common.chosen_options(config), metrics)


if __name__ == "__main__":
    main()
