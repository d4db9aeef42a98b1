"""gmmtorch-localize: the pose of each scan of a recording in a saved map."""

from __future__ import annotations

import functools
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import MISSING, DictConfig

from gmmtorch.cli import app, common, schema
from gmmtorch.cli.view import BOUNDS
from gmmtorch.declarations import group, option
from gmmtorch.errors import InvalidArgumentError, check_choice
from gmmtorch.report import ProgressBars

if TYPE_CHECKING:
    from gmmtorch.datasets import Dataset
    from gmmtorch.localization import ScanLocation, Tracker

_STAGE = "localising"
TABLE = "dataset n_scans n_found n_lost_runs ate rpe ate_degrees deviation scans_per_second"


@dataclass
class LocalizeOptions:
    """Options of gmmtorch-localize."""

    dataset: Any = option(MISSING, "where the scans come from")
    map_path: str | None = option(
        None,
        "map file, run directory of gmmtorch-map, or folder of tiles; map=FILE is short for it",
        name="map.path",
    )
    bounds: list[float] | None = option(None, BOUNDS)
    pose: Any = option(
        None,
        "first pose, [x,y,yaw], in 3D [x,y,z,yaw] or [x,y,z,qx,qy,qz,qw] (m, rad), within 0.5 m and 0.175 "
        "rad; dataset: that of the data set; null: unknown, the whole map is searched",
    )
    motion: str = option(
        "constant",
        "constant: as between the last two scans; dataset: as between the poses of the data set, such as an "
        "odometry's; imu: with the rotation of the IMU of a ROS bag",
    )
    least_explained: float = option(
        0.9, "share of the points that must lie on surfaces of the map; less where much has changed"
    )
    truth: str | None = option(
        "none", "true poses in the frame of the map, for scores: dataset, none, or a TUM or KITTI file"
    )
    report: common.Report = group(common.Report)
    runtime: common.Memory = group(common.Memory)


@functools.cache
def register() -> None:
    """Stores the options of the command."""
    schema.register()
    schema.store({"localize": schema.schema_of(LocalizeOptions)})


def main() -> None:
    """Entry point of the command."""
    sys.argv[1:] = overrides(sys.argv[1:])
    app.start("localize", run, register)


def overrides(words: Sequence[str]) -> list[str]:
    """The arguments as Hydra's overrides: map=FILE becomes map.path=FILE, because map is a group."""
    return [f"map.path={word.removeprefix('map=')}" if word.startswith("map=") else word for word in words]


def run(config: DictConfig) -> None:
    """Run the command."""
    from gmmtorch.cli import inputs
    from gmmtorch.cli.reporting import localization_outputs
    from gmmtorch.localization import MOTIONS, Tracker

    if not config.map.path:
        raise InvalidArgumentError("map is not set; give map=FILE, a map file or a run directory.")
    check_choice("motion", config.motion, MOTIONS)
    common.use_runtime(config.runtime)
    folder = common.run_dir()
    built = inputs.open_map(Path(config.map.path).expanduser(), config.runtime, config.bounds)
    dataset = inputs.open_dataset(config.dataset)
    truth = localization_outputs.true_poses(config, dataset, built.dim or 3)
    with schema.naming({"surfaces": "map", "points": "dataset"}):
        tracker = Tracker(
            built,
            localization_outputs.first_pose(config, dataset, built.dim or 3),
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
