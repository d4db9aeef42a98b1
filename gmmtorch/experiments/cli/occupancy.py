"""gmmtorch-occupancy: learns maps from scans, scores them on held-out scans and draws them."""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig

from gmmtorch.cli import print_files, print_table, run_dir, set_up, start, write_results
from gmmtorch.errors import check_whole
from gmmtorch.events import Event, Row
from gmmtorch.experiments.cli import experiment_schema
from gmmtorch.report import ProgressBars

TABLE = (
    "method resolution kept auc auc_low auc_high ece log_loss_bits accuracy n_components nbytes "
    "build_seconds query_seconds"
)


def main() -> None:
    """Entry point of the command."""
    start("occupancy", run, experiment_schema.register)


def run(config: DictConfig) -> float | None:
    """Run the command; returns the AUC of the last row, which a sweep can optimize."""
    from gmmtorch.experiments.cli import studies

    device = set_up(config)
    folder = run_dir()
    with ProgressBars(enabled=config.report.progress) as bars:
        if config.study is None:
            rows = _compare(config, device, folder, bars)
        else:
            rows = studies.run("occupancy", config, device, folder, bars)
    print_files(folder)
    return rows[-1].get("auc")


def _compare(config: DictConfig, device: str, folder: Path, on_event: Event) -> list[Row]:
    """A row for each method, share kept and resolution."""
    from gmmtorch.cli import all_scans
    from gmmtorch.experiments.cli import methods_of_options, occupancy_outputs
    from gmmtorch.experiments.evaluation import choose, evaluate

    check_whole("report.magnify", config.report.magnify, 0)
    factories = choose(list(config.method), methods_of_options.known_methods(config))
    protocol = methods_of_options.protocol_of(config)
    methods_of_options.check_factories(factories, protocol.resolution[0])
    name, scans = all_scans(config, device, on_event)
    outcome = evaluate(
        name,
        scans,
        factories,
        protocol,
        config.seed,
        on_event,
        # Rows are written one by one, so that a run that fails late keeps them.
        lambda rows: write_results("occupancy", config, rows, folder),
    )
    occupancy_outputs.draw(config, scans, outcome, folder)
    print_table(outcome.rows, TABLE.split(), f"{name}: {len(scans)} scans")
    return outcome.rows


if __name__ == "__main__":
    main()
