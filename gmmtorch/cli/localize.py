"""gmmtorch-localize: the pose of each scan of a recording in a saved map."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from gmmtorch.cli import app, common
from gmmtorch.cli.options import schema
from gmmtorch.errors import InvalidArgumentError, check_choice
from gmmtorch.report import ProgressBars

if TYPE_CHECKING:
    from gmmtorch.datasets import Dataset
    from gmmtorch.localization import ScanLocation, Tracker

_STAGE = "localising"
TABLE = "dataset n_scans n_found n_lost_runs ate rpe ate_degrees deviation scans_per_second"


def main() -> None:
    """Entry point of the command."""
    sys.argv[1:] = overrides(sys.argv[1:])
    app.start("localize", run, schema.register)


def overrides(words: Sequence[str]) -> list[str]:
    """The arguments as Hydra's overrides: map=FILE becomes map.path=FILE."""
    return [f"map.path={word.removeprefix('map=')}" if word.startswith("map=") else word for word in words]


def run(config: DictConfig) -> None:
    """Run the command."""
    from gmmtorch.cli.from_options import maps
    from gmmtorch.cli.from_options.scans import open_dataset
    from gmmtorch.cli.reporting import localization_outputs
    from gmmtorch.localization import ALIGNMENTS, MOTIONS, Tracker

    if not config.map.path:
        raise InvalidArgumentError("map is not set; give map=FILE, a map file or a run directory.")
    check_choice("motion", config.motion, MOTIONS)
    check_choice("align", config.align, ALIGNMENTS)
    common.use_runtime(config.runtime)
    folder = common.run_dir()
    built = maps.open_map(Path(config.map.path).expanduser(), config.runtime, config.map.bounds)
    dataset = open_dataset(config.dataset)
    truth = localization_outputs.true_poses(config, dataset, built.dim or 3)
    with common.naming({"surfaces": "map", "points": "dataset"}):
        tracker = Tracker(
            built,
            localization_outputs.first_pose(config, dataset, built.dim or 3),
            distance=config.distance,
            angle=config.angle,
            n_points=config.n_points,
            least_explained=config.least_explained,
        )
        with ProgressBars(enabled=config.report.progress) as bars:
            located = _locate(config, dataset, tracker, bars)
    row = localization_outputs.result_row(config, dataset, located, truth)
    localization_outputs.write(config, built, located, truth, row, folder)
    common.write_results("localize", config, [row], folder)
    common.print_table([row], TABLE.split(), f"{dataset.name} in {config.map.path}")
    for message in row["messages"]:
        print(message)
    print(f"\ntrajectory  {folder}/{{{localization_outputs.FOUND}, {localization_outputs.ALL}}}")
    common.print_files(folder)


def _locate(config: DictConfig, dataset: Dataset, tracker: Tracker, bars: ProgressBars) -> list[ScanLocation]:
    """The locations of all scans."""
    from gmmtorch.localization import locate_scans

    if len(dataset) and dataset[0].dim != tracker.dim:
        raise InvalidArgumentError(
            f"map={config.map.path} is {tracker.dim}D, and the scans of {dataset.name} are "
            f"{dataset[0].dim}D; give a map of scans of the same kind."
        )
    located = []
    turns = dataset.turns() if config.motion == "imu" else None
    for scan in locate_scans(dataset, tracker, config.motion == "dataset", turns):
        located.append(scan)
        bars(_STAGE, len(located), len(dataset))
        n_found = sum(one.location.found for one in located)
        bars.note(_STAGE, f"{n_found:,} found, now {', '.join(scan.location.doubts) or 'found'}"[:80])
    return located


if __name__ == "__main__":
    main()
