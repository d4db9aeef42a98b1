"""gmmtorch-localize: the pose of each scan of a recording in a saved map."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig, ListConfig

from gmmtorch.cli import app, common
from gmmtorch.cli.from_options import maps
from gmmtorch.cli.reporting import localization_outputs

if TYPE_CHECKING:
    from torch import Tensor

    from gmmtorch.datasets import Dataset
    from gmmtorch.localization import Tracker
    from gmmtorch.localization.scan_locations import ScanLocation
    from gmmtorch.report.progress import ProgressBars

_STAGE = "localising"
_FORMS = {2: "[x,y,yaw]", 3: "[x,y,z,yaw] or [x,y,z,qx,qy,qz,qw]"}
TABLE = "dataset n_scans n_found n_lost_runs ate rpe ate_degrees deviation scans_per_second"


def main() -> None:
    """Entry point of the command."""
    sys.argv[1:] = overrides(sys.argv[1:])
    app.start("localize", run)


def overrides(words: Sequence[str]) -> list[str]:
    """The arguments as Hydra's overrides: map=FILE becomes map.path=FILE."""
    return [f"map.path={word.removeprefix('map=')}" if word.startswith("map=") else word for word in words]


def run(config: DictConfig) -> None:
    """Run the command."""
    from gmmtorch.errors import InvalidArgumentError, check_choice
    from gmmtorch.evaluation.trajectories import ALIGNMENTS
    from gmmtorch.report.progress import ProgressBars

    if not config.map.path:
        raise InvalidArgumentError("map is not set; give map=FILE, a map file or a run directory.")
    check_choice("motion", config.motion, ("constant", "dataset"))
    check_choice("align", config.align, ALIGNMENTS)
    common.use_runtime(config.runtime)
    folder = common.run_dir()
    built = maps.open_map(Path(config.map.path).expanduser(), config.runtime, config.map.bounds)
    dataset = common.open_dataset(config.dataset)
    truth = localization_outputs.true_poses(config, dataset, built.dim or 3)
    with common.naming({"surfaces": "map", "points": "dataset"}):
        from gmmtorch.localization import Tracker

        tracker = Tracker(
            built,
            first_pose(config, dataset, built.dim or 3),
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
    common.print_files(folder, folder / "results.json")


def _locate(config: DictConfig, dataset: Dataset, tracker: Tracker, bars: ProgressBars) -> list[ScanLocation]:
    """The locations of all scans."""
    from gmmtorch.errors import InvalidArgumentError
    from gmmtorch.localization.scan_locations import locate_scans

    if len(dataset) and dataset[0].dim != tracker.dim:
        raise InvalidArgumentError(
            f"map={config.map.path} is {tracker.dim}D, and the scans of {dataset.name} are "
            f"{dataset[0].dim}D; give a map of scans of the same kind."
        )
    located = []
    for scan in locate_scans(dataset, tracker, config.motion == "dataset"):
        located.append(scan)
        bars(_STAGE, len(located), len(dataset))
        n_found = sum(one.location.found for one in located)
        bars.note(_STAGE, f"{n_found:,} found, now {', '.join(scan.location.doubts) or 'found'}"[:80])
    return located


def first_pose(config: DictConfig, dataset: Dataset, dim: int) -> Tensor | None:
    """The first pose (D+1, D+1), map ← sensor, of the option `pose`; None: unknown."""
    import numpy as np
    import torch

    from gmmtorch.datasets.recordings.trajectory import in_plane, pose_matrix
    from gmmtorch.errors import InvalidArgumentError

    given = config.pose
    if given is None or given == "dataset":
        known = None if given is None else dataset.pose(0)
        if given is not None and known is None:
            raise InvalidArgumentError(
                f"pose=dataset, but {dataset.name} has no poses; give pose={_FORMS[dim]}."
            )
        return known
    numbers = list(given) if isinstance(given, ListConfig) else []
    try:
        values = np.array([float(value) for value in numbers])
        if len(values) not in {2: (3,), 3: (4, 7)}[dim]:
            raise ValueError
        position = np.zeros(3)
        position[:dim] = values[:dim]
        yaw = values[dim]
        spin = values[3:] if len(values) == 7 else np.array([0, 0, math.sin(yaw / 2), math.cos(yaw / 2)])
        matrix = pose_matrix(position, spin)
    except (TypeError, ValueError) as error:
        raise InvalidArgumentError(
            f"pose={given} is not a pose in a {dim}D map; give {_FORMS[dim]} (m, rad), dataset or null."
        ) from error
    return torch.from_numpy(matrix if dim == 3 else in_plane(matrix[None])[0])


if __name__ == "__main__":
    main()
