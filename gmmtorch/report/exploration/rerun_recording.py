"""A recording of an exploration for the rerun viewer: robots, map and mixture over simulated time."""

from __future__ import annotations

import importlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.colors import to_rgb
from torch import Tensor

from gmmtorch.errors import GmmTorchError, InvalidArgumentError
from gmmtorch.files import write_atomically
from gmmtorch.occupancy.grid import check_resolution
from gmmtorch.report.maps.mesh_figures import checked_components, height_colors
from gmmtorch.report.style import as_array, colour
from gmmtorch.scan import ArrayLike

TIMELINE = "simulated_time"

_N_SIGMA = 2.0


class RecordedMap(NamedTuple):
    """What was known at a time (s): occupied cells, as indices (C, 3) of the lattice, and the mixture's means
    (K, 3) and covariances (K, 3, 3), metres; either may be empty."""

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
    """Write a recording, and return its path: open it with `rerun FILE`.

    Robots move along their paths, occupied cells and 2σ ellipsoids (coloured by height) follow as they were,
    and the curves of entropy and bytes beside them, all on one timeline of simulated seconds.

    Args:
        path: of the file, which ends in .rrd.
        trajectories: of each robot, poses (T, ≥ 3), world metres.
        period: seconds between poses.
        maps: at some times, in any order.
        resolution: side (m) of the maps' cells.
        row: an explore row of `results.json`, for the curves.

    Raises:
        GmmTorchError: rerun is not installed, or older than 0.23.
        InvalidArgumentError: another suffix, a period that is not above zero, or shapes that disagree.
        OutputError: the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".rrd":
        raise InvalidArgumentError(f"path={path} must end in .rrd.")
    if not (math.isfinite(period) and period > 0):
        raise InvalidArgumentError(f"period={period} must be above zero seconds.")
    check_resolution(resolution)
    rerun = load_rerun()
    return write_atomically(
        path, lambda temporary: _write(rerun, temporary, trajectories, period, maps, resolution, row)
    )


def load_rerun() -> Any:
    """The library that recordings are written with. Raises `GmmTorchError` if it is not there, or too old."""
    try:
        rerun = importlib.import_module("rerun")
    except ImportError as error:
        raise GmmTorchError(
            f"The recording for the rerun viewer needs rerun-sdk, which does not load ({error}); "
            "pip install 'rerun-sdk>=0.23'."
        ) from error
    if not hasattr(rerun, "Scalars"):  # came with the present way to set times
        version = getattr(rerun, "__version__", "unknown")
        raise GmmTorchError(
            f"rerun-sdk {version} is too old for the recording; pip install 'rerun-sdk>=0.23'."
        )
    return rerun


def _write(
    rerun: Any,
    path: Path,
    trajectories: Sequence[ArrayLike],
    period: float,
    maps: Sequence[RecordedMap],
    resolution: float,
    row: Mapping[str, Any] | None,
) -> None:
    with rerun.RecordingStream("gmmtorch_exploration") as stream:
        stream.save(str(path))
        stream.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for robot, trajectory in enumerate(trajectories):
            _log_robot(rerun, stream, robot, as_array(trajectory), period)
        for known in sorted(maps, key=lambda known: known.time):
            stream.set_time(TIMELINE, duration=float(known.time))
            _log_map(rerun, stream, known, resolution)
        if row is not None:
            _log_curves(rerun, stream, row)
        stream.flush()
        stream.disconnect()


def _log_robot(rerun: Any, stream: Any, robot: int, poses: np.ndarray, period: float) -> None:
    """The whole path, faintly and at all times; the robot and its heading at each."""
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


def _log_map(rerun: Any, stream: Any, known: RecordedMap, resolution: float) -> None:
    cells = as_array(known.cells).reshape(-1, 3)
    centres = torch.from_numpy((cells + 0.5) * resolution)
    half = np.full((len(cells), 3), resolution / 2)
    shades = height_colors(centres[:, 2]).numpy()
    stream.log("world/cells", rerun.Boxes3D(centers=centres.numpy(), half_sizes=half, colors=shades))
    means, covariances = checked_components(
        torch.as_tensor(known.means).reshape(-1, 3), torch.as_tensor(known.covariances).reshape(-1, 3, 3)
    )
    sizes, turns = _ellipsoids(covariances.cpu())
    stream.log(
        "world/mixture",
        rerun.Ellipsoids3D(
            centers=means.cpu().numpy(),
            half_sizes=sizes,
            quaternions=turns,
            colors=height_colors(means[:, 2]).numpy(),
            fill_mode="solid",
        ),
    )


def _ellipsoids(covariances: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Half axes (K, 3), metres, and the quaternions (K, 4), x y z w, that turn them."""
    from scipy.spatial.transform import Rotation

    if len(covariances) == 0:
        return np.empty((0, 3)), np.empty((0, 4))
    variances, directions = torch.linalg.eigh((covariances + covariances.mT) / 2)
    flip = torch.where(torch.linalg.det(directions) < 0, -1.0, 1.0)
    turns = Rotation.from_matrix((directions * flip[:, None, None]).numpy()).as_quat()
    return (_N_SIGMA * variances.clamp_min(0).sqrt()).numpy(), turns


def _log_curves(rerun: Any, stream: Any, row: Mapping[str, Any]) -> None:
    observable = max(float(row["observable_bits"]), 1.0)
    for i, time in enumerate(row["times"]):
        stream.set_time(TIMELINE, duration=float(time))
        stream.log("entropy_left", rerun.Scalars(row["entropy_bits"][i] / observable))
        if row.get("bytes_over_time"):
            stream.log("bytes_sent", rerun.Scalars(float(row["bytes_over_time"][i])))
