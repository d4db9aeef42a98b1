"""Reading point cloud files with Open3D, imported only when a file is read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError, GmmTorchError

_HEADER_BYTES = 4096


def read_cloud(path: Path) -> Tensor:
    """Points (N, 3), float64, of a PCD or PLY file, NaN rows included.

    Raises `DataError` if the file is unreadable.
    """
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise GmmTorchError(
            f"{path} cannot be read, because Open3D does not load: {error}. On Debian or Ubuntu install "
            "libusb-1.0-0 libgl1 libegl1 libx11-6 libudev1 libgomp1 (scripts/setup.sh does it)."
        ) from error
    expected = _announced_points(path)
    try:
        with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
            cloud = open3d.t.io.read_point_cloud(path)
            points = cloud.point.positions.numpy() if "positions" in cloud.point else np.empty((0, 3))
    except (RuntimeError, KeyError) as error:
        raise DataError(f"{path} cannot be read as a point cloud: {error}") from error
    if points.shape[0] != expected:
        raise DataError(
            f"{path} announces {expected} points, but {points.shape[0]} could be read; the file is "
            "truncated or not a point cloud. Write it again."
        )
    return torch.from_numpy(points.astype(np.float64))


def pcd_header(path: Path) -> dict[str, list[str]]:
    """Header fields of a PCD file, such as {"VIEWPOINT": ["0", "0", "0", "1", "0", "0", "0"]}."""
    fields: dict[str, list[str]] = {}
    with path.open("rb") as file:
        head = file.read(_HEADER_BYTES)
    for line in head.decode("ascii", errors="replace").splitlines():
        words = line.split()
        if words and not words[0].startswith("#"):
            fields[words[0]] = words[1:]
            if words[0] == "DATA":
                return fields
    raise DataError(f"{path} has no PCD header (no DATA line); it is not a PCD file.")


def _announced_points(path: Path) -> int:
    """How many points the header promises, so that a short read does not pass unnoticed."""
    if path.suffix == ".pcd":
        count = pcd_header(path).get("POINTS", [])
    else:
        with path.open("rb") as file:
            lines = file.read(_HEADER_BYTES).decode("ascii", errors="replace").splitlines()
        if not lines or lines[0].strip() != "ply":
            raise DataError(f"{path} does not start with 'ply'; it is not a PLY file.")
        count = next((line.split()[2:] for line in lines if line.startswith("element vertex")), [])
    if not count or not count[0].isdigit():
        raise DataError(f"{path} does not say how many points it holds; it is damaged.")
    return int(count[0])
