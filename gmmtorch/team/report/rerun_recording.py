"""Recordings of explorations for the rerun viewer: robots, map and mixture over simulated time."""

from __future__ import annotations

import importlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.colors import to_rgb

from gmmtorch.errors import GmmTorchError, InvalidArgumentError
from gmmtorch.files import write_atomically
from gmmtorch.occupancy import check_resolution
from gmmtorch.optional_packages import needs_extra
from gmmtorch.report import N_SIGMA, as_array, checked_components, colour, height_colours, principal_axes
from gmmtorch.scan import ArrayLike

TIMELINE = "simulated_time"


class RecordedMap(NamedTuple):
    """The map at a time (s): occupied cells, as indices (C, 3) of the lattice, and means (K, 3) and
    covariances (K, 3, 3) of the mixture, metres; either may be empty."""

    time: float
    cells: ArrayLike = ()
    means: ArrayLike = ()
    covariances: ArrayLike = ()


def record_rerun(
    path: str | Path,
    trajectories: Sequence[ArrayLike],
    *,
    period: float = 1.0,
    maps: Sequence[RecordedMap] = (),
    resolution: float = 0.2,
    row: Mapping[str, Any] | None = None,
) -> Path:
    """Writes a recording and returns its path; `rerun FILE` opens it.

    One timeline of simulated seconds shows moving robots, occupied cells, 2σ ellipsoids coloured by height,
    and curves of entropy and bytes.

    Args:
        path: file name that ends in .rrd.
        trajectories: poses (T, ≥ 3) of each robot, world metres.
        period: seconds between poses.
        maps: maps at several times, in any order.
        resolution: side (m) of the maps' cells.
        row: explore row of `results.json` with the curves.

    Raises:
        GmmTorchError: rerun is not installed, or older than 0.23.
        InvalidArgumentError: another suffix, a period that is not positive, or shapes that disagree.
        OutputError: the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".rrd":
        raise InvalidArgumentError(f"path={path} must end in .rrd.")
    if not (math.isfinite(period) and period > 0):
        raise InvalidArgumentError(f"period={period} must be above zero seconds.")
    check_resolution(resolution)
    rerun = load_rerun()

    def write(temporary: Path) -> None:
        with rerun.RecordingStream("gmmtorch_exploration") as stream:
            stream.save(str(temporary))
            stream.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
            for robot, trajectory in enumerate(trajectories):
                _log_robot(rerun, stream, robot, as_array(trajectory), period)
            for recorded in sorted(maps, key=lambda recorded: recorded.time):
                stream.set_time(TIMELINE, duration=float(recorded.time))
                _log_map(rerun, stream, recorded, resolution)
            if row is not None:
                _log_curves(rerun, stream, row)
            stream.flush()
            stream.disconnect()

    return write_atomically(path, write)


def load_rerun() -> Any:
    """Imports rerun. Raises `GmmTorchError` if it is not installed or too old."""
    with needs_extra("The recording for the rerun viewer needs", "rerun-sdk", "viewer"):
        rerun = importlib.import_module("rerun")
    if not hasattr(rerun, "Scalars"):  # was introduced together with set_time(duration=…)
        version = getattr(rerun, "__version__", "unknown")
        raise GmmTorchError(
            f"rerun-sdk {version} is too old for the recording; pip install 'rerun-sdk>=0.23'."
        )
    return rerun


def _log_robot(rerun: Any, stream: Any, robot: int, poses: np.ndarray, period: float) -> None:
    """Logs the whole path, visible at all times, and the robot and its heading at each pose."""
    if poses.ndim != 2 or poses.shape[1] < 3:
        raise InvalidArgumentError(
            f"trajectories[{robot}] has shape {poses.shape}; expected (T, 3) or more, metres."
        )
    name = f"world/robots/{robot}"
    hue = [round(255 * share) for share in to_rgb(colour(robot))]
    if len(poses):
        stream.log(f"{name}/path", rerun.LineStrips3D([poses[:, :3]], colors=[[*hue, 110]]), static=True)
    for i, pose in enumerate(poses):
        stream.set_time(TIMELINE, duration=i * period)
        stream.log(name, rerun.Points3D([pose[:3]], colors=[hue], radii=[0.3]))
        if len(pose) > 3:
            ahead = [math.cos(pose[3]), math.sin(pose[3]), 0.0]
            stream.log(f"{name}/heading", rerun.Arrows3D(origins=[pose[:3]], vectors=[ahead], colors=[hue]))


def _log_map(rerun: Any, stream: Any, recorded: RecordedMap, resolution: float) -> None:
    from scipy.spatial.transform import Rotation

    cells = as_array(recorded.cells).reshape(-1, 3)
    centres = (cells + 0.5) * resolution
    half = np.full((len(cells), 3), resolution / 2)
    boxes = rerun.Boxes3D(centers=centres, half_sizes=half, colors=_shades(centres))
    stream.log("world/cells", boxes)
    means, covariances = checked_components(
        torch.as_tensor(recorded.means).reshape(-1, 3),
        torch.as_tensor(recorded.covariances).reshape(-1, 3, 3),
    )
    deviations, directions = principal_axes(covariances.cpu())
    ellipsoids = rerun.Ellipsoids3D(
        centers=means.cpu().numpy(),
        half_sizes=(N_SIGMA * deviations).numpy(),
        quaternions=Rotation.from_matrix(directions.numpy()).as_quat() if len(means) else np.empty((0, 4)),
        colors=_shades(means.cpu().numpy()),
        fill_mode="solid",
    )
    stream.log("world/mixture", ellipsoids)


def _shades(centres: np.ndarray) -> np.ndarray:
    """Returns the colours of heights (K, 3), 0 to 255, of centres (K, 3)."""
    return (255 * height_colours(torch.from_numpy(centres[:, 2])).numpy()).astype(np.uint8)


def _log_curves(rerun: Any, stream: Any, row: Mapping[str, Any]) -> None:
    observable = max(float(row["observable_bits"]), 1.0)
    for i, time in enumerate(row["times"]):
        stream.set_time(TIMELINE, duration=float(time))
        stream.log("entropy_left", rerun.Scalars(row["entropy_bits"][i] / observable))
        if row.get("bytes_over_time"):
            stream.log("bytes_sent", rerun.Scalars(float(row["bytes_over_time"][i])))
